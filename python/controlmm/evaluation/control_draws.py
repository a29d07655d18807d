"""Which joints are controlled at which frames in an evaluation.

Sources: Xie et al., OmniControl, ICLR 2024; Pinyoanuntapong et al., ControlMM / MaskControl, ICCV 2025.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from controlmm.evaluation.random_streams import draw
from controlmm.motion.skeleton import Skeleton

DENSITIES = (1, 2, 5, 49, 196)  # of 196 frames; the last two are a quarter and all of shorter clips
EVERY_DENSITY = "all"
GROUPS = ("random", "cross", "lower", "all", "none")  # beside the names of joints
JOINED = "+"  # between the names of joints that are controlled together
_PELVIS = "pelvis"  # joint 0 of every skeleton, by this name too
_QUARTER, _WHOLE = 49, 196


@dataclass(frozen=True)
class ControlSetting:
    """What is controlled.

    Attributes:
        control: A joint's name, or several joined by ``+``; ``random`` (one of the six for each sample),
            ``cross`` (one of their 63 combinations for each sample), ``lower`` (pelvis and feet), ``all``
            (all six), ``none``.
        density: 1, 2, 5, 49 or 196 keyframes; ``"all"`` draws one of these for each sample; a fraction such
            as 0.25 takes that share of the frames (TLControl, Figure 7).
    """

    control: str
    density: int | float | str = EVERY_DENSITY

    def check(self, skeleton: Skeleton) -> None:
        """Raise ``ValueError`` if there is no such joint, group or density."""
        joints = {*skeleton.joint_names, _PELVIS}
        if self.control not in GROUPS and not joints.issuperset(self.control.split(JOINED)):
            raise ValueError(
                f"`control` must be a joint ({', '.join(skeleton.joint_names)}), several joined by "
                f"{JOINED!r}, or one of {', '.join(GROUPS)}, got {self.control!r}."
            )
        is_share = isinstance(self.density, float) and 0 < self.density <= 1
        if self.density not in (*DENSITIES, EVERY_DENSITY) and not is_share:
            raise ValueError(
                f"`density` must be one of {', '.join(map(str, DENSITIES))} or {EVERY_DENSITY}, "
                f"got {self.density!r}."
            )


def combinations(skeleton: Skeleton) -> list[tuple[int, ...]]:
    """The 63 non-empty subsets of the six control joints, by size, then in lexicographic order."""
    joints = skeleton.control_joints
    return [some for size in range(1, len(joints) + 1) for some in itertools.combinations(joints, size)]


def draw_joints(control: str, skeleton: Skeleton, generator: torch.Generator) -> tuple[int, ...]:
    """The joints that one sample controls."""
    six = skeleton.control_joints
    if control == "none":
        return ()
    if control == "random":
        return (six[draw(len(six), generator)],)
    if control == "cross":
        return combinations(skeleton)[draw(2 ** len(six) - 1, generator)]
    if control == "all":
        return six
    if control == "lower":
        return (0, skeleton.left_foot[1], skeleton.right_foot[1])
    names = control.split(JOINED)
    return tuple(0 if name == _PELVIS else skeleton.joint_index(name) for name in names)


def draw_frames(density: int | float | str, length: int, generator: torch.Generator) -> Int[Tensor, "K"]:
    """Distinct frames of ``[0, length)``, uniform: 1, 2 or 5 of them; 49: a quarter; 196: all; or a share."""
    if density == EVERY_DENSITY:
        density = DENSITIES[draw(len(DENSITIES), generator)]
    if isinstance(density, float):
        return torch.randperm(length, generator=generator)[: max(1, round(density * length))]
    count = {_QUARTER: length // 4, _WHOLE: length}.get(int(density), int(density))
    return torch.randperm(length, generator=generator)[: min(count, length)]


def draw_mask(
    setting: ControlSetting, length: int, skeleton: Skeleton, *, frames: int, generator: torch.Generator
) -> Bool[Tensor, "T J"]:
    """Controlled joints and frames of a sample of ``length`` frames, padded to ``frames``.

    All chosen joints share their frames.
    """
    joints = draw_joints(setting.control, skeleton, generator)
    at = draw_frames(setting.density, length, generator)
    mask = torch.zeros(frames, skeleton.num_joints, dtype=torch.bool)
    mask[at[:, None], torch.tensor(joints, dtype=torch.long)] = True
    return mask
