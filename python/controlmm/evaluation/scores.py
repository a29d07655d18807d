"""From the batches of a row to its numbers: one value a repeat, then mean and 95 % interval."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from controlmm.evaluation.batch_scores import BatchScores
from controlmm.evaluation.frechet import frechet_distance
from controlmm.evaluation.intervals import Interval, interval
from controlmm.evaluation.random_streams import stream
from controlmm.evaluation.retrieval import GROUP, matching_distance, r_precision
from controlmm.evaluation.variety import diversity

_TOP = 3


@dataclass(frozen=True)
class RowScores:
    """One row of a table.

    Attributes:
        label: What the row is.
        repeats: Values of every metric, one for each repeat.
        clips: Samples in a repeat.
        about: What identifies the row: source, weights, preset, control, density.
    """

    label: str
    repeats: Mapping[str, Sequence[float]]
    clips: int
    about: Mapping[str, Any]

    def __getitem__(self, metric: str) -> Interval:
        return interval(self.repeats[metric])

    def as_json(self) -> dict[str, Any]:
        """Everything, NaN as ``null``."""
        metrics = {
            name: {
                "mean": _plain(self[name].mean),
                "half_width_95": _plain(self[name].half_width),
                "repeats": [_plain(value) for value in values],
            }
            for name, values in self.repeats.items()
        }
        return {"label": self.label, "clips": self.clips, "metrics": metrics, **self.about}


def repeat_scores(batches: Sequence[BatchScores], *, seed: int, repeat: int) -> dict[str, float]:
    """All metrics over the batches of one repeat.

    R-precision needs complete groups of 32 and FID two samples; a metric without enough samples is NaN.
    """
    texts, real, motions = (
        torch.cat([getattr(batch, name) for batch in batches]) for name in ("texts", "real", "motions")
    )
    generator = stream(seed, repeat, "diversity")
    values = dict(zip(("r1", "r2", "r3"), _r_precision(texts, motions), strict=True))
    values["mm_distance"] = matching_distance(texts, motions)
    values["fid"] = _fid(real, motions)
    values["fid_halves"] = _fid(*_halves(motions, stream(seed, repeat, "halves")))
    values["diversity"] = diversity(motions, generator=generator) if len(motions) > 1 else math.nan
    for name in batches[0].numbers:
        values[name] = float(torch.cat([batch.numbers[name] for batch in batches]).nanmean())
    return values


def _r_precision(texts: Tensor, motions: Tensor) -> list[float]:
    if len(texts) < GROUP:
        return [math.nan] * _TOP
    shares: list[float] = r_precision(texts, motions, top=_TOP).tolist()
    return shares


def _fid(real: Tensor, motions: Tensor) -> float:
    return frechet_distance(real, motions) if min(len(real), len(motions)) > 1 else math.nan


def _halves(motions: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    order = torch.randperm(len(motions), generator=generator)
    half = len(motions) // 2
    return motions[order[:half]], motions[order[half : 2 * half]]


def _plain(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 6)
