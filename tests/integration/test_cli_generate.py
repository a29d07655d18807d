"""``controlmm generate`` on a tiny model: what it writes, what it prints, what it refuses."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from controlmm.cli.generate import slug
from controlmm.controls import (
    Avoid,
    ControlFile,
    HalfSpace,
    JointControl,
    PathControl,
    Sphere,
    TimelineEntry,
    penetration,
    save_controls,
)
from controlmm.evaluation import foot_skating_ratio
from controlmm.motion.motion import Motion

SECONDS, FRAMES = 0.8, 16
PROMPT = "a person walks forward"
CENTIMETRE = 0.01
PRINTED = 0.006  # centimetres; errors are printed with two digits

Command = Callable[..., str]


@pytest.fixture
def walk_line(tmp_path: Path) -> Path:
    """A short straight way for the pelvis, with its own prompt and length."""
    path = PathControl("pelvis", xz=[[0.0, 0.0], [0.0, 0.5]])
    return save_controls(ControlFile([path], seconds=SECONDS, text=PROMPT), tmp_path / "line.json")


def test_writes_every_format_of_every_sample_and_prints_a_row_for_each(
    command: Command, tiny_pipeline_folder: Path, walk_line: Path, tmp_path: Path
) -> None:
    printed = command(
        "generate", PROMPT, "--seconds", SECONDS, "--controls", walk_line, "--preset", "fast", "--samples", 2,
        "--seed", 3, "--formats", "npz,bvh,png", "--out", tmp_path / "out", "--model", tiny_pipeline_folder,
    )  # fmt: skip
    names = [f"a-person-walks-forward_3_{i}.{suffix}" for i in (0, 1) for suffix in ("npz", "bvh", "png")]
    lines = printed.splitlines()
    assert lines[-6:] == [str(tmp_path / "out" / name) for name in names]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(names)
    for index, row in enumerate(line.split() for line in lines[2:4]):
        motion = Motion.load(tmp_path / "out" / names[3 * index])
        assert motion.num_frames == FRAMES
        distance = (motion.joints - motion.extra["targets"])[:, 0, [0, 2]].norm(dim=-1).mean().item()
        assert float(row[1]) == pytest.approx(distance / CENTIMETRE, abs=PRINTED)
        assert row[2] == "-"  # no obstacles
        assert row[3] == f"{foot_skating_ratio(motion.joints[None]).item():.3f}"
        assert row[0] == str(index)
        assert float(row[4]) > 0
        assert float(row[5]) > 0


def test_obstacles_of_the_control_file_and_of_their_own_file_count_together(
    command: Command, tiny_pipeline_folder: Path, tmp_path: Path
) -> None:
    path = PathControl("pelvis", xz=[[0.0, 0.0], [0.0, 0.5]])
    beside = Avoid(Sphere((0.5, 0.9, 0.2), 0.2), joints=["head"])
    controls = ControlFile([path], seconds=SECONDS, text=PROMPT, obstacles=[beside])
    below = Avoid(
        HalfSpace(point=(0, 3, 0), normal=(0, 1, 0)), margin=0.0
    )  # solid, and motions stand on y = 0
    printed = command(
        "generate", "--controls", save_controls(controls, tmp_path / "walk.json"),
        "--obstacles", save_controls(ControlFile(obstacles=[below]), tmp_path / "scene.json"),
        "--preset", "fast", "--formats", "npz", "--out", tmp_path / "out", "--model", tiny_pipeline_folder,
    )  # fmt: skip
    motion = Motion.load(Path(printed.splitlines()[-1]))
    assert [avoid.label for avoid in motion.extra["obstacles"]] == ["sphere", "half_space"]
    depth = penetration(motion.joints[None], motion.extra["obstacles"], motion.skeleton).item()
    assert depth > 0.1
    assert float(printed.splitlines()[2].split()[2]) == pytest.approx(depth / CENTIMETRE, abs=PRINTED)


def test_a_file_without_obstacles_is_refused_as_scene(
    refused: Command, tiny_pipeline_folder: Path, walk_line: Path
) -> None:
    said = refused("generate", PROMPT, "--obstacles", walk_line, "--model", tiny_pipeline_folder)
    assert 'line.json holds no obstacles. Give them as "obstacles": [...]' in said


def test_prompt_and_length_come_from_the_control_file_when_not_given(
    command: Command, tiny_pipeline_folder: Path, walk_line: Path, tmp_path: Path
) -> None:
    printed = command(
        "generate", "--controls", walk_line, "--preset", "fast", "--formats", "npz", "--out", tmp_path,
        "--model", tiny_pipeline_folder, "--quiet",
    )  # fmt: skip
    assert printed == f"{tmp_path / 'a-person-walks-forward_0_0.npz'}\n"
    motion = Motion.load(printed.strip())
    assert (motion.text, motion.num_frames) == (PROMPT, FRAMES)


def test_the_seed_decides_the_motion_and_text_alone_has_no_control_error(
    command: Command, tiny_pipeline_folder: Path, tmp_path: Path
) -> None:
    def joints(seed: int, folder: str) -> torch.Tensor:
        printed = command(
            "generate", "turn", "--seconds", SECONDS, "--seed", seed, "--formats", "npz", "--out",
            tmp_path / folder, "--model", tiny_pipeline_folder, "--preset", "fast", "--guidance", 2,
        )  # fmt: skip
        assert printed.splitlines()[2].split()[1] == "-"
        return Motion.load(tmp_path / folder / f"turn_{seed}_0.npz").joints

    first = joints(1, "a")
    assert torch.equal(first, joints(1, "b"))
    assert not torch.equal(first, joints(2, "a"))


@pytest.mark.parametrize(
    ("prompt", "expected"),
    [
        ("A person, walking!", "a-person-walking"),
        ("../../etc/passwd", "etc-passwd"),
        ("word " * 30, "word-word-word-word-word-word-word-word-word"),
        ("...", "motion"),
        ("x" * 60, "x" * 48),
    ],
)
def test_file_names_are_made_of_the_prompts_words(prompt: str, expected: str) -> None:
    assert slug(prompt) == expected


_HEADER = {"version": 1, "units": "m", "up": "y", "fps": 20}


def _joint_control(joint: str, frame: int, x: float) -> str:
    control = {"type": "joint", "joint": joint, "frames": [0, frame], "positions": [[0, 0.9, 0], [x, 0.9, 0]]}
    return json.dumps({**_HEADER, "prompt": PROMPT, "seconds": 6.0, "controls": [control]})


BAD_FILES = {
    "unknown joint": ("tail.json", _joint_control("tail", 1, 0.0), r'Unknown joint "tail"'),
    "frame after the end": (
        "late.json",
        _joint_control("pelvis", 400, 0.0),
        r"\(pelvis\) names frame 400, but the clip has 120 frames",
    ),
    "NaN target": (
        "nan.json",
        _joint_control("pelvis", 1, float("nan")),
        r"controls\[0\]\.positions\[1\]: must be a finite number, got NaN",
    ),
    "NaN in a table": ("nan.csv", "frame,joint,x,y,z\n0,pelvis,nan,0.9,0\n", r"must be finite, got \(nan"),
    "broken JSON": ("broken.json", '{"version": 1, ', r"broken JSON at line 1, column 16"),
    "too short": (
        "short.json",
        '{"version": 1, "units": "m", "up": "y", "fps": 20, "seconds": 0.2, "controls": []}',
        r"short\.json is 0\.2 s long, a motion is 0\.4 to 9\.8 s",
    ),
    "too long": (
        "long.json",
        _joint_control("pelvis", 1, 0.0).replace('"seconds": 6.0', '"seconds": 12'),
        r"is 12 s long, a motion is 0\.4 to 9\.8 s",
    ),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_control_files_are_refused_in_one_line(
    case: str, refused: Command, tiny_pipeline_folder: Path, tmp_path: Path
) -> None:
    name, content, pattern = BAD_FILES[case]
    (tmp_path / name).write_text(content)
    message = refused(
        "generate", "a person stands", "--controls", tmp_path / name, "--model", tiny_pipeline_folder,
        "--out", tmp_path / "out", "--quiet",
    )  # fmt: skip
    assert _matches(pattern, message)
    assert not (tmp_path / "out").exists()


BAD_OPTIONS = {
    "empty prompt": (["  "], r"`prompt` is empty"),
    "no prompt": ([], r"Give a prompt"),
    "missing model folder": (["walk", "--model", "nowhere"], r"No model folder at nowhere"),
    "missing control file": (["walk", "--controls", "nowhere.json"], r"No control file at nowhere\.json"),
    "negative naturalness": (
        ["walk", "--naturalness", "-1"],
        r"`naturalness` must be a number of at least 0",
    ),
    "unknown preset": (["walk", "--preset", "best"], r"Unknown `preset` 'best'.*fast"),
    "unknown format": (["walk", "--formats", "npz,fbx"], r"`--formats` must name some of .*bvh.*'npz,fbx'"),
    "no format": (["walk", "--formats", ","], r"`--formats` must name some of"),
    "too long": (["walk", "--seconds", "11"], r"`seconds` must be between 0\.4 and 9\.8, got 11"),
    "no samples": (["walk", "--samples", "0"], r"`samples` must be a whole number of at least 1"),
    "negative seed": (["walk", "--seed", "-1"], r"`seed` must be a whole number of at least 0"),
    "seed too large": (["walk", "--seed", str(2**63)], r"`seed` must be at most 9223372036854775807"),
    "prompt without quotes": (["a", "person", "walks"], r'in quotes, .*generate "a person walks"'),
    "tolerance without a number": (
        ["walk", "--tolerance", "small"],
        r"`tolerance` must be a positive number of m or text such as '5mm' or '5cm', got 'small'",
    ),
    "time budget in minutes": (["walk", "--time-budget", "2min"], r"`time_budget` must be .*got '2min'"),
}


@pytest.mark.parametrize("case", BAD_OPTIONS)
def test_bad_options_are_refused_in_one_line(
    case: str, refused: Command, tiny_pipeline_folder: Path, tmp_path: Path
) -> None:
    arguments, pattern = BAD_OPTIONS[case]
    model = [] if "--model" in arguments else ["--model", tiny_pipeline_folder]
    assert _matches(pattern, refused("generate", *arguments, *model, "--out", tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_file_in_place_of_the_folder_is_refused_before_anything_is_generated(
    refused: Command, tmp_path: Path
) -> None:
    (tmp_path / "taken").write_text("mine")
    for out in (tmp_path / "taken", tmp_path / "taken" / "deeper"):
        # A missing model would be the next thing to be refused.
        message = refused("generate", "walk", "--model", "nowhere", "--out", out)
        assert f"`--out` needs a folder, but {tmp_path / 'taken'} is a file" in message
    assert (tmp_path / "taken").read_text() == "mine"


def test_a_tolerance_replaces_the_presets(
    command: Command, tiny_pipeline_folder: Path, walk_line: Path, tmp_path: Path
) -> None:
    def joints(*options: str) -> torch.Tensor:
        command(
            "generate", PROMPT, "--controls", walk_line, "--formats", "npz", "--out", tmp_path, "--model",
            tiny_pipeline_folder, *options,
        )  # fmt: skip
        return Motion.load(next(tmp_path.glob("*.npz"))).joints

    as_preset = joints()
    assert torch.equal(joints("--tolerance", "3cm"), as_preset)
    assert not torch.equal(joints("--tolerance", "1m"), as_preset)


@pytest.mark.parametrize("part", ["tokenizer", "transformer", "residual", "control"])
def test_truncated_weights_are_named(
    part: str, refused: Command, tiny_pipeline_folder: Path, tmp_path: Path
) -> None:
    model = shutil.copytree(tiny_pipeline_folder, tmp_path / "model")
    weights = model / part / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-100])
    message = refused("generate", "walk", "--model", model)
    assert f"{weights} is damaged or truncated" in message


def test_debug_shows_the_traceback() -> None:
    from typer.testing import CliRunner

    from controlmm.cli.main import app

    result = CliRunner().invoke(app, ["--debug", "generate", "walk", "--formats", "fbx"])
    assert isinstance(result.exception, ValueError)


def test_a_dense_array_sets_the_length(command: Command, tiny_pipeline_folder: Path, tmp_path: Path) -> None:
    positions = np.full((FRAMES, 22, 3), np.nan, dtype=np.float32)
    positions[:, 0] = [0.0, 0.9, 0.0]
    np.save(tmp_path / "dense.npy", positions)
    command(
        "generate", "stand", "--controls", tmp_path / "dense.npy", "--preset", "fast", "--formats", "npz",
        "--out", tmp_path, "--model", tiny_pipeline_folder,
    )  # fmt: skip
    assert Motion.load(tmp_path / "stand_0_0.npz").num_frames == FRAMES


def _matches(pattern: str, message: str) -> bool:
    return re.search(pattern, message) is not None


def test_a_timeline_file_is_generated_pass_by_pass(
    command: Command, tiny_pipeline_folder: Path, tmp_path: Path
) -> None:
    entries = [
        TimelineEntry("lower", "a person walks", frames=(0, FRAMES)),
        TimelineEntry("right_arm", "a person waves", frames=(0, FRAMES)),
    ]
    printed = command(
        "generate", "--timeline", save_controls(ControlFile(timeline=entries), tmp_path / "timeline.json"),
        "--method", "passes", "--preset", "fast", "--formats", "npz,png", "--out", tmp_path / "out",
        "--model", tiny_pipeline_folder,
    )  # fmt: skip
    motion = Motion.load(tmp_path / "out" / "a-person-walks_0_0.npz")
    assert motion.extra["timeline"] == tuple(entries)
    assert motion.num_frames == FRAMES
    assert float(printed.splitlines()[2].split()[1]) > 0  # how well the second pass held the first


def test_a_motion_is_edited(command: Command, tiny_pipeline_folder: Path, tmp_path: Path) -> None:
    model = ("--model", tiny_pipeline_folder, "--preset", "fast")
    first = command(
        "generate", PROMPT, "--seconds", 2, "--formats", "npz,bvh", "--out", tmp_path, "--quiet", *model
    ).split()
    for source, keep in (
        (first[0], ("--keep", "0-0.6", "--keep", "1.2-2")),
        (first[1], ("--keep-part", "lower")),
    ):
        printed = command(
            "generate",
            "a person jumps",
            "--edit",
            source,
            *keep,
            "--formats",
            "npz",
            "--out",
            tmp_path / "e",
            *model,
        )
        edited = Motion.load(tmp_path / "e" / "a-person-jumps_0_0.npz")
        assert edited.num_frames == 40
        assert edited.text == "a person jumps"
        assert float(printed.splitlines()[2].split()[1]) < 0.02  # centimetres by which what is kept has moved
    assert "jumps" in command(
        "generate",
        "he jumps",
        "--edit",
        first[0],
        "--keep",
        "0-1",
        "--loose",
        "--out",
        tmp_path / "f",
        *model,
    )


def test_a_motion_is_edited_under_the_controls_and_obstacles_of_files(
    command: Command, tiny_pipeline_folder: Path, walking_joints: torch.Tensor, tmp_path: Path
) -> None:
    source = Motion(walking_joints).save(tmp_path / "a.npz")
    ball = ControlFile(obstacles=[Sphere((9.0, 1.0, 0.0), 0.2)])
    controls = ControlFile([JointControl("head", [FRAMES - 1], [[0.0, 1.0, None]])], text="he walks on")
    command(
        "generate", "--edit", source, "--keep", "0-0.4", "--preset", "fast", "--formats", "npz,glb",
        "--controls", save_controls(controls, tmp_path / "c.json"),
        "--obstacles", save_controls(ball, tmp_path / "o.json"),
        "--out", tmp_path, "--model", tiny_pipeline_folder,
    )  # fmt: skip
    edited = Motion.load(tmp_path / "he-walks-on_0_0.npz")
    assert edited.extra["mask"].nonzero().tolist() == [[FRAMES - 1, 15, 0], [FRAMES - 1, 15, 1]]
    assert len(edited.extra["obstacles"]) == 1
    assert (tmp_path / "he-walks-on_0_0.glb").read_bytes()[:4] == b"glTF"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--keep", "0-1"), "`--keep` says what of a motion to keep. Name the motion with `--edit FILE`."),
        (("--loose",), "`--loose` says what of a motion to keep."),
        (
            ("--edit", "a.npz", "--seconds", "2"),
            "`--edit` and `--seconds` do not go together. Leave one out.",
        ),
        (
            ("--edit", "a.npz", "--controls", "long.json"),
            "The controls are for a clip of 9 s, but the motion lasts",
        ),
        (
            ("--edit", "a.npz", "--keep", "1"),
            "`--keep` must be START-END in seconds, such as 0-2.5, got '1'.",
        ),
        (("--edit", "a.npz", "--timeline", "t.json"), "`--timeline` and `--edit` do not go together."),
        (("--timeline", "t.json"), "A timeline has prompts of its own. Leave the prompt out."),
        (("--method", "passes"), "`--method` is for timelines. Name one with `--timeline FILE`."),
        (("--timeline", "line.json"), 'line.json holds no timeline. Give it as "timeline": [...]'),
        (("--timeline", "t.json", "--seconds", "2"), "`--timeline` and `--seconds` do not go together."),
        (("--then", "he bows:3"), "`--then` goes on from a first clip. Say how long that lasts, with"),
        (
            ("--then", "he bows 3", "--seconds", "3"),
            "`--then` must be PROMPT:SECONDS, such as 'a person sits down:3', got 'he bows 3'.",
        ),
        (("--then", "he bows:3", "--controls", "line.json"), "`--then` and `--controls` do not go together."),
        (("--then", "he bows:3", "--edit", "a.npz"), "`--edit` and `--then` do not go together."),
        (("--then", "he bows:1", "--seconds", "3"), "`clips[1]` must last more than twice the overlap"),
    ],
)
def test_options_that_do_not_go_together_are_refused(
    refused: Command, walk_line: Path, walking_joints: torch.Tensor, arguments: tuple[str, ...], said: str
) -> None:
    folder = walk_line.parent
    Motion(walking_joints).save(folder / "a.npz")
    entry = TimelineEntry("body", "a person walks", frames=(0, FRAMES))
    save_controls(ControlFile(timeline=[entry]), folder / "t.json")
    start = JointControl("head", [0], [[0, 1.6, 0]])
    save_controls(ControlFile([start], seconds=9), folder / "long.json")
    files = {path.name: str(path) for path in folder.iterdir()}
    assert said in refused("generate", PROMPT, *(files.get(argument, argument) for argument in arguments))
