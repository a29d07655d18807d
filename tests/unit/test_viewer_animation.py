from __future__ import annotations

import sys

import numpy as np
import pytest
from PIL import Image

from controlmm.motion.motion import Motion
from controlmm.viewer import palette
from controlmm.viewer.animation import GifFormat, Mp4Format
from controlmm.viewer.moving_picture import MovingPicture
from controlmm.viewer.scene import scene_of

SMALL = (240, 200)


@pytest.fixture
def clip(controlled_walking):
    extra = {name: value[:24] for name, value in controlled_walking.extra.items()}
    return Motion(joints=controlled_walking.joints[:24], text="a person walks forward", extra=extra)


def test_gif_has_every_frame_at_20_fps(clip, tmp_path):
    path = tmp_path / "walk.gif"
    GifFormat.save(clip, path, size=SMALL)
    with Image.open(path) as image:
        assert image.size == SMALL
        assert image.n_frames == 24
        durations = []
        for frame in range(image.n_frames):
            image.seek(frame)
            durations.append(image.info["duration"])
    assert durations == [50] * 24


def test_still_figure_keeps_its_frames(walking, tmp_path):
    path = tmp_path / "still.gif"
    GifFormat.save(Motion(joints=walking.joints[:1].expand(10, -1, -1)), path, size=SMALL)
    with Image.open(path) as image:
        assert image.n_frames == 10


@pytest.mark.parametrize("follow", [False, True])
def test_mp4_has_every_frame_at_20_fps(clip, tmp_path, follow):
    av = pytest.importorskip("av")
    path = tmp_path / "walk.mp4"
    Mp4Format.save(clip, path, size=SMALL, follow=follow)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.average_rate == 20
        assert float(stream.duration * stream.time_base) == pytest.approx(24 / 20)
        assert (stream.width, stream.height) == SMALL
        assert sum(1 for _ in container.decode(video=0)) == 24


def figure_column(frame: np.ndarray) -> float:
    """Mean column of the pixels that have the left limbs' colour."""
    wanted = np.array([int(palette.LEFT[i : i + 2], 16) for i in (1, 3, 5)])
    return float(np.nonzero(np.abs(frame.astype(int) - wanted).max(-1) < 30)[1].mean())


def test_fixed_camera_sees_the_figure_walk_to_the_right(walking):
    frames = list(MovingPicture(scene_of(walking), title="", size=SMALL).frames())
    assert figure_column(frames[-1]) > figure_column(frames[0]) + 30


def test_following_camera_keeps_the_figure_in_the_middle(walking):
    frames = list(MovingPicture(scene_of(walking), title="", size=SMALL, follow=True).frames())
    columns = [figure_column(frame) for frame in frames]
    assert max(abs(column - SMALL[0] / 2) for column in columns) < 25


def test_missing_video_library_says_what_to_install(clip, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ImportError, match=r"pip install 'controlmm\[video\]'"):
        Mp4Format.save(clip, tmp_path / "walk.mp4")


@pytest.mark.parametrize("size", [(241, 200), (100, 200), (4096, 200)])
def test_impossible_sizes_are_refused(clip, tmp_path, size):
    with pytest.raises(ValueError, match=r"`size` must be two even numbers in 160..2048"):
        GifFormat.save(clip, tmp_path / "walk.gif", size=size)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("plugin", [GifFormat, Mp4Format])
def test_moving_pictures_cannot_be_loaded(plugin, tmp_path):
    with pytest.raises(ValueError, match="cannot be loaded"):
        plugin.load(tmp_path / "walk")
