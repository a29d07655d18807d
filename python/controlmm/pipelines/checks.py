"""Checks of a pipeline's arguments: everything is refused before any network runs."""

from __future__ import annotations

from controlmm.motion.skeleton import Skeleton

MIN_FRAMES = 8
_DEFAULT_SECONDS = 6.0


def frame_count(*, seconds: float | None, frames: int | None, skeleton: Skeleton, max_frames: int) -> int:
    """Length of the motion in frames; 6 s when neither is given.

    Raises:
        ValueError: If both are given, or the length is not a number from 8 frames to ``max_frames``.
    """
    if seconds is not None and frames is not None:
        raise ValueError(f"Pass `seconds` or `frames`, not both (got {seconds} and {frames}).")
    if frames is None:
        seconds = _DEFAULT_SECONDS if seconds is None else seconds
        if isinstance(seconds, bool) or not isinstance(seconds, int | float) or seconds != seconds:
            raise ValueError(f"`seconds` must be a number, got {seconds!r}.")
        if not MIN_FRAMES <= round(min(seconds, 1e6) * skeleton.fps) <= max_frames:
            raise ValueError(
                f"`seconds` must be between {MIN_FRAMES / skeleton.fps:g} and {max_frames / skeleton.fps:g}, "
                f"got {seconds}."
            )
        return round(seconds * skeleton.fps)
    if isinstance(frames, bool) or not isinstance(frames, int):
        raise ValueError(f"`frames` must be a whole number, got {frames!r}.")
    if not MIN_FRAMES <= frames <= max_frames:
        raise ValueError(f"`frames` must be between {MIN_FRAMES} and {max_frames}, got {frames}.")
    return frames


def check_sampling(*, samples: int, seed: int) -> None:
    """Raise ``ValueError`` unless ``samples`` is a positive and ``seed`` a non-negative whole number."""
    for name, value, least in (("samples", samples, 1), ("seed", seed, 0)):
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise ValueError(f"`{name}` must be a whole number of at least {least}, got {value!r}.")
