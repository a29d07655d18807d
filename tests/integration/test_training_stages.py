"""The training stages of ControlMM on a tiny folder, from statistics to a pipeline that generates."""

from __future__ import annotations

import json

import pytest
import torch
from safetensors.torch import load_file

from controlmm.data import MotionFolder
from controlmm.models.control_branch import ControlBranch
from controlmm.models.masked_transformer import MaskedTransformer
from controlmm.models.residual_transformer import ResidualTransformer
from controlmm.motion.normalizer import Normalizer
from controlmm.pipelines import ControlMM
from controlmm.text.hashing import HashingTextEncoder
from controlmm.training import rvq
from controlmm.training.registry import MODULES, load_stage
from controlmm.training.run_folder import RunFolder
from controlmm.training.stage import load_tokenizer
from controlmm.training.stages import train_stage
from controlmm.training.step import StepTaker

STAGES = ("rvq", "rvq-decoder", "masked", "residual", "control", "residual-control")
QUICK = {"steps": 10, "validate_every": 5, "average_decay": 0.9}


def train(stage, data, root, **changes):
    return train_stage(
        stage,
        data=data,
        size="tiny",
        root=root,
        text_encoder=HashingTextEncoder(64),
        changes=QUICK | changes,
        progress=False,
    )


@pytest.fixture(scope="module")
def trained(tiny_data_folder, tmp_path_factory):
    """A root folder with all stages trained for ten steps, with averaged weights."""
    root = tmp_path_factory.mktemp("trained")
    for stage in STAGES:
        train(stage, tiny_data_folder, root)
    return root


@pytest.mark.parametrize("stage", STAGES)
def test_every_stage_leaves_weights_a_log_and_what_it_was_told(trained, stage):
    run = RunFolder(trained / stage)
    records = run.records()
    assert [record["step"] for record in records] == [5, 10, 10]
    assert all(torch.isfinite(torch.tensor(list(record.values()))).all() for record in records)
    assert (run.path / "best" / "model.safetensors").is_file()
    assert '"sha256"' in (run.path / "run.json").read_text()


@pytest.mark.parametrize("name", MODULES)
def test_every_name_leads_to_a_stage_that_has_a_tiny_size_and_known_needs(name):
    stage = load_stage(name)
    assert stage.name == name
    assert stage.configs.keys() == stage.settings.keys() >= {"tiny"}
    assert set(stage.needs) <= set(list(MODULES)[: list(MODULES).index(name)])


def test_statistics_are_those_of_the_training_split(trained, tiny_data_folder):
    expected = Normalizer.fit(clip.features for clip in MotionFolder(tiny_data_folder).clips("train"))
    assert torch.equal(Normalizer.load(trained / "normalizer.safetensors").std, expected.std)


def test_the_trained_parts_make_a_pipeline_that_generates(trained):
    tokenizer, normalizer = load_tokenizer(trained)
    pipeline = ControlMM(
        tokenizer=tokenizer,
        normalizer=normalizer,
        transformer=MaskedTransformer.from_pretrained(trained / "masked" / "best"),
        residual=ResidualTransformer.from_pretrained(trained / "residual" / "best"),
        control=ControlBranch.from_pretrained(trained / "control" / "best"),
        text_encoder=HashingTextEncoder(64),
    )
    assert pipeline("a person walks", frames=16, preset="fast").best.num_frames == 16


def test_base_and_tokenizer_stay_frozen_while_control_is_trained(trained):
    """The control run's checkpoint holds the branch alone, and the branch has left the base's weights."""
    names = load_file(trained / "control" / "checkpoint.safetensors")
    base = MaskedTransformer.from_pretrained(trained / "masked" / "best")
    assert not any("token_embedding" in name or "quantizer" in name for name in names)
    branch = names["model.layers.0.linear1.weight"]
    assert not torch.equal(branch, base.layers[0].linear1.weight)
    assert names["model.first_zero.weight"].abs().max() > 0


class KilledError(Exception):
    """The kill."""


@pytest.mark.parametrize("stage", STAGES)
def test_a_killed_and_resumed_stage_equals_the_unbroken_one_bit_by_bit(
    trained, tiny_data_folder, tmp_path, monkeypatch, stage
):
    tokenizer = ("normalizer.safetensors", "rvq/best")
    earlier = {"rvq": (), "rvq-decoder": tokenizer}.get(
        stage, (*tokenizer, "rvq-decoder/best", "masked/best", "residual/best")
    )
    for name in {*earlier} - {f"{stage}/best"}:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).symlink_to(trained / name)
    run = tmp_path / stage
    take = StepTaker.take

    def killed_at_eight(self, step):
        if step == 7:
            raise KilledError
        return take(self, step)

    monkeypatch.setattr(StepTaker, "take", killed_at_eight)
    with pytest.raises(KilledError):
        train(stage, tiny_data_folder, tmp_path)
    monkeypatch.setattr(StepTaker, "take", take)
    train(stage, tiny_data_folder, tmp_path)

    for name in ("checkpoint.safetensors", "best/model.safetensors"):
        expected, actual = load_file(trained / stage / name), load_file(run / name)
        assert expected.keys() == actual.keys()
        assert all(torch.equal(expected[key], actual[key]) for key in expected), name
    assert RunFolder(run).records() == RunFolder(trained / stage).records()


