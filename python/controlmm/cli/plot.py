"""``controlmm plot``: the curves of a training run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from controlmm.cli.run_pictures import CURVES_FILE


def plot(
    run: Annotated[Path, typer.Argument(help="Run folder of one stage, such as runs/small/rvq.")],
    out: Annotated[
        Path | None, typer.Option(help=f"Picture to write; by default {CURVES_FILE} in the run folder.")
    ] = None,
) -> None:
    """Draw every metric of a training run over its steps."""
    from controlmm.training.run_folder import LOG_FILE, RunFolder
    from controlmm.viewer.training_curves import save_training_curves

    if not (run / LOG_FILE).is_file():
        raise FileNotFoundError(
            f"No {LOG_FILE} in {run}. Pass the run folder of one stage, such as runs/small/rvq."
        )
    path = save_training_curves(RunFolder(run).records(), out or run / CURVES_FILE, title=str(run))
    typer.echo(str(path))
