"""Clips whose ground rises are left out of training when asked."""

import pytest
import torch

from controlmm.data.clip import FeatureClip
from controlmm.motion.features import joints_to_features
from controlmm.motion.skeleton import HUMANML3D
from controlmm.training.level_ground import ClipSelection, floor_range, select

_FRAMES = 100
_ALMOST = 1e-4  # metres; the root's height goes through float32 features


def _clip(name: str, rise: torch.Tensor) -> FeatureClip:
    """The rest pose whose height is changed by ``rise`` (T,) metres, walking forward a little."""
    offsets = HUMANML3D.rest_offsets().double()
    pose = torch.zeros_like(offsets)
    for joint, parent in enumerate(HUMANML3D.parents):
        pose[joint] = offsets[joint] + (pose[parent] if parent >= 0 else 0)
    joints = pose.repeat(len(rise), 1, 1)
    joints[..., 1] += rise[:, None]
    joints[..., 2] += torch.arange(len(rise))[:, None] * 0.02
    return FeatureClip(name, joints_to_features(joints, public_quirks=False).float(), ())


def test_stairs_raise_the_floor_and_a_jump_does_not() -> None:
    time = torch.arange(_FRAMES) / 20
    stairs = _clip("stairs", (time * 0.3).floor() * 0.5)
    jump = _clip("jump", 0.4 * torch.exp(-(((time - 2.5) / 0.2) ** 2)))

    assert floor_range(stairs) == pytest.approx(0.5 * int(0.3 * float(time[-1])), abs=_ALMOST)
    assert floor_range(jump) == pytest.approx(0.0, abs=_ALMOST)


def test_selection_leaves_out_what_rises_and_keeps_the_order() -> None:
    level = _clip("level", torch.zeros(_FRAMES))
    hill = _clip("hill", torch.linspace(0, 1, _FRAMES))

    assert [clip.id for clip in select([hill, level], ClipSelection(max_floor_range=0.1))] == ["level"]
    assert [clip.id for clip in select([hill, level], ClipSelection())] == ["hill", "level"]


@pytest.mark.parametrize("height", [0.0, -1.0, float("nan")])
def test_the_height_must_be_positive(height: float) -> None:
    with pytest.raises(ValueError, match="`max_floor_range` must be a positive height"):
        ClipSelection(max_floor_range=height)
