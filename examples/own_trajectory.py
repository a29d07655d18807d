"""A figure of eight for the pelvis, written as BVH.

python examples/own_trajectory.py [--model FOLDER]
"""

import argparse

import numpy as np

from controlmm import ControlMM, PathControl

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--model", help="model folder; by default the one that ships")
model = parser.parse_args().model

turn = np.linspace(0, 2 * np.pi, 121)
eight = np.stack([0.8 * np.sin(2 * turn), 1.6 * np.sin(turn)], axis=1)  # x (left), z (ahead) in metres

result = ControlMM.from_pretrained(model)(
    "a person walks in a figure eight",
    seconds=9.0,
    controls=[PathControl("pelvis", xz=eight)],
    preset="fast",
    samples=2,
    seed=0,
)
for sample, error in enumerate(result.control_error):
    print(f"sample {sample}: {100 * error:.2f} cm from the path on average")
print("best one:", result.best.save("out/figure_eight.bvh"))
