"""The paper's two obstacle demonstrations, drawn from above and from the side.

python examples/obstacles.py [--model FOLDER] [--preset accurate]
"""

import argparse

from controlmm import Avoid, ControlMM, JointControl, Sphere
from controlmm.viewer.scene_views import save_scene_views

LAST = 195
ZIGZAG = [
    Sphere(center=(0.5, 0.9508, 1.5), radius=1.0),
    Sphere(center=(-1.5, 0.9898, 4.0), radius=2.0),
    Sphere(center=(1.5, 0.9508, 5.5), radius=1.0),
    Sphere(center=(3.0, 0.9898, 3.0), radius=2.0),
]
OVERHEAD = [Sphere(center=(x, 1.991, 2.981), radius=1.0) for x in (-2.014, -1.014, 0.014, 1.014, 2.014)]
# name: prompt, where the pelvis ends, spheres, the joint that avoids them
DEMONSTRATIONS = {
    "zigzag": ("the man walks zigzag.", (0.5, 1.0229, 6.5), ZIGZAG, "pelvis"),
    "overhead": ("the man walks forward in a straight line.", (0.0, 1.0229, 5.0), OVERHEAD, "head"),
}

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--model", help="model folder; by default the one that ships")
parser.add_argument("--preset", default="balanced")
arguments = parser.parse_args()
pipeline = ControlMM.from_pretrained(arguments.model)

for name, (prompt, end, spheres, joint) in DEMONSTRATIONS.items():
    result = pipeline(
        prompt,
        frames=LAST + 1,
        controls=[JointControl("pelvis", frames=[LAST], positions=[end])],
        obstacles=[Avoid(sphere, joints=[joint]) for sphere in spheres],
        preset=arguments.preset,
        samples=2,
        seed=1,
    )
    deepest, miss = 100 * result.penetration.max(), 100 * result.control_error.max()
    print(
        f"{name}: {deepest:.2f} cm inside at most, end missed by {miss:.2f} cm, {result.seconds_taken:.1f} s"
    )
    result.best.save(f"out/{name}.npz")
    print("to look at:", save_scene_views(result.best, f"out/{name}.png"))
