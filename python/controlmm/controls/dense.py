"""Controls as dense targets with a mask, the form that networks and losses take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.controls.checks import AXES
from controlmm.controls.samples import Control, ControlSamples
from controlmm.motion.skeleton import HUMANML3D, Skeleton

AGREEMENT = 1e-3  # metres; two controls of one coordinate may differ by this much
_UNITS_PER_METRE = {"m": 1.0, "mm": 1000.0}


@dataclass(frozen=True, eq=False)
class DenseControls:
    """Targets of a clip.

    Attributes:
        targets: (T, J, 3) global positions, Y up, in the skeleton's unit (HumanML3D: metres); 0 where free.
        mask: (T, J, 3) true where the coordinate is controlled.
    """

    targets: Float[Tensor, "T J 3"]
    mask: Bool[Tensor, "T J 3"]

    @property
    def num_frames(self) -> int:
        """Number of frames ``T``."""
        return len(self.mask)

    @property
    def is_empty(self) -> bool:
        """Whether nothing is controlled."""
        return not bool(self.mask.any())

    @property
    def controlled_joints(self) -> tuple[int, ...]:
        """Indices of the joints that are controlled at some frame, in rising order."""
        return tuple(self.mask.any(dim=2).any(dim=0).nonzero()[:, 0].tolist())


def densify(controls: Sequence[Control], num_frames: int, skeleton: Skeleton = HUMANML3D) -> DenseControls:
    """The controls of one clip as dense targets.

    Args:
        controls: Joint, path and pose controls, in metres; may be empty.
        num_frames: Length ``T`` of the clip.
        skeleton: The joints, and the unit of the result.

    Raises:
        TypeError: If ``controls`` is not a sequence of controls.
        ValueError: If a control names a joint or a frame that is not there, or two controls want one
            coordinate at places more than 1 mm apart.
    """
    _check_arguments(controls, num_frames)
    shape = (num_frames, skeleton.num_joints, 3)
    targets, owners = torch.zeros(shape), torch.full(shape, -1)
    labels = [control.label for control in controls]
    for index, control in enumerate(controls):
        try:
            samples = control.sample(num_frames, skeleton)
        except ValueError as error:
            raise ValueError(f"control {index} ({control.label}): {error}") from error
        _check_frames(samples, num_frames, f"control {index} ({control.label})")
        _check_agreement(samples, targets, owners, index, labels, skeleton)
        cells = (samples.frames[:, None], samples.joints[None, :])
        is_new = samples.mask & (owners[cells] < 0)
        targets[cells] = torch.where(is_new, samples.positions, targets[cells])
        owners[cells] = torch.where(is_new, index, owners[cells])
    return DenseControls(targets * _UNITS_PER_METRE[skeleton.unit], owners >= 0)


def stack_dense(clips: Sequence[DenseControls]) -> tuple[Float[Tensor, "B T J 3"], Bool[Tensor, "B T J 3"]]:
    """Targets and masks of several clips, padded with uncontrolled frames to the longest.

    Raises:
        ValueError: If there are no clips, or they have different skeletons.
    """
    if not clips:
        raise ValueError("`clips` is empty. Pass at least one DenseControls.")
    joints = sorted({clip.mask.shape[1] for clip in clips})
    if len(joints) > 1:
        raise ValueError(f"`clips` must have one number of joints, got {joints}.")
    longest = max(clip.num_frames for clip in clips)
    targets = torch.zeros(len(clips), longest, joints[0], 3)
    mask = torch.zeros(len(clips), longest, joints[0], 3, dtype=torch.bool)
    for row, clip in enumerate(clips):
        targets[row, : clip.num_frames] = clip.targets
        mask[row, : clip.num_frames] = clip.mask
    return targets, mask


def _check_arguments(controls: Sequence[Control], num_frames: int) -> None:
    if isinstance(num_frames, bool) or not isinstance(num_frames, int) or num_frames < 1:
        raise ValueError(f"`num_frames` must be a positive integer, got {num_frames!r}.")
    if not isinstance(controls, Sequence) or isinstance(controls, str):
        raise TypeError(
            f"`controls` must be a list of controls, got {type(controls).__name__}. Put one in brackets; "
            "of a file take `load_controls(path).controls`."
        )
    for index, control in enumerate(controls):
        if not isinstance(control, Control):
            raise TypeError(
                f"`controls[{index}]` must be a JointControl, PathControl or PoseControl, "
                f"got {type(control).__name__}. Read files with `load_controls`."
            )


def _check_frames(samples: ControlSamples, num_frames: int, who: str) -> None:
    last = int(samples.frames.max())
    if last >= num_frames:
        raise ValueError(
            f"{who} names frame {last}, but the clip has {num_frames} frames (0..{num_frames - 1}). "
            "Shorten the control or ask for more seconds."
        )


def _check_agreement(
    samples: ControlSamples,
    targets: Tensor,
    owners: Tensor,
    index: int,
    labels: list[str],
    skeleton: Skeleton,
) -> None:
    cells = (samples.frames[:, None], samples.joints[None, :])
    differs = (targets[cells] - samples.positions).abs() > AGREEMENT
    clashes = (samples.mask & (owners[cells] >= 0) & differs).nonzero()
    if not len(clashes):
        return
    row, column, axis = clashes[0].tolist()
    frame, joint = int(samples.frames[row]), int(samples.joints[column])
    other = int(owners[frame, joint, axis])
    first, second = float(targets[frame, joint, axis]), float(samples.positions[row, column, axis])
    raise ValueError(
        f"control {other} ({labels[other]}) and control {index} ({labels[index]}) contradict each other: "
        f"at frame {frame} they want {skeleton.joint_names[joint]} {AXES[axis]} = {first:.3f} m and "
        f"{second:.3f} m. Remove one or make them agree to 1 mm."
    )