def test_a_stage_needs_the_ones_before_it(tiny_data_folder, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"rvq holds no trained stage\. Run `controlmm train rvq`"):
        train("masked", tiny_data_folder, tmp_path)


def test_augmented_clips_are_trained_on_and_written_down(trained, tiny_data_folder, tmp_path, monkeypatch):
    """The made clips reach the sampler; statistics, hashes and the clip list stay those of the recordings."""
    seen = []
    windows = rvq.WindowSampler

    def watched(clips, *arguments, **options):
        seen.extend(clip.id for clip in clips)
        return windows(clips, *arguments, **options)

    monkeypatch.setattr(rvq, "WindowSampler", watched)
    train_stage(
        "rvq",
        data=tiny_data_folder,
        size="tiny",
        root=tmp_path,
        changes={"steps": 1},
        options={"joined_share": "0.5", "bent_share": "0.5"},
        progress=False,
    )
    assert len([name for name in seen if "+" in name and "@" not in name]) == 3
    assert len([name for name in seen if "@" in name]) == 3
    told, plain = (json.loads((root / "rvq" / "run.json").read_text()) for root in (tmp_path, trained))
    assert told["options"] == {"joined_share": "0.5", "bent_share": "0.5"}
    assert told["data"] == plain["data"]
    for name in ("normalizer.safetensors", "rvq/clips.tsv"):
        assert (tmp_path / name).read_bytes() == (trained / name).read_bytes()


def test_other_data_is_not_mixed_into_a_run(trained, tiny_data_folder, walk, tmp_path):
    from controlmm.data import Caption, Clip, write_folder

    clips = [Clip(s, walk(70), (Caption("walks"),), split=s) for s in ("train", "val")]
    write_folder(clips, tmp_path, progress=False)
    with pytest.raises(
        ValueError,
        match=r"masked holds a run with other settings: captions.*data\.train\.clips \(6 before, 2 now\)",
    ):
        train("masked", tmp_path, trained)


def test_unknown_names_and_a_missing_text_encoder_are_refused(trained, tiny_data_folder, tmp_path):
    with pytest.raises(ValueError, match=r"Unknown stage 'vq'\. Stages: rvq, rvq-decoder, masked"):
        train("vq", tiny_data_folder, tmp_path)
    with pytest.raises(ValueError, match=r"Stage 'rvq' has no size 'huge'\. Sizes: small, paper, tiny"):
        train_stage("rvq", data=tiny_data_folder, size="huge", root=tmp_path, progress=False)
    with pytest.raises(FileNotFoundError, match="no HumanML3D-style folder"):
        train("rvq", tmp_path / "nowhere", tmp_path)
    with pytest.raises(ValueError, match="`text_encoder` is needed to train 'masked'"):
        train_stage("masked", data=tiny_data_folder, size="tiny", root=trained, progress=False)


@pytest.mark.parametrize("split", ["train", "val"])
def test_an_empty_split_is_named(tiny_data_folder, walk, tmp_path, split):
    from controlmm.data import Clip, write_folder

    clips = [Clip("a", walk(70), (), split="val" if split == "train" else "train")]
    write_folder(clips, tmp_path / "data", progress=False)
    with pytest.raises(
        ValueError, match=f"The {'training' if split == 'train' else 'validation'} split has no"
    ):
        train("rvq", tmp_path / "data", tmp_path)


@pytest.mark.parametrize("stage", ["rvq", "masked", "control"])
def test_mixed_precision_computes_in_bfloat16_and_keeps_float32_weights(
    trained, tiny_data_folder, tmp_path, stage
):
    for name in ("normalizer.safetensors", "rvq/best", "masked/best"):
        if not name.startswith(stage) and stage != "rvq":
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).symlink_to(trained / name)
    seen = set()
    linear = torch.nn.functional.linear
    convolution = torch.nn.Conv1d.forward

    def watched(self, x):
        result = convolution(self, x)
        seen.add(result.dtype)
        return result

    def watched_linear(*arguments):
        result = linear(*arguments)
        seen.add(result.dtype)
        return result

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.nn.Conv1d, "forward", watched)
        patch.setattr(torch.nn.functional, "linear", watched_linear)
        train_stage(
            stage,
            data=tiny_data_folder,
            size="tiny",
            root=tmp_path,
            text_encoder=HashingTextEncoder(64),
            changes={"steps": 3},
            options={"bf16": "true"},
            progress=False,
            device="cpu",
        )
    assert torch.bfloat16 in seen
    weights = load_file(tmp_path / stage / "checkpoint.safetensors")
    floats = {value.dtype for value in weights.values() if value.is_floating_point()}
    assert floats == {torch.float32}
    (start,) = (tmp_path / stage / "starts.jsonl").read_text().splitlines()
    assert json.loads(start)["device"] == "cpu"
