"""Solvers of latent editing on test clips, and what one evaluation costs.

python -m benchmarks.editing --data DATA [--model FOLDER] [--clips 8] [--solvers gauss-newton lbfgs ...]
python -m benchmarks.editing --evaluation

Every solver starts from the same latents (masked decoding of the clip's caption and targets, without logits
editing). Times are processor seconds of the solving alone, so that a busy machine does not count; medians
over clips.
"""

from __future__ import annotations

import argparse
import itertools
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.decoder_evaluation import print_evaluations
from controlmm import ControlMM
from controlmm.data import MotionFolder
from controlmm.evaluation import foot_skating_ratio
from controlmm.generation.editing import EditingBudget
from controlmm.generation.exact import meet_exactly
from controlmm.generation.latent_editing import edit_latents
from controlmm.generation.noise import clip_seeds
from controlmm.generation.objective import ControlObjective, control_error
from controlmm.motion.skeleton import HUMANML3D
from controlmm.ops import recover_joints
from controlmm.pipelines import Preset

FRAMES = 196
SIX = HUMANML3D.control_joints
BUDGETS = {
    "paper (600 AdamW)": EditingBudget(latent_iterations=600),
    "lbfgs": EditingBudget(latent_iterations=100, solver="lbfgs", tolerance=0.001),
    "gauss-newton": EditingBudget(latent_iterations=60, solver="gauss-newton", tolerance=0.001),
    "exact": EditingBudget(latent_iterations=60, solver="gauss-newton", tolerance=0.001),
}


@dataclass(frozen=True)
class Problem:
    """Clips whose joints are to follow recorded ones."""

    name: str
    joints: tuple[tuple[int, ...], ...]  # of each clip
    keys: int  # frames of each clip


def problems(clips: int) -> list[Problem]:
    """Pelvis, each other joint and subsets of the six, at 1, 2, 5 frames, 25 % and 100 %."""
    subsets = [s for size in range(1, 7) for s in itertools.combinations(SIX, size)]
    spread = tuple(subsets[(7 * clip) % len(subsets)] for clip in range(clips))
    names = {HUMANML3D.joint_names[joint]: ((joint,),) * clips for joint in SIX} | {"subsets of six": spread}
    return [Problem(name, joints, keys) for name, joints in names.items() for keys in (1, 2, 5, 49, FRAMES)]


def drawn(problem: Problem, joints: Tensor) -> Tensor:
    """Which coordinates are controlled; the frames are drawn with a seed."""
    generator = torch.Generator().manual_seed(problem.keys)
    mask = torch.zeros(*joints.shape, dtype=torch.bool)
    for clip, chosen in enumerate(problem.joints):
        frames = torch.randperm(FRAMES, generator=generator)[: problem.keys]
        for joint in chosen:
            mask[clip, frames, joint] = True
    return mask


def row(pipeline: ControlMM, solver: str, start: Tensor, targets: Tensor, mask: Tensor) -> dict[str, float]:
    """Medians over the clips for one solver: each clip is solved alone."""
    decoder, values = pipeline.decoder, []
    for clip in range(len(start)):
        one = slice(clip, clip + 1)
        frames = torch.ones(1, FRAMES, dtype=torch.bool)
        objective = ControlObjective(decoder, targets[one], mask[one], frames)
        began = time.thread_time()
        solution = edit_latents(objective, start[one], torch.ones(1, start.shape[1], 1), BUDGETS[solver])
        features = decoder.features(solution.latents)
        if solver == "exact":
            features = meet_exactly(features[0], targets[clip], mask[clip], HUMANML3D)[0][None]
        seconds = time.thread_time() - began
        joints = recover_joints(features, joints=HUMANML3D.num_joints)
        values.append(
            (
                100 * control_error(joints, targets[one], mask[one])[0],
                seconds,
                solution.evaluations[0],
                foot_skating_ratio(joints)[0],
                (joints.diff(n=3, dim=1) * HUMANML3D.fps**3).norm(dim=-1).mean(),
            )
        )
    table = torch.tensor([[float(value) for value in one] for one in values])
    middle = table.median(0).values
    names = ("error (cm)", "seconds", "evaluations", "skating", "jerk")
    return dict(zip(names, middle.tolist(), strict=True)) | {"worst (cm)": table[:, 0].max().item()}


@torch.no_grad()
def run(pipeline: ControlMM, data: Path, clips: int, solvers: list[str], only: str | None) -> None:
    """Print the table."""
    chosen = [c for c in MotionFolder(data).clips("test") if len(c.features) >= FRAMES][:clips]
    targets = torch.cat([recover_joints(c.features[None, :FRAMES], joints=22) for c in chosen])
    text = torch.cat([pipeline.text_encoder.encode([c.captions[0].text]).pooled for c in chosen])
    plan = Preset(EditingBudget(latent_iterations=0))
    for problem in problems(len(chosen)):
        if only is not None and only != problem.name:
            continue
        mask = drawn(problem, targets)
        start = pipeline.generate_latents(
            text,
            lengths=[FRAMES] * len(chosen),
            targets=targets,
            mask=mask,
            seeds=clip_seeds(0, len(chosen)),
            preset=plan,
        )
        before = 100 * control_error(pipeline.decoder(start), targets, mask).median().item()
        print(f"\n{problem.name}, {problem.keys} frames, before editing {before:.1f} cm", flush=True)
        for solver in solvers:
            found = row(pipeline, solver, start, targets, mask)
            print(
                f"{solver:>18}  " + "  ".join(f"{name} {value:8.3f}" for name, value in found.items()),
                flush=True,
            )


def main() -> None:
    """Parse the command line and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, help="HumanML3D-style folder")
    parser.add_argument("--model", type=Path, help="model folder; by default the one that ships")
    parser.add_argument("--clips", type=int, default=8)
    parser.add_argument("--solvers", nargs="*", default=list(BUDGETS), choices=list(BUDGETS))
    parser.add_argument("--only", help="one problem, such as pelvis or 'subsets of six'")
    parser.add_argument("--evaluation", action="store_true", help="milliseconds of one evaluation by part")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.evaluation:
        print_evaluations()
    if arguments.data:
        pipeline = ControlMM.from_pretrained(arguments.model)
        run(pipeline, arguments.data, arguments.clips, arguments.solvers, arguments.only)


if __name__ == "__main__":
    main()
