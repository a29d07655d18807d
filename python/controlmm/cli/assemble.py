"""``controlmm assemble``: trained stages in, one model folder out."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import typer

from controlmm.cli.output_folder import writable_folder
from controlmm.training.registry import MODULES

if TYPE_CHECKING:
    from controlmm.nn.checkpoint import PretrainedModel
    from controlmm.pipelines.pipeline import MotionPipeline
    from controlmm.text import TextEncoder

_Network = TypeVar("_Network", bound="PretrainedModel")


def assemble(
    root: Annotated[Path, typer.Argument(help="Folder that `controlmm train --out` filled.")],
    out: Annotated[Path, typer.Option(help="Model folder to write.", callback=writable_folder)],
    half: Annotated[bool, typer.Option("--half", help="Store weights as float16: half the size.")] = False,
    text: Annotated[
        Literal["minilm", "clip", "hashing"] | None,
        typer.Option(help="Text encoder; by default the one that training wrote down.", show_default=False),
    ] = None,
    text_folder: Annotated[
        Path | None, typer.Option(help="Where the text encoder's weights are, if not in their package.")
    ] = None,
) -> None:
    """Put the best weights of the stages together, to generate with."""
    import torch

    from controlmm.training.run_folder import SETTINGS_FILE

    if not any((root / stage).is_dir() for stage in MODULES):
        raise FileNotFoundError(
            f"No trained stage in {root}. Pass the folder that `controlmm train STAGE --out` wrote to."
        )
    if out.resolve() == root.resolve():
        raise ValueError("`--out` must not be the folder of the stages: their files would mix.")
    encoder = _text_encoder(root, text, text_folder)
    pipeline, stages = (_tlcontrol if (root / "tl-mtt").is_dir() else _controlmm)(root, encoder)
    _check_nothing_stale(out, pipeline)
    pipeline.save_pretrained(out, dtype=torch.float16 if half else torch.float32)
    for network, stage in stages.items():
        if (root / stage / SETTINGS_FILE).is_file():  # not there when a stage came from a model without it
            shutil.copyfile(root / stage / SETTINGS_FILE, out / network / SETTINGS_FILE)
    size = sum(file.stat().st_size for file in out.rglob("*") if file.is_file()) / 1e6
    typer.echo(f"{out}: {size:.1f} MB, {pipeline.num_parameters / 1e6:.2f} million parameters")
    typer.echo(f'Next: controlmm generate "a person walks forward" --model {out}')


def _check_nothing_stale(out: Path, pipeline: MotionPipeline[Any]) -> None:
    """A network that an earlier model left in the folder would be loaded with this one."""
    for name in pipeline.optional_networks:
        if (out / name).is_dir() and name not in pipeline.networks():
            raise ValueError(
                f"{out / name} is of an earlier model and would be loaded with this one, which has none. "
                "Delete it, or choose another `--out`."
            )


def _controlmm(root: Path, encoder: TextEncoder) -> tuple[MotionPipeline[Any], dict[str, str]]:
    """The pipeline, and the stage that each network's folder comes from."""
    from controlmm.models.control_branch import ControlBranch
    from controlmm.models.length_estimator import LengthEstimator
    from controlmm.models.masked_transformer import MaskedTransformer
    from controlmm.models.residual_control import ResidualControl
    from controlmm.models.residual_transformer import ResidualTransformer
    from controlmm.pipelines import ControlMM
    from controlmm.pipelines.guidance import TRAINED_HERE
    from controlmm.training.stage import load_tokenizer, tokenizer_stage

    tokenizer, normalizer = load_tokenizer(root)
    pipeline = ControlMM(
        tokenizer=tokenizer,
        transformer=MaskedTransformer.from_pretrained(_best(root, "masked")),
        residual=ResidualTransformer.from_pretrained(_best(root, "residual")),
        control=ControlBranch.from_pretrained(_best(root, "control")),
        residual_control=_optional(ResidualControl, root, "residual-control"),
        normalizer=normalizer,
        text_encoder=encoder,
        length=_optional(LengthEstimator, root, "length"),
        guidance=TRAINED_HERE,
    )
    stages = {
        "tokenizer": tokenizer_stage(root),
        "transformer": "masked",
        "residual": "residual",
        "control": "control",
        "residual_control": "residual-control",
        "length": "length",
    }
    return pipeline, stages


def _tlcontrol(root: Path, encoder: TextEncoder) -> tuple[MotionPipeline[Any], dict[str, str]]:
    from controlmm.models.length_estimator import LengthEstimator
    from controlmm.models.trajectory_transformer import TrajectoryTransformer
    from controlmm.pipelines import TLControl
    from controlmm.training.stage import load_part_tokenizer, tokenizer_stage

    tokenizer, normalizer = load_part_tokenizer(root)
    pipeline = TLControl(
        tokenizer=tokenizer,
        transformer=TrajectoryTransformer.from_pretrained(_best(root, "tl-mtt")),
        normalizer=normalizer,
        text_encoder=encoder,
        length=_optional(LengthEstimator, root, "length"),
    )
    stages = {
        "tokenizer": tokenizer_stage(root, "tl-vq"),
        "transformer": "tl-mtt",
        "length": "length",
    }
    return pipeline, stages


def _optional(network: type[_Network], root: Path, stage: str) -> _Network | None:
    return network.from_pretrained(_best(root, stage)) if (root / stage).is_dir() else None


def _best(root: Path, stage: str) -> Path:
    folder = root / stage / "best"
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{root / stage} holds no trained stage. Run `controlmm train {stage}` first."
        )
    return folder


def _text_encoder(root: Path, kind: str | None, folder: Path | None) -> TextEncoder:
    from controlmm.pipelines.folder import TEXT_ENCODER_FILE, read_json
    from controlmm.text import load_text_encoder

    if kind is not None:
        return load_text_encoder({"kind": kind}, folder=folder)
    if not (root / TEXT_ENCODER_FILE).is_file():
        raise FileNotFoundError(f"No {TEXT_ENCODER_FILE} in {root}: say with `--text` which one trained it.")
    return load_text_encoder(read_json(root / TEXT_ENCODER_FILE), folder=folder)
