"""``controlmm train``: one stage of a model, resumable."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from controlmm.cli.output_folder import writable_folder
from controlmm.cli.run_pictures import CURVES_FILE
from controlmm.training.registry import MODULES

if TYPE_CHECKING:
    from controlmm.text import TextEncoder

_INTERRUPTED = 130  # exit code of a command that Ctrl-C ended

_Size = Literal["small", "paper", "tiny"]
_Text = Literal["minilm", "clip", "hashing"]


def train(
    stage: Annotated[
        str,
        typer.Argument(help=f"One of: {', '.join(MODULES)}. Most need ones before them, trained already."),
    ],
    data: Annotated[Path, typer.Option(help="HumanML3D-style folder, see `controlmm prepare`.")],
    out: Annotated[
        Path,
        typer.Option(
            help="Folder of the model; the stage gets a run folder in it.", callback=writable_folder
        ),
    ],
    config: Annotated[_Size, typer.Option(help="Size of the networks and length of the training.")] = "small",
    text: Annotated[_Text, typer.Option(help="Text encoder; the same for all stages.")] = "minilm",
    text_folder: Annotated[
        Path | None, typer.Option(help="Where the text encoder's weights are, if not in their package.")
    ] = None,
    start_from: Annotated[
        Path | None,
        typer.Option(
            help="Train these weights further: a network's folder, or a whole model's, which also lends the "
            "earlier stages that --out lacks."
        ),
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Optimiser steps.", show_default=False)] = None,
    batch_size: Annotated[int | None, typer.Option(help="Clips a step.", show_default=False)] = None,
    learning_rate: Annotated[float | None, typer.Option(help="Peak rate.", show_default=False)] = None,
    seed: Annotated[
        int | None, typer.Option(help="Of first weights and of batches.", show_default=False)
    ] = None,
    options: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Change an option of the stage, its network or its settings: masks=cross; may be repeated. "
            "A name that does not exist is answered with the list of all.",
        ),
    ] = None,
    shards: Annotated[
        int | None,
        typer.Option(
            help="A step's batch is this many times --batch-size; processes share the shards. By default one "
            "for each process of torchrun.",
            min=1,
            show_default=False,
        ),
    ] = None,
    average_decay: Annotated[
        float | None,
        typer.Option(help="Keep a moving average of the weights, such as 0.999.", show_default=False),
    ] = None,
    patience: Annotated[
        int | None,
        typer.Option(help="End after this many validations without a better score.", show_default=False),
    ] = None,
    validate_every: Annotated[
        int | None, typer.Option(help="Steps between two validations.", show_default=False)
    ] = None,
    device: Annotated[str, typer.Option(help="Where to train: cpu, cuda, cuda:1, ...")] = "cpu",
    threads: Annotated[
        int | None, typer.Option(help="Threads of torch; by default all.", min=1, show_default=False)
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bars.")] = False,
) -> None:
    """Train one stage; the same command goes on where a stopped or killed run left off.

    Several processes train together when torchrun starts the command:
    torchrun --nproc-per-node 2 --no-python controlmm train STAGE ...
    """
    import torch

    from controlmm.cli.run_pictures import draw_validation
    from controlmm.data import MotionFolder
    from controlmm.training.processes import device_of_process, joined_processes
    from controlmm.training.registry import load_stage
    from controlmm.training.stages import train_stage

    if threads is not None:
        torch.set_num_threads(threads)
    named = dict(map(_name_and_value, options or []))
    MotionFolder(data)  # before anything is written: a missing folder leaves no trace of a run
    given = {
        "steps": steps,
        "batch_size": batch_size,
        "learning_rate": learning_rate,
        "seed": seed,
        "average_decay": average_decay,
        "patience": patience,
        "validate_every": validate_every,
    }
    changes: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    uses_text = load_stage(stage).uses_text
    try:
        with joined_processes() as team, _validations_above_the_bar(quiet=quiet):
            with team.first_goes_ahead():
                encoder = _load_encoder(text, text_folder, out) if uses_text else None
            run = train_stage(
                stage,
                data=data,
                size=config,
                root=out,
                text_encoder=encoder,
                options=named,
                changes=changes | {"shards": shards or team.count},
                start_from=start_from,
                progress=not quiet and team.is_first,
                on_validation=draw_validation,
                processes=team,
                device=device_of_process(device),
            )
    except KeyboardInterrupt:
        typer.echo(
            f"\nStopped. The same command resumes from the last checkpoint in {out / stage}.", err=True
        )
        raise typer.Exit(_INTERRUPTED) from None
    if team.is_first:
        typer.echo(f"{run}: done, best weights in {run / 'best'}, curves in {run / CURVES_FILE}")


def _name_and_value(option: str) -> tuple[str, str]:
    name, equals, value = option.partition("=")
    if not equals or not name:
        raise ValueError(f"`--set` expects NAME=VALUE, got {option!r}.")
    return name, value


def _load_encoder(kind: str, folder: Path | None, root: Path) -> TextEncoder:
    """The text encoder, which the first stage that needs one writes down and the others must repeat."""
    from controlmm.pipelines.folder import TEXT_ENCODER_FILE, read_json, write_json
    from controlmm.text import check_same_encoder, load_text_encoder

    encoder = load_text_encoder({"kind": kind}, folder=folder)
    file = root / TEXT_ENCODER_FILE
    if file.is_file():
        check_same_encoder(read_json(file), encoder)
    else:
        root.mkdir(parents=True, exist_ok=True)
        write_json(file, encoder.config())
    return encoder


def _validations_above_the_bar(*, quiet: bool) -> Any:
    """Print the metrics of every validation without breaking the progress bar."""
    import contextlib
    import logging

    from tqdm.contrib.logging import logging_redirect_tqdm

    if quiet:
        return contextlib.nullcontext()
    logger = logging.getLogger("controlmm")
    logging.basicConfig(format="%(message)s")
    logger.setLevel(logging.INFO)
    return logging_redirect_tqdm()
