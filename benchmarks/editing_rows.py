"""One row of the table of editing: a solver on the clips of one choice of joints and keyframes."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from benchmarks.progress_file import Row
from controlmm import ControlMM
from controlmm.evaluation.batch_scores import BatchScores, score_batch
from controlmm.evaluation.control_draws import ControlSetting
from controlmm.evaluation.evaluators import Evaluator
from controlmm.evaluation.motion_sources import Batch, Produced, pooled_texts
from controlmm.evaluation.protocol import Protocol, batches_of
from controlmm.evaluation.retrieval import GROUP
from controlmm.evaluation.scores import repeat_scores
from controlmm.evaluation.test_set import TestSet
from controlmm.generation.editing import EditingBudget
from controlmm.generation.exact import meet_exactly
from controlmm.generation.latent_editing import edit_latents
from controlmm.generation.objective import ControlObjective
from controlmm.models.rvq_vae import frame_mask
from controlmm.pipelines import PRESETS, Preset

UNEDITED = replace(PRESETS["accurate"], budget=EditingBudget(latent_iterations=0), closes_from=None)
PLANS: dict[str, Preset] = {
    "unedited": UNEDITED,
    "latents alone": replace(PRESETS["accurate"], closes_from=None),
    "gauss-newton": PRESETS["accurate"],
    "fast": PRESETS["fast"],
    "exact": PRESETS["exact"],
    "lbfgs": replace(PRESETS["accurate"], budget=replace(PRESETS["accurate"].budget, solver="lbfgs")),
    "paper-fast": PRESETS["paper-fast"],
    "paper-accurate": PRESETS["paper-accurate"],
}
REAL = "recorded"
_TRIALS = 5  # of a plain evaluation


@dataclass(frozen=True)
class Edited:
    """A clip after editing: features (T, D), processor seconds of the editing alone, its end included."""

    features: Tensor
    seconds: float
    evaluations: int
    worth: float  # of the seconds, in plain evaluations of the same clip


class Bench:
    """What all rows share, and the tokens of the latest choice of joints and keyframes."""

    def __init__(
        self,
        pipeline: ControlMM,
        evaluator: Evaluator,
        test_set: TestSet,
        protocol: Protocol,
        *,
        slow_limit: int,
    ) -> None:
        self.pipeline, self.evaluator = pipeline, evaluator
        self.test_set, self.protocol, self._slow_limit = test_set, protocol, slow_limit
        self._drawn: dict[tuple[ControlSetting, int], Tensor] = {}

    def row(self, solver: str, setting: ControlSetting) -> Row:
        """Scores of one solver. Errors, seconds and evaluations are medians over clips, the rest means."""
        found: list[BatchScores] = []
        clips: list[Edited] = []
        protocol = self.protocol
        if is_slow(solver):
            protocol = replace(protocol, limit=min(self._slow_limit, protocol.limit or self._slow_limit))
        for number, pairs in enumerate(batches_of(self.test_set, setting, protocol, 0)):
            samples, masks = zip(*pairs, strict=True)
            batch = Batch.of(samples, masks, seed=protocol.seed, repeat=0)
            features = batch.real
            if solver != REAL:
                edited = self._edited(PLANS[solver], batch, (setting, number))
                clips += edited
                features = torch.zeros_like(batch.real)
                for row, clip in zip(features, edited, strict=True):
                    row[: len(clip.features)] = clip.features
            found.append(score_batch(batch, Produced(features, 0.0, has_padding=False), self.evaluator))
        scores = repeat_scores(found, seed=protocol.seed, repeat=0)
        scores["fid"] = scores["fid"] if sum(len(part.motions) for part in found) >= GROUP else math.nan
        errors = torch.cat([scores_of.numbers["average_joint"] for scores_of in found])
        return {
            "error_cm": 100 * errors.median().item(),
            "worst_cm": 100 * errors.max().item(),
            "seconds": _median([clip.seconds for clip in clips]),
            "evaluations": _median([float(clip.evaluations) for clip in clips]),
            "worth": _median([clip.worth for clip in clips]),
            **{name: scores[name] for name in ("fid", "r3", "mm_distance", "skating", "jerk")},
            "bones_mm": 1000 * scores["bone_deviation"],
            "clips": len(errors),
        }

    def _edited(self, plan: Preset, batch: Batch, place: tuple[ControlSetting, int]) -> list[Edited]:
        """All clips of a batch; their tokens are drawn together, and then each is edited alone."""
        in_logits = plan.budget.logits_iterations * plan.steps
        began = time.thread_time()
        if in_logits:
            latents = self._latents(plan, batch)
        else:
            if place not in self._drawn:
                self._drawn = {key: known for key, known in self._drawn.items() if key[0] == place[0]}
                self._drawn[place] = self._latents(PRESETS["accurate"], batch)  # whatever comes first
            latents = self._drawn[place]
        share = (time.thread_time() - began) / len(latents) if in_logits else 0.0
        return [
            self._clip(plan, batch, clip, latents[clip : clip + 1], share, in_logits)
            for clip in range(len(latents))
        ]

    def _latents(self, plan: Preset, batch: Batch) -> Tensor:
        pipeline, budget = self.pipeline, plan.budget
        return pipeline.generate_latents(
            pooled_texts(pipeline.text_encoder, batch.samples),
            lengths=batch.lengths.tolist(),
            targets=batch.joints,
            mask=batch.mask[..., None].expand_as(batch.joints),
            seeds=batch.noise_seeds,
            preset=replace(
                plan, budget=replace(budget, latent_iterations=0, solver="papers", naturalness=0.0)
            ),
        )

    def _clip(
        self,
        plan: Preset,
        batch: Batch,
        clip: int,
        latents: Tensor,
        seconds: float,
        evaluations: int,
    ) -> Edited:
        decoder = self.pipeline.decoder
        length = int(batch.lengths[clip])
        latents = latents[:, : length // decoder.downsample]
        targets = batch.joints[clip : clip + 1, :length]
        mask = batch.mask[clip : clip + 1, :length, :, None].expand_as(targets)
        objective = ControlObjective(decoder, targets, mask, frame_mask(torch.tensor([length]), length))
        plain = _plain_seconds(objective, latents)
        budget = plan.latent_budget(has_terms=False)
        if budget.latent_iterations:
            latents, taken, count = _solved(objective, latents, budget)
            seconds, evaluations = seconds + taken, evaluations + count
        began = time.thread_time()
        features = decoder.features(latents)[0]
        if plan.closes(has_terms=False):
            features, _ = meet_exactly(features, targets[0], mask[0], self.pipeline.skeleton)
        seconds += time.thread_time() - began
        return Edited(features, seconds, evaluations, seconds / plain)


def _plain_seconds(objective: ControlObjective, latents: Tensor) -> float:
    """Processor seconds of one evaluation, value and gradient: the median of a few."""
    taken = []
    for _ in range(_TRIALS):
        began = time.thread_time()
        objective.value_and_gradient(latents)
        taken.append(time.thread_time() - began)
    return _median(taken)


def _solved(objective: ControlObjective, latents: Tensor, budget: EditingBudget) -> tuple[Tensor, float, int]:
    """Edited latents, processor seconds and evaluations of a clip."""
    if budget.solver == "auto":  # made once in a process for a choice of joints: it does not count
        residuals = objective.residuals()
        assert residuals is not None  # squares of a residual tokenizer
        residuals.gram(residuals.probe(torch.zeros_like(latents))[0])
    began = time.thread_time()
    solution = edit_latents(objective, latents, torch.ones(1, latents.shape[1], 1), budget)
    return solution.latents, time.thread_time() - began, int(solution.evaluations[0])


def is_slow(solver: str) -> bool:
    """Whether a solver takes thousands of evaluations for a clip."""
    return solver in PLANS and PLANS[solver].budget.logits_iterations > 0


def _median(values: list[float]) -> float:
    return torch.tensor(values).median().item() if values else 0.0
