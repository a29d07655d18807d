"""ControlMM: text plus 3D control in, human motion out.

Source: Pinyoanuntapong et al., ControlMM / MaskControl, ICCV 2025.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from controlmm.controls import Avoid, Control, Objective, Obstacle
from controlmm.generation.frozen_matrix import has_fast_bfloat16
from controlmm.generation.latent_editing import edit_latents
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.generation.objective import ControlObjective
from controlmm.generation.one_thread import one_thread
from controlmm.generation.packed_networks import PackedCopies
from controlmm.generation.shares import in_shares
from controlmm.generation.solvers import Progress
from controlmm.generation.terms import JointTerm
from controlmm.models.control_branch import ControlBranch
from controlmm.models.length_estimator import LengthEstimator
from controlmm.models.masked_transformer import MaskedTransformer
from controlmm.models.residual_control import ResidualControl
from controlmm.models.residual_transformer import ResidualTransformer
from controlmm.models.rvq_vae import RvqVae, frame_mask
from controlmm.motion.motion import Motion
from controlmm.motion.normalizer import Normalizer
from controlmm.nn.checkpoint import PretrainedModel
from controlmm.pipelines.adjusting import adjusted
from controlmm.pipelines.checks import check_masks_end, check_sizes
from controlmm.pipelines.clip_batch import ClipBatch, share_count
from controlmm.pipelines.guidance import PUBLISHED, Guidance
from controlmm.pipelines.motion_editing import run_edit
from controlmm.pipelines.output import GenerationResult
from controlmm.pipelines.pipeline import MotionPipeline
from controlmm.pipelines.presets import Preset, resolve_preset, with_limits
from controlmm.text import TextEncoder

_Network = TypeVar("_Network", bound=nn.Module)


class ControlMM(MotionPipeline[Preset]):
    """Generates motions of the 22 HumanML3D joints from a prompt and spatial controls.

    Example:
        >>> pipeline = ControlMM.from_pretrained()
        >>> result = pipeline("a person walks forward", seconds=4, seed=1)
        >>> result.best.save("walk.bvh")
    """

    kind = "controlmm"
    network_classes: ClassVar[Mapping[str, type[PretrainedModel]]] = {
        "tokenizer": RvqVae,
        "transformer": MaskedTransformer,
        "residual": ResidualTransformer,
        "control": ControlBranch,
        "residual_control": ResidualControl,
        "length": LengthEstimator,
    }
    settings: ClassVar[Mapping[str, Callable[[Mapping[str, Any]], Any]]] = {"guidance": Guidance.of}

    def __init__(
        self,
        *,
        tokenizer: RvqVae,
        transformer: MaskedTransformer,
        residual: ResidualTransformer,
        control: ControlBranch,
        normalizer: Normalizer,
        text_encoder: TextEncoder,
        residual_control: ResidualControl | None = None,
        length: LengthEstimator | None = None,
        guidance: Guidance = PUBLISHED,
    ) -> None:
        control.config.check_base(transformer.config)
        if residual_control is not None:
            residual_control.config.check_base(residual.config)
        check_sizes(
            tokenizer=tokenizer.config,
            transformer=transformer.config,
            residual=residual.config,
            control=control.config,
            residual_control=None if residual_control is None else residual_control.config,
            skeleton=normalizer.skeleton,
            text_dim=text_encoder.dim,
            length=None if length is None else length.config,
        )
        self.length = None if length is None else length.eval().requires_grad_(False)
        self.tokenizer = tokenizer
        self.transformer = transformer.eval().requires_grad_(False)
        self.residual = residual.eval().requires_grad_(False)
        self.control = control.eval().requires_grad_(False)
        self.residual_control = (
            None if residual_control is None else residual_control.eval().requires_grad_(False)
        )
        self.decoder = MotionDecoder(tokenizer, normalizer)
        self.text_encoder = text_encoder
        self.guidance = guidance
        self._packed = PackedCopies()

    def resolve_preset(self, preset: str | Preset, guidance_scale: float | None) -> Preset:
        """See :class:`MotionPipeline`."""
        plan = resolve_preset(preset, guidance_scale=guidance_scale)
        scales = self.guidance.under(plan)
        return replace(
            plan,
            guidance_scale=scales.base,
            residual_guidance_scale=scales.residual,
            guided_share=scales.share,
        )

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
        preset: str | Preset = "balanced",
        guidance_scale: float | None = None,
        seed: int = 0,
        progress: Progress | None = None,
    ) -> GenerationResult:
        """Change a motion that exists: what is kept stays, the rest follows the prompt.

        - ``keep``: whole poses stay in these intervals, the tokens outside are drawn anew (in-painting):
          a new ending, beginning or middle.
        - ``keep_parts``: these parts stay at all frames, under control: ``["lower"]`` (pelvis and feet) gives
          the upper body a new task.
        - neither: each of ten steps draws the least certain 16 % of the tokens anew; the motion drifts
          towards the prompt.

        Controls, obstacles and objectives count as in a call, in the world of ``motion``.

        Args:
            motion: What to change, at most 196 frames at 20 fps, anywhere in the world.
            prompt: What the person does where nothing is kept.
            keep: (start, end) in seconds; may be several.
            keep_parts: Parts (see ``controlmm.controls.PARTS``) or joints.
            controls: Targets in the world of ``motion``; on what is kept they must agree with it to 1 cm.
            obstacles: Shapes that joints keep out of, there. Nothing that is kept may be inside.
            objectives: As in a call.
            exact: Move what was kept back onto the source after drawing: a kept ending is where it was.
                ``False`` leaves it as the tokens decode: poses are kept to some centimetres, but the way
                on the ground goes on from wherever the new part leads.
            samples: As in a call.
            preset: As in a call.
            guidance_scale: As in a call.
            seed: As in a call.
            progress: As in a call.

        Returns:
            Motions in the world of ``motion``; ``control_error`` is the mean distance of what was kept or
            that of the controlled joints, whichever is larger.

        Raises:
            TypeError: If an argument has the wrong type; nothing has run then.
            ValueError: If an argument is unusable, everything is kept, or what is kept contradicts controls
                or obstacles; nothing has run then.
        """
        return run_edit(
            self,
            motion,
            prompt,
            keep=keep,
            keep_parts=keep_parts,
            controls=controls,
            obstacles=obstacles,
            objectives=objectives,
            exact=exact,
            samples=samples,
            preset=self.inexact(preset, guidance_scale),
            seed=seed,
            progress=progress,
        )

    @torch.no_grad()
    @one_thread()
    def adjust(
        self,
        result: GenerationResult,
        controls: Sequence[Control],
        *,
        hold_frames: int = 0,
        tolerance: float = 0.02,
    ) -> GenerationResult:
        """Move the targets of a result and solve again from where it stands: for dragging a target about.

        No network but the decoder runs, and motions change least, so that what the new targets leave alone
        stays. Latents are edited to ``tolerance`` or as well as 40 steps can, then joints are put on their
        targets, and bones get their lengths.

        Args:
            result: What a call or an earlier :meth:`adjust` returned.
            controls: All targets that hold now, in the world of ``result``.
            hold_frames: The first frames stay as they are, to the bit.
            tolerance: Metres.

        Returns:
            The same motions, adjusted; the world's origin is that of ``result``.

        Raises:
            TypeError: If ``result`` is none.
            ValueError: If an argument is unusable; nothing has run then.
        """
        return adjusted(self.decoder, result, controls, hold_frames=hold_frames, tolerance=tolerance)

    def closes(self, plan: Preset, *, has_terms: bool) -> bool:
        """See :class:`MotionPipeline`."""
        return plan.closes(has_terms=has_terms)

    def is_exact(self, plan: Preset) -> bool:
        """See :class:`MotionPipeline`."""
        return plan.is_exact

    def open_ended(self, plan: Preset) -> Preset:
        """See :class:`MotionPipeline`."""
        return replace(plan, closes_from=None)

    def limited(
        self,
        plan: Preset,
        tolerance: str | float | None,
        time_budget: str | float | None,
        naturalness: float | None,
    ) -> Preset:
        """See :class:`MotionPipeline`."""
        return with_limits(plan, tolerance=tolerance, time_budget=time_budget, naturalness=naturalness)

    @property
    def longest(self) -> int:
        """See :class:`MotionPipeline`."""
        tokens = min(self.transformer.config.max_tokens, self.residual.config.max_tokens)
        return tokens * self.decoder.downsample

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
        preset: Preset,
        terms: Sequence[JointTerm] = (),
        progress: Progress | None = None,
    ) -> Float[Tensor, "B L C"]:
        """Latents of a batch of clips of different texts, lengths and targets (canonical frame).

        Clips without any target are decoded with the control branch off: from text alone, and then edited if
        there are ``terms``, else with their feet planted as strongly as ``preset`` is natural.

        Raises:
            ValueError: If a target lies after the end of its clip.
        """
        check_masks_end(mask, lengths)
        step = self.decoder.downsample
        tokens = torch.tensor([-(-length // step) for length in lengths])
        valid = frame_mask(tokens, int(tokens.max()))
        targets, mask = (_padded(dense, valid.shape[1] * step) for dense in (targets, mask))
        batch = ClipBatch(text, valid, targets, mask, seeds, terms)
        return in_shares(
            lambda rows, report: batch.select(rows).latents(self, preset, report),
            batch.costs,
            threads=share_count(preset, terms),
            progress=progress,
        )

    def drawing_dtype(self, preset: Preset) -> torch.dtype:
        """In which the networks that draw tokens multiply. Published ones keep to what they were made in."""
        is_ours = self.control.config.has_observation_mask
        return torch.bfloat16 if preset.is_bfloat16 and is_ours and has_fast_bfloat16() else torch.float32

    def packed(self, network: _Network, dtype: torch.dtype) -> _Network:
        """A quicker copy of one of the networks, see :mod:`controlmm.generation.packed_networks`."""
        return self._packed.of(network, dtype)

    def refined_latents(
        self,
        latents: Float[Tensor, "B L C"],
        valid: Bool[Tensor, "B L"],
        targets: Float[Tensor, "B T J 3"],
        mask: Bool[Tensor, "B T J 3"],
        preset: Preset,
        *,
        terms: Sequence[JointTerm] = (),
        progress: Progress | None = None,
    ) -> Float[Tensor, "B L C"]:
        """See :class:`MotionPipeline`."""
        frames = valid.repeat_interleave(self.decoder.downsample, dim=1)
        keep = valid[..., None].float()

        def refine(rows: Tensor, report: Progress | None) -> Tensor:
            objective = ControlObjective(
                self.decoder,
                targets[rows],
                mask[rows],
                frames[rows],
                norm=preset.control_norm,
                terms=[term.select(rows) for term in terms],
            )
            return edit_latents(objective, latents[rows], keep[rows], preset.budget, progress=report).latents

        costs = valid.sum(1).tolist()
        return in_shares(refine, costs, threads=share_count(preset, terms), progress=progress)


def _padded(dense: Tensor, frames: int) -> Tensor:
    return nn.functional.pad(dense, (0, 0, 0, 0, 0, frames - dense.shape[1]))
