"""``controlmm controls``: ready-made control files to play with."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from controlmm.cli.output_folder import writable_file

if TYPE_CHECKING:
    from controlmm.controls import ControlFile

controls_app = typer.Typer(no_args_is_help=True, help="Write an example control file.")

_Out = Annotated[Path, typer.Option(help="The .json file to write.", callback=writable_file)]
_Joint = Annotated[str, typer.Option(help="The joint that is led.")]
_Seconds = Annotated[
    float | None,
    typer.Option(help="Duration, 0.4 to 9.8; by default a natural walking speed.", show_default=False),
]
_Length = Annotated[float, typer.Option(help="Metres ahead.")]


@controls_app.command()
def line(out: _Out, joint: _Joint = "pelvis", length: _Length = 5.0, seconds: _Seconds = None) -> None:
    """Straight ahead."""
    from controlmm.controls import shapes

    _write(shapes.line(joint, length=length, seconds=seconds), out)


@controls_app.command()
def circle(
    out: _Out,
    joint: _Joint = "pelvis",
    radius: Annotated[float, typer.Option(help="Metres.")] = 2.0,
    direction: Annotated[Literal["left", "right"], typer.Option(help="Side to which it turns.")] = "left",
    seconds: _Seconds = None,
) -> None:
    """One full circle."""
    from controlmm.controls import shapes

    _write(shapes.circle(joint, radius=radius, direction=direction, seconds=seconds), out)


@controls_app.command()
def zigzag(
    out: _Out,
    joint: _Joint = "pelvis",
    length: _Length = 6.0,
    width: Annotated[float, typer.Option(help="Metres from the leftmost to the rightmost point.")] = 1.2,
    turns: Annotated[int, typer.Option(help="Number of corners.")] = 4,
    seconds: _Seconds = None,
) -> None:
    """Ahead, swinging left and right with rounded corners."""
    from controlmm.controls import shapes

    _write(shapes.zigzag(joint, length=length, width=width, turns=turns, seconds=seconds), out)


@controls_app.command()
def wave(
    out: _Out,
    joint: _Joint = "right_wrist",
    amplitude: Annotated[float, typer.Option(help="Metres up and down from 1.2 m.")] = 0.2,
    length: _Length = 5.0,
    period: Annotated[float, typer.Option(help="Seconds of one wave.")] = 1.2,
    seconds: _Seconds = None,
) -> None:
    """A wrist drawn along a sine while the body walks ahead."""
    from controlmm.controls import shapes

    _write(shapes.wave(joint, amplitude=amplitude, length=length, period=period, seconds=seconds), out)


@controls_app.command()
def reach(
    out: _Out,
    joint: _Joint = "right_wrist",
    seconds: Annotated[float, typer.Option(help="Duration, 0.4 to 9.8.")] = 4.0,
) -> None:
    """Key frames only: a standing person reaches forward, then up."""
    from controlmm.controls import shapes

    _write(shapes.reach(joint, seconds=seconds), out)


def _write(file: ControlFile, out: Path) -> None:
    from controlmm.controls import save_controls

    path = save_controls(file, out)
    typer.echo(f"{path}: {file.seconds:g} s, prompt {file.text!r}")
    typer.echo(f"Next: controlmm generate --controls {path}")
