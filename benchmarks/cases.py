"""The workloads of the operator benchmark: for each, contenders that compute the same.

"raw" is the kernel with outputs at hand, "public" the call that users make; the others are plain torch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from benchmarks.eager import eager_consistency, eager_gumbel, lean_joints, quaternion_joints
from controlmm import _core, ops
from controlmm.ops.clearance import resolve_clearance
from controlmm.ops.obstacle_loss import native_arguments
from controlmm.ops.signed_distance import obstacle_loss_reference

DIM, JOINTS = 263, 22
MARGIN = 0.1  # metres


@dataclass(frozen=True)
class Workload:
    """Contenders by name."""

    name: str
    contenders: dict[str, Callable[[], object]]
    bytes_moved: int = 0  # by the raw kernel, where its speed is bound by memory


def _random(*shape: int, seed: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def _features(batch: int, frames: int) -> torch.Tensor:
    features = _random(batch, frames, DIM, seed=0)
    features[..., :3] *= 0.02
    return features


def _forward_backward(
    function: Callable, leaf: torch.Tensor, cotangent: torch.Tensor
) -> Callable[[], object]:
    return lambda: torch.autograd.grad(function(leaf), leaf, cotangent)


def kinematics(batch: int, frames: int, threads: int) -> list[Workload]:
    """recover_joints: forward; forward and backward."""
    features = _features(batch, frames)
    leaf = features.clone().requires_grad_()
    cotangent = _random(batch, frames, JOINTS, 3, seed=1)
    joints, gradient = torch.empty_like(cotangent), torch.empty_like(features)

    def raw_forward() -> None:
        _core.recover_joints(features, joints, threads)

    def raw_both() -> None:
        _core.recover_joints(features, joints, threads)
        _core.recover_joints_backward(features, cotangent, gradient, threads)

    forms = {
        "public": lambda x: ops.recover_joints(x, backend="native"),
        "quaternion": quaternion_joints,
        "lean": lean_joints,
    }
    values = batch * frames * 4
    return [
        Workload(
            "recover_joints, forward",
            {"raw": raw_forward, **{name: (lambda f=f: f(features)) for name, f in forms.items()}},
            bytes_moved=values * (67 + 66),
        ),
        Workload(
            "recover_joints, forward+backward",
            {"raw": raw_both, **{name: _forward_backward(f, leaf, cotangent) for name, f in forms.items()}},
            bytes_moved=values * (67 + 66 + 67 + 66 + DIM),
        ),
    ]


def moving_obstacles(frames: int) -> list[ops.Obstacle]:
    """Four each of spheres, capsules, boxes and half-spaces, moving frame by frame among the joints."""
    generator = torch.Generator().manual_seed(2)

    def path() -> torch.Tensor:
        steps = torch.randn(frames, 3, generator=generator)
        return torch.randn(3, generator=generator) + 0.03 * steps.cumsum(0)

    scene: list[ops.Obstacle] = []
    for _ in range(4):
        start = path()
        scene += [
            ops.Sphere(path(), 0.4),
            ops.Capsule(start, start + torch.tensor([0.5, 0.8, 0.0]), 0.2),
            ops.Box(path(), (0.4, 0.5, 0.3)),
            ops.HalfSpace(path() - torch.tensor([0.0, 1.0, 0.0]), (0.1, 1, 0)),
        ]
    return scene


def guidance(batch: int, frames: int, threads: int, *, obstacles: bool) -> Workload:
    """Denormalise, kinematics and losses with their gradient: fused against eager autograd."""
    decoded = _features(batch, frames).transpose(1, 2).contiguous()
    leaf = decoded.clone().requires_grad_()
    targets = ops.frames_last(_random(batch, frames, JOINTS, 3, seed=3))
    mask = ops.frames_last(torch.ones(batch, frames, JOINTS, 3, dtype=torch.bool))
    mean, std = torch.zeros(DIM), torch.ones(DIM)
    packed = ops.pack_obstacles(moving_obstacles(frames) if obstacles else [])
    clearance = resolve_clearance(
        (batch, frames, JOINTS), decoded, margin=MARGIN, joint_radius=0.0, joint_indices=None, lengths=None
    )
    scene = (*native_arguments(packed, clearance), MARGIN, True, 1.0) if obstacles else ()
    kernel = _core.guidance_value_and_grad if obstacles else _core.control_value_and_grad
    loss, gradient = torch.empty(batch), torch.zeros_like(decoded)
    _, out = ops.guidance_value_and_grad(decoded, targets, mask, packed, mean=mean, std=std)

    def raw() -> None:
        kernel(decoded, mean, std, targets, mask, 0, *scene, loss, gradient, threads)

    def public() -> object:
        return ops.guidance_value_and_grad(
            decoded, targets, mask, packed, mean=mean, std=std, margin=MARGIN, out=out, backend="native"
        )

    def eager(kinematics: Callable[[torch.Tensor], torch.Tensor]) -> Callable[[], object]:
        def run() -> object:
            joints = kinematics(leaf.transpose(1, 2) * std + mean)
            total = eager_consistency(joints, targets, mask)
            if obstacles:
                counts = clearance.counts(frames)
                total = total + obstacle_loss_reference(
                    joints, packed, counts, clearance.radii, MARGIN, "mean"
                )
            return torch.autograd.grad(total.sum(), leaf)

        return run

    name = "kinematics+consistency" + ("+16 moving obstacles" if obstacles else "")
    return Workload(
        f"{name}, value+gradient",
        {"raw": raw, "public": public, "quaternion": eager(quaternion_joints), "lean": eager(lean_joints)},
        bytes_moved=batch * frames * (4 * (67 + 66 + 67) + 66 * 3),
    )


def losses(batch: int, frames: int) -> list[Workload]:
    """The two losses on joints, forward and backward through the public calls."""
    leaf = _random(batch, frames, JOINTS, 3, seed=5).requires_grad_()
    targets = _random(batch, frames, JOINTS, 3, seed=6)
    mask = _random(batch, frames, JOINTS, seed=7) > 0
    packed = ops.pack_obstacles(moving_obstacles(frames))
    cotangent = torch.ones(batch)

    def consistency(backend: ops.Backend) -> Callable[[], object]:
        return _forward_backward(
            lambda x: ops.masked_consistency_loss(x, targets, mask, reduction="clip", backend=backend),
            leaf, cotangent,
        )  # fmt: skip

    def clearance(backend: ops.Backend) -> Callable[[], object]:
        return _forward_backward(
            lambda x: ops.obstacle_loss(x, packed, margin=MARGIN, backend=backend), leaf, cotangent
        )

    return [
        Workload(
            "masked_consistency_loss, forward+backward",
            {"public": consistency("native"), "eager": consistency("reference")},
        ),
        Workload(
            "obstacle_loss, 16 moving, forward+backward",
            {"public": clearance("native"), "eager": clearance("reference")},
        ),
    ]


def gumbel(tokens: int, threads: int) -> list[Workload]:
    """Gumbel straight-through of ``tokens`` tokens, 512 codes of 512 channels."""
    logits, codebook = _random(1, tokens, 512, seed=4), _random(512, 512, seed=8)
    leaf = logits.clone().requires_grad_()
    cotangent = _random(1, tokens, 512, seed=9)
    ids, rows, soft = torch.empty(1, tokens, dtype=torch.int64), torch.empty(1, tokens, 512), logits.clone()
    gradient = torch.empty(tokens, 512)

    def draw(probabilities: torch.Tensor) -> None:
        _core.gumbel_straight_through(logits, codebook, 1.0, 0, 0, ids, rows, probabilities, threads)

    def raw_both() -> None:
        draw(soft)
        torch.mm(cotangent[0], codebook.T, out=gradient)
        _core.softmax_backward(soft[0], 1.0, gradient, threads)

    def public(values: torch.Tensor) -> torch.Tensor:
        return ops.gumbel_straight_through(values, codebook, seed=0, backend="native")[0]

    def eager(values: torch.Tensor) -> torch.Tensor:
        return eager_gumbel(values, codebook)

    name = f"gumbel_straight_through {tokens} x 512"
    return [
        Workload(
            f"{name}, forward",
            {
                "raw": lambda: draw(soft[..., :0]),
                "public": lambda: public(logits),
                "eager": lambda: eager(logits),
            },
        ),
        Workload(
            f"{name}, forward+backward",
            {
                "raw": raw_both,
                "public": _forward_backward(public, leaf, cotangent),
                "eager": _forward_backward(eager, leaf, cotangent),
                "the matrix product alone": lambda: torch.mm(cotangent[0], codebook.T, out=gradient),
            },
        ),
    ]
