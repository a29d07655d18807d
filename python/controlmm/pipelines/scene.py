"""What one call asks for, in the user's world and in the frame that the networks work in."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.controls import Control, DenseControls, densify
from controlmm.generation.objective import control_error
from controlmm.motion.ground import grounded
from controlmm.motion.motion import Motion
from controlmm.motion.skeleton import Skeleton
from controlmm.pipelines.checks import frame_count
from controlmm.pipelines.output import GenerationResult
from controlmm.pipelines.placement import moved, start_position
from controlmm.text import check_prompt


@dataclass(frozen=True, eq=False)
class Scene:
    """A checked call: prompt, length and targets.

    Attributes:
        prompt: What the person does.
        frames: Length of the motion.
        controls: Targets as the caller gave them, metres, Y up.
        origin: Where the body starts on the ground; the networks' frame has it at x = z = 0.
    """

    prompt: str
    frames: int
    controls: DenseControls
    origin: Float[Tensor, "3"]

    @classmethod
    def of_call(
        cls,
        prompt: str,
        controls: Sequence[Control],
        *,
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
        return cls(prompt, count, dense, start_position(dense))

    @property
    def canonical(self) -> DenseControls:
        """The targets in the networks' frame."""
        return moved(self.controls, -self.origin)

    def result(
        self, features: Float[Tensor, "S T D"], latents: Float[Tensor, "S L C"], *, seconds_taken: float
    ) -> GenerationResult:
        """Decoded features (de-normalised, networks' frame) as motions in the user's world.

        Without height targets each motion is stood on the floor.
        """
        if not self.controls.mask[..., 1].any():
            features = grounded(features)
        motions = tuple(self._motion(clip) for clip in features)
        joints = torch.stack([motion.joints for motion in motions])
        error = control_error(
            joints, self.controls.targets.expand_as(joints), self.controls.mask.expand_as(joints)
        )
        return GenerationResult(motions, error, latents, seconds_taken)

    def _motion(self, features: Float[Tensor, "T D"]) -> Motion:
        motion = Motion.from_features(features.contiguous(), text=self.prompt)
        controls = self.controls
        extra = {} if controls.is_empty else {"targets": controls.targets, "mask": controls.mask}
        return dataclasses.replace(motion, joints=motion.joints + self.origin, extra=extra)
