"""BVH files: what Blender, Unreal, Unity and MotionBuilder import."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from controlmm.io.bvh_parser import BvhClip, bvh_positions, parse_bvh
from controlmm.io.bvh_writer import file_scale, write_bvh
from controlmm.motion.motion import Motion
from controlmm.motion.rotation_fit import BoneLengths, fit_rotations
from controlmm.motion.skeleton import HUMANML3D, SKELETONS, Skeleton

_LOGGER = logging.getLogger(__name__)

_RATE_TOLERANCE = 1e-3  # of a frame's time; files round it to six digits or fewer
_LEG_METRES = (0.2, 3.0)  # shortest and longest plausible leg: outside it the unit must be wrong


class BvhFormat:
    """Reader and writer of ``.bvh``."""

    @staticmethod
    def save(motion: Motion, path: Path, *, unit: str = "cm", bone_lengths: BoneLengths = "clip") -> None:
        """Fit rigid bones to the motion and write them; the fitting error goes to the log (level INFO).

        Args:
            motion: Any motion of the HumanML3D or KIT-ML skeleton. Its rotation features are not used.
            path: File to write, replaced as a whole.
            unit: ``"cm"`` or ``"m"``.
            bone_lengths: ``"clip"`` (mean over the clip) or ``"reference"`` (the skeleton's published ones).

        Raises:
            ValueError: If an option is unknown.
        """
        fit = fit_rotations(motion.joints, motion.skeleton, bone_lengths=bone_lengths)
        write_bvh(fit, path, unit=unit)
        _LOGGER.info(
            "%s: rigid bones lie %.3g %s from the given joints on average, %.3g %s at most.",
            path, fit.mean_error, motion.skeleton.unit, fit.max_error, motion.skeleton.unit,
        )  # fmt: skip

    @staticmethod
    def load(path: Path, *, unit: str = "cm", resample: bool = False) -> Motion:
        """Read joint positions from a BVH file whose joints carry the names of a known skeleton.

        Args:
            path: File to read. Joints beyond the skeleton's (fingers) are left out.
            unit: The file's unit of length, ``"cm"`` or ``"m"``; a BVH does not say.
            resample: Interpolate positions linearly to the skeleton's frame rate; else another is an error.

        Raises:
            ValueError: If the file is damaged (with the line), lacks joints, has another frame rate, or its
                body has no plausible size in ``unit``.
        """
        try:
            clip = parse_bvh(path.read_text(encoding="utf-8", errors="replace"))
            skeleton, order = _match_skeleton(clip)
            positions = bvh_positions(clip)[:, order] / file_scale(skeleton, unit)
            _check_size(positions, skeleton, unit)
            positions = _at_rate(positions, clip.frame_time, skeleton.fps, resample=resample)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        return Motion(joints=torch.from_numpy(positions.astype(np.float32)), skeleton=skeleton)


def _match_skeleton(clip: BvhClip) -> tuple[Skeleton, list[int]]:
    """The skeleton whose joint names the file holds, and where they are in it."""
    names = [joint.name for joint in clip.joints]
    for skeleton in SKELETONS.values():
        if set(skeleton.joint_names) <= set(names):
            return skeleton, [names.index(name) for name in skeleton.joint_names]
    missing = [name for name in HUMANML3D.joint_names if name not in names]
    raise ValueError(
        f"not the {HUMANML3D.name} skeleton: {len(missing)} of its {HUMANML3D.num_joints} joints are missing "
        f"({', '.join(missing)}). Rename the file's joints to these names."
    )


def _check_size(positions: Float[ndarray, "T J 3"], skeleton: Skeleton, unit: str) -> None:
    metres = positions * (0.001 if skeleton.unit == "mm" else 1.0)
    lower = list(skeleton.leg_bones)
    upper = [skeleton.parents[joint] for joint in lower]
    leg = float(np.linalg.norm(metres[:, lower] - metres[:, upper], axis=-1).sum(-1).mean())
    if not _LEG_METRES[0] <= leg <= _LEG_METRES[1]:
        raise ValueError(
            f"legs are {leg:.3g} m long if the unit is {unit!r}. Pass the right `unit`, 'cm' or 'm'."
        )


def _at_rate(
    positions: Float[ndarray, "T J 3"], frame_time: float, fps: float, *, resample: bool
) -> Float[ndarray, "T J 3"]:
    if abs(frame_time * fps - 1) <= _RATE_TOLERANCE:
        return positions
    if not resample:
        raise ValueError(
            f"frame time is {frame_time:g} s, expected {1 / fps:g} s ({fps:g} fps). "
            "Pass `resample=True` to interpolate."
        )
    last = len(positions) - 1
    times = np.arange(int(last * frame_time * fps + _RATE_TOLERANCE) + 1) / (frame_time * fps)
    before = np.minimum(times.astype(int), last)
    after = np.minimum(before + 1, last)
    share = (times - before)[:, None, None]
    result: ndarray = (1 - share) * positions[before] + share * positions[after]
    return result
