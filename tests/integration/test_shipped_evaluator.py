"""The evaluator in the package finds the recordings of sentences that it was not trained on."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from controlmm.evaluation.evaluators import SHIPPED, LearnedEvaluator, load_evaluator
from controlmm.evaluation.motion_sources import RealMotion
from controlmm.evaluation.protocol import Protocol, Row, evaluate_rows
from controlmm.evaluation.test_set import read_test_set
from controlmm.pipelines.folder import shipped_folder
from controlmm.text.minilm import WEIGHTS_PACKAGE

pytestmark = [
    pytest.mark.skipif(
        not (shipped_folder(SHIPPED) / "config.json").is_file(), reason="no evaluator in this installation"
    ),
    pytest.mark.skipif(
        importlib.util.find_spec(WEIGHTS_PACKAGE) is None, reason="the weights of MiniLM are not installed"
    ),
]
CHANCE = 3 / 32  # of the top three in a group of 32


def test_it_finds_the_recordings_of_test_sentences(shared: Path, tmp_path: Path) -> None:
    evaluator = load_evaluator()
    assert isinstance(evaluator, LearnedEvaluator)
    test_set = read_test_set(shared / "data", sources=("cmu",))
    rows = [Row("real motion", RealMotion())]
    (real,) = evaluate_rows(rows, test_set, evaluator, Protocol(repeats=2), tmp_path, progress=False)
    assert real.clips == 32
    assert real["r3"].mean > 5 * CHANCE
    assert real["fid"].mean < 0.1 * real["fid_halves"].mean  # other crops are nearer than other clips
