"""``controlmm train``, ``plot``, ``assemble``: the whole way from joints to a model; stopped runs."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from PIL import Image
from safetensors.torch import load_file
from typer.testing import CliRunner

from controlmm.cli.main import app
from controlmm.motion.motion import Motion
from controlmm.motion.normalizer import Normalizer
from controlmm.pipelines import ControlMM
from controlmm.training import stages

Command = Callable[..., str]
STAGES = ("rvq", "masked", "residual", "control")
STEPS = 60  # of the run that is killed: long enough to be caught in the middle
PATIENCE = 120  # seconds until a checkpoint must be there on a busy machine
HALF_PRECISION = 1e-3  # relative, of float16


def _run(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def data(joint_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The made-up clips as a training folder."""
    folder = tmp_path_factory.mktemp("data")
    _run("prepare", "--joints", joint_folder, "--out", folder, "--quiet")
    return folder


@pytest.fixture(scope="module")
def root(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All four stages, trained for a few steps."""
    folder = tmp_path_factory.mktemp("runs") / "tiny"
    for stage in STAGES:
        _run(
            "train", stage, "--data", data, "--config", "tiny", "--text", "hashing", "--out", folder,
            "--steps", 4, "--batch-size", 2, "--quiet",
        )  # fmt: skip
    return folder


@pytest.fixture
def same_threads() -> Iterator[None]:
    """Leaves torch's thread count as it was."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def test_every_stage_leaves_weights_settings_and_its_command(root: Path) -> None:
    for stage in STAGES:
        assert (root / stage / "best" / "model.safetensors").is_file()
        settings = json.loads((root / stage / "run.json").read_text())["settings"]
        assert (settings["steps"], settings["batch_size"]) == (4, 2)
        start = json.loads((root / stage / "starts.jsonl").read_text())
        assert start.keys() >= {"command", "version", "revision", "torch", "time"}
        clips = (root / stage / "clips.tsv").read_text().splitlines()
        assert clips[0] == "split\tid\tframes\tsha256"
        assert {line.split("\t")[0] for line in clips[1:]} == {"train", "val"}
        for name in ("curves.png", "samples/step_000004.png"):
            with Image.open(root / stage / name) as picture:
                assert min(picture.size) >= 300
                assert len(picture.convert("RGB").getcolors(1 << 20) or []) > 10  # not an empty page
    assert json.loads((root / "text_encoder.json").read_text())["kind"] == "hashing"


def test_the_stages_become_a_model_that_generates(root: Path, command: Command, tmp_path: Path) -> None:
    printed = command("assemble", root, "--out", tmp_path / "model", "--half")
    pipeline = ControlMM.from_pretrained(tmp_path / "model")
    assert f"{pipeline.num_parameters / 1e6:.2f} million parameters" in printed
    trained = load_file(root / "masked" / "best" / "model.safetensors")
    stored = load_file(tmp_path / "model" / "transformer" / "model.safetensors")
    assert stored.keys() == trained.keys()
    for name, value in stored.items():
        assert value.dtype == torch.float16
        torch.testing.assert_close(value.float(), trained[name], rtol=HALF_PRECISION, atol=HALF_PRECISION)
    for network, stage in zip(("tokenizer", "transformer", "residual", "control"), STAGES, strict=True):
        copied = tmp_path / "model" / network / "run.json"
        assert copied.read_bytes() == (root / stage / "run.json").read_bytes()
    command(
        "generate", "walk", "--seconds", 0.8, "--formats", "npz", "--out", tmp_path, "--preset", "fast",
        "--model", tmp_path / "model",
    )  # fmt: skip
    assert Motion.load(tmp_path / "walk_0_0.npz").num_frames == 16


def test_a_length_estimator_comes_along_and_says_how_long(
    root: Path, data: Path, command: Command, tmp_path: Path
) -> None:
    shutil.copytree(root, tmp_path / "root")
    arguments = ("--data", data, "--config", "tiny", "--text", "hashing", "--out", tmp_path / "root")
    command("train", "length", *arguments, "--steps", 4, "--batch-size", 2, "--quiet")
    command("assemble", tmp_path / "root", "--out", tmp_path / "model")
    out = tmp_path / "out"
    command(
        "generate", "a person walks", "--model", tmp_path / "model", "--preset", "fast", "--formats", "npz",
        "--out", out, "--seed", 2, "--quiet",
    )  # fmt: skip
    expected = ControlMM.from_pretrained(tmp_path / "model")("a person walks", preset="fast", seed=2)
    assert Motion.load(next(out.glob("*.npz"))).num_frames == expected.best.num_frames


def test_plot_draws_the_curves(root: Path, command: Command, tmp_path: Path) -> None:
    command("plot", root / "rvq", "--out", tmp_path / "rvq.png")
    with Image.open(tmp_path / "rvq.png") as picture:
        assert picture.size[0] > 1000
        assert len(picture.convert("RGB").getcolors(1 << 20) or []) > 10  # not an empty page
    assert command("plot", root / "masked") == f"{root / 'masked' / 'curves.png'}\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "rvq", "--data", "nowhere"], "nowhere is no HumanML3D-style folder"),
        (["plot", "nowhere"], "No metrics.jsonl in nowhere"),
    ],
)
def test_missing_folders_are_named(
    arguments: list[str], message: str, refused: Command, tmp_path: Path
) -> None:
    assert message in refused(*arguments, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_model_is_not_mixed_with_stages_or_with_an_earlier_model(
    root: Path, refused: Command, tmp_path: Path
) -> None:
    before = sorted(root.rglob("*"))
    assert "`--out` must not be the folder of the stages" in refused("assemble", root, "--out", root)
    assert sorted(root.rglob("*")) == before
    (tmp_path / "model" / "length").mkdir(parents=True)
    message = refused("assemble", root, "--out", tmp_path / "model")
    assert f"{tmp_path / 'model' / 'length'} is of an earlier model" in message
    assert [path.name for path in (tmp_path / "model").iterdir()] == ["length"]


def test_a_stage_asks_for_the_one_before(data: Path, refused: Command, tmp_path: Path) -> None:
    arguments = ("--data", data, "--config", "tiny", "--text", "hashing", "--out", tmp_path, "--quiet")
    assert "Run `controlmm train rvq` with the same --out first" in refused("train", "masked", *arguments)
    message = refused("assemble", tmp_path, "--out", tmp_path / "model")
    assert (
        f"No trained stage in {tmp_path}. Pass the folder that `controlmm train STAGE --out` wrote to"
        in message
    )


def test_other_settings_do_not_resume_a_run(root: Path, data: Path, refused: Command) -> None:
    message = refused(
        "train", "rvq", "--data", data, "--config", "tiny", "--out", root, "--seed", 9, "--quiet"
    )
    assert "settings.seed (3407 before, 9 now)" in message


def test_options_of_a_stage_are_set_by_name(root: Path, data: Path, command: Command, tmp_path: Path) -> None:
    shutil.copytree(root, tmp_path / "root", ignore=shutil.ignore_patterns("control"))
    arguments = ("--data", data, "--config", "tiny", "--text", "hashing", "--out", tmp_path / "root")
    named = ("masks=cross", "sampling=gumbel_st", "into_frozen_trunk=false", "milestones=1,2")
    options = [part for name in named for part in ("--set", name)]
    command("train", "control", *arguments, *options, "--steps", 2, "--batch-size", 2, "--quiet")
    told = json.loads((tmp_path / "root" / "control" / "run.json").read_text())
    assert told["options"] == dict(name.split("=") for name in named)
    assert told["settings"]["milestones"] == [1, 2]
    assert told["alpha"] == 0.5  # the published one for such masks
    config = json.loads((tmp_path / "root" / "control" / "best" / "config.json").read_text())
    assert config["into_frozen_trunk"] is False


def test_the_weight_of_root_and_contacts_can_be_set(
    root: Path, data: Path, command: Command, tmp_path: Path
) -> None:
    arguments = (
        "--data",
        data,
        "--config",
        "tiny",
        "--out",
        tmp_path / "root",
        "--steps",
        1,
        "--batch-size",
        2,
    )
    command("train", "rvq", *arguments, "--set", "root_contact_bias=5", "--quiet")
    five = Normalizer.load(tmp_path / "root" / "normalizer.safetensors").std
    once_25 = Normalizer.load(root / "normalizer.safetensors").std
    heavier = [0, 1, 2, 3, 259, 260, 261, 262]
    torch.testing.assert_close(five[heavier], 5 * once_25[heavier])
    others = [channel for channel in range(263) if channel not in heavier]
    assert torch.equal(five[others], once_25[others])


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("masks", "`--set` expects NAME=VALUE, got 'masks'"),
        ("masks=all", "Option 'masks' must be one of mixed, trajectory, random, cross, got 'all'"),
        ("colour=red", "There is no option 'colour'. Options: alpha, "),
    ],
)
def test_unknown_options_are_refused(
    root: Path, data: Path, refused: Command, tmp_path: Path, option: str, message: str
) -> None:
    arguments = ("--data", data, "--config", "tiny", "--text", "hashing", "--out", tmp_path)
    assert message in refused("train", "control", *arguments, "--set", option, "--quiet")


