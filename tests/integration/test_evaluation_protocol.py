"""The protocol on a tiny model: determinism, resuming, what it refuses."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch

from controlmm.data import Caption, Clip, write_folder
from controlmm.evaluation.control_draws import ControlSetting
from controlmm.evaluation.evaluators import Evaluator, LearnedEvaluator, load_evaluator
from controlmm.evaluation.motion_sources import (
    Batch,
    Generated,
    Produced,
    RealMotion,
    Reconstruction,
    pooled_texts,
)
from controlmm.evaluation.protocol import Protocol, Row, evaluate_rows
from controlmm.evaluation.report import ResultPage
from controlmm.evaluation.test_set import Item, TestSet, read_test_set
from controlmm.generation.editing import EditingBudget
from controlmm.models.motion_text_matcher import MatcherConfig, MotionTextMatcher
from controlmm.motion.skeleton import KIT
from controlmm.pipelines import ControlMM, Preset
from controlmm.text.encoder import TextFeatures
from controlmm.text.hashing import HashingTextEncoder

QUICK = Preset(EditingBudget(latent_iterations=2), steps=2)
EXACT = 1e-4  # metres; float32 features of joints that lie on their targets
ROUNDING = 1e-4  # of embeddings and errors when the batch around a clip changes


@pytest.fixture(scope="module")
def test_set(tiny_data_folder: Path) -> TestSet:
    return read_test_set(tiny_data_folder, split="train")


@pytest.fixture(scope="module")
def evaluator(tiny_evaluator_folder: Path) -> Evaluator:
    return load_evaluator(tiny_evaluator_folder)


def _rows(pipeline: ControlMM, control: str = "pelvis") -> list[Row]:
    setting = ControlSetting(control, 5)
    return [
        Row("real motion", RealMotion(), setting),
        Row("reconstruction", Reconstruction(pipeline), setting),
        Row("quick", Generated(pipeline, QUICK), setting),
    ]


def test_a_row_has_every_metric_once_a_repeat(
    tiny_pipeline: ControlMM, test_set: TestSet, evaluator: Evaluator, tmp_path: Path
) -> None:
    real, rebuilt, quick = evaluate_rows(
        _rows(tiny_pipeline), test_set, evaluator, Protocol(repeats=2), tmp_path, progress=False
    )
    assert all(len(values) == 2 for values in quick.repeats.values())
    assert real["average_joint"].mean == real["distance_to_real"].mean == 0
    assert real["contact_consistency"].mean == 1
    assert rebuilt["fid"].mean > 0
    assert quick["average_joint"].mean > 0
    assert quick["trajectory_50_joint"].mean == quick["trajectory_50_frame"].mean  # one joint
    assert quick["average_of_pelvis"].mean == quick["average_joint"].mean
    assert torch.isnan(torch.tensor(quick["average_of_head"].mean))  # not controlled
    assert torch.isnan(torch.tensor(quick["r1"].mean))  # six clips are no group of 32
    assert quick.clips == 6
    assert quick.about["preset"]["steps"] == 2


def test_a_stopped_run_goes_on_and_gives_the_same_numbers(
    tiny_pipeline: ControlMM, test_set: TestSet, evaluator: Evaluator, tmp_path: Path
) -> None:
    class Stopped(Generated):
        batches = 0

        def motions(self, batch: Batch) -> Produced:
            self.batches += 1
            if self.batches == 2:
                raise KeyboardInterrupt
            return super().motions(batch)

    def run(folder: Path, source: Generated) -> dict[str, Sequence[float]]:
        row = Row("quick", source, ControlSetting("cross"))
        (scores,) = evaluate_rows([row], test_set, evaluator, Protocol(repeats=3), folder, progress=False)
        return {name: values for name, values in scores.repeats.items() if name != "seconds"}

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "stopped", Stopped(tiny_pipeline, QUICK))
    files = list((tmp_path / "stopped").rglob("*.safetensors"))
    assert len(files) == 1
    files[0].write_bytes(files[0].read_bytes()[:100])  # even cut short by the kill
    resumed, unbroken = (run(tmp_path / name, Generated(tiny_pipeline, QUICK)) for name in ("stopped", "new"))
    assert json.dumps(resumed) == json.dumps(unbroken)


def test_a_closed_end_meets_targets_here_too(
    tiny_pipeline: ControlMM, test_set: TestSet, evaluator: Evaluator, tmp_path: Path
) -> None:
    exact = dataclasses.replace(QUICK, closes_from=0.05)
    rows = [
        Row(name, Generated(tiny_pipeline, preset), ControlSetting("random", 5))
        for name, preset in (("quick", QUICK), ("exact", exact))
    ]
    quick, met = evaluate_rows(rows, test_set, evaluator, Protocol(), tmp_path, progress=False)
    assert met["average_joint"].mean < EXACT < quick["average_joint"].mean


def test_more_repeats_go_on_where_fewer_ended(
    tiny_pipeline: ControlMM, test_set: TestSet, evaluator: Evaluator, tmp_path: Path
) -> None:
    row = Row("quick", Generated(tiny_pipeline, QUICK), ControlSetting("pelvis"))
    evaluate_rows([row], test_set, evaluator, Protocol(repeats=1), tmp_path, progress=False)
    (first,) = tmp_path.rglob("*.safetensors")
    written = first.stat().st_mtime_ns
    (scores,) = evaluate_rows([row], test_set, evaluator, Protocol(repeats=2), tmp_path, progress=False)
    assert first.stat().st_mtime_ns == written
    assert len(scores.repeats["fid"]) == 2


def test_a_clips_result_does_not_depend_on_its_batch(
    tiny_pipeline: ControlMM, test_set: TestSet, evaluator: Evaluator, tmp_path: Path
) -> None:
    def errors(items: TestSet, name: str) -> list[float]:
        row = Row("quick", Generated(tiny_pipeline, QUICK), ControlSetting("cross"))
        (scores,) = evaluate_rows([row], items, evaluator, Protocol(), tmp_path / name, progress=False)
        return [scores[metric].mean for metric in ("average_joint", "skating", "jerk")]

    together = torch.tensor(errors(test_set, "together"))
    alone = torch.tensor(
        [errors(TestSet((item,), "train", test_set.kinds), item.id) for item in test_set.items]
    )
    torch.testing.assert_close(alone.mean(0), together, rtol=ROUNDING, atol=ROUNDING)


def test_captions_are_encoded_as_in_a_call_whatever_the_batch_and_the_threads(test_set: TestSet) -> None:
    """Of a batch, or by more threads, real encoders give other last bits."""

    class Crowded(HashingTextEncoder):
        def encode(self, prompts: Sequence[str]) -> TextFeatures:
            plain = super().encode(prompts)
            crowd = len(prompts) + torch.get_num_threads()
            return dataclasses.replace(plain, pooled=plain.pooled + crowd)

    samples = test_set.samples(seed=0, repeat=0)[:3]
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        together = pooled_texts(Crowded(64), samples)
    finally:
        torch.set_num_threads(before)
    alone = HashingTextEncoder(64).encode([sample.caption.text for sample in samples]).pooled
    assert torch.equal(together, alone + 2)


def test_other_settings_are_not_mixed_into_a_folder(
    tiny_pipeline: ControlMM, test_set: TestSet, evaluator: Evaluator, tmp_path: Path
) -> None:
    rows = _rows(tiny_pipeline)[:1]
    evaluate_rows(rows, test_set, evaluator, Protocol(), tmp_path, progress=False)
    with pytest.raises(ValueError, match=r"other settings: protocol\.seed \(0 before, 1 now\)\. Go on"):
        evaluate_rows(rows, test_set, evaluator, Protocol(seed=1), tmp_path, progress=False)
    with pytest.raises(ValueError, match=r"other settings: control.* \(\"pelvis\" before, \"head\" now\)"):
        evaluate_rows(
            _rows(tiny_pipeline, "head")[:1], test_set, evaluator, Protocol(), tmp_path, progress=False
        )


def test_equal_labels_and_unusable_numbers_are_refused(
    tiny_pipeline: ControlMM, test_set: TestSet, evaluator: Evaluator, tmp_path: Path
) -> None:
    row = _rows(tiny_pipeline)[0]
    with pytest.raises(ValueError, match="Rows must have different labels, got real motion, real motion"):
        evaluate_rows([row, row], test_set, evaluator, Protocol(), tmp_path, progress=False)
    with pytest.raises(ValueError, match="`repeats` must be at least 1, got 0"):
        Protocol(repeats=0)
    with pytest.raises(ValueError, match="`limit` must be at least 1, got -3"):
        Protocol(limit=-3)


def test_limits_are_whole_batches() -> None:
    assert [Protocol(limit=limit).clips(100) for limit in (None, 64, 40, 10, 500)] == [96, 64, 32, 10, 96]
    assert Protocol().clips(20) == 20


def test_packs_are_read_as_they_stand(shared: Path) -> None:
    found = read_test_set(shared / "data", split="all", sources=("hdm05",))
    assert found.sources == {"hdm05": len(found.items)}
    assert len(found.items) > 100
    assert {caption.kind for item in found.items for caption in item.captions} <= set(found.kinds)


def test_kit_is_measured_in_metres_and_needs_an_evaluator_of_its_own(
    evaluator: Evaluator, tmp_path: Path
) -> None:
    generator = torch.Generator().manual_seed(0)
    features = [100 * torch.randn(40, KIT.feature_dim, generator=generator) for _ in range(3)]  # millimetres
    items = tuple(Item(f"{i}", clip, (Caption("walks"),), "kit") for i, clip in enumerate(features))
    kit = TestSet(items, "test", ("annotator",))
    encoder = HashingTextEncoder(64)
    config = MatcherConfig.tiny().for_data(KIT.feature_dim, encoder.config())
    judge = LearnedEvaluator(MotionTextMatcher(config), encoder)
    rows = [Row("real motion", RealMotion(), ControlSetting("all", 5))]
    (real,) = evaluate_rows(rows, kit, judge, Protocol(), tmp_path, progress=False)
    assert real["keys"].mean == 5 * 6
    assert real["average_joint"].mean == 0
    local = features[0][:, 4:64].unflatten(-1, (20, 3))
    assert real["penetration"].mean < 0.001 * local.abs().max()
    with pytest.raises(ValueError, match="The evaluator takes features of width 263, the data has 251"):
        evaluate_rows(rows, kit, evaluator, Protocol(), tmp_path / "other", progress=False)


def test_a_split_without_usable_clips_is_named(walk: object, tmp_path: Path) -> None:
    clips = [Clip("a", walk(70), (Caption("walks", "template"),), split="test")]  # type: ignore[operator]
    write_folder(clips, tmp_path, progress=False)
    with pytest.raises(
        ValueError, match=r"No clip in the split 'test' .* kinds annotator, written, kinematic"
    ):
        read_test_set(tmp_path)


def test_results_are_written_for_people_and_programs(
    tiny_pipeline: ControlMM, test_set: TestSet, evaluator: Evaluator, tmp_path: Path
) -> None:
    scores = evaluate_rows(_rows(tiny_pipeline), test_set, evaluator, Protocol(), tmp_path, progress=False)
    page = ResultPage("A title", {"seed": 0}, scores, evaluator.caution)
    page.write(tmp_path)
    text = (tmp_path / "results.md").read_text()
    assert text.startswith("# A title\n\n- seed: 0\n")
    assert text.endswith("never with published ones.\n")
    assert "| real motion | - | - | - | " in text
    content = json.loads((tmp_path / "results.json").read_text())
    assert [row["label"] for row in content["rows"]] == ["real motion", "reconstruction", "quick"]
    assert content["rows"][0]["metrics"]["r1"]["mean"] is None
    assert content["rows"][2]["metrics"]["average_joint"]["repeats"] == [
        pytest.approx(scores[2]["average_joint"].mean, abs=1e-6)
    ]


def test_multimodality_is_of_thirty_motions_that_differ_in_noise_alone(
    tiny_pipeline: ControlMM, test_set: TestSet, evaluator: Evaluator, tmp_path: Path
) -> None:
    class Copied(Generated):
        """Motions that no noise changes."""

        def motions(self, batch: Batch) -> Produced:
            return super().motions(dataclasses.replace(batch, noise_seeds=[0] * len(batch.samples)))

    def varied(source: Generated, name: str, repeats: int = 1) -> Sequence[float]:
        rows = [Row("real motion", RealMotion()), Row("quick", source)]
        protocol = Protocol(repeats, multimodality=4)
        real, quick = evaluate_rows(rows, test_set, evaluator, protocol, tmp_path / name, progress=False)
        assert "multimodality" not in real.repeats
        text = ResultPage("title", {}, [real, quick], "").markdown()
        assert "| Diversity → | Multimodality ↑ |" in text
        return quick.repeats["multimodality"]

    first, second = varied(Generated(tiny_pipeline, QUICK), "drawn", repeats=2)
    assert first > 0
    assert first != second
    assert varied(Generated(tiny_pipeline, QUICK), "drawn") == [first]  # from the files
    (nothing,) = varied(Copied(tiny_pipeline, QUICK), "copied")
    assert nothing == pytest.approx(0, abs=ROUNDING)


def test_joints_are_controlled_together_by_their_names(
    tiny_pipeline: ControlMM, test_set: TestSet, evaluator: Evaluator, tmp_path: Path
) -> None:
    rows = [Row("real motion", RealMotion(), ControlSetting("left_wrist+head+pelvis", 5))]
    (real,) = evaluate_rows(rows, test_set, evaluator, Protocol(), tmp_path, progress=False)
    assert real["keys"].mean == 3 * 5
    assert real["average_of_head"].mean == 0
    with pytest.raises(ValueError, match=r"several joined by '\+', or one of random"):
        ControlSetting("head+cross").check(test_set.skeleton)
