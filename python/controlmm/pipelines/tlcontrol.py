"""TLControl: text plus trajectories in, human motion out, by one prediction and an optimisation.

Source: Wan et al., TLControl: Trajectory and Language Control for Human Motion Synthesis, ECCV 2024.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from controlmm.controls import Avoid, Control, Objective, Obstacle
from controlmm.generation.code_optimization import optimize_codes
from controlmm.generation.code_prediction import CodePrediction
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.generation.one_thread import one_thread
from controlmm.generation.solvers import Progress, Solution
from controlmm.generation.terms import JointTerm
from controlmm.models.length_estimator import LengthEstimator
from controlmm.models.part_vq_vae import PartVqVae
from controlmm.models.rvq_vae import frame_mask
from controlmm.models.trajectory_transformer import TrajectoryTransformer
from controlmm.motion.body_parts import part_index
from controlmm.motion.motion import Motion
from controlmm.motion.normalizer import Normalizer
from controlmm.nn.checkpoint import PretrainedModel
from controlmm.pipelines.checks import check_masks_end, check_sampling, check_tlcontrol_sizes
from controlmm.pipelines.edit_scene import EditScene
from controlmm.pipelines.output import GenerationResult
from controlmm.pipelines.part_editing import run_part_edit
from controlmm.pipelines.pipeline import MAX_FRAMES, MotionPipeline
from controlmm.pipelines.tlcontrol_presets import TLControlPreset, resolve_tlcontrol_preset
from controlmm.text import TextEncoder


class TLControl(MotionPipeline[TLControlPreset]):
    """Generates motions of the 22 HumanML3D joints from a prompt and spatial controls.

    Takes the same call as :class:`ControlMM`. The networks see the six trajectories (root, head, wrists,
    feet); what they cannot say (other joints) is left to the optimisation.

    Example:
        >>> pipeline = TLControl.from_pretrained()
        >>> result = pipeline("a person walks forward", seconds=4, seed=1)
        >>> result.best.save("walk.bvh")
    """

    kind = "tlcontrol"
    network_classes: ClassVar[Mapping[str, type[PretrainedModel]]] = {
        "tokenizer": PartVqVae,
        "transformer": TrajectoryTransformer,
        "length": LengthEstimator,
    }

    def __init__(
        self,
        *,
        tokenizer: PartVqVae,
        transformer: TrajectoryTransformer,
        normalizer: Normalizer,
        text_encoder: TextEncoder,
        length: LengthEstimator | None = None,
    ) -> None:
        check_tlcontrol_sizes(
            tokenizer=tokenizer.config,
            transformer=transformer.config,
            skeleton=normalizer.skeleton,
            text_dim=text_encoder.dim,
            length=None if length is None else length.config,
        )
        self.length = None if length is None else length.eval().requires_grad_(False)
        self.tokenizer = tokenizer
        self.transformer = transformer.eval().requires_grad_(False)
        self.decoder = MotionDecoder(tokenizer, normalizer)
        self.text_encoder = text_encoder

    def __call__(
        self,
        prompt: str,
        *,
        preset: str | TLControlPreset = "balanced",
        vary: str | None = None,
        **call: Any,
    ) -> GenerationResult:
        """Generate motions; all arguments of :meth:`MotionPipeline.__call__`, and ``vary``.

        Args:
            prompt: What the person does, in words.
            preset: ``fast``, ``balanced``, ``accurate`` (tolerances 1e-5, 1e-6, 1e-8), ``paper`` (the most
                likely codes, the released optimisation) or a :class:`TLControlPreset`.
            vary: A body part (``root``, ``trunk``, ``left_arm``, ``right_arm``, ``left_leg``, ``right_leg``):
                samples draw the codes of this part anew and keep the first sample's codes of all others.
            **call: As for :class:`ControlMM`.

        Raises:
            TypeError: If an argument has the wrong type; nothing has run then.
            ValueError: If an argument is unusable; nothing has run then.
        """
        plan = resolve_tlcontrol_preset(preset)
        if vary is not None:
            plan = dataclasses.replace(plan, vary=vary)
        return super().__call__(prompt, preset=plan, **call)

    @torch.no_grad()
    @one_thread()
    def edit(
        self,
        motion: Motion,
        prompt: str,
        *,
        keep: Sequence[tuple[float, float]] = (),
        keep_parts: Sequence[str] = (),
        controls: Sequence[Control] = (),
        obstacles: Sequence[Obstacle | Avoid] = (),
        objectives: Sequence[Objective] = (),
        exact: bool = True,
        samples: int = 1,
        preset: str | TLControlPreset = "balanced",
        guidance_scale: float | None = None,
        seed: int = 0,
        progress: Progress | None = None,
    ) -> GenerationResult:
        """Change a motion that exists, see :meth:`ControlMM.edit`; something must be kept.

        The network sees the six trajectories of what is kept; tokens that are kept whole have the motion's
        own codes; then all codes are optimised until what is kept, and controls, are where they should be.

        Raises:
            TypeError: If an argument has the wrong type; nothing has run then.
            ValueError: If an argument is unusable, nothing or everything is kept, or what is kept contradicts
                controls or obstacles; nothing has run then.
        """
        check_sampling(samples=samples, seed=seed)
        plan = self.inexact(preset, guidance_scale)
        scene = EditScene.of_call(
            motion,
            prompt,
            keep=keep,
            keep_parts=keep_parts,
            controls=controls,
            obstacles=obstacles,
            objectives=objectives,
            skeleton=self.skeleton,
            max_frames=MAX_FRAMES,
        )
        return run_part_edit(
            self, scene, exact=exact, samples=samples, preset=plan, seed=seed, progress=progress
        )

    def resolve_preset(self, preset: str | TLControlPreset, guidance_scale: float | None) -> TLControlPreset:
        """See :class:`MotionPipeline`."""
        return resolve_tlcontrol_preset(preset, guidance_scale=guidance_scale)

    @torch.no_grad()
    @one_thread()
    def generate_latents(
        self,
        text: Float[Tensor, "B E"],
        *,
        lengths: Sequence[int],
        targets: Float[Tensor, "B T J 3"],
        mask: Bool[Tensor, "B T J 3"],
        seeds: Sequence[int],
        preset: TLControlPreset,
        terms: Sequence[JointTerm] = (),
        progress: Progress | None = None,
    ) -> Float[Tensor, "B L C"]:
        """Latents of a batch of clips of different texts, lengths and targets (the networks' frame).

        Clips without any target keep the codes as drawn, unless there are ``terms``.

        Raises:
            ValueError: If a target lies after the end of its clip.
        """
        check_masks_end(mask, lengths)
        valid = self._valid_tokens(lengths)
        targets, mask = (_padded(x, valid.shape[1] * self.decoder.downsample) for x in (targets, mask))
        prediction = CodePrediction(
            self.transformer, self.decoder, text, valid, seeds, guidance_scale=preset.guidance_scale
        )
        latents = prediction.latents(
            targets,
            mask,
            rounds=preset.rounds,
            temperature=preset.temperature,
            varied=None if preset.vary is None else part_index(preset.vary),
        )
        is_edited = mask.flatten(1).any(1) | bool(terms)
        rows = is_edited.nonzero()[:, 0]
        if preset.iterations and len(rows):
            chosen = [term.select(rows) for term in terms]
            edited = self.optimize(
                latents[rows], valid[rows], targets[rows], mask[rows], preset, terms=chosen, progress=progress
            )
            latents[rows] = edited.latents
        return latents

    def optimize(
        self,
        latents: Float[Tensor, "B L C"],
        valid: Bool[Tensor, "B L"],
        targets: Float[Tensor, "B T J 3"],
        mask: Bool[Tensor, "B T J 3"],
        preset: TLControlPreset,
        *,
        terms: Sequence[JointTerm] = (),
        progress: Progress | None = None,
    ) -> Solution:
        """Test-time optimisation of the continuous codes in front of the frozen decoder (section 3.3).

        Args:
            latents: Where to start: the predicted codes.
            valid: Tokens of each clip.
            targets: Metres, the networks' frame, padded to whole tokens.
            mask: The controlled coordinates.
            preset: Tolerance, limits and forms of the loss.
            terms: Minimised beside the distance.
            progress: Called after every evaluation.
        """
        return optimize_codes(
            self.decoder,
            latents,
            valid,
            targets,
            mask,
            preset,
            unit=self.tokenizer.config.published_unit,
            terms=terms,
            progress=progress,
        )

    def refined_latents(
        self,
        latents: Float[Tensor, "B L C"],
        valid: Bool[Tensor, "B L"],
        targets: Float[Tensor, "B T J 3"],
        mask: Bool[Tensor, "B T J 3"],
        preset: TLControlPreset,
        *,
        terms: Sequence[JointTerm] = (),
        progress: Progress | None = None,
    ) -> Float[Tensor, "B L C"]:
        """See :class:`MotionPipeline`."""
        solution = self.optimize(latents, valid, targets, mask, preset, terms=terms, progress=progress)
        return solution.latents

    @property
    def longest(self) -> int:
        """See :class:`MotionPipeline`."""
        return MAX_FRAMES

    def padded_frames(self, frames: int) -> int:
        """See :class:`MotionPipeline`; networks of the published form always work on their full length."""
        if self.tokenizer.config.latent_norm == "clip":
            return self.transformer.config.max_tokens * self.decoder.downsample
        return super().padded_frames(frames)

    def _valid_tokens(self, lengths: Sequence[int]) -> Bool[Tensor, "B L"]:
        tokens = torch.tensor([self.padded_frames(length) // self.decoder.downsample for length in lengths])
        return frame_mask(tokens, int(tokens.max()))


def _padded(dense: Tensor, frames: int) -> Tensor:
    return nn.functional.pad(dense, (0, 0, 0, 0, 0, frames - dense.shape[1]))