def test_all_stages_must_have_the_same_text_encoder(root: Path, data: Path, refused: Command) -> None:
    encoder = root / "text_encoder.json"
    before = encoder.read_text()
    encoder.write_text(before.replace('"dim": 64', '"dim": 32'))
    try:
        message = refused(
            "train",
            "masked",
            "--data",
            data,
            "--config",
            "tiny",
            "--text",
            "hashing",
            "--out",
            root,
            "--quiet",
        )
    finally:
        encoder.write_text(before)
    assert "is not the one that the model was trained with: expected dim=32, got dim=64" in message


def test_ctrl_c_says_how_to_resume(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(stages, "train_stage", interrupted)
    result = CliRunner().invoke(app, ["train", "rvq", "--data", str(data), "--out", str(tmp_path)])
    assert result.exit_code == 130
    assert "The same command resumes from the last checkpoint" in result.stderr


@pytest.mark.usefixtures("same_threads")
def test_a_killed_run_ends_with_the_weights_of_an_unbroken_one(
    data: Path, command: Command, tmp_path: Path
) -> None:
    def arguments(root: Path) -> list[str]:
        return [
            "train", "rvq", "--data", str(data), "--config", "tiny", "--out", str(root),
            "--steps", str(STEPS), "--batch-size", "4", "--threads", "1", "--quiet",
        ]  # fmt: skip

    killed, unbroken = tmp_path / "killed", tmp_path / "unbroken"
    _kill_after_a_checkpoint(arguments(killed), killed / "rvq")
    command(*arguments(killed))
    command(*arguments(unbroken))
    expected = load_file(unbroken / "rvq" / "checkpoint.safetensors")
    for name, value in load_file(killed / "rvq" / "checkpoint.safetensors").items():
        assert torch.equal(value, expected[name]), name
    log = [json.loads(line) for line in (killed / "rvq" / "metrics.jsonl").read_text().splitlines()]
    assert log == [json.loads(line) for line in (unbroken / "rvq" / "metrics.jsonl").read_text().splitlines()]
    starts = [json.loads(line) for line in (killed / "rvq" / "starts.jsonl").read_text().splitlines()]
    assert len(starts) == 2
    assert starts[0]["command"].endswith("--threads 1 --quiet")


def _kill_after_a_checkpoint(arguments: list[str], run: Path) -> None:
    """Start a training as its own process and end it with SIGKILL as soon as it has written a checkpoint."""
    process = subprocess.Popen(
        [sys.executable, "-m", "controlmm", *arguments], env={**os.environ, "OMP_NUM_THREADS": "1"}
    )
    deadline = time.monotonic() + PATIENCE
    while not (run / "checkpoint.safetensors").is_file():
        assert process.poll() is None, "the training ended before it wrote a checkpoint"
        assert time.monotonic() < deadline, f"no checkpoint after {PATIENCE} s"
        time.sleep(0.01)
    process.kill()
    assert process.wait() == -signal.SIGKILL
