"""The command ``controlmm`` and how it reports errors.

Commands import what they need when they run, so that ``controlmm --help`` does not wait for torch.
"""

from __future__ import annotations

import warnings
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from controlmm.cli.assemble import assemble
from controlmm.cli.controls import controls_app
from controlmm.cli.convert import convert
from controlmm.cli.convert_evaluator import convert_evaluator
from controlmm.cli.evaluate import evaluate
from controlmm.cli.generate import generate
from controlmm.cli.info import info
from controlmm.cli.plot import plot
from controlmm.cli.prepare import prepare
from controlmm.cli.reproduce import reproduce
from controlmm.cli.train import train

USER_ERROR = 2  # exit code
_USER_ERRORS = (ValueError, OSError, ImportError)


class _Commands(TyperGroup):
    """Turns what a user can mend into one line on stderr; anything else is a bug and keeps its traceback."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except _USER_ERRORS as error:
            if ctx.params["debug"]:
                raise
            typer.echo(f"error: {' '.join(str(error).split())}", err=True)
            raise typer.Exit(USER_ERROR) from None


app = typer.Typer(cls=_Commands, no_args_is_help=True, pretty_exceptions_enable=False, add_completion=False)


@app.callback()
def _options(
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
) -> None:
    """Text plus 3D control in, human motion out."""


# Words beyond the first are a prompt without quotes: the command says so in words of its own.
app.command(context_settings={"allow_extra_args": True})(generate)
for _command in (
    info,
    prepare,
    train,
    plot,
    assemble,
    convert,
    convert_evaluator,
    evaluate,
    reproduce,
):
    app.command()(_command)
app.add_typer(controls_app, name="controls")


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    typer.echo(f"warning: {message}", err=True)


def main() -> None:
    """Entry point of the command."""
    warnings.showwarning = _show_warning
    app(prog_name="controlmm")
