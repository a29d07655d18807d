"""Seconds of what a person waits for: a whole controlled call, and the same call with one target moved.

python -m benchmarks.calls --data DATA [--split val] [--presets fast accurate] [--clips 3] [--repeats 2]

Clips as long as a call allows, with the recording's pelvis as targets: at every frame, and at three.
Wall-clock time of one thread, medians; a first round, in which networks are packed, does not count.
"""

import argparse
import statistics
import time
from collections import defaultdict
from pathlib import Path

import torch

from controlmm import ControlMM, JointControl
from controlmm.evaluation.machine import machine
from controlmm.evaluation.test_set import Sample, read_test_set
from controlmm.ops import recover_joints

LONG = 190  # frames
MOVED = (0.05, 0.0, 0.05)  # metres by which a target is dragged


def pelvis_of(sample: Sample) -> torch.Tensor:
    """(T, 3) of a recording."""
    features = torch.as_tensor(sample.features[: sample.length]).float()
    return recover_joints(features[None], joints=22)[0, :, 0]


def controls_at(pelvis: torch.Tensor, frames: list[int]) -> list[JointControl]:
    """Targets of the pelvis at some frames."""
    return [JointControl("pelvis", frames=frames, positions=pelvis[frames].tolist())]


def measure(pipeline: ControlMM, sample: Sample, presets: list[str]) -> dict[str, float]:
    """Seconds of the calls for one clip."""
    pelvis, length, taken = pelvis_of(sample), sample.length, {}
    thirds = [length // 3, 2 * length // 3, length - 1]
    for preset in presets:
        for name, frames in (("every frame", list(range(length))), ("three frames", thirds)):
            controls = controls_at(pelvis, frames)
            started = time.perf_counter()
            result = pipeline(sample.caption.text, frames=length, controls=controls, preset=preset)
            taken[f"{preset}, pelvis at {name}"] = time.perf_counter() - started
    dragged = pelvis.clone()
    dragged[thirds[1]] += torch.tensor(MOVED)
    started = time.perf_counter()
    pipeline.adjust(result, controls_at(dragged, thirds))
    taken["adjust, one of three moved by 7 cm"] = time.perf_counter() - started
    return taken


def main() -> None:
    """Print a line a case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="HumanML3D-style folder")
    parser.add_argument("--split", default="val")
    parser.add_argument("--presets", nargs="+", default=["fast", "accurate"])
    parser.add_argument("--clips", type=int, default=3)
    parser.add_argument("--repeats", type=int, default=2)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    pipeline, test_set = ControlMM.from_pretrained(), read_test_set(asked.data, split=asked.split)
    samples = [sample for sample in test_set.samples(seed=0, repeat=0) if sample.length >= LONG]
    print(machine())
    taken = defaultdict(list)
    for repeat in range(asked.repeats + 1):
        for sample in samples[: asked.clips]:
            for case, seconds in measure(pipeline, sample, asked.presets).items():
                if repeat:
                    taken[case].append(seconds)
    for case, seconds in taken.items():
        print(f"{case}: {statistics.median(seconds):.3f} s (most {max(seconds):.3f}, {len(seconds)} calls)")


if __name__ == "__main__":
    main()
