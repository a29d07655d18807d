"""Clips a second of whole controlled generations: one at a time, a batch in one thread, a batch in several.

python -m benchmarks.batches [--preset accurate] [--clips 32] [--threads 2] [--repeats 3] [--data DATA]

Clips of 196 frames that walk along one path with seeds of their own or, with ``--data``, validation clips of
their own lengths along the ways of their pelvis. Cases are measured in turn: a busy minute slows them all.
"""

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from controlmm import ControlMM
from controlmm.controls import PathControl, densify
from controlmm.evaluation.control_draws import ControlSetting
from controlmm.evaluation.machine import machine
from controlmm.evaluation.motion_sources import Batch
from controlmm.evaluation.protocol import Protocol, batches_of
from controlmm.evaluation.test_set import read_test_set
from controlmm.generation.noise import clip_seeds
from controlmm.pipelines import Preset
from controlmm.pipelines.closing import close_clips

FRAMES, LENGTH, BEND = 196, 8.0, 0.6  # of the path: frames, metres forward, metres to each side
ALONE = 8  # clips that are made one at a time


@dataclass(frozen=True, eq=False)
class Clips:
    """What is asked of the networks."""

    text: Tensor
    lengths: Sequence[int]
    targets: Tensor
    mask: Tensor
    seeds: Sequence[int]

    @classmethod
    def along_a_path(cls, pipeline: ControlMM, count: int) -> "Clips":
        way = torch.linspace(0, 1, FRAMES)
        path = torch.stack([BEND * torch.sin(2 * torch.pi * way), LENGTH * way], dim=1)
        dense = densify([PathControl("pelvis", xz=path)], FRAMES, pipeline.skeleton)
        text = pipeline.text_encoder.encode(["a person walks forward"]).pooled
        targets, mask = (x.expand(count, -1, -1, -1) for x in (dense.targets, dense.mask))
        return cls(text.expand(count, -1), [FRAMES] * count, targets, mask, clip_seeds(0, count))

    @classmethod
    def of_data(cls, pipeline: ControlMM, count: int, folder: Path, split: str) -> "Clips":
        test_set = read_test_set(folder, split=split)
        pairs = next(batches_of(test_set, ControlSetting("pelvis", "all"), Protocol(limit=count), 0))
        samples, masks = zip(*pairs, strict=True)
        batch = Batch.of(samples, masks, seed=0, repeat=0)
        text = pipeline.text_encoder.encode([sample.caption.text for sample in samples]).pooled
        mask = batch.mask[..., None].expand_as(batch.joints)
        return cls(text, batch.lengths.tolist(), batch.joints, mask, batch.noise_seeds)

    def generate(self, pipeline: ControlMM, preset: Preset, rows: Sequence[int]) -> Tensor:
        """Features of some of the clips."""
        lengths = [self.lengths[row] for row in rows]
        latents = pipeline.generate_latents(
            self.text[rows],
            lengths=lengths,
            targets=self.targets[rows, : max(lengths)],
            mask=self.mask[rows, : max(lengths)],
            seeds=[self.seeds[row] for row in rows],
            preset=preset,
        )
        features = pipeline.decoder.clip_features(latents)[:, : max(lengths)]
        if preset.closes(has_terms=False):
            close_clips(features, self.targets[rows], self.mask[rows], lengths, pipeline.skeleton)
        return features


def seconds_of(work: Callable[[], object], threads: int) -> tuple[float, float]:
    """Wall-clock time, and that of all processors together."""
    torch.set_num_threads(threads)
    started = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - started[0], time.process_time() - started[1]


def main() -> None:
    """Print seconds a clip and ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--preset", default="accurate")
    parser.add_argument("--clips", type=int, default=32)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--data", type=Path, help="folder of recordings whose lengths and paths are taken")
    parser.add_argument("--split", default="val")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    asked = parser.parse_args()
    pipeline, threads = ControlMM.from_pretrained(), asked.threads
    preset = pipeline.resolve_preset(asked.preset, None)
    count = asked.clips
    clips = (
        Clips.along_a_path(pipeline, count)
        if asked.data is None
        else Clips.of_data(pipeline, count, asked.data, asked.split)
    )
    print(machine())
    clips.generate(pipeline, preset, range(min(2, count)))  # packs the networks
    alone, everything = range(0, count, max(1, count // ALONE)), range(count)
    cases: dict[str, tuple[Callable[[], object], int, int]] = {  # work, threads, clips
        "one at a time": (
            lambda: [clips.generate(pipeline, preset, [row]) for row in alone],
            1,
            len(alone),
        )
    }
    for cores in (1, threads):
        cases[f"{count} in {cores} threads"] = (
            lambda: clips.generate(pipeline, preset, everything),
            cores,
            count,
        )
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in cases}
    for _ in range(asked.repeats):
        for name, (work, cores, made) in cases.items():
            wall, processor = seconds_of(work, cores)
            taken[name].append((wall / made, processor / made))
    alone_taken = taken["one at a time"]
    for name, seconds in taken.items():
        wall, processor = (statistics.median(times) for times in zip(*seconds, strict=True))
        rate = statistics.median(one[0] / own[0] for one, own in zip(alone_taken, seconds, strict=True))
        print(f"{name}: {wall:.3f} s a clip ({processor:.3f} s of processors), {rate:.2f} times as many")


if __name__ == "__main__":
    main()
