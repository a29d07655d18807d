"""What one edit asks for: a motion, what of it is kept, and controls and obstacles in its world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from controlmm.controls import (
    Avoid,
    Control,
    DenseControls,
    Objective,
    Obstacle,
    as_avoids,
    check_kept_clear,
    check_targets_clear,
    densify,
)
from controlmm.generation.terms import HeldTerm, JointTerm, ObjectiveTerm, Placed, obstacle_terms
from controlmm.motion.motion import Motion
from controlmm.motion.skeleton import Skeleton
from controlmm.pipelines.checks import check_objectives
from controlmm.pipelines.source_motion import Interval, SourceMotion, kept_coordinates, kept_frames
from controlmm.text import check_prompt

_AGREEMENT = 0.01  # metres; a source's features give its joints back to some millimetres
_METRE = {"m": 1.0, "mm": 1000.0}  # in a skeleton's unit
_AXES = "xyz"


@dataclass(frozen=True, eq=False)
class EditScene:
    """A checked call of ``edit``.

    Attributes:
        prompt: What the person does where nothing is kept.
        source: The motion, in the networks' frame.
        kept: (T, J) joints that stay where they are: whole poses and parts.
        whole: (T,) frames whose whole pose stays.
        controls: Targets in the world of the motion.
        obstacles: What joints keep out of, there.
        objectives: Functions of the caller's, with whether each takes many clips at once.
        skeleton: Joints and unit.
    """

    prompt: str
    source: SourceMotion
    kept: Bool[Tensor, "T J"]
    whole: Bool[Tensor, "T"]
    controls: DenseControls
    obstacles: tuple[Avoid, ...]
    objectives: tuple[tuple[Objective, bool], ...]
    skeleton: Skeleton

    @classmethod
    def of_call(
        cls,
        motion: Motion,
        prompt: str,
        *,
        keep: Sequence[Interval],
        keep_parts: Sequence[str],
        controls: Sequence[Control],
        obstacles: Sequence[Obstacle | Avoid],
        objectives: Sequence[Objective],
        skeleton: Skeleton,
        max_frames: int,
    ) -> EditScene:
        """Check the arguments of ``edit``.

        Raises:
            TypeError: If one of them has the wrong type.
            ValueError: If one of them is unusable, or they contradict each other.
        """
        prompt = check_prompt(prompt)
        source = SourceMotion.of(motion, skeleton=skeleton, max_frames=max_frames)
        kept = kept_coordinates(source, keep, keep_parts, skeleton)
        dense = densify(controls, source.num_frames, skeleton)
        avoids = as_avoids(obstacles)
        world = source.placed(source.joints)
        _check_agreement(world, kept, dense, skeleton)
        check_targets_clear(dense, avoids, skeleton)
        check_kept_clear(world, kept, avoids, skeleton, slack=_AGREEMENT)
        checked = check_objectives(objectives, source.num_frames, skeleton, torch.zeros(3))
        whole = kept_frames(source.num_frames, keep, skeleton.fps)
        return cls(prompt, source, kept, whole, dense, avoids, checked, skeleton)

    @property
    def shown(self) -> DenseControls:
        """Parts that stay and controls, in the networks' frame: what the control branch sees.

        Controls of x alone or z alone have no such form when the motion stands turned; see :attr:`slanted`.
        """
        parts = (self.kept & ~self.whole[:, None])[..., None].expand(-1, -1, 3)
        mask = self.controls.mask & ~self.slanted
        targets = self.source.unplaced(self.controls.targets)
        return DenseControls(torch.where(mask, targets, self.source.joints * parts), mask | parts)

    @property
    def held(self) -> Bool[Tensor, "T J 3"]:
        """Whole poses that stay, where no control says the same."""
        return (self.kept & self.whole[:, None])[..., None] & ~self.shown.mask

    @property
    def slanted(self) -> Bool[Tensor, "T J 3"]:
        """Controlled coordinates that are no coordinates of the networks' frame."""
        x, z = self.controls.mask[..., 0], self.controls.mask[..., 2]
        alone = (x ^ z) & (not self.source.is_aligned)
        return torch.stack([x & alone, torch.zeros_like(x), z & alone], dim=-1)

    def terms(self, samples: int, padded: int) -> tuple[JointTerm, ...]:
        """What editing minimises beside the distance to targets, for clips of ``padded`` frames."""
        frames, nowhere = self.source.num_frames, torch.zeros(3)
        lengths = torch.full((samples,), frames)
        in_world: list[JointTerm] = [
            *obstacle_terms(
                self.obstacles,
                lengths=lengths,
                frames=frames,
                padded=padded,
                skeleton=self.skeleton,
                origin=nowhere,
            ),
            *(ObjectiveTerm(fn, is_batched, lengths, nowhere) for fn, is_batched in self.objectives),
        ]
        if self.slanted.any():
            in_world.append(held_term(self.controls.targets, self.slanted, samples=samples, padded=padded))
        return tuple(Placed(term, self.source.turn, self.source.offset) for term in in_world)


def held_term(
    targets: Float[Tensor, "T J 3"], mask: Bool[Tensor, "T J 3"], *, samples: int, padded: int
) -> HeldTerm:
    """The same targets for all samples, as a term."""
    missing = (0, 0, 0, 0, 0, padded - len(targets))
    dense = (nn.functional.pad(x, missing).expand(samples, -1, -1, -1) for x in (targets, mask))
    return HeldTerm(*dense)


def _check_agreement(
    world: Float[Tensor, "T J 3"], kept: Bool[Tensor, "T J"], controls: DenseControls, skeleton: Skeleton
) -> None:
    unit = _METRE[skeleton.unit]
    clashes = kept[..., None] & controls.mask & ((world - controls.targets).abs() > _AGREEMENT * unit)
    if not clashes.any():
        return
    frame, joint, axis = clashes.nonzero()[0].tolist()
    raise ValueError(
        f"`controls` want {skeleton.joint_names[joint]} {_AXES[axis]} = "
        f"{float(controls.targets[frame, joint, axis]) / unit:.3f} m at frame {frame}, but what is kept has "
        f"it at {float(world[frame, joint, axis]) / unit:.3f} m. Keep less, or control another frame."
    )
