"""Published TLControl checkpoints -> one model folder for :class:`TLControl`.

Both checkpoints are bare state dicts; the statistics lie beside the authors' demo.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import torch

from controlmm.convert.momask import IGNORED, codebook_state, decoder_rules, encoder_rules
from controlmm.convert.output_folder import check_free, new_folder
from controlmm.convert.pickled_array import read_vector
from controlmm.convert.renaming import Rule, count_indices, load_strictly, renamed, weight
from controlmm.convert.report import ConversionReport
from controlmm.convert.torch_file import StateDict, as_float32, is_state_dict, read_torch_file
from controlmm.models.part_vq_vae import PartVqVae, PartVqVaeConfig
from controlmm.models.trajectory_transformer import TrajectoryTransformer, TrajectoryTransformerConfig
from controlmm.motion.normalizer import Normalizer
from controlmm.pipelines import folder as files
from controlmm.pipelines.checks import check_tlcontrol_sizes
from controlmm.pipelines.tlcontrol import TLControl

CLIP_DIM = 512  # ViT-B/32, frozen inside the published transformer
_CHECKPOINTS, _STATISTICS = (".pth", ".pt", ".tar"), (".npy", ".pkl", ".pt", ".pth")
_COORDINATES = 3
_PREFIX = "vqvae."
_TRANSFORMER_RULES: tuple[Rule, ...] = (
    (r"embed_text\.(.+)", r"text_proj.\1"),
    (r"linear_in\.(.+)", r"bundle_proj.\1"),
    (r"transformer_encoder\.(layers\..+)", r"\1"),
    (r"linear_mid_codeIdx\.(.+)", r"to_head.\1"),
    (r"transformer_codeIdx\.(layers\..+)", r"head_\1"),
    (r"project_codeIdx\.(.+)", r"to_codes.0.\1"),
)
_IGNORED = (*IGNORED, r"pos_encoder\.pe")


def convert(paths: Sequence[Path], out: Path) -> ConversionReport:
    """Write the model folder ``out`` from published files.

    Args:
        paths: Folders or files: the tokenizer's and the transformer's checkpoint, and the statistics, whose
            names say ``mean`` or ``std``. Without trajectory statistics those of the demo are taken.
        out: Folder to write; it appears when everything has gone well.

    Raises:
        FileExistsError: If ``out`` exists and is not empty.
        FileNotFoundError: If a network or the feature statistics are missing.
        ValueError: If a file is refused or damaged, or weights are missing, unknown or misshapen.
    """
    check_free(out)
    report = ConversionReport(out)
    candidates = list(_files_of(paths))
    tokenizer = import_part_vq(_state(candidates, "vqvae.decoder.model.0.weight", "tokenizer", report))
    transformer = import_transformer(_state(candidates, "linear_in.weight", "trajectory transformer", report))
    width = tokenizer.config.feature_dim
    mean, std = (_statistics(candidates, name, width, report) for name in ("mean", "std"))
    if mean is None or std is None:
        raise FileNotFoundError(
            f"No feature statistics among the files: two vectors of {width} numbers, their names with `mean` "
            "and `std`. The tokenizer's own are needed; no others fit."
        )
    normalizer = Normalizer(mean, std)
    _put_trajectory_statistics(transformer, candidates, report)
    check_tlcontrol_sizes(
        tokenizer=tokenizer.config,
        transformer=transformer.config,
        skeleton=normalizer.skeleton,
        text_dim=CLIP_DIM,
    )
    with new_folder(out) as folder:
        tokenizer.save_pretrained(folder / "tokenizer")
        transformer.save_pretrained(folder / "transformer")
        normalizer.save(folder / files.NORMALIZER_FILE)
        files.write_json(folder / files.TEXT_ENCODER_FILE, {"kind": "clip", "dim": CLIP_DIM})
        files.write_json(folder / files.PIPELINE_FILE, {"kind": TLControl.kind, "format": files.FORMAT})
        (folder / "README.md").write_text(report.card(), encoding="utf-8")
    return report


def import_part_vq(state: StateDict) -> PartVqVae:
    """The tokenizer, with the published latent norm.

    Raises:
        ValueError: If weights are missing, unknown or misshapen.
    """
    what = "tokenizer"
    state = {name.removeprefix(_PREFIX): tensor for name, tensor in state.items()}
    parts = count_indices(state, r"limb_encoders\.(\d+)\.")
    stages = count_indices(state, r"decoder\.model\.(\d+)\.0\.model\.")
    codes = weight(state, "quantizers.0.codebook", what=what)
    config = PartVqVaeConfig(
        feature_dim=weight(state, f"decoder.model.{4 + stages}.weight", what=what).shape[0],
        codebook_size=codes.shape[0],
        code_dim=codes.shape[1],
        width=weight(state, "decoder.model.0.weight", what=what).shape[0],
        encoder_width=weight(state, "limb_encoders.0.model.0.weight", what=what).shape[0],
        depth=count_indices(state, r"decoder\.model\.2\.0\.model\.(\d+)\."),
        downsample=2**stages,
        latent_norm="clip",
    )
    rules = [
        *decoder_rules(stages),
        *(
            rule
            for part in range(parts)
            for rule in encoder_rules(rf"limb_encoders\.{part}", stages, ours=f"encoders.{part}")
        ),
        (r"quantizers\.(\d+)\.codebook", r"quantizer.books.\1.codes"),
    ]
    network = PartVqVae(config)
    weights = renamed(state, rules)
    load_strictly(network, {**codebook_state(network, weights), **weights}, what=what)
    return network.eval()


def import_transformer(state: StateDict) -> TrajectoryTransformer:
    """The trajectory transformer in its published form; CLIP's weights beside it are left out.

    Raises:
        ValueError: If weights are missing, unknown or misshapen.
    """
    what = "trajectory transformer"
    text = weight(state, "embed_text.weight", what=what)
    bundle = weight(state, "linear_in.weight", what=what)
    codes = weight(state, "project_codeIdx.weight", what=what)
    config = TrajectoryTransformerConfig(
        codebook_size=codes.shape[0],
        width=text.shape[0],
        layers=count_indices(state, r"transformer_encoder\.layers\.(\d+)\."),
        feedforward=weight(state, "transformer_encoder.layers.0.linear1.weight", what=what).shape[0],
        head_width=codes.shape[1],
        head_layers=count_indices(state, r"transformer_codeIdx\.layers\.(\d+)\."),
        head_feedforward=weight(state, "transformer_codeIdx.layers.0.linear1.weight", what=what).shape[0],
        text_dim=text.shape[1],
        downsample=bundle.shape[1] // _COORDINATES,
        form="published",
    )
    network = TrajectoryTransformer(config)
    own = {name: network.state_dict()[name] for name in ("trajectory_mean", "trajectory_std", "batches_seen")}
    load_strictly(network, {**own, **renamed(state, _TRANSFORMER_RULES, ignored=_IGNORED)}, what=what)
    return network.eval()


def _files_of(paths: Sequence[Path]) -> Iterable[Path]:
    for path in paths:
        if not path.exists():
            raise FileNotFoundError(f"No file or folder at {path}.")
        inside = sorted(path.rglob("*")) if path.is_dir() else [path]
        yield from (file for file in inside if file.suffix in {*_CHECKPOINTS, *_STATISTICS})


def _state(candidates: Sequence[Path], key: str, role: str, report: ConversionReport) -> StateDict:
    """The bare state dict that holds the weight ``key``."""
    for file in candidates:
        if file.suffix not in _CHECKPOINTS or _names_statistics(file):
            continue
        loaded = read_torch_file(file)
        if key in loaded and is_state_dict(loaded):
            report.used[role] = file
            return as_float32(loaded)
    raise FileNotFoundError(
        f"No {role} among the files: a bare state dict with the weight {key}. Published are "
        "best_model_epoch_hml_emaReset.pth (tokenizer) and withEmaReset_stage3.pth (transformer)."
    )


def _statistics(
    candidates: Sequence[Path], name: str, width: int, report: ConversionReport
) -> torch.Tensor | None:
    """The vector of ``width`` numbers in a file whose name holds ``name``."""
    for file in candidates:
        if name in file.stem.lower() and file.suffix in _STATISTICS:
            vector = read_vector(file)
            if len(vector) == width:
                report.used[f"{name} of {width}"] = file
                return vector
    return None


def _put_trajectory_statistics(
    transformer: TrajectoryTransformer, candidates: Sequence[Path], report: ConversionReport
) -> None:
    mean, std = (_statistics(candidates, name, _COORDINATES, report) for name in ("mean", "std"))
    if mean is None or std is None:
        report.notes.append("No trajectory statistics among the files: those of the authors' demo are taken.")
        return
    transformer.trajectory_mean.copy_(mean)
    transformer.trajectory_std.copy_(std)


def _names_statistics(file: Path) -> bool:
    return any(name in file.stem.lower() for name in ("mean", "std"))
