"""Rotations that follow bones: worked by hand, against the twin, the same bits everywhere."""

import functools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import pytest
import torch

from controlmm import ops
from controlmm.motion.rotations import quat_multiply, quat_rotate
from controlmm.motion.skeleton import HUMANML3D, KIT

pytestmark = pytest.mark.skipif(not ops.available_isas(), reason="the C++ extension is not built")

TOLERANCE = 1e-13  # six numbers are of the order of one; they differ by 1e-14
SKELETONS = {"humanml3d": HUMANML3D, "kit": KIT}
UNTURNED = (1.0, 0, 0, 0, 1, 0)
both_backends = pytest.mark.parametrize("backend", ["native", "reference"])


def random(*shape, seed):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@dataclass(frozen=True)
class Case:
    frames: int = 17
    body: str = "humanml3d"
    moved: float = 0.1  # of a metre
    is_strided: bool = False

    def __str__(self):
        return f"{self.body}-{self.frames}-{self.moved}" + "-strided" * self.is_strided

    @property
    def skeleton(self):
        return SKELETONS[self.body]

    @property
    def clip(self):
        """Rotations more bent than a decoder's, joints anywhere within a metre, quaternions of any length."""
        joints, metre = self.skeleton.num_joints, 1 / self.skeleton.metres
        before = metre * random(self.frames, joints, 3, seed=1)
        after = before + self.moved * metre * random(self.frames, joints, 3, seed=2)
        rotations, heading = random(self.frames, joints - 1, 6, seed=3), random(self.frames, 4, seed=4)
        return [self.layout(x) for x in (rotations, before, after, heading)]

    def layout(self, tensor):
        """The same values, frames last in memory."""
        return tensor.movedim(0, -1).contiguous().movedim(-1, 0) if self.is_strided else tensor


CASES = [
    *(Case(frames, body) for body in SKELETONS for frames in (0, 1, 15, 16, 17, 196)),
    *(Case(17, body, is_strided=True) for body in SKELETONS),
    Case(196, moved=3),
    Case(196, moved=0),
]


@functools.cache  # the instruction sets share it
def by_reference(case):
    return ops.swing_rotations(*case.clip, chains=case.skeleton.chains, backend="reference")


def by_kernel(case):
    return ops.swing_rotations(*case.clip, chains=case.skeleton.chains, backend="native")


@pytest.mark.parametrize("case", CASES, ids=str)
def test_the_kernel_agrees_with_its_twin(case, isa):
    actual = by_kernel(case)
    torch.testing.assert_close(actual, by_reference(case), rtol=0, atol=TOLERANCE)
    assert actual.shape == (case.frames, case.skeleton.num_joints - 1, 6)


@pytest.mark.parametrize("case", CASES, ids=str)
def test_the_same_bits_on_all_instruction_sets_and_threads(case):
    results = []
    for isa in ops.available_isas():
        with ops.use_isa(isa):
            results.append(by_kernel(case))
    with ThreadPoolExecutor(3) as callers:
        results += callers.map(lambda _: by_kernel(case), range(3))
    for result in results[1:]:
        assert torch.equal(result, results[0])


@pytest.mark.parametrize("case", [Case(17), Case(17, "kit")], ids=str)
def test_a_frame_has_the_same_bits_alone(case):
    clip, whole = case.clip, by_kernel(case)
    for frame in (0, 7, 16):
        alone = (x[frame : frame + 1] for x in clip)
        assert torch.equal(ops.swing_rotations(*alone, chains=case.skeleton.chains)[0], whole[frame])


@both_backends
@pytest.mark.parametrize(
    ("chains", "upper"),
    [(((0, 1, 2),), (0.0, 1, 0, -1, 0, 0)), (((0, 1), (1, 2)), UNTURNED)],
    ids=["one chain", "two chains"],
)
def test_a_column_whose_lower_bone_falls(chains, upper, backend):
    """By a quarter turn about z; the upper bone, which stays upright, is turned back if it hangs on it."""
    before = torch.tensor([[[0.0, 0, 0], [0, 1, 0], [0, 2, 0]]], dtype=torch.float64)
    after = torch.tensor([[[0.0, 0, 0], [2, 0, 0], [2, 1, 0]]], dtype=torch.float64)
    rotations = torch.tensor([[UNTURNED, UNTURNED]], dtype=torch.float64)
    heading = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64)
    turned = ops.swing_rotations(rotations, before, after, heading, chains=chains, backend=backend)
    expected = torch.tensor([[(0.0, -1, 0, 1, 0, 0), upper]], dtype=torch.float64)
    torch.testing.assert_close(turned, expected, rtol=0, atol=1e-15)


