"""TLControl from the command line: train, assemble, generate, vary a part."""

from __future__ import annotations

import json

import pytest

from controlmm.motion.motion import Motion


def test_two_stages_become_a_model_that_generates(command, tiny_data_folder, tmp_path):
    for stage in ("tl-vq", "tl-mtt"):
        command(
            "train", stage, "--data", tiny_data_folder, "--out", tmp_path / "root", "--config", "tiny",
            "--text", "hashing", "--steps", 3, "--quiet",
        )  # fmt: skip
    command("assemble", tmp_path / "root", "--out", tmp_path / "model", "--half")
    assert json.loads((tmp_path / "model" / "pipeline.json").read_text())["kind"] == "tlcontrol"
    assert (tmp_path / "model" / "transformer" / "run.json").is_file()
    printed = command(
        "generate", "a person walks", "--seconds", 1, "--model", tmp_path / "model",
        "--formats", "npz", "--out", tmp_path / "out", "--quiet",
    )  # fmt: skip
    (file,) = printed.split()
    assert Motion.load(file).num_frames == 20


@pytest.fixture
def generate(command, tmp_path):
    def run(model, *arguments):
        return command(
            "generate", "a person walks", "--seconds", 1, "--model", model, "--formats", "npz",
            "--out", tmp_path / "out", *arguments,
        )  # fmt: skip

    return run


def test_one_body_part_varies(generate, tiny_tlcontrol_folder):
    printed = generate(tiny_tlcontrol_folder, "--samples", 2, "--vary", "left_arm", "--quiet")
    first, second = (Motion.load(file).joints for file in printed.split())
    assert (first - second).abs().max() > 0


def test_vary_needs_tlcontrol(refused, tiny_pipeline_folder, tmp_path):
    error = refused(
        "generate", "a person walks", "--model", tiny_pipeline_folder, "--vary", "left_arm",
        "--out", tmp_path,
    )  # fmt: skip
    assert "`--vary` needs a TLControl model" in error


def test_a_motion_is_edited(generate, command, tiny_tlcontrol_folder, tmp_path):
    (source,) = generate(tiny_tlcontrol_folder, "--quiet").split()
    printed = command(
        "generate", "a person jumps", "--edit", source, "--keep", "0-0.4", "--model", tiny_tlcontrol_folder,
        "--preset", "fast", "--formats", "npz", "--out", tmp_path / "edited", "--quiet",
    )  # fmt: skip
    edited = Motion.load(printed.strip())
    assert edited.num_frames == 20
    assert edited.text == "a person jumps"
