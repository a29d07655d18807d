"""The public call, which every pipeline shares: checks first, then latents, then motions."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import partial
from typing import Generic, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.controls import Avoid, Control, Objective, Obstacle, TimelineEntry
from controlmm.generation.exact import ExactReport
from controlmm.generation.noise import clip_seeds
from controlmm.generation.one_thread import one_thread
from controlmm.generation.solvers import Progress
from controlmm.generation.terms import JointTerm
from controlmm.models.length_estimator import LengthEstimator
from controlmm.pipelines.chaining import run_chain
from controlmm.pipelines.checks import check_sampling
from controlmm.pipelines.closing import close_clips
from controlmm.pipelines.length import draw_frames
from controlmm.pipelines.output import GenerationResult
from controlmm.pipelines.pretrained import PretrainedPipeline
from controlmm.pipelines.reach import check_reach
from controlmm.pipelines.scene import Scene
from controlmm.pipelines.timeline import TimelineMethod, run_timeline
from controlmm.text import check_prompt

MAX_FRAMES = 196


_Plan = TypeVar("_Plan")  # a pipeline's kind of preset


class MotionPipeline(PretrainedPipeline, ABC, Generic[_Plan]):
    """Text plus 3D control in, motions out. A subclass says how the latents of a batch are made.

    One clip takes one thread: operators are so small that two would save a tenth of the time, and wait for
    each other twenty times as long where another program keeps a core busy. A batch is dealt out to as many
    threads as torch may use, with the same results; ``torch.set_num_threads(1)`` forbids it.
    """

    length: LengthEstimator | None = None  # draws the length of motions whose caller does not say

    @abstractmethod
    def generate_latents(
        self,
        text: Float[Tensor, "B E"],
        *,
        lengths: Sequence[int],
        targets: Float[Tensor, "B T J 3"],
        mask: Bool[Tensor, "B T J 3"],
        seeds: Sequence[int],
        preset: _Plan,
        terms: Sequence[JointTerm] = (),
        progress: Progress | None = None,
    ) -> Float[Tensor, "B L C"]:
        """Latents of a batch of clips of different texts, lengths and targets (the networks' frame).

        ``terms`` are minimised beside the distance to the targets.

        Raises:
            ValueError: If a target lies after the end of its clip.
        """

    @abstractmethod
    def refined_latents(
        self,
        latents: Float[Tensor, "B L C"],
        valid: Bool[Tensor, "B L"],
        targets: Float[Tensor, "B T J 3"],
        mask: Bool[Tensor, "B T J 3"],
        preset: _Plan,
        *,
        terms: Sequence[JointTerm] = (),
        progress: Progress | None = None,
    ) -> Float[Tensor, "B L C"]:
        """Latents moved towards targets (the networks' frame, padded to whole tokens) and ``terms``."""

    @abstractmethod
    def resolve_preset(self, preset: str | _Plan, guidance_scale: float | None) -> _Plan:
        """A preset or the one of that name; ``guidance_scale`` replaces its own unless it is ``None``.

        Raises:
            TypeError: If it is neither.
            ValueError: If there is none of that name.
        """

    @torch.no_grad()
    @one_thread()
    def __call__(
        self,
        prompt: str,
        *,
        seconds: float | None = None,
        frames: int | None = None,
        controls: Sequence[Control] = (),
        obstacles: Sequence[Obstacle | Avoid] = (),
        objectives: Sequence[Objective] = (),
        samples: int = 1,
        preset: str | _Plan = "balanced",
        guidance_scale: float | None = None,
        tolerance: str | float | None = None,
        time_budget: str | float | None = None,
        naturalness: float | None = None,
        seed: int = 0,
        progress: Progress | None = None,
    ) -> GenerationResult:
        """Generate ``samples`` motions.

        Without height targets each motion is stood on the floor: its lowest joint touches y = 0.

        Args:
            prompt: What the person does, in words.
            seconds: Length, 0.4 to 9.8 s; or pass ``frames`` (8 to 196, at 20 fps). Without either, a
                length drawn by the model's length estimator if it has one, else 6 s.
            frames: Length in frames.
            controls: Targets in metres, Y up, ground at y = 0. The body starts facing +Z (its left is +X), at
                x = z = 0 unless a control names the pelvis at frame 0. Contradicting or impossible frames are
                refused.
            obstacles: Shapes that joints keep out of, still or moving, in the world of the controls; wrap
                one in :class:`Avoid` to choose joints and margin.
            objectives: Differentiable functions of the joints to be made small.
            samples: How many motions; sample ``i`` is the same however many are asked for.
            preset: ``fast``, ``balanced``, ``accurate``, ``exact``, a paper's (``paper-accurate``), or
                a preset of one's own. Ours put joints on their targets and give bones their lengths, unless
                there are obstacles or objectives.
            guidance_scale: How strongly the text counts; ``None`` takes the preset's, or the model's.
            tolerance: Control error at which the editing of latents is done, in metres or as ``"1mm"``;
                ``None`` takes the preset's.
            time_budget: Time for the editing of latents, in seconds or as ``"200ms"``. Results then depend on
                the speed of the machine.
            naturalness: How strongly editing keeps what no target leads as it was: 0 not at all, 1 as the
                presets do (the papers' do not). Feet at rest stay, joints do not shake, and the ground stays
                level where heights are free; 0 if a path climbs stairs. Without targets only feet count.
            seed: Same seed, same motions.
            progress: Called as ``progress(phase, done, total)`` during long loops, from the caller's thread.

        Raises:
            TypeError: If an argument has the wrong type; nothing has run then.
            ValueError: If an argument is unusable, or a target lies inside an obstacle; nothing has run then.
        """
        started = time.perf_counter()
        check_sampling(samples=samples, seed=seed)
        plan = self.resolve_preset(preset, guidance_scale)
        plan = self.limited(plan, tolerance, time_budget, naturalness)
        arrange = partial(
            Scene.of_call,
            prompt,
            controls,
            obstacles=obstacles,
            objectives=objectives,
            skeleton=self.skeleton,
            max_frames=MAX_FRAMES,
        )
        if seconds is None and frames is None and self.length is not None:
            arrange(seconds=None, frames=MAX_FRAMES)  # an unusable call is refused before any network runs
            frames = self._drawn_frames(self.length, prompt, controls, seed)
        scene = arrange(seconds=seconds, frames=frames)
        reached = check_reach(scene.controls, self.skeleton, is_strict=self.is_exact(plan))
        canonical = scene.canonical
        targets, mask = (x.expand(samples, -1, -1, -1) for x in (canonical.targets, canonical.mask))
        terms = scene.terms(samples, padded=self.padded_frames(scene.frames), skeleton=self.skeleton)
        latents = self.generate_latents(
            self.text_encoder.encode([scene.prompt]).pooled.expand(samples, -1),
            lengths=[scene.frames] * samples,
            targets=targets,
            mask=mask,
            seeds=clip_seeds(seed, samples),
            preset=plan,
            terms=terms,
            progress=progress,
        )
        features = self.decoder.clip_features(latents)[:, : scene.frames]
        reports: tuple[ExactReport, ...] = ()
        if self.closes(plan, has_terms=bool(terms)):
            within = mask & reached[:, None, None]
            reports = close_clips(features, targets, within, [scene.frames] * samples, self.skeleton)
        seconds_taken = time.perf_counter() - started
        return scene.result(features, latents, seconds_taken=seconds_taken, exact=reports)

    def closes(self, plan: _Plan, *, has_terms: bool) -> bool:  # noqa: ARG002 (for subclasses)
        """Whether joints are put on their targets after editing, and bones get their lengths."""
        return False

    def is_exact(self, plan: _Plan) -> bool:  # noqa: ARG002 (for subclasses)
        """Whether targets that bones cannot span are refused."""
        return False

    def open_ended(self, plan: _Plan) -> _Plan:
        """The plan where latents do all: joints must not be put on what editing moves them towards."""
        return plan

    def inexact(self, preset: str | _Plan, guidance_scale: float | None) -> _Plan:
        """The preset for a call that cannot say beforehand what is out of reach.

        Raises:
            TypeError: If it is none.
            ValueError: If there is none of that name, or it is to be exact.
        """
        plan = self.resolve_preset(preset, guidance_scale)
        if self.is_exact(plan):
            raise ValueError(
                "`preset` 'exact' makes single motions from controls. Use 'accurate' for `timeline`, `chain` "
                "and `edit`: it meets what bones can span as exactly."
            )
        return plan

    def limited(
        self,
        plan: _Plan,
        tolerance: str | float | None,
        time_budget: str | float | None,
        naturalness: float | None,
    ) -> _Plan:
        """``plan`` with other limits of editing and another strength of its natural terms.

        Raises:
            ValueError: If a limit is unusable, or this pipeline knows none.
        """
        if not (tolerance is time_budget is naturalness is None):
            raise ValueError(
                f"{type(self).__name__} knows no `tolerance`, no `time_budget` and no `naturalness`. "
                "Choose a preset instead."
            )
        return plan

    def padded_frames(self, frames: int) -> int:
        """Frames that the networks work on for a motion of ``frames``: whole tokens."""
        step = self.decoder.downsample
        return -(-frames // step) * step

    @torch.no_grad()
    @one_thread()
    def timeline(
        self,
        entries: Sequence[TimelineEntry],
        *,
        controls: Sequence[Control] = (),
        obstacles: Sequence[Obstacle | Avoid] = (),
        samples: int = 1,
        preset: str | _Plan = "balanced",
        guidance_scale: float | None = None,
        seed: int = 0,
        method: TimelineMethod = "tracks",
        progress: Progress | None = None,
    ) -> GenerationResult:
        """Generate motions in which body parts follow prompts of their own, each in its own time.

        An entry decides its part in its interval; where two entries name a part, the earlier one does. What
        nobody names follows the entry that moves the legs, else the first that is there.

        ``tracks`` makes a motion of every entry apart, as long as its interval, puts their parts onto one
        body, and moves that towards controls and away from obstacles. ``passes`` makes the motion again for
        every entry: each pass holds what earlier entries decided, and the whole body outside the entry's
        interval but for 5 frames of transition. ``published`` is the same without the latter: each prompt
        acts on the whole clip.

        Args:
            entries: Parts, prompts and intervals; may overlap. The motion ends with the last of them.
            controls: As in a call.
            obstacles: As in a call.
            samples: As in a call.
            preset: As in a call, for every pass.
            guidance_scale: As in a call.
            seed: As in a call.
            method: ``tracks``, ``passes`` or ``published``.
            progress: As in a call; every pass reports anew.

        Returns:
            The motions; ``control_error`` is how well the tracks, or the last pass, held what entries and
            controls had decided.

        Raises:
            TypeError: If an argument has the wrong type; nothing has run then.
            ValueError: If an argument is unusable or the timeline is longer than the networks can make.
        """
        return run_timeline(
            self,
            entries,
            controls=controls,
            obstacles=obstacles,
            samples=samples,
            preset=self.inexact(preset, guidance_scale),
            seed=seed,
            method=method,
            progress=progress,
        )

    @torch.no_grad()
    @one_thread()
    def chain(
        self,
        clips: Sequence[tuple[str, float]],
        *,
        overlap: float = 0.8,
        samples: int = 1,
        preset: str | _Plan = "balanced",
        guidance_scale: float | None = None,
        seed: int = 0,
        progress: Progress | None = None,
    ) -> GenerationResult:
        """Generate motions of any length, clip after clip.

        Each clip begins with the poses in which the one before ends, all joints controlled; over these frames
        one fades into the other.

        Args:
            clips: (prompt, seconds) of each clip, 0.4 to 9.8 s and more than twice the overlap.
            overlap: Seconds that neighbours share, at least 0.4.
            samples: As in a call.
            preset: As in a call.
            guidance_scale: As in a call.
            seed: As in a call.
            progress: As in a call; every clip reports anew.

        Returns:
            The whole motions; ``control_error`` is the greatest distance at a joint between two clips (mean
            over its frames and joints), ``latents`` those of the last clip.

        Raises:
            ValueError: If an argument is unusable; nothing has run then.
        """
        return run_chain(
            self,
            clips,
            overlap=overlap,
            max_frames=MAX_FRAMES,
            samples=samples,
            preset=self.inexact(preset, guidance_scale),
            seed=seed,
            progress=progress,
        )

    @property
    @abstractmethod
    def longest(self) -> int:
        """Frames of the longest motion that the networks can make, which may exceed what a call allows."""

    def _drawn_frames(
        self, estimator: LengthEstimator, prompt: str, controls: Sequence[Control], seed: int
    ) -> int:
        text = self.text_encoder.encode([check_prompt(prompt)]).pooled
        return draw_frames(
            estimator,
            text,
            controls=controls,
            skeleton=self.skeleton,
            max_frames=MAX_FRAMES,
            downsample=self.decoder.downsample,
            seed=seed,
        )
