"""TLControl's published files with seeded random weights: the authors' names and shapes, any size."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from published_layout import Shapes, Sizes, encoder_shapes, random_state, rvq_shapes

PART_WIDTHS = (7, 60, 48, 48, 50, 50)
TOKENIZER, TRANSFORMER = "best_model_epoch_hml_emaReset.pth", "withEmaReset_stage3.pth"


@dataclass(frozen=True)
class TlSizes:
    """Sizes of a published model; the defaults are the published ones."""

    conv: Sizes = field(default_factory=lambda: Sizes(codes=128, code_dim=128))
    width: int = 512
    layers: int = 4
    feedforward: int = 2048
    head_width: int = 256
    head_layers: int = 3
    head_feedforward: int = 1024
    text: int = 512
    positions: int = 5000


PAPER = TlSizes()
SMALL = TlSizes(
    conv=Sizes(codes=12, code_dim=8, conv_width=16, depth=2),
    width=16,
    layers=2,
    feedforward=24,
    head_width=8,
    head_layers=1,
    head_feedforward=12,
    positions=320,
)


def tokenizer_shapes(size: TlSizes) -> Shapes:
    """Names and shapes of the part-based tokenizer."""
    parts = len(PART_WIDTHS)
    wide = Sizes(**{**vars(size.conv), "code_dim": parts * size.conv.code_dim})
    decoder = {n: s for n, s in rvq_shapes(wide).items() if n.startswith("decoder.")}
    shapes = decoder | {
        f"quantizers.{part}.codebook": (size.conv.codes, size.conv.code_dim) for part in range(parts)
    }
    for part, channels in enumerate(PART_WIDTHS):
        shapes |= encoder_shapes(f"limb_encoders.{part}", channels, size.conv.code_dim, size.conv)
    return {f"vqvae.{name}": shape for name, shape in shapes.items()}


def transformer_shapes(size: TlSizes) -> Shapes:
    """Names and shapes of the trajectory transformer, CLIP left out."""
    shapes = _linear("embed_text", size.text, size.width) | _linear("linear_in", 12, size.width)
    shapes["pos_encoder.pe"] = (size.positions, 1, size.width)
    shapes |= _layers("transformer_encoder", size.layers, size.width, size.feedforward)
    shapes |= _linear("linear_mid_codeIdx", size.width, size.head_width)
    shapes |= _layers("transformer_codeIdx", size.head_layers, size.head_width, size.head_feedforward)
    return shapes | _linear("project_codeIdx", size.head_width, size.conv.codes)


def write_published(root: Path, size: TlSizes) -> Path:
    """Both checkpoints, feature statistics as pickled arrays, trajectory statistics as tensors."""
    root.mkdir(parents=True, exist_ok=True)
    torch.save(random_state(tokenizer_shapes(size), seed=1), root / TOKENIZER)
    clip = {"clip_model.visual.proj": torch.ones(3, 3, dtype=torch.float16)}
    torch.save({**random_state(transformer_shapes(size), seed=2), **clip}, root / TRANSFORMER)
    random = np.random.default_rng(0)
    mean, std = random.normal(0, 0.01, 263), random.uniform(0.001, 0.02, 263)
    mean[3] = 0.9
    for name, values in (("motion_mean", mean), ("motion_std", std)):
        (root / f"{name}.pkl").write_bytes(pickle.dumps(values.astype(np.float32)))
    for name, values in (("traj_mean", (0.1, 0.7, 0.3)), ("traj_std", (0.5, 0.6, 0.9))):
        torch.save(torch.tensor(values), root / f"{name}.pt")
    return root


def _layers(name: str, count: int, width: int, feedforward: int) -> Shapes:
    shapes: Shapes = {}
    for layer in range(count):
        at = f"{name}.layers.{layer}"
        shapes |= {
            f"{at}.self_attn.in_proj_weight": (3 * width, width),
            f"{at}.self_attn.in_proj_bias": (3 * width,),
        }
        shapes |= _linear(f"{at}.self_attn.out_proj", width, width)
        shapes |= _linear(f"{at}.linear1", width, feedforward) | _linear(f"{at}.linear2", feedforward, width)
        for norm in ("norm1", "norm2"):
            shapes |= {f"{at}.{norm}.weight": (width,), f"{at}.{norm}.bias": (width,)}
    return shapes


def _linear(name: str, in_dim: int, out_dim: int) -> Shapes:
    return {f"{name}.weight": (out_dim, in_dim), f"{name}.bias": (out_dim,)}
