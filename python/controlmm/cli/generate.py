"""``controlmm generate``: a prompt and controls in, motion files out."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from controlmm.cli.output_folder import writable_folder
from controlmm.cli.phase_bars import PhaseBars
from controlmm.cli.table import format_table

if TYPE_CHECKING:
    from controlmm.controls import ControlFile
    from controlmm.pipelines import GenerationResult

_SLUG_LENGTH = 48
_TITLES = (
    "sample", "control error (cm)", "in obstacles (cm)", "foot skating ratio", "BVH fit error (mm)",
    "time (s)",
)  # fmt: skip
_PER_METRE = {"m": 1.0, "mm": 1000.0}  # of a skeleton's unit


def generate(
    context: typer.Context,
    prompt: Annotated[
        str | None, typer.Argument(help="What the person does. By default the control file's prompt.")
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            help="Length, 0.4 to 9.8. By default the control file's, else the model's choice or 6.",
            show_default=False,
        ),
    ] = None,
    controls: Annotated[Path | None, typer.Option(help="Control file: .json, .csv, .npy or .npz.")] = None,
    obstacles: Annotated[
        Path | None,
        typer.Option(help="JSON file with obstacles to keep clear of, beside those in the control file."),
    ] = None,
    timeline: Annotated[
        Path | None, typer.Option(help="JSON file that says what each body part does when.")
    ] = None,
    method: Annotated[
        str | None,
        typer.Option(help="How a timeline is made: tracks, passes or published.", show_default="tracks"),
    ] = None,
    then: Annotated[
        list[str] | None,
        typer.Option(help="PROMPT:SECONDS of a clip that goes on from there; repeat for a long motion."),
    ] = None,
    edit: Annotated[
        Path | None, typer.Option(help="Motion to change: .npz, .npy or .bvh; see --keep and --keep-part.")
    ] = None,
    keep: Annotated[
        list[str] | None, typer.Option(help="START-END in seconds of the motion that stays; may be repeated.")
    ] = None,
    keep_part: Annotated[
        list[str] | None, typer.Option(help="Body part that stays, such as lower; may be repeated.")
    ] = None,
    loose: Annotated[
        bool, typer.Option("--loose", help="Keep tokens only: kept poses may shift on the ground.")
    ] = False,
    preset: Annotated[
        str,
        typer.Option(
            help="fast, balanced, accurate, exact: all put joints on targets, with whole bones; later ones "
            "bend motions less for it, and exact refuses what no body can do. paper-fast, paper-medium, "
            "paper-accurate: the papers' steps."
        ),
    ] = "balanced",
    naturalness: Annotated[
        float | None,
        typer.Option(
            help="How strongly editing keeps feet, floor and uncontrolled joints as they were; 0 not at all.",
            show_default=False,
        ),
    ] = None,
    tolerance: Annotated[
        str | None,
        typer.Option(
            help="Control error at which to stop, such as 5mm. By default the preset's.", show_default=False
        ),
    ] = None,
    time_budget: Annotated[
        str | None,
        typer.Option(help="Time for editing, such as 500ms or 2s. By default none.", show_default=False),
    ] = None,
    samples: Annotated[int, typer.Option(help="Number of motions.")] = 1,
    vary: Annotated[
        str | None,
        typer.Option(help="Body part that samples differ in, such as left_arm (TLControl)."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same motions.")] = 0,
    formats: Annotated[
        str, typer.Option(help="Files to write, comma-separated: npz, npy, bvh, glb, png, gif, mp4.")
    ] = "npz,bvh,png",
    out: Annotated[
        Path,
        typer.Option(
            help="Folder for the files, which prompt and seed name; is made. Older files are replaced.",
            callback=writable_folder,
        ),
    ] = Path("out"),
    model: Annotated[
        Path | None,
        typer.Option(help="Model folder, or controlmm or tlcontrol, which come with the package."),
    ] = None,
    guidance: Annotated[
        float | None,
        typer.Option(
            help="How strongly the text counts; 1 is without guidance. By default what suits the model.",
            show_default=False,
        ),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but the names of the files.")] = False,
) -> None:
    """Generate motions and print how well each of them meets its controls."""
    from controlmm.cli.scene_options import (
        all_obstacles,
        chained_clips,
        check_same_length,
        check_together,
        parse_interval,
        timeline_entries,
    )
    from controlmm.controls import load_controls
    from controlmm.motion.motion import Motion

    if context.args:
        words = " ".join([prompt or "", *context.args])
        raise ValueError(f'Put the prompt in quotes, it is one argument: controlmm generate "{words}".')
    suffixes = _checked_formats(formats)
    document = load_controls(controls) if controls else None
    entries = timeline_entries(document, timeline)
    check_together(
        edit=edit, has_timeline=bool(entries), keep=keep, keep_part=keep_part, loose=loose, controls=controls,
        obstacles=obstacles, seconds=seconds, vary=vary, method=method, then=then,
    )  # fmt: skip
    avoided = all_obstacles(document, obstacles)
    if entries and prompt is not None:
        raise ValueError("A timeline has prompts of its own. Leave the prompt out.")
    prompt = entries[0].prompt if entries else _chosen_prompt(prompt, document)
    options: dict[str, Any] = {"samples": samples, "seed": seed}
    held = document.controls if document else ()
    source = Motion.load(edit) if edit else None
    if source is not None:
        check_same_length(document, source)
    seconds = None if entries or source else _chosen_seconds(seconds, document, controls)
    intervals = [parse_interval(text) for text in keep or ()]
    clips = chained_clips(prompt, seconds, then or ())

    from controlmm.pipelines import ControlMM, TLControl, load_pipeline

    pipeline = load_pipeline(model)
    if vary is not None and not isinstance(pipeline, TLControl):
        raise ValueError("`--vary` needs a TLControl model, for example: --model tlcontrol.")
    parts: dict[str, Any] = {} if vary is None else {"vary": vary}
    with PhaseBars(enabled=not quiet) as bars:
        plan = pipeline.limited(
            pipeline.resolve_preset(preset, guidance),
            _quantity(tolerance),
            _quantity(time_budget),
            naturalness,
        )
        options |= {"progress": bars, "preset": plan, **parts}
        if entries:
            options |= {} if method is None else {"method": method}
            result = pipeline.timeline(entries, controls=held, obstacles=avoided, **options)
        elif clips:
            result = pipeline.chain(clips, **options)
        elif source is not None:
            assert isinstance(pipeline, ControlMM | TLControl)
            result = pipeline.edit(
                source, prompt, keep=intervals, keep_parts=keep_part or (), controls=held, obstacles=avoided,
                exact=not loose, **options,
            )  # fmt: skip
        else:
            result = pipeline(prompt, seconds=seconds, controls=held, obstacles=avoided, **options)
    stem = f"{slug(prompt)}_{seed}"
    files = [
        motion.save(out / f"{stem}_{index}.{suffix}")
        for index, motion in enumerate(result)
        for suffix in suffixes
    ]
    if not quiet:
        typer.echo(_report(result, has_fit=bool({"bvh", "glb"} & set(suffixes))) + "\n")
    typer.echo("\n".join(map(str, files)))


def _quantity(text: str | None) -> str | float | None:
    """A number without a unit as a number; what has one is read with the preset."""
    try:
        return text if text is None else float(text)
    except ValueError:
        return text


def slug(prompt: str) -> str:
    """A prompt as part of a file name: lower-case letters, digits and hyphens, cut at a word."""
    words = "-".join(re.findall(r"[^\W_]+", prompt.lower()))
    if len(words) <= _SLUG_LENGTH:
        return words or "motion"
    return words[:_SLUG_LENGTH].rpartition("-")[0] or words[:_SLUG_LENGTH]


def _checked_formats(formats: str) -> list[str]:
    from controlmm.motion.formats import known_suffixes

    suffixes = [suffix.strip().lower().removeprefix(".") for suffix in formats.split(",") if suffix.strip()]
    unknown = [suffix for suffix in suffixes if suffix not in known_suffixes()]
    if unknown or not suffixes:
        raise ValueError(
            f"`--formats` must name some of {', '.join(known_suffixes())}, comma-separated, got {formats!r}."
        )
    if "mp4" in suffixes and find_spec("av") is None:  # better now than after minutes of generation
        raise ModuleNotFoundError(
            "`--formats mp4` needs PyAV: pip install 'controlmm[video]' (or ask for gif)."
        )
    return suffixes


def _chosen_prompt(prompt: str | None, document: ControlFile | None) -> str:
    if prompt is None and document is not None:
        prompt = document.text
    if prompt is None:
        raise ValueError('Give a prompt, for example: controlmm generate "a person walks forward".')
    return prompt


def _chosen_seconds(seconds: float | None, document: ControlFile | None, path: Path | None) -> float | None:
    from controlmm.controls.shapes import MAX_SECONDS, MIN_SECONDS

    if seconds is not None or document is None:
        return seconds
    if document.seconds is not None and not MIN_SECONDS <= document.seconds <= MAX_SECONDS:
        raise ValueError(
            f"{path} is {document.seconds:g} s long, a motion is {MIN_SECONDS} to {MAX_SECONDS} s. Change "
            "the file, or pass `--seconds`, into which its controls must fit."
        )
    return document.seconds


def _report(result: GenerationResult, *, has_fit: bool) -> str:
    """One row a sample. All samples are generated together, so each takes an equal share of the time."""
    import torch

    from controlmm.evaluation import foot_skating_ratio
    from controlmm.motion.rotation_fit import fit_rotations

    skeleton = result[0].skeleton
    unit = _PER_METRE[skeleton.unit]
    skating = foot_skating_ratio(torch.stack([motion.joints for motion in result]), skeleton=skeleton)
    rows = []
    for index, motion in enumerate(result):
        has_targets = "targets" in motion.extra or result.control_error[index] > 0
        has_obstacles = "obstacles" in motion.extra
        error = f"{100 * result.control_error[index].item() / unit:.2f}" if has_targets else "-"
        depth = f"{100 * result.penetration[index].item():.2f}" if has_obstacles else "-"
        fit = f"{1000 * fit_rotations(motion.joints, skeleton).mean_error / unit:.1f}" if has_fit else "-"
        share = result.seconds_taken / len(result)
        rows.append((str(index), error, depth, f"{skating[index].item():.3f}", fit, f"{share:.1f}"))
    return format_table(_TITLES, rows)
