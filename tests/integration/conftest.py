"""What the tests of the command share: ways to run it, and a few made-up clips."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from controlmm.cli.main import app
from controlmm.motion.skeleton import HUMANML3D

USER_ERROR = 2
FRAMES = 70  # of a made-up clip; training windows take 64
TRAIN_CLIPS, VAL_CLIPS = 6, 2


@pytest.fixture
def command() -> Callable[..., str]:
    """Runs ``controlmm ARGUMENTS`` in this process, expects success and returns stdout."""

    def run(*arguments: object) -> str:
        result = CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)
        assert result.exit_code == 0, result.stderr
        return result.stdout

    return run


@pytest.fixture
def refused() -> Callable[..., str]:
    """Runs ``controlmm ARGUMENTS``, expects exit code 2 and one line on stderr, which it returns."""

    def run(*arguments: object) -> str:
        result = CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)
        assert result.exit_code == USER_ERROR, result.output
        assert result.stdout == ""
        assert result.stderr.startswith("error: ")
        assert result.stderr.count("\n") == 1
        return result.stderr

    return run


@pytest.fixture(scope="session")
def joint_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Clips of a body that walks stiffly in different directions, with captions and a validation list."""
    folder = tmp_path_factory.mktemp("joints")
    names = [f"clip{index}" for index in range(TRAIN_CLIPS + VAL_CLIPS)]
    for index, name in enumerate(names):
        np.save(folder / f"{name}.npy", _walking_joints(seed=index))
        (folder / f"{name}.txt").write_text(f"a person walks forward\nsomeone raises the left hand {index}\n")
    (folder / "val.txt").write_text("\n".join(names[TRAIN_CLIPS:]))
    return folder


def _walking_joints(seed: int) -> np.ndarray:
    """(70, 22, 3) metres: the rest pose on a straight way, every joint wobbling by a few centimetres."""
    random = np.random.default_rng(seed)
    pose = np.zeros((22, 3))
    offsets = HUMANML3D.rest_offsets().numpy()
    for joint, parent in enumerate(HUMANML3D.parents[1:], start=1):
        pose[joint] = pose[parent] + offsets[joint] + random.normal(0, 0.01, 3)
    time = np.arange(FRAMES)[:, None, None] / HUMANML3D.fps
    rates, phases = random.uniform(1, 6, (1, 22, 3)), random.uniform(0, 6, (1, 22, 3))
    way = time * np.array([random.uniform(-0.3, 0.3), 0, random.uniform(0.5, 1.5)])
    return pose - [0, pose[:, 1].min(), 0] + way + 0.03 * np.sin(rates * time + phases)
