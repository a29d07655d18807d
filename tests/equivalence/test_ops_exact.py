"""The kernels of the closed end: against their twins, the same bits everywhere, held coordinates kept."""

import contextlib
import functools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import pytest
import torch

from controlmm import ops
from controlmm.motion.skeleton import HUMANML3D, KIT

pytestmark = pytest.mark.skipif(not ops.available_isas(), reason="the C++ extension is not built")

TOLERANCE = 1e-9  # metres: bones differ by 2e-14, projections by 5e-11, as the twin holds softly (by 1e-12)
SKELETONS = {"humanml3d": HUMANML3D, "kit": KIT}
HELD = ["nothing", "one coordinate", "one axis", "a joint in all frames", "several joints", "a whole frame"]


def random(*shape, seed):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@dataclass(frozen=True)
class Case:
    frames: int = 8
    held: str = "several joints"
    is_planted: bool = True
    body: str = "humanml3d"
    is_strided: bool = False

    def __str__(self):
        marks = "-planted" * self.is_planted + "-strided" * self.is_strided
        return f"{self.body}-{self.frames}-{self.held.replace(' ', '_')}{marks}"

    @property
    def skeleton(self):
        return SKELETONS[self.body]

    @property
    def metre(self):
        return 1 / self.skeleton.metres

    @property
    def lengths(self):
        return self.metre * (0.05 + 0.3 * random(self.skeleton.num_joints, seed=1).sigmoid())

    @property
    def is_held(self):
        held = torch.zeros(self.frames, self.skeleton.num_joints, 3, dtype=torch.bool)
        middle = self.frames // 2
        if self.held == "one coordinate":
            held[middle, 20, 1] = True
        if self.held == "one axis":
            held[::3, 5, 2] = held[middle, 0, 2] = True
        if self.held == "a joint in all frames":
            held[:, 0] = True
        if self.held == "several joints":
            held[::5, 20] = held[middle:, 0] = held[-1, 10] = True
        if self.held == "a whole frame":
            held[middle] = True
        return held

    @property
    def planted(self):
        planted = torch.zeros(self.frames, self.skeleton.num_joints, dtype=torch.bool)
        if self.is_planted:
            planted[: self.frames // 2, list(self.skeleton.left_foot)] = True
            planted[self.frames // 3 :, self.skeleton.right_foot[1]] = True  # the last one stands for nothing
        return planted

    @property
    def joints(self):
        """A body whose bones sway, two centimetres of noise on every joint."""
        phase = torch.arange(self.frames, dtype=torch.float64)[:, None, None] / 10
        bones = (
            random(1, self.skeleton.num_joints, 3, seed=2)
            + 0.5 * (phase + random(1, self.skeleton.num_joints, 3, seed=3)).sin()
        )
        bones = self.lengths[:, None] * bones / bones.norm(dim=-1, keepdim=True)
        places = [bones[:, 0]]
        for joint, parent in enumerate(self.skeleton.parents[1:], start=1):
            places.append(places[parent] + bones[:, joint])
        clean = torch.stack(places, dim=1)
        return clean + 0.02 * self.metre * random(*clean.shape, seed=4)

    @property
    def change(self):
        """Wanted where it is held; NaN elsewhere, which nobody may read."""
        change = 0.2 * self.metre * random(*self.is_held.shape, seed=5)
        return torch.where(self.is_held, change, torch.nan)

    def layout(self, tensor):
        """The same values, frames last in memory."""
        if not self.is_strided:
            return tensor
        return tensor.movedim(0, -1).contiguous().movedim(-1, 0)


def project(case, backend):
    clip = [case.layout(x) for x in (case.change, case.is_held, case.planted)]
    return ops.project_change(*clip, parents=case.skeleton.parents, backend=backend)


def smooth(case, backend):
    joints, held, planted = (case.layout(x) for x in (case.joints, case.is_held, case.planted))
    return ops.smooth_bones(
        joints, case.lengths, held, planted,
        parents=case.skeleton.parents, feet=case.skeleton.foot_joints,
        toes=(case.skeleton.left_foot[1], case.skeleton.right_foot[1]),
        enough=1e-5 * case.metre, steps=6, backend=backend,
    )  # fmt: skip


def frame(case, backend):
    joints, held, planted = (case.layout(x) for x in (case.joints, case.is_held, case.planted))
    return ops.frame_bones(
        joints, case.lengths, held, planted,
        parents=case.skeleton.parents, feet=case.skeleton.foot_joints,
        enough=1e-5 * case.metre, steps=40, metre=case.metre, backend=backend,
    )  # fmt: skip


OPERATORS = {"project_change": project, "smooth_bones": smooth, "frame_bones": frame}
CASES = [
    *(Case(frames, held) for frames in (1, 2, 3, 8, 41, 196) for held in HELD),
    *(Case(8, held, is_planted=False) for held in HELD),
    *(Case(frames, held, body="kit") for frames in (1, 41) for held in HELD),
    Case(8, is_strided=True),
    Case(41, "one axis", is_strided=True, body="kit"),
]
both_backends = pytest.mark.parametrize("backend", ["native", "reference"])
each_operator = pytest.mark.parametrize("name", OPERATORS)


@functools.cache  # the instruction sets share it
def by_reference(name, case):
    return OPERATORS[name](case, "reference")


@each_operator
@pytest.mark.parametrize("case", CASES, ids=str)
def test_kernels_agree_with_their_twins_and_held_coordinates_are_kept(case, name, isa):
    actual, held = OPERATORS[name](case, "native"), case.is_held
    expected = by_reference(name, case)
    torch.testing.assert_close(actual, expected, rtol=0, atol=TOLERANCE * case.metre)
    kept = case.change if name == "project_change" else case.joints
    assert torch.equal(actual[held], kept[held])
    assert torch.equal(expected[held], kept[held])
    if name == "project_change":
        axes_at_rest = ~held.flatten(0, 1).any(dim=0)
        assert not actual[..., axes_at_rest].any()


@pytest.mark.parametrize("case", [Case(41), Case(3), Case(41, "one axis", body="kit")], ids=str)
@both_backends
def test_bones_get_their_lengths(case, backend):
    parents = list(case.skeleton.parents[1:])
    moved = frame(case, backend)
    error = ((moved[:, 1:] - moved[:, parents]).norm(dim=-1) - case.lengths[1:]).abs()
    assert error.max() < 1e-5 * case.metre


@each_operator
@pytest.mark.parametrize("case", [Case(41), Case(196), Case(41, "one axis", body="kit")], ids=str)
def test_the_same_bits_on_all_instruction_sets_and_threads(case, name):
    operator = OPERATORS[name]
    results = []
    for isa in ops.available_isas():
        with ops.use_isa(isa):
            results += [operator(case, "native"), operator(case, "native")]
    kept = torch.get_num_threads()
    with contextlib.ExitStack() as restored:
        restored.callback(torch.set_num_threads, kept)
        for count in (1, 2):
            torch.set_num_threads(count)
            results.append(operator(case, "native"))
    with ThreadPoolExecutor(3) as callers:
        results += callers.map(lambda _: operator(case, "native"), range(3))
    for result in results[1:]:
        assert torch.equal(result, results[0])


@pytest.mark.parametrize("joints", [2, 3, 8, 23])
@pytest.mark.parametrize("frames", [1, 2, 15, 16, 17, 33, 113])
def test_any_tree_and_any_number_of_frames(frames, joints):
    """The kernel keeps eight stretches of pairs of frames abreast; the last ones may be short or empty."""
    parents = (-1, *(7 * joint % 5 % joint for joint in range(1, joints)))
    lengths = 0.05 + 0.3 * random(joints, seed=joints).sigmoid()
    clip = 0.2 * random(1, joints, 3, seed=6) + 0.02 * random(frames, joints, 3, seed=frames)
    held, planted = random(frames, joints, 3, seed=7) > 1.5, random(frames, joints, seed=8) > 0.5
    results = []
    for isa in (None, *ops.available_isas()):
        with ops.use_isa(isa) if isa else contextlib.nullcontext():
            results.append(
                ops.smooth_bones(
                    clip, lengths, held, planted, parents=parents, feet=(joints - 1,), toes=(joints // 2,),
                    enough=1e-9, steps=3, backend="native" if isa else "reference",
                )
            )  # fmt: skip
    torch.testing.assert_close(results[1], results[0], rtol=0, atol=1e-12)
    assert torch.equal(results[1][held], clip[held])
    for result in results[2:]:
        assert torch.equal(result, results[1])


@each_operator
@both_backends
def test_arguments_stay_and_no_gradient_flows(backend, name, monkeypatch):
    case = Case(8)
    given = {"change": case.change.requires_grad_(), "joints": case.joints.requires_grad_()}
    kept = {key: value.detach().clone() for key, value in given.items()}
    for key, value in given.items():
        monkeypatch.setattr(Case, key, value)
    assert not OPERATORS[name](case, backend).requires_grad
    for key, value in given.items():
        torch.testing.assert_close(value.detach(), kept[key], rtol=0, atol=0, equal_nan=True)


@each_operator
@both_backends
def test_no_frame(backend, name):
    assert OPERATORS[name](Case(0, "nothing"), backend).shape == (0, 22, 3)


@both_backends
def test_a_single_joint_has_no_bone(backend):
    alone = torch.ones(4, 1, 3, dtype=torch.float64)
    held, planted, length = alone.bool(), torch.zeros(4, 1, dtype=torch.bool), alone[0, 0, :1]
    options = {"parents": (-1,), "feet": (0,), "enough": 1e-5, "steps": 2, "backend": backend}
    for moved in (
        ops.project_change(alone, held, planted, parents=(-1,), backend=backend),
        ops.smooth_bones(alone, 2 * length, ~held, planted, toes=(), **options),
        ops.frame_bones(alone, 2 * length, ~held, planted, **options),
    ):
        assert torch.equal(moved, alone)


@pytest.mark.parametrize("name", ["smooth_bones", "frame_bones"])
@both_backends
def test_a_chain_out_of_reach_stays_finite_and_near(backend, name, monkeypatch):
    """Shoulder and wrist three metres apart in one frame: the arm is straight there, lengths stay wrong."""
    case = Case(8, "nothing")
    joints, held = case.joints, case.is_held
    joints[4, 20] = joints[4, 16] + torch.tensor([3.0, 0.0, 0.0])
    held[4, [16, 20]] = True
    monkeypatch.setattr(Case, "joints", joints)
    monkeypatch.setattr(Case, "is_held", held)
    moved = OPERATORS[name](case, backend)
    assert moved.isfinite().all()
    assert (moved - joints).abs().max() < 3
    assert torch.equal(moved[held], joints[held])
    others = [0, 1, 2, 3, 5, 6, 7]
    others = others if name == "frame_bones" else [0, 7]  # neighbours are pulled along
    assert (moved - joints)[others].abs().max() < 0.3


@pytest.mark.parametrize("name", ["smooth_bones", "frame_bones"])
@both_backends
def test_a_broken_joint_stays_in_its_frame(backend, name, monkeypatch):
    case, joints = Case(8), Case(8).joints
    joints[4, 7, 1] = torch.nan
    monkeypatch.setattr(Case, "joints", joints)
    others = [0, 1, 2, 3, 5, 6, 7]
    moved = OPERATORS[name](case, backend)
    assert moved[4].isnan().any()
    assert moved[others].isfinite().all()


@each_operator
def test_joints_in_the_same_place_have_no_direction_and_stay_finite(name, isa, monkeypatch):
    monkeypatch.setattr(Case, "joints", torch.zeros(3, 22, 3, dtype=torch.float64))
    case = Case(3, "nothing")
    assert OPERATORS[name](case, "native").isfinite().all()
