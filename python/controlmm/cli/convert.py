"""``controlmm convert``: published checkpoints in, one model folder out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer


def convert(
    paths: Annotated[
        list[Path],
        typer.Argument(help="Folder with the published checkpoints, or single run folders or files of it."),
    ],
    out: Annotated[Path, typer.Option(help="Model folder to write.")],
    control: Annotated[
        Literal["joints", "pelvis"] | None,
        typer.Option(help="Which control checkpoint, if there are both.", show_default="joints"),
    ] = None,
) -> None:
    """Turn the authors' checkpoints of ControlMM / MaskControl (and MoMask) into a model folder."""
    from controlmm.convert.controlmm import convert as convert_checkpoints

    report = convert_checkpoints(paths, out, control=control)
    typer.echo("\n".join(report.lines()))
    size = sum(file.stat().st_size for file in out.rglob("*") if file.is_file()) / 1e6
    typer.echo(f"{out}: {size:.1f} MB")
    typer.echo(f'Next: controlmm generate "a person walks forward" --model {out}')
