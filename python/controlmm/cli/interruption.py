"""What a long command says when Ctrl-C ends it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import typer

INTERRUPTED = 130  # exit code of a command that Ctrl-C ended


@contextmanager
def resumable(folder: Path) -> Iterator[None]:
    """Turn Ctrl-C into one line that says that the same command goes on in ``folder``, and exit code 130."""
    try:
        yield
    except KeyboardInterrupt:
        typer.echo(f"\nStopped. The same command goes on in {folder}; at most one batch is lost.", err=True)
        raise typer.Exit(INTERRUPTED) from None
