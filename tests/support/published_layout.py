"""State dicts in the layout of the published checkpoints, of any size, with seeded random weights.

Names are those of the authors' classes. ``tests/integration/test_convert_published.py`` checks them against
the dumps of those classes where the reference data is there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

# Run folders, named as the authors name them in short.
RVQ, MASKED, RESIDUAL = "rvq_nq6", "t2m_nlayer8", "tres_nlayer8"
JOINTS, PELVIS, LENGTH = "z_CtrlNet_cross", "z_CtrlNet_pelvis", "length_estimator"

Shapes = dict[str, tuple[int, ...]]


@dataclass(frozen=True)
class Sizes:
    """Sizes of a published model; the defaults are the published ones."""

    features: int = 263
    codes: int = 512
    code_dim: int = 512
    quantizers: int = 6
    conv_width: int = 512
    depth: int = 3
    width: int = 384
    layers: int = 8
    feedforward: int = 1024
    text: int = 512
    joints: int = 6  # of the control signal
    positions: int = 5000


PAPER = Sizes()
SMALL = Sizes(
    codes=32,
    code_dim=16,
    quantizers=4,
    conv_width=16,
    depth=2,
    width=24,
    layers=2,
    feedforward=32,
    positions=60,
)
SMALL_KIT = replace(SMALL, features=251)


def rvq_shapes(size: Sizes) -> Shapes:
    """Names and shapes of the tokenizer."""
    shapes = encoder_shapes("encoder", size.features, size.code_dim, size)
    wide = size.conv_width
    shapes |= _conv("decoder.model.0", size.code_dim, wide, 3)
    for stage in (2, 3):
        shapes |= _stack(f"decoder.model.{stage}.0", size)
        shapes |= _conv(f"decoder.model.{stage}.2", wide, wide, 3)
    shapes |= _conv("decoder.model.4", wide, wide, 3) | _conv("decoder.model.6", wide, size.features, 3)
    books = {f"quantizer.layers.{q}.codebook": (size.codes, size.code_dim) for q in range(size.quantizers)}
    return shapes | books


def encoder_shapes(name: str, in_dim: int, out_dim: int, size: Sizes) -> Shapes:
    """Names and shapes of a convolutional encoder."""
    wide = size.conv_width
    shapes = _conv(f"{name}.model.0", in_dim, wide, 3)
    for stage in (2, 3):
        shapes |= _conv(f"{name}.model.{stage}.0", wide, wide, 4)
        shapes |= _stack(f"{name}.model.{stage}.1", size)
    return shapes | _conv(f"{name}.model.4", wide, out_dim, 3)


def masked_shapes(size: Sizes) -> Shapes:
    """Names and shapes of the masked transformer."""
    return {**_transformer(size, size.codes), "token_emb.weight": (size.codes + 2, size.code_dim)}


def residual_shapes(size: Sizes) -> Shapes:
    """Names and shapes of the residual transformer with shared tables."""
    rows, dim = size.codes + 1, size.code_dim
    tables = {
        "embed_proj_shared_weight": (size.quantizers - 2, rows, dim),
        "token_embed_weight_": (1, rows, dim),
        "output_proj_weight_": (1, rows, dim),
    }
    return tables | _transformer(size, dim) | _linear("quant_emb", size.quantizers, size.width)


def control_shapes(size: Sizes) -> Shapes:
    """Names and shapes of a control checkpoint: base, branch and a copy of the tokenizer."""
    shapes = masked_shapes(size) | _linear("first_zero_linear", size.width, size.width)
    for layer in range(size.layers):
        shapes |= _linear(f"mid_zero_linear.{layer}", size.width, size.width)
    shapes |= _trunk("seqTransEncoder_control", size)
    shapes |= encoder_shapes("encoder_control", 6 * size.joints, size.width, size)
    return shapes | {f"vq_model.{name}": shape for name, shape in rvq_shapes(size).items()}


def length_shapes(size: Sizes) -> Shapes:
    """Names and shapes of the length estimator."""
    shapes: Shapes = {}
    for index, (wide_in, wide_out) in zip(
        (0, 4, 8, 11), ((size.text, 512), (512, 256), (256, 128), (128, 50)), strict=True
    ):
        shapes |= _linear(f"output.{index}", wide_in, wide_out)
        if index < 11:
            shapes |= _norm(f"output.{index + 1}", wide_out)
    return shapes


def random_state(shapes: Shapes, seed: int) -> dict[str, torch.Tensor]:
    """Seeded weights: fan-in scaled matrices and kernels, small biases, norms near one, unit codes."""
    generator = torch.Generator().manual_seed(seed)
    state = {}
    for name, shape in shapes.items():
        noise = torch.randn(shape, generator=generator)
        if name.endswith(("codebook", "position_enc.pe")):
            state[name] = noise
        elif len(shape) == 1:
            is_gain = name.endswith("weight")
            state[name] = 0.1 * noise + (1.0 if is_gain else 0.0)
        else:
            state[name] = noise / np.sqrt(np.prod(shape[1:]))
    return state


def write_published(root: Path, size: Sizes, *, leave_out: Sequence[str] = ()) -> Path:
    """The authors' folder with random weights, in the published form: opt.txt, meta, torch-save files."""
    tokenizer = random_state(rvq_shapes(size), seed=1)
    common = {"n_heads": 6, "n_layers": size.layers, "lr": 0.0002, "milestones": "[50000]", "max_epoch": 500}
    writers = {
        RVQ: lambda run: write_run(
            run,
            "net_best_fid.tar",
            {"vq_model": tokenizer, "ep": 40},
            {"mu": 0.99, "vq_act": "relu", "vq_norm": "None", "quantize_dropout_prob": 0.2},
        ),
        MASKED: lambda run: write_run(
            run, "latest.tar", {"t2m_transformer": random_state(masked_shapes(size), seed=2)}, common
        ),
        RESIDUAL: lambda run: write_run(
            run,
            "net_best_fid.tar",
            {"res_transformer": random_state(residual_shapes(size), seed=3)},
            common | {"cond_drop_prob": 0.2, "share_weight": True},
        ),
        JOINTS: lambda run: write_run(
            run, "latest.tar", {"ct2m_transformer": _control_state(size, tokenizer), "ep": 9}, common
        ),
        PELVIS: lambda run: write_run(
            run,
            "latest.tar",
            {"ct2m_transformer": _control_state(replace(size, joints=1), tokenizer)},
            common | {"control": "trajectory"},
        ),
        LENGTH: lambda run: write_run(
            run, "finest.tar", {"estimator": random_state(length_shapes(size), seed=4), "epoch": 7}
        ),
    }
    for name, write in writers.items():
        if name not in leave_out:
            write(root / name)
    if RVQ not in leave_out:
        write_statistics(root / RVQ, size.features)
    return root


