"""Sheets of recorded clips beside what a network makes of them."""

from __future__ import annotations

import pytest
from PIL import Image

from controlmm.motion.motion import Motion
from controlmm.viewer.sample_sheet import sample_sheet, save_sample_sheet


def test_every_pair_has_two_strips_and_its_caption(walk, tmp_path):
    pairs = [
        (f"walk $number$ {i}", *(Motion(joints=walk(40, turn=t).float()) for t in (0.2, 0.9))) for i in (1, 2)
    ]
    figure = sample_sheet(pairs, title="masked, step 500")
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == ["walk $number$ 1\nrecorded", "made", "walk $number$ 2\nrecorded", "made"]
    path = save_sample_sheet(pairs, tmp_path / "samples" / "step.png")
    with Image.open(path) as picture:
        assert picture.size[0] == 960
        assert len(picture.convert("RGB").getcolors(1 << 21) or []) > 100
    assert [file.name for file in path.parent.iterdir()] == ["step.png"]  # nothing half-written is left


def test_no_pairs_are_refused():
    with pytest.raises(ValueError, match="`pairs` is empty, so there is nothing to draw"):
        sample_sheet([])
