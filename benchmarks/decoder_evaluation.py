"""One editing evaluation of a paper-sized decoder with random weights: plain eager against ours, by part."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.eager import quaternion_joints
from controlmm.generation.frozen_matrix import has_fast_bfloat16
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.generation.partial_decoder import PartialDecoder
from controlmm.models.rvq_vae import RvqVae, RvqVaeConfig
from controlmm.motion.normalizer import Normalizer
from controlmm.motion.skeleton import HUMANML3D
from controlmm.ops import guidance_value_and_grad

TOKENS, FRAMES = 49, 196
JOINTS = (0, 20)  # pelvis and left wrist


def medians(contenders: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Processor milliseconds, every contender in every round."""
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for step in range(rounds + 1):
        for name, call in contenders.items():
            began = time.thread_time()
            call()
            if step:  # the first round warms up
                times[name].append(1000 * (time.thread_time() - began))
    return {name: statistics.median(values) for name, values in times.items()}


def eager_evaluation(decoder: MotionDecoder, latents: Tensor, targets: Tensor) -> Tensor:
    """As plain code has it: decode all channels, joints by quaternions, mean square, autograd."""
    with torch.enable_grad():
        leaf = latents.clone().requires_grad_()
        joints = quaternion_joints(decoder.features(leaf))
        loss = (joints[:, :, JOINTS] - targets).square().mean((1, 2, 3)).sum()
    return torch.autograd.grad(loss, leaf)[0]


def contenders(decoder: MotionDecoder, batch: int) -> dict[str, Callable[[], object]]:
    """Eager, ours in float32 and, where the processor has AMX, in bfloat16, and the parts of ours."""
    generator = torch.Generator().manual_seed(0)
    latents = torch.randn(batch, TOKENS, decoder.tokenizer.config.code_dim, generator=generator)
    targets = torch.randn(batch, FRAMES, len(JOINTS), 3, generator=generator)
    mask, frames = torch.ones_like(targets, dtype=torch.bool), torch.ones(batch, FRAMES, dtype=torch.bool)

    def evaluation(part: PartialDecoder) -> Callable[[], object]:
        def run() -> object:
            decoded = part.decode(latents)
            _, gradient = guidance_value_and_grad(
                decoded.features.mT, targets, mask, mean=part.mean, std=part.std, norm="mse"
            )
            return part.pull(decoded, gradient.mT)

        return run

    exact = PartialDecoder(decoder, JOINTS, frames, dtype=torch.float32)
    decoded = exact.decode(latents)
    gradient = torch.ones_like(decoded.features)
    found = {
        "eager": lambda: eager_evaluation(decoder, latents, targets),
        "float32": evaluation(exact),
        "float32 forward": lambda: exact.decode(latents),
        "float32 back": lambda: exact.pull(decoded, gradient),
        "kinematics and loss": lambda: guidance_value_and_grad(
            decoded.features.mT, targets, mask, mean=exact.mean, std=exact.std, norm="mse"
        ),
    }
    if has_fast_bfloat16():
        rough = PartialDecoder(decoder, JOINTS, frames, dtype=torch.bfloat16)
        rough_decoded = rough.decode(latents)
        found |= {
            "bfloat16": evaluation(rough),
            "bfloat16 forward": lambda: rough.decode(latents),
            "bfloat16 back": lambda: rough.pull(rough_decoded, gradient),
        }
    return found


@torch.no_grad()
def print_evaluations() -> None:
    """One line a batch size and part."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        tokenizer = RvqVae(RvqVaeConfig.paper())
    width = HUMANML3D.feature_dim
    decoder = MotionDecoder(tokenizer, Normalizer(torch.zeros(width), torch.full((width,), 0.01)))
    for batch, rounds in ((1, 9), (8, 5), (32, 3)):
        found = medians(contenders(decoder, batch), rounds)
        print(f"\npaper size, B = {batch}, one thread: eager {found['eager']:.1f} ms of processor time")
        for name, milliseconds in found.items():
            ratio = f"  {found['eager'] / milliseconds:.2f}x" if name in ("float32", "bfloat16") else ""
            print(f"{name:>20} {milliseconds:8.2f} ms{ratio}", flush=True)
