"""TLControl's tables on a split: errors of control, tolerance, masked trajectories, parts of an evaluation.

python -m benchmarks.tlcontrol joints|tolerance|masked|time --data DATA [--limit N] [--model FOLDER]
"""

import argparse
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from controlmm import TLControl
from controlmm.data import FeatureClip, MotionFolder
from controlmm.evaluation.control_errors import control_errors
from controlmm.evaluation.machine import machine, revision
from controlmm.generation.partial_decoder import PartialDecoder
from controlmm.models.rvq_vae import frame_mask
from controlmm.motion.skeleton import Skeleton
from controlmm.ops import frames_last, guidance_value_and_grad, recover_joints
from controlmm.pipelines import TLCONTROL_PRESETS, TLControlPreset
from controlmm.training.trajectory_masks import hide_segments

JOINT_SETS = {
    "pelvis": ("pelvis",),
    "head": ("head",),
    "left hand": ("left_wrist",),
    "right hand": ("right_wrist",),
    "left foot": ("left_foot",),
    "right foot": ("right_foot",),
    "all six": ("pelvis", "head", "left_wrist", "right_wrist", "left_foot", "right_foot"),
    "both hands": ("left_wrist", "right_wrist"),
    "upper body": ("left_wrist", "right_wrist", "head"),
    "both feet": ("left_foot", "right_foot"),
    "lower body": ("left_foot", "right_foot", "pelvis"),
}
TOLERANCES = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
MASKED_SHARES = (0.0, 0.25, 0.5, 0.75, 0.9, 0.97)
_SHORTEST, _LONGEST, _BATCH = 40, 196, 32
_FAR = 0.5  # metres: failed in the papers' tables
# The most likely codes of a single pass without guidance, as the paper has it; the optimisation is ours.
_PRESET = TLControlPreset(temperature=0.0, guidance_scale=1.0, rounds=0)


@dataclass(frozen=True, eq=False)
class Clips:
    """A batch of recorded clips, padded."""

    captions: list[str]
    lengths: list[int]  # frames
    features: Tensor  # (B, T, D), de-normalised
    joints: Tensor  # (B, T, J, 3)

    @property
    def frames(self) -> Tensor:
        """(B, T)"""
        return frame_mask(torch.tensor(self.lengths), self.joints.shape[1])

    def mask(self, names: Sequence[str], skeleton: Skeleton) -> Tensor:
        """(B, T, J): ``names`` in every frame."""
        mask = torch.zeros(self.joints.shape[:3], dtype=torch.bool)
        mask[:, :, [skeleton.joint_index(name) for name in names]] = True
        return mask & self.frames[..., None]


@dataclass(frozen=True, eq=False)
class Measured:
    """Numbers of one setting over all clips; errors in metres."""

    feedforward: float
    average: float
    trajectory: float  # share of clips with an error above 50 cm
    location: float  # share of targets
    evaluations: float  # a clip, on average
    seconds: float  # of optimisation, a clip


