"""What an evaluator sees: retrieval of recordings by kind of caption, and FID of recordings that were spoilt.

    python -m benchmarks.evaluator --data DATA [--evaluator FOLDER] [--repeats 5] [--packs PACKS]

No model generates anything here. With ``--packs`` there is a row for a source that was in no training
(HDM05).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from controlmm.evaluation.evaluators import Evaluator, load_evaluator
from controlmm.evaluation.machine import machine, revision
from controlmm.evaluation.motion_sources import Batch, MotionSource, Produced, RealMotion
from controlmm.evaluation.protocol import Protocol, Row, evaluate_rows
from controlmm.evaluation.report import QUALITY, Column, markdown_table
from controlmm.evaluation.scores import RowScores
from controlmm.evaluation.test_set import SCORED_KINDS, TestSet, read_test_set
from controlmm.motion.features import joints_to_features
from controlmm.motion.mirror import mirror_features
from controlmm.ops import recover_joints

JITTER = 0.01  # metres, standard deviation of each coordinate of each joint


class Spoilt(MotionSource):
    """Recordings after a change of each clip's features (T, D)."""

    def __init__(self, name: str, change: Callable[[torch.Tensor], torch.Tensor]) -> None:
        self._name, self._change = name, change

    def describe(self) -> dict[str, Any]:
        return {"source": f"recordings, {self._name}"}

    def motions(self, batch: Batch) -> Produced:
        features = batch.real.clone()
        for row, length in zip(features, batch.lengths.tolist(), strict=True):
            row[:length] = self._change(row[:length].clone())
        return Produced(features, 0.0, has_padding=False)


def _from_joints(joints: torch.Tensor) -> torch.Tensor:
    """Features of moved joints, as many frames as before (the last frame is held)."""
    return joints_to_features(torch.cat([joints, joints[-1:]])).float()


def _jittered(features: torch.Tensor) -> torch.Tensor:
    joints = recover_joints(features[None], joints=22)[0].double()
    noise = torch.randn(joints.shape, generator=torch.Generator().manual_seed(len(features)))
    return _from_joints(joints + JITTER * noise.double())


def _slowed(features: torch.Tensor) -> torch.Tensor:
    """The first half at half the speed."""
    joints = recover_joints(features[None], joints=22)[0].double()
    place = torch.arange(len(joints)) / 2
    low = place.floor().long()
    part = (place - low)[:, None, None].double()
    return _from_joints(joints[low] * (1 - part) + joints[low + 1] * part)


def _frozen(features: torch.Tensor) -> torch.Tensor:
    joints = recover_joints(features[None], joints=22)[0].double()
    return _from_joints(joints[:1].expand_as(joints).contiguous())


SPOILT = {
    "joints jitter by 1 cm": _jittered,
    "half speed": _slowed,
    "left and right swapped": mirror_features,
    "first pose held": _frozen,
}


def scores_of(rows: list[Row], test_set: TestSet, evaluator: Evaluator, repeats: int) -> list[RowScores]:
    with tempfile.TemporaryDirectory() as folder:
        return evaluate_rows(rows, test_set, evaluator, Protocol(repeats), folder, progress=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--evaluator", type=Path)
    parser.add_argument("--packs", type=Path)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    started = time.perf_counter()
    evaluator = load_evaluator(options.evaluator)

    kinds: list[RowScores] = []
    for chosen in (SCORED_KINDS, *((kind,) for kind in SCORED_KINDS)):
        test_set = read_test_set(options.data, kinds=chosen)
        kinds += scores_of([Row(", ".join(chosen), RealMotion())], test_set, evaluator, options.repeats)
    if options.packs is not None:
        unseen = read_test_set(options.packs, split="all", sources=("hdm05",))
        row = Row("hdm05 (unseen source), all three kinds", RealMotion())
        kinds += scores_of([row], unseen, evaluator, options.repeats)
    print(f"{machine()}; {revision()}\n")
    show(f"Recordings by captions, {options.repeats} repeats", kinds)
    rows = [Row(name, Spoilt(name, change)) for name, change in SPOILT.items()]
    show("Spoilt recordings, 1 repeat", scores_of(rows, read_test_set(options.data), evaluator, 1))
    print(f"{time.perf_counter() - started:.0f} s")


def show(title: str, scores: list[RowScores]) -> None:
    columns = [*QUALITY, Column("FID of two halves", "fid_halves")]
    clips = ", ".join(f"{score.label}: {score.clips}" for score in scores)
    print(f"{title}\n\n{markdown_table(scores, columns)}\n\nclips a repeat: {clips}\n", flush=True)


if __name__ == "__main__":
    main()
