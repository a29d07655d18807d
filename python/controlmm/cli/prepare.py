"""``controlmm prepare``: joint positions in, a HumanML3D-style folder out."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from controlmm.cli.output_folder import writable_folder

if TYPE_CHECKING:
    from collections.abc import Iterator

    from controlmm.data import Clip

# HDM05 is CC BY-SA: a model trained on it could not be published under the non-commercial terms that
# Bandai Namco's data (CC BY-NC) asks for.
SHIPPABLE_SOURCES = ("cmu", "cmu_dance", "bandai_namco")


def prepare(
    out: Annotated[Path, typer.Option(help="Folder to write; is made.", callback=writable_folder)],
    packs: Annotated[
        Path | None, typer.Option(help="Folder of .npz packs with captions.jsonl, already canonical.")
    ] = None,
    joints: Annotated[
        Path | None,
        typer.Option(
            help="Folder of NAME.npy joints (F, 22, 3) in metres, Y up, 20 fps, with captions in NAME.txt; "
            "val.txt and test.txt list the names of those splits."
        ),
    ] = None,
    sources: Annotated[
        str | None,
        typer.Option(
            help="With --packs: sources to take, comma-separated, or 'all'. By default "
            f"{', '.join(SHIPPABLE_SOURCES)}, those that the published model may be trained on.",
            show_default=False,
        ),
    ] = None,
    mirror: Annotated[
        bool, typer.Option("--mirror/--no-mirror", help="Add every clip with left and right swapped.")
    ] = True,
    retarget: Annotated[
        bool, typer.Option("--retarget", help="Give all bodies the reference body's bone lengths.")
    ] = False,
    quirks: Annotated[
        bool,
        typer.Option(
            "--quirks/--no-quirks",
            help="Repeat the public scripts' yaw errors, to be bit-compatible with published HumanML3D "
            "files. By default the yaw is right.",
        ),
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar.")] = False,
) -> None:
    """Turn joint positions into a folder in HumanML3D's layout, to train on."""
    from controlmm.data import write_folder
    from controlmm.data.tally import Tally

    for folder in (packs, joints):
        if folder is not None and not folder.is_dir():  # before anything is written
            raise FileNotFoundError(f"No folder at {folder}.")
    tally = Tally()
    count = write_folder(
        tally.counted(_clips(packs, joints, sources)),
        out,
        mirror=mirror,
        retarget_bones=retarget,
        canonical=packs is not None,
        public_quirks=quirks,
        progress=not quiet,
    )
    typer.echo(f"{out}: {count} clips{', mirrored ones included' if mirror else ''}")
    typer.echo(f"recorded clips of each split: {tally.splits()}")
    for caution in tally.cautions():
        warnings.warn(caution, stacklevel=2)


def _clips(packs: Path | None, joints: Path | None, sources: str | None) -> Iterator[Clip]:
    from controlmm.data import read_joint_folder, read_packs

    if packs is not None and joints is None:
        return read_packs(packs, sources=_source_names(sources))
    if joints is not None and packs is None:
        if sources is not None:
            raise ValueError("`--sources` chooses among packs; a folder of joints has none.")
        return read_joint_folder(joints)
    raise ValueError("Pass either `--packs` or `--joints`.")


def _source_names(sources: str | None) -> tuple[str, ...] | None:
    if sources is None:
        return SHIPPABLE_SOURCES
    if sources == "all":
        return None
    names = tuple(source.strip() for source in sources.split(",") if source.strip())
    if not names:
        raise ValueError("`--sources` is empty. Name some sources, or 'all'.")
    return names