def read_clips(skeleton: Skeleton, data: Path, *, split: str, limit: int) -> list[Clips]:
    """``limit`` clips of the split with their first caption, spread over it, in batches of like length."""
    every = [
        clip
        for clip in MotionFolder(data).clips(split, progress=False)
        if len(clip.features) >= _SHORTEST and clip.captions
    ]
    step = max(1, len(every) // limit)
    chosen = sorted(every[::step][:limit], key=lambda clip: len(clip.features))
    return [_batch(skeleton, chosen[at : at + _BATCH]) for at in range(0, len(chosen), _BATCH)]


def _batch(skeleton: Skeleton, clips: Sequence[FeatureClip]) -> Clips:
    features = [clip.features[: min(len(clip.features), _LONGEST) // 4 * 4] for clip in clips]
    padded = pad_sequence(features, batch_first=True)
    joints = recover_joints(padded, joints=skeleton.num_joints)
    captions = [clip.captions[0].text for clip in clips]
    return Clips(captions, [len(x) for x in features], padded, joints)


@torch.no_grad()
def measure(
    pipeline: TLControl, batches: Sequence[Clips], preset: TLControlPreset, mask_of: Callable[[Clips], Tensor]
) -> Measured:
    """Control the joints of ``mask_of(clips)`` (B, T, J), before and after the optimisation."""
    rows: list[list[float]] = []
    for clips in batches:
        mask = mask_of(clips)
        coordinates = mask[..., None].expand_as(clips.joints)
        predicted = pipeline.generate_latents(
            pipeline.text_encoder.encode(clips.captions).pooled,
            lengths=clips.lengths,
            targets=clips.joints,
            mask=coordinates,
            seeds=list(range(len(clips.lengths))),
            preset=replace(preset, iterations=0),
        )
        valid = clips.frames[:, :: pipeline.decoder.downsample]
        solution = pipeline.optimize(predicted, valid, clips.joints, coordinates, preset)
        before, after = (
            control_errors(pipeline.decoder(latents, clips.frames), clips.joints, mask)
            for latents in (predicted, solution.latents)
        )
        share = solution.seconds / len(clips.lengths)
        rows += [
            [*errors, share]
            for errors in zip(
                before.average.tolist(),
                after.average.tolist(),
                after.trajectory[_FAR].tolist(),
                after.location[_FAR].tolist(),
                solution.evaluations.tolist(),
                strict=True,
            )
        ]
    return Measured(*(statistics.fmean(column) for column in zip(*rows, strict=True)))


def joints_table(pipeline: TLControl, batches: Sequence[Clips]) -> list[tuple[str, ...]]:
    """The paper's Table 1 and supplementary Table 2: dense trajectories at tolerance 1e-6."""
    return [_HEAD] + [
        _row(
            name, measure(pipeline, batches, _PRESET, lambda clips, n=names: clips.mask(n, pipeline.skeleton))
        )
        for name, names in JOINT_SETS.items()
    ]


def tolerance_table(pipeline: TLControl, batches: Sequence[Clips]) -> list[tuple[str, ...]]:
    """The paper's Table 4: all six joints, with the released first step of 0.1 and with ours of 1."""
    rows = [_HEAD]
    for rate in (TLCONTROL_PRESETS["paper"].rate, _PRESET.rate):
        for tolerance in TOLERANCES:
            preset = replace(_PRESET, tolerance=tolerance, rate=rate)
            measured = measure(
                pipeline, batches, preset, lambda clips: clips.mask(JOINT_SETS["all six"], pipeline.skeleton)
            )
            rows.append(_row(f"{tolerance:.0e}, rate {rate:g}", measured))
    return rows


def masked_table(pipeline: TLControl, batches: Sequence[Clips]) -> list[tuple[str, ...]]:
    """The paper's Figure 7: segments of all six trajectories hidden; errors of what is left."""
    rows = [_HEAD]
    for share in MASKED_SHARES:

        def mask_of(clips: Clips, share: float = share) -> Tensor:
            torch.manual_seed(0)
            mask = clips.mask(JOINT_SETS["all six"], pipeline.skeleton)
            for row, length in zip(mask, clips.lengths, strict=True):
                for joint in row.any(0).nonzero()[:, 0].tolist():
                    row[:, joint] &= ~hide_segments(len(row), share, span=length)
            return mask

        rows.append(_row(f"{share:.0%} hidden", measure(pipeline, batches, _PRESET, mask_of)))
    return rows


def time_table(pipeline: TLControl, batches: Sequence[Clips]) -> list[tuple[str, ...]]:
    """CPU time of one evaluation of one clip of 196 frames, and where it goes; medians of 9."""
    names = JOINT_SETS["all six"]
    joints = sorted(pipeline.skeleton.joint_index(name) for name in names)
    generator = torch.Generator().manual_seed(0)
    channels = pipeline.tokenizer.config.latent_dim
    latents = torch.randn(1, _LONGEST // pipeline.decoder.downsample, channels, generator=generator)
    targets = torch.zeros(1, _LONGEST, pipeline.skeleton.num_joints, 3)
    mask = torch.zeros(targets.shape, dtype=torch.bool)
    mask[:, :, joints] = True
    # As the optimisation has it: only the channels of these joints.
    part = PartialDecoder(pipeline.decoder, joints, torch.ones(1, _LONGEST, dtype=torch.bool))
    wanted = frames_last(targets[:, :, joints]), frames_last(mask[:, :, joints])
    decoded = part.decode(latents)
    gradient = torch.zeros_like(decoded.features.mT)

    def decode() -> None:
        part.pull(part.decode(latents), gradient.mT)

    def kernel() -> None:
        guidance_value_and_grad(
            decoded.features.mT, *wanted, mean=part.mean, std=part.std, norm="mse", out=gradient
        )

    valid = torch.ones(latents.shape[:2], dtype=torch.bool)
    preset = replace(_PRESET, tolerance=1e-12, iterations=60, foot="none")
    evaluations = 0

    def optimise() -> None:
        nonlocal evaluations
        evaluations = int(pipeline.optimize(latents, valid, targets, mask, preset).evaluations.item())

    parts = {"decoder, forward and backward": decode, "kinematics and loss, fused kernel": kernel}
    each = _median_seconds({**parts, "": optimise})
    total = each.pop("") / evaluations
    each["L-BFGS and the rest"] = total - sum(each.values())
    rows = [("part", "ms of CPU", "share")]
    rows += [(name, f"{1000 * s:.2f}", f"{s / total:.0%}") for name, s in each.items()]
    rows.append(("an evaluation", f"{1000 * total:.2f}", "100%"))
    pelvis = measure(pipeline, batches, _PRESET, lambda clips: clips.mask(("pelvis",), pipeline.skeleton))
    frames = statistics.fmean(length for clips in batches for length in clips.lengths)
    rows.append(("a frame of a clip, pelvis controlled", f"{1000 * pelvis.seconds / frames:.2f}", ""))
    return rows


_HEAD = (
    "setting", "feed-forward (cm)", "average (cm)", "trajectory (%)", "location (%)", "evaluations",
    "seconds a clip",
)  # fmt: skip


def _row(name: str, measured: Measured) -> tuple[str, ...]:
    return (
        name,
        f"{100 * measured.feedforward:.2f}",
        f"{100 * measured.average:.2f}",
        f"{100 * measured.trajectory:.2f}",
        f"{100 * measured.location:.2f}",
        f"{measured.evaluations:.0f}",
        f"{measured.seconds:.2f}",
    )


def _median_seconds(runs: Mapping[str, Callable[[], None]], rounds: int = 9) -> dict[str, float]:
    """CPU time of each, in turn, so that a change of the machine's speed meets all alike."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for name, run in [*runs.items()] * (1 + rounds):
        started = time.process_time()
        run()
        times[name].append(time.process_time() - started)
    return {name: statistics.median(taken[1:]) for name, taken in times.items()}  # the first warms up


TABLES = {
    "joints": joints_table, "tolerance": tolerance_table, "masked": masked_table, "time": time_table,
}  # fmt: skip


def main() -> None:
    """Print a table as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("table", choices=TABLES)
    parser.add_argument("--data", type=Path, required=True, help="HumanML3D-style folder")
    parser.add_argument("--model", type=Path, help="model folder; by default the one that ships")
    parser.add_argument("--split", default="test")
    parser.add_argument("--limit", type=int, default=64, help="clips")
    arguments = parser.parse_args()
    pipeline = TLControl.from_pretrained(arguments.model)
    batches = read_clips(pipeline.skeleton, arguments.data, split=arguments.split, limit=arguments.limit)
    rows = TABLES[arguments.table](pipeline, batches)
    count = sum(len(clips.lengths) for clips in batches)
    print(f"{count} clips of {arguments.split}, {machine()}; {revision()}\n\n{markdown(rows)}")


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A table; the first row has its titles."""
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|" + " --- |" * len(rows[0]), *lines[1:]])


if __name__ == "__main__":
    main()
