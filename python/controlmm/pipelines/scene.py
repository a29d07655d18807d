"""What one call asks for, in the user's world and in the frame that the networks work in."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.controls import (
    Avoid,
    Control,
    DenseControls,
    Objective,
    Obstacle,
    as_avoids,
    check_targets_clear,
    densify,
    penetration,
)
from controlmm.generation.exact import ExactReport
from controlmm.generation.objective import control_error
from controlmm.generation.terms import JointTerm, ObjectiveTerm, OnFloor, obstacle_terms
from controlmm.motion.ground import grounded
from controlmm.motion.motion import Motion
from controlmm.motion.skeleton import Skeleton
from controlmm.pipelines.checks import check_objectives, frame_count
from controlmm.pipelines.output import GenerationResult
from controlmm.pipelines.placement import moved, start_position
from controlmm.text import check_prompt


@dataclass(frozen=True, eq=False)
class Scene:
    """A checked call: prompt, length, targets, obstacles and objectives.

    Attributes:
        prompt: What the person does.
        frames: Length of the motion.
        controls: Targets as the caller gave them, metres, Y up.
        origin: Where the body starts on the ground; the networks' frame has it at x = z = 0.
        obstacles: What joints keep out of, as the caller gave it.
        objectives: Functions of the caller's, with whether each takes many clips at once.
    """

    prompt: str
    frames: int
    controls: DenseControls
    origin: Float[Tensor, "3"]
    obstacles: tuple[Avoid, ...] = ()
    objectives: tuple[tuple[Objective, bool], ...] = ()

    @classmethod
    def of_call(
        cls,
        prompt: str,
        controls: Sequence[Control],
        *,
        obstacles: Sequence[Obstacle | Avoid] = (),
        objectives: Sequence[Objective] = (),
        seconds: float | None,
        frames: int | None,
        skeleton: Skeleton,
        max_frames: int,
    ) -> Scene:
        """Check the arguments of a pipeline's call.

        Raises:
            ValueError: If one of them is unusable, or controls contradict each other.
        """
        prompt = check_prompt(prompt)
        count = frame_count(seconds=seconds, frames=frames, skeleton=skeleton, max_frames=max_frames)
        dense = densify(controls, count, skeleton)
        avoids = as_avoids(obstacles)
        check_targets_clear(dense, avoids, skeleton)
        origin = start_position(dense)
        checked = check_objectives(objectives, count, skeleton, origin)
        return cls(prompt, count, dense, origin, avoids, checked)

    @property
    def canonical(self) -> DenseControls:
        """The targets in the networks' frame."""
        return moved(self.controls, -self.origin)

    @property
    def stands_on_floor(self) -> bool:
        """Whether the motions are moved onto the floor: they are without height targets."""
        return not self.controls.mask[..., 1].any()

    def terms(
        self,
        samples: int,
        *,
        padded: int,
        skeleton: Skeleton,
        frames: int | None = None,
        on_floor: bool | None = None,
    ) -> tuple[JointTerm, ...]:
        """What editing minimises beside the targets, for a batch of ``samples`` clips.

        Args:
            samples: Clips of the batch.
            padded: Frames of the padded batch.
            skeleton: Joints and unit.
            frames: Length of the clips, if they are only the beginning of the scene.
            on_floor: Whether the motions will be stood on the floor; ``None``: as :attr:`stands_on_floor`.
        """
        frames = self.frames if frames is None else frames
        lengths = torch.full((samples,), frames)
        terms: list[JointTerm] = [
            *obstacle_terms(
                self.obstacles,
                lengths=lengths,
                frames=self.frames,
                padded=padded,
                skeleton=skeleton,
                origin=self.origin,
            ),
            *(
                ObjectiveTerm(objective, is_batched, lengths, self.origin)
                for objective, is_batched in self.objectives
            ),
        ]
        if self.stands_on_floor if on_floor is None else on_floor:
            return tuple(OnFloor(term, lengths) for term in terms)
        return tuple(terms)

    def result(
        self,
        features: Float[Tensor, "S T D"],
        latents: Float[Tensor, "S L C"],
        *,
        seconds_taken: float,
        on_floor: bool | None = None,
        exact: tuple[ExactReport, ...] = (),
    ) -> GenerationResult:
        """Decoded features (de-normalised, networks' frame) as motions in the user's world.

        Without height targets each motion is stood on the floor, unless ``on_floor`` says otherwise.
        """
        if self.stands_on_floor if on_floor is None else on_floor:
            features = grounded(features)
        motions = tuple(self._motion(clip) for clip in features)
        joints = torch.stack([motion.joints for motion in motions])
        error = control_error(
            joints, self.controls.targets.expand_as(joints), self.controls.mask.expand_as(joints)
        )
        depth = penetration(joints, self.obstacles, motions[0].skeleton)
        return GenerationResult(motions, error, depth, latents, seconds_taken, exact)

    def _motion(self, features: Float[Tensor, "T D"]) -> Motion:
        motion = Motion.from_features(features.contiguous(), text=self.prompt)
        controls = self.controls
        extra: dict[str, Any] = {}
        if not controls.is_empty:
            extra |= {"targets": controls.targets, "mask": controls.mask}
        if self.obstacles:
            extra["obstacles"] = self.obstacles
        return dataclasses.replace(motion, joints=motion.joints + self.origin, extra=extra)