def _control_state(size: Sizes, tokenizer: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    state = random_state(control_shapes(size), seed=5)
    return state | {f"vq_model.{name}": tensor for name, tensor in tokenizer.items()}


def write_run(folder: Path, file: str, checkpoint: dict, options: dict[str, object] | None = None) -> Path:
    """A published run folder: ``model/FILE`` and, with options, ``opt.txt``. Returns the folder."""
    (folder / "model").mkdir(parents=True, exist_ok=True)
    torch.save(checkpoint, folder / "model" / file)
    if options is not None:
        lines = [f"{key}: {value}" for key, value in sorted(options.items())]
        (folder / "opt.txt").write_text(
            "\n".join(["------------ Options -------------", *lines, "-------------- End ----------------"])
        )
    return folder


def write_statistics(run: Path, features: int) -> None:
    """``meta/mean.npy`` and ``meta/std.npy`` of plausible size: a pelvis at 0.9 m, small velocities."""
    random = np.random.default_rng(0)
    mean, std = random.normal(0, 0.01, features), random.uniform(0.001, 0.02, features)
    mean[3] = 0.9
    (run / "meta").mkdir(parents=True, exist_ok=True)
    np.save(run / "meta" / "mean.npy", mean)
    np.save(run / "meta" / "std.npy", std)


def _transformer(size: Sizes, out_dim: int) -> Shapes:
    width = size.width
    return (
        _linear("input_process.poseEmbedding", size.code_dim, width)
        | {"position_enc.pe": (size.positions, 1, width)}
        | _trunk("seqTransEncoder", size)
        | _linear("cond_emb", size.text, width)
        | _linear("output_process.dense", width, width)
        | _norm("output_process.LayerNorm", width)
        | _linear("output_process.poseFinal", width, out_dim)
    )


def _trunk(name: str, size: Sizes) -> Shapes:
    width, shapes = size.width, {}
    for layer in range(size.layers):
        at = f"{name}.layers.{layer}"
        shapes |= {
            f"{at}.self_attn.in_proj_weight": (3 * width, width),
            f"{at}.self_attn.in_proj_bias": (3 * width,),
        }
        shapes |= _linear(f"{at}.self_attn.out_proj", width, width)
        shapes |= _linear(f"{at}.linear1", width, size.feedforward) | _linear(
            f"{at}.linear2", size.feedforward, width
        )
        shapes |= _norm(f"{at}.norm1", width) | _norm(f"{at}.norm2", width)
    return shapes


def _stack(name: str, size: Sizes) -> Shapes:
    shapes: Shapes = {}
    for block in range(size.depth):
        shapes |= _conv(f"{name}.model.{block}.conv1", size.conv_width, size.conv_width, 3)
        shapes |= _conv(f"{name}.model.{block}.conv2", size.conv_width, size.conv_width, 1)
    return shapes


def _conv(name: str, in_dim: int, out_dim: int, kernel: int) -> Shapes:
    return {f"{name}.weight": (out_dim, in_dim, kernel), f"{name}.bias": (out_dim,)}


def _linear(name: str, in_dim: int, out_dim: int) -> Shapes:
    return {f"{name}.weight": (out_dim, in_dim), f"{name}.bias": (out_dim,)}


def _norm(name: str, dim: int) -> Shapes:
    return {f"{name}.weight": (dim,), f"{name}.bias": (dim,)}
