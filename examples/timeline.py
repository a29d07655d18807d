"""Legs and arm with prompts of their own, and a chain of three clips.

python examples/timeline.py [--model FOLDER] [--preset accurate]
"""

import argparse

from controlmm import ControlMM, TimelineEntry

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--model", help="model folder; by default the one that ships")
parser.add_argument("--preset", default="balanced")
arguments = parser.parse_args()
pipeline = ControlMM.from_pretrained(arguments.model)

result = pipeline.timeline(
    [
        TimelineEntry("lower", "a person walks forward", seconds=(0, 6)),
        TimelineEntry("right_arm", "a person waves the right hand above the head", seconds=(1.5, 4.5)),
    ],
    preset=arguments.preset,
    seed=2,
)
print(f"entries are held to {100 * result.control_error[0]:.2f} cm")
print("to look at:", result.best.save("out/timeline.png"))

clips = [("a person walks forward", 4), ("a person jumps", 3), ("a person bows", 4)]
chain = pipeline.chain(clips, preset=arguments.preset, seed=2)
print(f"{chain.best.seconds:g} s; clips meet to {100 * chain.control_error[0]:.2f} cm")
print("to look at:", chain.best.save("out/chain.png"))
