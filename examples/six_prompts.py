"""Six prompts, each with and without control: contact sheets to look at and a table of errors.

python examples/six_prompts.py --preset accurate --out out/six_prompts
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from controlmm import ControlMM, JointControl, PathControl
from controlmm.controls import Control
from controlmm.controls.shapes import circle, wave, zigzag
from controlmm.evaluation import foot_skating_ratio


def there_and_back(metres: float = 3.0, points: int = 61) -> PathControl:
    """Straight ahead, a half turn of 0.4 m radius, and back."""
    turn = np.linspace(0, np.pi, points)
    ahead, radius = metres - 0.4, 0.4
    corner = np.stack([radius * (1 - np.cos(turn)), ahead + radius * np.sin(turn)], axis=1)
    return PathControl("pelvis", xz=np.concatenate([[[0, 0]], corner, [[2 * radius, 0.6]]]))


def waving_hand(frames: int = 80) -> JointControl:
    """Key frames of a raised right wrist that swings from side to side."""
    keys = np.arange(20, frames - 15, 6)
    side = -0.45 + 0.12 * np.where(np.arange(len(keys)) % 2, 1, -1)
    points = np.stack([side, np.full(len(keys), 1.65), np.full(len(keys), 0.15)], axis=1)
    return JointControl("right_wrist", frames=keys, positions=points)


CASES: dict[str, tuple[str, float, Sequence[Control]]] = {
    "circle": ("a person walks in a circle", 9.0, circle(radius=1.5).controls),
    "turn": ("a person walks forward, then turns around and walks back", 5.5, [there_and_back()]),
    "wave": ("a person waves the right hand", 4.0, [waving_hand()]),
    "bow": ("a person bows", 4.0, [JointControl("head", frames=[35], positions=[[0.0, 1.1, 0.45]])]),
    "zigzag": ("a person runs in a zigzag", 4.0, zigzag(length=6, seconds=4.0).controls),
    "sine": ("a person walks forward", 5.0, wave(length=5, seconds=5.0).controls),
}


def main() -> None:
    """Generate all cases and print one row for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", type=Path, help="model folder; by default the one that ships")
    parser.add_argument("--preset", default="accurate")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/six_prompts"))
    arguments = parser.parse_args()
    pipeline = ControlMM.from_pretrained(arguments.model)
    print(f"{'case':8} {'control':8} {'error (cm)':>10} {'skating':>8} {'seconds':>8}")
    for name, (prompt, seconds, controls) in CASES.items():
        for kind, chosen in (("none", ()), ("given", controls)):
            result = pipeline(
                prompt, seconds=seconds, controls=chosen, preset=arguments.preset, seed=arguments.seed
            )
            result.best.save(arguments.out / f"{name}_{kind}.png")
            skating = foot_skating_ratio(torch.stack([motion.joints for motion in result]))
            error = 100 * result.control_error.mean().item()
            print(f"{name:8} {kind:8} {error:10.2f} {skating.mean().item():8.3f} {result.seconds_taken:8.1f}")


if __name__ == "__main__":
    main()
