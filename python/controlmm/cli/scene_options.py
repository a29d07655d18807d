"""Options of ``controlmm generate`` beside a prompt: obstacles, timelines, chains, motions to edit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from controlmm.controls import Avoid, ControlFile, TimelineEntry
    from controlmm.motion.motion import Motion

_FPS = 20  # of controls and of motions that are edited


def all_obstacles(document: ControlFile | None, path: Path | None) -> tuple[Avoid, ...]:
    """Obstacles of the control file and of the file of obstacles together.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is broken or holds no obstacle.
    """
    from controlmm.controls import as_avoids, load_controls

    avoided = as_avoids(document.obstacles) if document else ()
    if path is None:
        return avoided
    scene = load_controls(path)
    if not scene.obstacles:
        raise ValueError(
            f'{path} holds no obstacles. Give them as "obstacles": [...], see docs/obstacles.md.'
        )
    return avoided + as_avoids(scene.obstacles)


def timeline_entries(document: ControlFile | None, path: Path | None) -> tuple[TimelineEntry, ...]:
    """The timeline of its own file, else of the control file; empty without either.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is broken or holds no timeline.
    """
    from controlmm.controls import load_controls

    if path is None:
        return tuple(document.timeline) if document else ()
    entries = tuple(load_controls(path).timeline)
    if not entries:
        raise ValueError(f'{path} holds no timeline. Give it as "timeline": [...], see docs/timeline.md.')
    return entries


def chained_clips(prompt: str, seconds: float | None, then: Sequence[str]) -> list[tuple[str, float]]:
    """(prompt, seconds) of the first clip and of those that go on from it; none without ``then``.

    Raises:
        ValueError: If a clip has no length.
    """
    if not then:
        return []
    if seconds is None:
        raise ValueError("`--then` goes on from a first clip. Say how long that lasts, with `--seconds`.")
    clips = [(prompt, seconds)]
    for text in then:
        words, _, length = text.rpartition(":")
        try:
            clips.append((words.strip(), float(length)))
        except ValueError:
            raise ValueError(
                f"`--then` must be PROMPT:SECONDS, such as 'a person sits down:3', got {text!r}."
            ) from None
    return clips


def parse_interval(text: str) -> tuple[float, float]:
    """Start and end in seconds of an interval such as ``0-2.5``.

    Raises:
        ValueError: If it is none.
    """
    start, _, end = text.partition("-")
    try:
        return float(start), float(end)
    except ValueError:
        raise ValueError(f"`--keep` must be START-END in seconds, such as 0-2.5, got {text!r}.") from None


def check_same_length(document: ControlFile | None, motion: Motion) -> None:
    """Refuse controls of a clip of another length than the motion that is edited.

    Raises:
        ValueError: With both lengths.
    """
    if document is None or document.seconds is None or round(document.seconds * _FPS) == motion.num_frames:
        return
    raise ValueError(
        f"The controls are for a clip of {document.seconds:g} s, but the motion lasts "
        f"{motion.num_frames / _FPS:g} s, and editing keeps its length. Change `seconds` in the file."
    )


def check_together(*, edit: Path | None, has_timeline: bool, **others: object) -> None:
    """Refuse options that do not go together: nothing that was asked for is ignored.

    Args:
        edit: The motion to edit.
        has_timeline: Whether there is a timeline.
        others: Values of further options by their names; falsy: not given.

    Raises:
        ValueError: Naming two that do not go together.
    """
    given = {name.replace("_", "-") for name, value in others.items() if value}
    if has_timeline and edit:
        raise ValueError(
            "`--timeline` and `--edit` do not go together. Edit what a timeline made in a second call."
        )
    for first, is_there, allowed in (
        ("--then", bool(others.get("then")), {"then", "seconds"}),
        ("--edit", edit is not None, {"keep", "keep-part", "loose", "controls", "obstacles"}),
        ("--timeline", has_timeline, {"controls", "obstacles", "method"}),
        (
            "--controls",
            edit is None and not has_timeline,
            {"controls", "obstacles", "seconds", "vary", "then"},
        ),
    ):
        if is_there and given - allowed:
            name = sorted(given - allowed)[0]
            if name == "method":
                raise ValueError("`--method` is for timelines. Name one with `--timeline FILE`.")
            if first == "--controls":
                raise ValueError(
                    f"`--{name}` says what of a motion to keep. Name the motion with `--edit FILE`."
                )
            raise ValueError(f"`{first}` and `--{name}` do not go together. Leave one out.")
