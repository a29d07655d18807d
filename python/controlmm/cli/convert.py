"""``controlmm convert``: published checkpoints in, one model folder out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    from controlmm.convert.report import ConversionReport


def convert(
    paths: Annotated[
        list[Path],
        typer.Argument(help="Folder with the published checkpoints, or single run folders or files of it."),
    ],
    out: Annotated[Path, typer.Option(help="Model folder to write.")],
    kind: Annotated[
        Literal["controlmm", "tlcontrol"], typer.Option(help="Whose checkpoints they are.")
    ] = "controlmm",
    control: Annotated[
        Literal["joints", "pelvis"] | None,
        typer.Option(help="Which control checkpoint, if there are both.", show_default="joints"),
    ] = None,
) -> None:
    """Turn the authors' checkpoints of ControlMM / MaskControl, MoMask or TLControl into a model folder."""
    report = _converted(paths, out, kind, control)
    typer.echo("\n".join(report.lines()))
    size = sum(file.stat().st_size for file in out.rglob("*") if file.is_file()) / 1e6
    typer.echo(f"{out}: {size:.1f} MB")
    typer.echo(f'Next: controlmm generate "a person walks forward" --model {out}')


def _converted(
    paths: list[Path], out: Path, kind: str, control: Literal["joints", "pelvis"] | None
) -> ConversionReport:
    if kind == "tlcontrol":
        from controlmm.convert.tlcontrol import convert as convert_tlcontrol

        if control is not None:
            raise ValueError(
                "`--control` is for --kind controlmm: TLControl has one checkpoint for all joints."
            )
        return convert_tlcontrol(paths, out)
    from controlmm.convert.controlmm import convert as convert_controlmm

    return convert_controlmm(paths, out, control=control)
