"""Two poses of an earlier motion as key frames of a new one.

python examples/key_poses.py [--model FOLDER]
"""

import argparse

from controlmm import ControlMM, PoseControl

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--model", help="model folder; by default the one that ships")
pipeline = ControlMM.from_pretrained(parser.parse_args().model)

first = pipeline("a person bows", seconds=3.0, preset="exact", seed=1).best  # bones that keep their lengths
middle, end = first.num_frames // 2, first.num_frames - 1
poses = PoseControl(frames=[middle, end], positions=first.joints[[middle, end]])
second = pipeline("a person waves, then bows", seconds=3.0, controls=[poses], preset="fast", seed=2)

print(f"the two poses are met to {100 * second.control_error[0]:.2f} cm on average")
second.best.save("out/key_poses.npz")
print("to look at:", second.best.save("out/key_poses.png"))
