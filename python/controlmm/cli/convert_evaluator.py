"""``controlmm convert-evaluator``: the published text-motion evaluator in, one folder out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def convert_evaluator(
    checkpoint: Annotated[Path, typer.Argument(help="text_mot_match/model/finest.tar")],
    statistics: Annotated[Path, typer.Option(help="Folder with its meta/mean.npy and meta/std.npy.")],
    words: Annotated[Path, typer.Option(help="Folder with our_vab_data.npy and our_vab_idx.pkl.")],
    out: Annotated[Path, typer.Option(help="Folder to write, for `controlmm evaluate --evaluator`.")],
) -> None:
    """Turn the published evaluator of HumanML3D or KIT-ML into a folder for `controlmm evaluate`."""
    from controlmm.convert.evaluator import convert_evaluator as convert

    report = convert(checkpoint, statistics=statistics, words=words, out=out)
    typer.echo("\n".join([*report.lines(), str(out)]))
