"""The workloads of the operator benchmark: for each, contenders that compute the same."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from benchmarks.eager import eager_consistency, eager_gumbel, lean_joints, quaternion_joints
from controlmm import _core, ops
from controlmm.ops.signed_distance import obstacle_loss_reference

DIM, JOINTS = 263, 22


@dataclass(frozen=True)
class Workload:
    """Contenders by name; "native" is compared with each of the others."""

    name: str
    contenders: dict[str, Callable[[], object]]
    bytes_moved: int = 0  # by the native contender, where its speed is bound by memory


def _features(batch: int, frames: int) -> torch.Tensor:
    features = torch.randn(batch, frames, DIM, generator=torch.Generator().manual_seed(0))
    features[..., :3] *= 0.02
    return features


def _forward_backward(
    function: Callable, leaf: torch.Tensor, cotangent: torch.Tensor
) -> Callable[[], object]:
    return lambda: torch.autograd.grad(function(leaf), leaf, cotangent)


def kinematics(batch: int, frames: int, threads: int) -> list[Workload]:
    """recover_joints: raw kernels forward, forward and backward, and the differentiable operator."""
    features = _features(batch, frames)
    leaf = features.clone().requires_grad_()
    cotangent = torch.randn(batch, frames, JOINTS, 3, generator=torch.Generator().manual_seed(1))
    joints, gradient = torch.empty_like(cotangent), torch.empty_like(features)

    def raw_forward() -> None:
        _core.recover_joints(features, joints, threads)

    def raw_both() -> None:
        _core.recover_joints(features, joints, threads)
        _core.recover_joints_backward(features, cotangent, gradient, threads)

    eager_both = {
        "quaternion": _forward_backward(quaternion_joints, leaf, cotangent),
        "lean": _forward_backward(lean_joints, leaf, cotangent),
    }
    values = batch * frames * 4
    return [
        Workload(
            "recover_joints forward, raw",
            {
                "native": raw_forward,
                "quaternion": lambda: quaternion_joints(features),
                "lean": lambda: lean_joints(features),
            },
            bytes_moved=values * (67 + 66),
        ),
        Workload(
            "recover_joints forward+backward, raw",
            {"native": raw_both, **eager_both},
            bytes_moved=values * (67 + 66 + 67 + 66 + DIM),
        ),
        Workload(
            "recover_joints forward+backward, public",
            {
                "native": _forward_backward(
                    lambda x: ops.recover_joints(x, backend="native"), leaf, cotangent
                ),
                **eager_both,
            },
        ),
    ]


def moving_obstacles(frames: int) -> list[ops.Obstacle]:
    """Four each of spheres, capsules, boxes and half-spaces, moving frame by frame among the joints."""
    generator = torch.Generator().manual_seed(2)

    def path() -> torch.Tensor:
        return (
            torch.randn(3, generator=generator)
            + 0.3 * torch.randn(frames, 3, generator=generator).cumsum(0) * 0.1
        )

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


def _decoder_inputs(batch: int, frames: int) -> tuple[torch.Tensor, ...]:
    decoded = _features(batch, frames).transpose(1, 2).contiguous()
    targets = ops.frames_last(
        torch.randn(batch, frames, JOINTS, 3, generator=torch.Generator().manual_seed(3))
    )
    mask = ops.frames_last(torch.ones(batch, frames, JOINTS, 3, dtype=torch.bool))
    return decoded, targets, mask, torch.zeros(DIM), torch.ones(DIM)


def guidance(batch: int, frames: int, *, obstacles: bool) -> Workload:
    """Denormalise, kinematics and losses with their gradient: fused against eager autograd."""
    decoded, targets, mask, mean, std = _decoder_inputs(batch, frames)
    leaf = decoded.clone().requires_grad_()
    packed = ops.pack_obstacles(moving_obstacles(frames) if obstacles else [])
    counts = torch.ones(batch, frames, JOINTS, dtype=torch.bool)
    radii = torch.zeros(JOINTS)
    _, out = ops.guidance_value_and_grad(decoded, targets, mask, packed, mean=mean, std=std)

    def eager(kinematics: Callable[[torch.Tensor], torch.Tensor]) -> Callable[[], object]:
        def run() -> object:
            joints = kinematics(leaf.transpose(1, 2) * std + mean)
            loss = eager_consistency(joints, targets, mask)
            if obstacles:
                loss = loss + obstacle_loss_reference(joints, packed, counts, radii, 0.1, "mean")
            return torch.autograd.grad(loss.sum(), leaf)

        return run

    def native() -> object:
        return ops.guidance_value_and_grad(
            decoded, targets, mask, packed, mean=mean, std=std, margin=0.1, out=out, backend="native"
        )

    name = "kinematics+consistency" + ("+16 moving obstacles" if obstacles else "")
    return Workload(
        f"{name}, value+gradient",
        {"native": native, "quaternion": eager(quaternion_joints), "lean": eager(lean_joints)},
        bytes_moved=batch * frames * (4 * (67 + 66 + 67) + 66),
    )


def gumbel(tokens: int) -> list[Workload]:
    """Gumbel straight-through of ``tokens`` tokens, 512 codes of 512 channels."""
    generator = torch.Generator().manual_seed(4)
    logits = torch.randn(1, tokens, 512, generator=generator)
    codebook = torch.randn(512, 512, generator=generator)
    leaf = logits.clone().requires_grad_()
    cotangent = torch.randn(1, tokens, 512, generator=generator)

    def native(values: torch.Tensor) -> torch.Tensor:
        return ops.gumbel_straight_through(values, codebook, seed=0, backend="native")[0]

    return [
        Workload(
            f"gumbel_straight_through {tokens} x 512, forward",
            {"native": lambda: native(logits), "eager": lambda: eager_gumbel(logits, codebook)},
        ),
        Workload(
            f"gumbel_straight_through {tokens} x 512, forward+backward",
            {
                "native": _forward_backward(native, leaf, cotangent),
                "eager": _forward_backward(lambda x: eager_gumbel(x, codebook), leaf, cotangent),
            },
        ),
    ]
