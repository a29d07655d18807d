from __future__ import annotations

import subprocess
import sys
import time

import numpy as np
import pytest
import torch
from PIL import Image

from controlmm.motion.motion import Motion
from controlmm.motion.skeleton import KIT
from controlmm.viewer import palette
from controlmm.viewer.contact_sheet import PngFormat, contact_sheet


def pixels_near(path, color: str) -> int:
    image = np.asarray(Image.open(path).convert("RGB")).astype(int)
    wanted = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)])
    return int((np.abs(image - wanted).max(-1) < 12).sum())


def test_sheet_has_its_size_and_all_colors_in_under_three_seconds(controlled_walking, tmp_path):
    path = tmp_path / "walk.png"
    start = time.process_time()
    PngFormat.save(controlled_walking, path)
    assert time.process_time() - start < 3.0
    assert Image.open(path).size == (1650, 1012)
    for color in (palette.LEFT, palette.RIGHT, palette.TRUNK, palette.CONTROL[0], palette.CONTROL[1]):
        assert pixels_near(path, color) > 200, color


def test_no_target_color_without_targets(walking, tmp_path):
    path = tmp_path / "walk.png"
    PngFormat.save(walking, path, dpi=60)
    assert pixels_near(path, palette.CONTROL[0]) == 0


def texts(figure) -> str:
    return "\n".join(text.get_text() for text in figure.texts + [t for a in figure.axes for t in a.texts])


def test_title_times_and_control_error_are_written(controlled_walking):
    written = texts(contact_sheet(controlled_walking))
    assert "a person walks forward" in written
    assert "3.00 s" in written
    assert "control error 0.14 cm mean, 3.00 cm max" in written
    assert "0.00 s" in written
    assert "2.95 s" in written


def test_number_of_poses_is_the_one_asked_for(walking):
    figure = contact_sheet(walking, frames=6)
    assert len(figure.axes[0].texts) == 6


ODD = {
    "one frame": lambda motion: Motion(joints=motion.joints[:1]),
    "constant": lambda motion: Motion(joints=motion.joints[:1].expand(30, -1, -1), text="stands"),
    "one point": lambda motion: Motion(joints=torch.zeros(8, 22, 3)),
    "formula and long text": lambda motion: Motion(
        joints=motion.joints, text="costs $5 and $6_ " + "very " * 200
    ),
    "kit": lambda motion: Motion(joints=1000 * motion.joints[:, :21], skeleton=KIT),
    "far away": lambda motion: Motion(joints=motion.joints * 5 + 40),
}


@pytest.mark.parametrize("name", ODD)
def test_odd_motions_are_drawn(name, walking, tmp_path):
    PngFormat.save(ODD[name](walking), tmp_path / "odd.png", dpi=40)
    assert Image.open(tmp_path / "odd.png").size == (600, 368)


def test_whole_pose_keyframes_are_drawn(walking, tmp_path):
    mask = torch.zeros(60, 22, 3, dtype=torch.bool)
    mask[[0, 59]] = True
    figure = contact_sheet(walking, targets=walking.joints + 0.01, mask=mask)
    assert "44 targets on 22 joint(s)" in texts(figure)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frames": 1}, r"`frames` must be in 2..24, got 1"),
        ({"dpi": 5000}, r"`dpi` must be in 20..400, got 5000"),
    ],
)
def test_options_out_of_range_are_refused(walking, tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        PngFormat.save(walking, tmp_path / "walk.png", **options)


def test_pictures_cannot_be_loaded(tmp_path):
    with pytest.raises(ValueError, match=r"cannot be loaded. Load the .npz or .bvh"):
        PngFormat.load(tmp_path / "walk.png")


def test_pyplot_is_never_imported():
    code = "import sys, controlmm.viewer.contact_sheet; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