@both_backends
def test_a_bone_that_stays_keeps_its_rotation_and_what_is_bent_stays_bent(backend):
    clip = Case(17).clip
    clip[2] = clip[1].clone()
    clip[2][:, 20] += 0.1 * random(17, 3, seed=5)  # a wrist: the last of its chain
    turned = ops.swing_rotations(*clip, chains=HUMANML3D.chains, backend=backend)
    others = [bone for bone in range(21) if bone != 19]
    torch.testing.assert_close(turned[:, others], clip[0][:, others], rtol=0, atol=TOLERANCE)
    before, after = (x[:, 19].unflatten(-1, (2, 3)) for x in (clip[0], turned))
    torch.testing.assert_close(after @ after.mT, before @ before.mT, rtol=0, atol=TOLERANCE)
    assert (turned - clip[0])[:, 19].abs().amax() > 0.01


@both_backends
def test_rotations_do_not_know_where_the_body_faces(backend):
    case, turn = Case(17), random(17, 4, seed=6)
    turn = turn / turn.norm(dim=-1, keepdim=True)
    rotations, before, after, heading = case.clip
    elsewhere = [quat_rotate(turn[:, None], x) + 3 for x in (before, after)]
    turned = ops.swing_rotations(
        rotations, *elsewhere, quat_multiply(turn, heading), chains=HUMANML3D.chains, backend=backend
    )
    torch.testing.assert_close(
        turned, by_reference(case), rtol=0, atol=1e-12
    )  # of positions turned and moved


THIGH, SHIN, FOOT, TOES = 0, 3, 6, 9  # bones of one chain
BROKEN = {  # an argument, what the thigh's knee or column is there, the bones that this spoils, and by what
    "no length before": ("before", (0.0, 0, 0), [THIGH, SHIN], torch.nan),
    "no length after": ("after", (0.0, 0, 0), [THIGH, SHIN], torch.nan),
    "opposite": ("after", (0.0, 0.5, 0), [THIGH, SHIN], torch.nan),
    "not a number": ("after", (torch.nan, 0, 0), [THIGH, SHIN, FOOT], torch.nan),
    "first column of zeros": ("rotations", (0.0, 0, 0), [SHIN, FOOT, TOES], 0.0),
}


@both_backends
@pytest.mark.parametrize("name", BROKEN)
def test_what_has_no_rotation_stays_in_its_chain_and_frame(name, backend):
    argument, value, spoilt, number = BROKEN[name]
    rotations, before, after, heading = Case(17).clip
    before[4, 0] = after[4, 0] = 0
    before[4, 1] = torch.tensor([0.0, -0.5, 0.0])
    changed = {"rotations": rotations[4, THIGH, :3], "before": before[4, 1], "after": after[4, 1]}
    changed[argument].copy_(torch.tensor(value))
    clip = (rotations, before, after, heading)
    turned, twin = (
        ops.swing_rotations(*clip, chains=HUMANML3D.chains, backend=backend)
        for backend in (backend, "reference")
    )
    torch.testing.assert_close(turned, twin, rtol=0, atol=TOLERANCE, equal_nan=True)
    expected = torch.full((len(spoilt), 6), number, dtype=torch.float64)
    torch.testing.assert_close(turned[4, spoilt], expected, rtol=0, atol=0, equal_nan=True)
    turned[4, spoilt] = 1
    assert turned.isfinite().all()
    assert turned.any(dim=-1).all()


@both_backends
def test_arguments_stay_and_no_gradient_flows(backend):
    clip = [x.requires_grad_() for x in Case(17).clip]
    kept = [x.detach().clone() for x in clip]
    assert not ops.swing_rotations(*clip, chains=HUMANML3D.chains, backend=backend).requires_grad
    for given, before in zip(clip, kept, strict=True):
        assert torch.equal(given.detach(), before)


@both_backends
@pytest.mark.parametrize("chains", [(), ((0,),)])
def test_a_single_joint_has_no_rotation(chains, backend):
    clip = (random(4, *shape, seed=0) for shape in ((0, 6), (1, 3), (1, 3), (4,)))
    assert ops.swing_rotations(*clip, chains=chains, backend=backend).shape == (4, 0, 6)
