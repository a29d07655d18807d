"""The share of the fused kernel in an editing step: ``python -m benchmarks.share [--model FOLDER]``.

One step is one value and gradient of the control objective: decode, losses, back through the decoder.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch

from controlmm import ControlMM
from controlmm.generation import objective
from controlmm.generation.motion_decoder import MotionDecoder

FRAMES, ROUNDS = 196, 30


def _processor_seconds(run: Callable[[], object]) -> float:
    start = time.thread_time()
    run()
    return time.thread_time() - start


def _objective(decoder: MotionDecoder, clips: int, *, is_dense: bool) -> objective.ControlObjective:
    """All joints in every frame, or the pelvis in every tenth."""
    mask = torch.zeros(clips, FRAMES, 22, 3, dtype=torch.bool)
    mask[:, :: 1 if is_dense else 10, : 22 if is_dense else 1] = True
    frames = torch.ones(clips, FRAMES, dtype=torch.bool)
    return objective.ControlObjective(decoder, torch.zeros(mask.shape), mask, frames)


def step_and_kernel(decoder: MotionDecoder, clips: int, *, is_dense: bool) -> tuple[float, float]:
    """Median seconds of a step, and of the kernel's call in it."""
    target = _objective(decoder, clips, is_dense=is_dense)
    tokens = FRAMES // decoder.downsample
    latents = decoder.typical_latents()[:1, :1].expand(clips, tokens, -1).contiguous()
    kernel, spent = objective.guidance_value_and_grad, []

    def timed(*arguments: object, **options: object) -> object:
        results: list[object] = []
        spent.append(_processor_seconds(lambda: results.append(kernel(*arguments, **options))))
        return results[0]

    objective.guidance_value_and_grad = timed
    try:
        steps = [_processor_seconds(lambda: target.value_and_gradient(latents)) for _ in range(ROUNDS)]
    finally:
        objective.guidance_value_and_grad = kernel
    return statistics.median(steps), statistics.median(spent)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", type=Path, default=None)
    decoder = ControlMM.from_pretrained(parser.parse_args().model).decoder
    torch.set_num_threads(1)
    for clips in (1, 8):
        for is_dense in (False, True):
            step, kernel = step_and_kernel(decoder, clips, is_dense=is_dense)
            what = "all joints, all frames" if is_dense else "pelvis, every tenth frame"
            print(
                f"{clips} clips, {what:<26} step {step * 1e3:7.2f} ms, kernel {kernel * 1e6:6.0f} us, "
                f"share {100 * kernel / step:.1f} %"
            )


if __name__ == "__main__":
    main()
