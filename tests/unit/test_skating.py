"""Foot skating ratio: cases worked by hand, padding, and an independent count with NumPy loops."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from controlmm.evaluation import foot_skating_ratio
from controlmm.motion.skeleton import HUMANML3D, KIT

LEFT, RIGHT = 10, 11
FPS = 20
ROUNDING = 1e-6  # of a quotient of small whole numbers in float32


def _standing(frames: int, *, clips: int = 1, height: float = 0.02) -> torch.Tensor:
    joints = torch.zeros(clips, frames, 22, 3)
    joints[..., 1] = 1.0
    joints[:, :, [LEFT, RIGHT], 1] = height
    return joints


def _slide(joints: torch.Tensor, foot: int, *, start: int, stop: int, speed: float) -> None:
    """Move a foot along x at ``speed`` m/s in the frame pairs ``start`` to ``stop - 1``."""
    step = torch.zeros(joints.shape[1])
    step[start + 1 : stop + 1] = speed / FPS
    joints[:, :, foot, 0] += step.cumsum(0)


def _counted_by_hand(joints: np.ndarray) -> float:
    """The definition, pair by pair, for one clip (T, 22, 3)."""
    skating = 0
    pairs = len(joints) - 1
    speeds = {
        foot: [float(np.hypot(*(joints[t + 1, foot] - joints[t, foot])[[0, 2]])) * FPS for t in range(pairs)]
        for foot in (LEFT, RIGHT)
    }
    for t in range(pairs):
        for foot in (LEFT, RIGHT):
            around = [speeds[foot][s] if 0 <= s < pairs else 0.0 for s in range(t - 2, t + 3)]
            is_low = max(joints[t, foot, 1], joints[t + 1, foot, 1]) < 0.05
            if is_low and speeds[foot][t] > 0.5 and sum(around) / 5 > 0.5:
                skating += 1
                break
    return skating / pairs


def test_a_standing_body_does_not_skate() -> None:
    assert foot_skating_ratio(_standing(41)).tolist() == [0.0]


def test_a_sliding_foot_counts_where_its_average_speed_is_high_too() -> None:
    joints = _standing(41)
    _slide(joints, RIGHT, start=10, stop=20, speed=0.7)
    # 10 pairs at 0.7 m/s; the 5-frame average is 0.42 at the first and the last, 0.56 next to them
    assert foot_skating_ratio(joints).item() == pytest.approx(8 / 40, abs=ROUNDING)


def test_a_frame_counts_once_when_both_feet_slide() -> None:
    joints = _standing(41)
    for foot in (LEFT, RIGHT):
        _slide(joints, foot, start=0, stop=40, speed=1.0)
    assert foot_skating_ratio(joints).item() == pytest.approx(1.0, abs=ROUNDING)


@pytest.mark.parametrize(("height", "speed"), [(0.06, 1.0), (0.02, 0.4)], ids=["lifted", "slow"])
def test_a_lifted_or_slow_foot_does_not_skate(height: float, speed: float) -> None:
    joints = _standing(41, height=height)
    _slide(joints, LEFT, start=0, stop=40, speed=speed)
    assert foot_skating_ratio(joints).item() == 0


def test_one_jump_of_a_frame_does_not_count() -> None:
    joints = _standing(41)
    _slide(joints, LEFT, start=20, stop=21, speed=2.0)  # the average is 0.4 m/s
    assert foot_skating_ratio(joints).item() == 0


def test_padding_changes_nothing() -> None:
    joints = _standing(30, clips=2)
    _slide(joints, LEFT, start=5, stop=29, speed=1.0)
    alone = foot_skating_ratio(joints[:1, :20])
    padded = foot_skating_ratio(joints, lengths=torch.tensor([20, 30]))
    assert padded[0] == alone[0]
    assert padded[1] == foot_skating_ratio(joints[1:])[0]


def test_agrees_with_the_definition_counted_pair_by_pair() -> None:
    generator = torch.Generator().manual_seed(7)
    joints = _standing(80, clips=3)
    steps = torch.rand(3, 80, 2, generator=generator) * 0.08
    joints[:, :, [LEFT, RIGHT], 2] = steps.cumsum(1)
    joints[:, :, [LEFT, RIGHT], 1] = torch.rand(3, 80, 2, generator=generator) * 0.06
    expected = [_counted_by_hand(clip.double().numpy()) for clip in joints]
    assert min(expected) > 0.1
    torch.testing.assert_close(foot_skating_ratio(joints), torch.tensor(expected), rtol=0, atol=ROUNDING)


def test_kit_motions_are_millimetres() -> None:
    joints = torch.zeros(1, 30, 21, 3)
    joints[:, :, KIT.left_foot[1], 2] = torch.arange(30) * 1000 / KIT.fps  # 1 m/s
    assert foot_skating_ratio(joints, skeleton=KIT).item() == pytest.approx(1.0, abs=ROUNDING)


def test_a_single_frame_has_no_pairs() -> None:
    assert foot_skating_ratio(_standing(1, clips=2)).tolist() == [0.0, 0.0]


def test_wrong_shapes_and_lengths_are_refused() -> None:
    with pytest.raises(ValueError, match=r"`joints` must have shape \(B, T, 22, 3\)"):
        foot_skating_ratio(torch.zeros(5, 22, 3))
    with pytest.raises(ValueError, match=r"`lengths` must hold one number from 1 to 5"):
        foot_skating_ratio(torch.zeros(1, 5, HUMANML3D.num_joints, 3), lengths=torch.tensor([6]))
