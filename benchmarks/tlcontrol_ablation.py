"""Part-based against unsplit tokenizer (TLControl, supplementary Table 1): reconstruction, error, time.

python -m benchmarks.tlcontrol_ablation --data DATA --root RUNS [--limit N]

RUNS is the folder of the stages ``tl-vq`` and ``tl-unsplit``. Both optimise from their mean code, so that the
numbers are those of the tokenizers and of no transformer.
"""

import argparse
import statistics
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.tlcontrol import JOINT_SETS, Clips, markdown, read_clips
from controlmm.evaluation.control_errors import control_errors
from controlmm.evaluation.machine import machine, revision
from controlmm.evaluation.published_tables import published_table
from controlmm.generation.code_optimization import CodeOptimization, optimize_codes
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.models.part_vq_vae import PartVqVae
from controlmm.motion.normalizer import Normalizer

STAGES = ("tl-vq", "tl-unsplit")
_JOINT_SETS = ("pelvis", "head", "left hand", "right hand", "left foot", "right foot", "all six")
_SETTINGS = CodeOptimization(foot="none")  # the paper's objective has no foot term


@torch.no_grad()
def reconstruction_error(decoder: MotionDecoder, batches: Sequence[Clips]) -> float:
    """Mean error of the global joints in metres, clips weighed alike."""
    errors = []
    for clips in batches:
        frames, tokenizer = clips.frames, decoder.tokenizer
        normalized = decoder.normalizer.normalize(clips.features) * frames[..., None]
        latents = tokenizer.quantizer.lookup(tokenizer.encode(normalized, frames))
        distance = (decoder(latents, frames) - clips.joints).norm(dim=-1).mean(-1)
        errors += [row[:length].mean().item() for row, length in zip(distance, clips.lengths, strict=True)]
    return statistics.fmean(errors)


@torch.no_grad()
def control(
    decoder: MotionDecoder, tokenizer: PartVqVae, clips: Clips, mask: Tensor
) -> tuple[list[float], list[float], float]:
    """Average error in metres and evaluations of every clip, and seconds of CPU time of the batch."""
    mean_code = torch.cat(
        [tokenizer.quantizer.book(p).codes.mean(0) for p in range(tokenizer.config.num_parts)]
    )
    valid = clips.frames[:, :: tokenizer.downsample]
    started = time.process_time()  # not of the clock: a busy machine would decide which tokenizer is faster
    solution = optimize_codes(
        decoder,
        mean_code * valid[..., None],
        valid,
        clips.joints,
        mask[..., None].expand_as(clips.joints),
        _SETTINGS,
        unit=tokenizer.config.published_unit,
    )
    seconds = time.process_time() - started
    joints = decoder(solution.latents, clips.frames)
    errors = control_errors(joints, clips.joints, mask)
    return errors.average.tolist(), solution.evaluations.tolist(), seconds


def main() -> None:
    """Print a table as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="HumanML3D-style folder")
    parser.add_argument("--root", type=Path, required=True, help="folder of the two stages")
    parser.add_argument("--split", default="test")
    parser.add_argument("--limit", type=int, default=32, help="clips")
    arguments = parser.parse_args()
    normalizer = Normalizer.load(arguments.root / "normalizer.safetensors")
    skeleton = normalizer.skeleton
    batches = read_clips(skeleton, arguments.data, split=arguments.split, limit=arguments.limit)
    count = sum(len(clips.lengths) for clips in batches)
    rows = [("tokenizer", "joints", "reconstruction (cm)", "average (cm)", "evaluations", "CPU s a clip")]
    for stage in STAGES:
        tokenizer = PartVqVae.from_pretrained(arguments.root / stage / "best")
        decoder = MotionDecoder(tokenizer, normalizer)
        rebuilt = reconstruction_error(decoder, batches)
        for name in _JOINT_SETS:
            done = [
                control(decoder, tokenizer, clips, clips.mask(JOINT_SETS[name], skeleton))
                for clips in batches
            ]
            errors, evaluations = ([x for row in done for x in row[i]] for i in (0, 1))
            rows.append(
                (
                    stage,
                    name,
                    f"{100 * rebuilt:.2f}",
                    f"{100 * statistics.fmean(errors):.2f}",
                    f"{statistics.fmean(evaluations):.0f}",
                    f"{sum(row[2] for row in done) / count:.2f}",
                )
            )
    published = published_table("tl-supplement1")
    print(f"Published:\n\n{markdown([published.columns, *published.rows])}\n")
    print(f"Ours, {count} clips of {arguments.split}, {machine()}; {revision()}:\n\n{markdown(rows)}")


if __name__ == "__main__":
    main()
