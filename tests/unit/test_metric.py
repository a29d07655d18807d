"""The metric of Gauss-Newton and the rows it is made of, against autograd and dense linear algebra."""

from __future__ import annotations

import pytest
import torch

from controlmm.generation.coordinate_groups import Groups
from controlmm.generation.kinematic_rows import KinematicPattern, KinematicRows
from controlmm.generation.solvers.metric import Metric
from controlmm.ops import recover_joints

ALL = torch.arange(10)


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def rows_of(features, joints, mask, std, groups=None) -> KinematicRows:
    return KinematicPattern(mask, std, groups).rows(features, joints)


@pytest.fixture
def rows_case():
    """Features of 20 frames and 3 joints, joints, mask, deviations; and the Jacobian by autograd."""
    features = (0.1 * random(20, 10)).double()
    features[:, 0] *= 0.5
    std = random(10, seed=1).double().abs() + 0.5
    mask = torch.rand(20, 3, 3, generator=torch.Generator().manual_seed(2)) < 0.3
    leaf = features.clone().requires_grad_()
    joints = recover_joints((leaf * std)[None], joints=3)[0]
    jacobian = torch.stack(
        [torch.autograd.grad(value, leaf, retain_graph=True)[0].T.flatten() for value in joints[mask]]
    )
    return (features * std, joints.detach(), mask, std), jacobian


def test_kinematic_rows_are_the_jacobian_of_the_kinematics(rows_case):
    case, jacobian = rows_case
    rows = rows_of(*case)
    dense = rows.dense(10).mT.flatten(1)
    torch.testing.assert_close(dense, jacobian, rtol=1e-12, atol=1e-12)


def test_products_of_kinematic_rows_and_of_their_sums(rows_case):
    case, jacobian = rows_case
    half = random(200, 200, seed=5).double()
    channels = (half @ half.T).reshape(10, 20, 10, 20)
    expected = jacobian @ half @ half.T @ jacobian.T
    torch.testing.assert_close(rows_of(*case).gram(channels, ALL), expected, rtol=1e-10, atol=1e-8)
    groups = Groups.of_neighbours(case[2], 3)
    sums = torch.stack([groups.sum(unit) for unit in torch.eye(len(expected)).double()], dim=1)
    summed = rows_of(*case, groups).gram(channels, ALL)
    torch.testing.assert_close(summed, sums @ expected @ sums.T, rtol=1e-10, atol=1e-8)
    torch.testing.assert_close(
        groups.spread(torch.arange(len(sums)).double()), sums.T @ torch.arange(len(sums)).double()
    )


def test_products_among_those_of_more_channels_and_frames(rows_case):
    """A clip of a batch controls some of the joints that any clip controls, and is shorter than others."""
    case, _ = rows_case
    half = random(16 * 24, 50, seed=5).double()
    products, columns = (half @ half.T).reshape(16, 24, 16, 24), torch.tensor([0, 1, 2, 3, 7, 8, 9, 4, 5, 6])
    own = products[:, :20, :, :20][columns][:, :, columns].contiguous()
    rows = rows_of(*case)
    torch.testing.assert_close(rows.gram(products, columns), rows.gram(own, ALL), rtol=1e-10, atol=1e-8)


def test_groups_are_orthonormal_and_join_neighbours_of_one_coordinate():
    mask = torch.zeros(9, 2, 3, dtype=torch.bool)
    mask[:, 0, 1] = mask[[2, 5, 8], 1, 0] = True
    groups = Groups.of_neighbours(mask, 4)
    sums = torch.stack([groups.sum(unit) for unit in torch.eye(12).double()], dim=1)
    torch.testing.assert_close(sums @ sums.T, torch.eye(4, dtype=torch.float64))
    frame, joint, _ = mask.nonzero().T
    members = [sorted(frame[row > 0].tolist()) for row in sums]
    assert sorted(members) == [[0, 1, 2, 3], [2, 5, 8], [4, 5, 6, 7], [8]]
    assert all(len(set(joint[row > 0].tolist())) == 1 for row in sums)


def test_many_coordinates_of_the_root_are_grouped_by_time_and_others_by_rank():
    mask = torch.zeros(120, 2, 3, dtype=torch.bool)
    mask[::3, 0, 1] = mask[:, 1, 0] = True
    assert Groups.of_many(mask[:30]) is None
    groups = Groups.of_many(mask, 70)
    assert groups is not None
    frame, joint, _ = mask.nonzero().T
    members: dict[int, list[int]] = {}
    for group, where, of in zip(groups.index.tolist(), frame.tolist(), joint.tolist(), strict=True):
        members.setdefault(group, []).append(1000 * of + where)
    root = [own for own in members.values() if own[0] < 1000]
    assert sorted(root)[:3] == [[0, 3], [6], [9]]  # frames 0 to 3, 4 to 7, 8 to 11
    assert {len(own) for own in members.values() if own[0] >= 1000} == {3}
    assert len(groups) == len(members) == 30 + 40


def test_a_metric_of_groups_is_a_metric(rows_case):
    """Symmetric and positive, so that the steps it gives go downhill."""
    case, _ = rows_case
    half = random(200, 200, seed=5).double()
    groups = Groups.of_many(case[2], 20)
    products = (half @ half.T).reshape(10, 20, 10, 20)
    metric = Metric(rows_of(*case, groups).gram(products, ALL), groups)
    size = int(case[2].sum())
    matrix = torch.stack([metric.weigh(unit)[1] for unit in torch.eye(size).double()])
    assert size > 40
    torch.testing.assert_close(matrix, matrix.T, rtol=1e-8, atol=1e-12)
    assert torch.linalg.eigvalsh(matrix).min() > 0
