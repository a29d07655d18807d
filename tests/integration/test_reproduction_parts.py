"""Parts of the reproduced tables: the ablated control model, averages, confidence."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from controlmm.evaluation.confidence import confidence_records
from controlmm.evaluation.control_draws import ControlSetting, draw_mask
from controlmm.evaluation.control_errors import control_errors
from controlmm.evaluation.controlmm_tables import TABLES, Study, without_control_model
from controlmm.evaluation.motion_sources import Batch, Generated
from controlmm.evaluation.optimized_codes import OptimizedCodes
from controlmm.evaluation.random_streams import stream
from controlmm.evaluation.reproduction import mean_of
from controlmm.evaluation.scores import RowScores
from controlmm.evaluation.test_set import TestSet, read_test_set
from controlmm.evaluation.tlcontrol_tables import TABLES as TL_TABLES
from controlmm.evaluation.tlcontrol_tables import Duel
from controlmm.generation.editing import EditingBudget
from controlmm.motion.skeleton import HUMANML3D
from controlmm.ops import recover_joints
from controlmm.pipelines import PRESETS, ControlMM, Preset, TLControl, TLControlPreset

PLAIN = Preset(EditingBudget(latent_iterations=0), steps=2)
ROUNDING = 1e-4  # of joints in metres, float32


@pytest.fixture(scope="module")
def test_set(tiny_data_folder: Path) -> TestSet:
    return read_test_set(tiny_data_folder, split="train")


def _batch(test_set: TestSet, seed: int = 0) -> Batch:
    samples = test_set.samples(seed=seed, repeat=0)[:3]
    setting = ControlSetting("pelvis", 5)
    masks = [
        draw_mask(setting, s.length, HUMANML3D, frames=196, generator=stream(seed, s.id)) for s in samples
    ]
    return Batch.of(samples, masks, seed=seed, repeat=0)


def test_without_the_control_model_targets_change_nothing_that_editing_does_not(
    tiny_pipeline: ControlMM, test_set: TestSet
) -> None:
    batch = _batch(test_set)
    moved = Batch(batch.samples, batch.real, batch.joints + 0.5, batch.mask, batch.noise_seeds)
    for pipeline, depends in ((without_control_model(tiny_pipeline), False), (tiny_pipeline, True)):
        source = Generated(pipeline, PLAIN)
        first, second = source.motions(batch).features, source.motions(moved).features
        assert torch.allclose(first, second, atol=ROUNDING) is not depends


def test_the_ablated_model_is_the_same_in_every_run(tiny_pipeline: ControlMM) -> None:
    first, second = (Generated(without_control_model(tiny_pipeline), PLAIN).describe() for _ in range(2))
    assert first == second
    assert first != Generated(tiny_pipeline, PLAIN).describe()


def test_effort_scales_the_papers_iterations(tiny_pipeline: ControlMM) -> None:
    full, tenth = Study(tiny_pipeline).accurate.budget, Study(tiny_pipeline, effort=0.1).accurate.budget
    assert (full.logits_iterations, full.latent_iterations) == (100, 600)
    assert (tenth.logits_iterations, tenth.latent_iterations) == (10, 60)


def test_the_ablation_has_the_papers_eight_cases(tiny_pipeline: ControlMM) -> None:
    table = TABLES["table3"](Study(tiny_pipeline))
    assert [line.keys for line in table.lines] == [row[:4] for row in table.published.rows]


METRICS = (
    "r1", "r2", "r3", "fid", "mm_distance", "diversity", "skating_published", "trajectory_50_joint",
    "location_50_joint", "average_joint", "seconds", "frames", "feedforward", "iterations", "evaluations",
    *(f"average_of_{HUMANML3D.joint_names[joint]}" for joint in HUMANML3D.control_joints),
)  # fmt: skip


@pytest.mark.parametrize(
    ("name", "ours"),
    [
        ("table1", 9), ("table2", 2), ("table3", 8), ("table4", 5), ("table5", len(PRESETS)), ("table7", 9),
        ("table8", 6), ("table9", 6), ("tl-table1", 15), ("tl-fig7", 12), ("tl-supplement2", 8),
    ],
)  # fmt: skip
def test_our_lines_fill_every_column_of_the_paper(
    tiny_pipeline: ControlMM, tiny_tlcontrol: TLControl, name: str, ours: int
) -> None:
    if name in TABLES:
        table = TABLES[name](Study(tiny_pipeline))
    else:
        table = TL_TABLES[name](Duel(tiny_tlcontrol, tiny_pipeline))
    labels = [row.label for row in table.rows]
    assert len(set(labels)) == len(labels)
    scores = [RowScores(label, {key: [0.5] for key in METRICS}, 32, {}) for label in labels]
    lines = table.markdown(scores).splitlines()[2 + len(table.published.rows) :]
    assert len(lines) == ours
    for line in lines:
        more = 2 + len(table.extra)  # who, and seconds
        assert len(line.split(" | ")) == len(table.published.columns) + more
        assert re.search(r"\| ours \| (0\.50* \| |50\.00 \| )+", line)


def test_accuracy_settings_stand_over_the_joints(tiny_pipeline: ControlMM, tiny_tlcontrol: TLControl) -> None:
    table = TL_TABLES["tl-table4"](Duel(tiny_tlcontrol, tiny_pipeline))
    values = {"seconds": [0.25], "average_joint": [0.02], "iterations": [70.2], "evaluations": [75.0]}
    values |= {name: [0.01] for name in METRICS if name.startswith("average_of")}
    lines = table.markdown([RowScores(row.label, values, 32, {}) for row in table.rows]).splitlines()
    assert "| runtime per batch (s) | 8.00 | 8.00 | 8.00 | 8.00 | 8.00 |" in lines
    assert "| left hand | 1.00 | 1.00 | 1.00 | 1.00 | 1.00 |" in lines
    assert "| average | 2.00 | 2.00 | 2.00 | 2.00 | 2.00 |" in lines
    assert "| iterations | 70 | 70 | 70 | 70 | 70 |" in lines


def test_tables_of_kit_need_a_model_of_kit(tiny_pipeline: ControlMM, tiny_tlcontrol: TLControl) -> None:
    with pytest.raises(ValueError, match="table10 is of KIT-ML"):
        TABLES["table10"](Study(tiny_pipeline))
    with pytest.raises(ValueError, match="tl-table2 is of KIT-ML"):
        TL_TABLES["tl-table2"](Duel(tiny_tlcontrol, tiny_pipeline))


def test_an_average_is_taken_repeat_by_repeat() -> None:
    rows = [RowScores(name, {"fid": values}, 32, {}) for name, values in (("a", [1, 3]), ("b", [2, 6]))]
    assert mean_of(rows).repeats == {"fid": [1.5, 4.5]}


def test_confidence_is_of_valid_tokens_only(tiny_pipeline: ControlMM, test_set: TestSet) -> None:
    batch = _batch(test_set)
    for record in confidence_records(tiny_pipeline, batch, steps=3, iterations=1):
        tokens = batch.lengths // 4
        assert record.steps.shape == (3, 3, int(tokens.max()))
        for clip, count in enumerate(tokens.tolist()):
            assert record.steps[:, clip, :count].isfinite().all()
            assert record.steps[:, clip, count:].isnan().all()
        assert record.mean.shape == (3,)


def test_the_optimisers_work_stands_beside_motions_that_are_those_of_a_call(
    tiny_tlcontrol: TLControl, test_set: TestSet
) -> None:
    preset = TLControlPreset(tolerance=1e-5, iterations=10)
    batch = _batch(test_set)
    watched, plain = (source(tiny_tlcontrol, preset).motions(batch) for source in (OptimizedCodes, Generated))
    assert torch.equal(watched.features, plain.features)
    untouched = Generated(tiny_tlcontrol, replace(preset, iterations=0)).motions(batch)
    joints = recover_joints(untouched.features, joints=22)
    expected = control_errors(joints, batch.joints, batch.mask).average
    torch.testing.assert_close(watched.numbers["feedforward"], expected, rtol=0, atol=ROUNDING)
    steps, evaluations = watched.numbers["iterations"], watched.numbers["evaluations"]
    assert (steps >= 1).all()
    assert (steps <= 10).all()
    assert (steps + 1 <= evaluations).all()  # the start, and at least one a step
