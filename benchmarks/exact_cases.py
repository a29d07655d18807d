"""The workloads of the closed end: one clip, kernels against their plain-torch twins, in double precision."""

from __future__ import annotations

from collections.abc import Callable

import torch

from benchmarks.cases import Workload
from controlmm import ops
from controlmm.motion.skeleton import HUMANML3D

NOISE = 0.02  # metres on every joint
STEPS, FRAME_STEPS = 6, 40  # as `exact` takes them
SMOOTH_ENOUGH, ENOUGH = 2e-3, 1e-5  # metres


def swaying_body(frames: int) -> torch.Tensor:
    """(T, 22, 3) joints of bones of the right length that sway about the rest pose."""
    generator = torch.Generator().manual_seed(1)
    rest = HUMANML3D.rest_offsets().double()
    phase = torch.rand(22, 3, generator=generator, dtype=torch.float64) * 6
    time = torch.arange(frames, dtype=torch.float64)[:, None, None] / 10
    lengths = rest.norm(dim=-1, keepdim=True)
    bones = rest + 0.3 * lengths * (time + phase).sin()
    bones = bones / bones.norm(dim=-1, keepdim=True).clamp(min=1e-9) * lengths
    places = [bones[:, 0]]
    for joint, parent in enumerate(HUMANML3D.parents[1:], start=1):
        places.append(places[parent] + bones[:, joint])
    return torch.stack(places, dim=1)


def exact(frames: int) -> list[Workload]:
    """A wrist led to every tenth frame and a pelvis to the first, one foot planted after the other."""
    generator = torch.Generator().manual_seed(0)
    joints = swaying_body(frames)
    noise = torch.randn(joints.shape, generator=generator, dtype=torch.float64)
    lengths = HUMANML3D.rest_offsets().double().norm(dim=-1)
    held, planted = torch.zeros(joints.shape, dtype=torch.bool), torch.zeros(frames, 22, dtype=torch.bool)
    held[::10, 20] = held[0, 0] = True
    planted[: frames // 2, list(HUMANML3D.left_foot)] = True
    planted[frames // 2 : -1, list(HUMANML3D.right_foot)] = True
    parents, feet = HUMANML3D.parents, HUMANML3D.foot_joints
    toes = (HUMANML3D.left_foot[1], HUMANML3D.right_foot[1])
    noisy = joints + NOISE * noise

    def project(backend: ops.Backend) -> Callable[[], object]:
        return lambda: ops.project_change(NOISE * noise, held, planted, parents=parents, backend=backend)

    def smooth(backend: ops.Backend) -> Callable[[], object]:
        return lambda: ops.smooth_bones(
            noisy, lengths, held, planted,
            parents=parents, feet=feet, toes=toes, enough=SMOOTH_ENOUGH, steps=STEPS, backend=backend,
        )  # fmt: skip

    def single(backend: ops.Backend) -> Callable[[], object]:
        return lambda: ops.frame_bones(
            noisy, lengths, held, planted,
            parents=parents, feet=feet, enough=ENOUGH, steps=FRAME_STEPS, backend=backend,
        )  # fmt: skip

    rotations = torch.randn(frames, 21, 6, generator=generator, dtype=torch.float64)
    heading = torch.randn(frames, 4, generator=generator, dtype=torch.float64)

    def swing(backend: ops.Backend) -> Callable[[], object]:
        return lambda: ops.swing_rotations(
            rotations, joints, noisy, heading, chains=HUMANML3D.chains, backend=backend
        )

    forms = {
        "project_change": project, "smooth_bones": smooth, "frame_bones": single, "swing_rotations": swing,
    }  # fmt: skip
    return [
        Workload(name, {"public": form("native"), "twin": form("reference")}) for name, form in forms.items()
    ]
