"""Obstacle avoidance: random scenes with a goal, with and without avoidance.

    python -m benchmarks.obstacle_scenes --out out/obstacle_scenes

Writes rows.jsonl as it goes (start it again to go on after a kill), summary.md, and pictures of some scenes.
Free of penetration means: no joint and no point of a bone is more than 1 mm inside an obstacle at any frame.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch

from benchmarks.progress_file import Row, measured_rows
from benchmarks.scenes import FRAMES, random_scene
from controlmm import ControlMM
from controlmm.controls import Avoid, penetration
from controlmm.evaluation import foot_skating_ratio
from controlmm.pipelines import GenerationResult
from controlmm.viewer.scene_views import save_scene_views

_COLUMNS = (
    ("free", "free of penetration", "{:.0%}"),
    ("depth", "mean depth (cm)", "{:.2f}"),
    ("worst", "greatest depth (cm)", "{:.2f}"),
    ("goal", "goal error (cm)", "{:.2f}"),
    ("skating", "foot skating ratio", "{:.3f}"),
    ("jerk", "jerk (m/s^3)", "{:.0f}"),
    ("seconds", "seconds", "{:.1f}"),
)


def measure(pipeline: ControlMM, key: str, *, preset: str, pictures: Path, pictured: int) -> Row:
    """The row of a key such as ``avoiding/7``."""
    way, number = key.split("/")
    scene = random_scene(int(number))
    avoided = scene.obstacles if way == "avoiding" else ()
    result = pipeline(
        scene.prompt, frames=FRAMES, controls=[scene.goal], obstacles=avoided, preset=preset, seed=int(number)
    )
    motion = result.best
    motion.extra["obstacles"] = scene.obstacles
    if int(number) < pictured:
        save_scene_views(motion, pictures / f"{int(number):02d}_{way}.png")
    return {**_facts(result, scene.obstacles), "obstacles": len(scene.obstacles), "moving": scene.num_moving}


def _facts(result: GenerationResult, obstacles: Sequence[Avoid]) -> Row:
    joints = torch.stack([motion.joints for motion in result])
    depth = penetration(joints, obstacles, result[0].skeleton).item()
    fps = result[0].fps
    return {
        "free": depth < 1e-3,
        "depth": 100 * depth,
        "goal": 100 * result.control_error.item(),
        "skating": foot_skating_ratio(joints).item(),
        "jerk": joints.diff(n=3, dim=1).norm(dim=-1).mean().item() * fps**3,
        "seconds": result.seconds_taken,
    }


def summary(rows: Sequence[Row]) -> str:
    """A Markdown table: one row with avoidance, one without."""
    lines = [
        "| | scenes | " + " | ".join(title for _, title, _ in _COLUMNS) + " |",
        "| --- |" + " --- |" * (1 + len(_COLUMNS)),
    ]
    for way in ("avoiding", "blind"):
        own = [row for row in rows if row["key"].startswith(way)]
        means = {name: sum(row[name] for row in own) / len(own) for name, _, _ in _COLUMNS if name != "worst"}
        means["worst"] = max(row["depth"] for row in own)
        cells = " | ".join(form.format(means[name]) for name, _, form in _COLUMNS)
        lines.append(f"| {way} | {len(own)} | {cells} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the suite."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--model", type=Path, help="model folder; by default the one that ships")
    parser.add_argument("--scenes", type=int, default=50)
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--pictures", type=int, default=12, help="scenes that are drawn")
    parser.add_argument("--out", type=Path, default=Path("out/obstacle_scenes"))
    arguments = parser.parse_args()
    pipeline = ControlMM.from_pretrained(arguments.model)
    keys = [f"{way}/{number}" for number in range(arguments.scenes) for way in ("avoiding", "blind")]
    rows = measured_rows(
        arguments.out / "rows.jsonl",
        keys,
        lambda key: measure(
            pipeline, key, preset=arguments.preset, pictures=arguments.out, pictured=arguments.pictures
        ),
    )
    table = summary(rows)
    (arguments.out / "summary.md").write_text(
        f"Preset `{arguments.preset}`, {torch.get_num_threads()} threads, one sample a scene.\n\n{table}"
    )
    print(table)


if __name__ == "__main__":
    main()
