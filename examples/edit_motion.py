"""A motion gets another middle, another upper body, and a new end.

python examples/edit_motion.py [--model FOLDER]
"""

import argparse

from controlmm import ControlMM

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--model", help="model folder; by default the one that ships")
pipeline = ControlMM.from_pretrained(parser.parse_args().model)

walk = pipeline("a person walks forward", seconds=6, seed=3).best
walk.save("out/walk.npz")
edits = {
    "middle": ("a person jumps", {"keep": [(0, 2), (4, 6)]}),
    "end": ("a person stops and bows", {"keep": [(0, 3)]}),
    "upper_body": ("a person waves both hands", {"keep_parts": ["lower"]}),
}
for name, (prompt, kept) in edits.items():
    result = pipeline.edit(walk, prompt, **kept, seed=1)
    print(f"{name}: what was kept is met to {100 * result.control_error[0]:.2f} cm")
    print("to look at:", result.best.save(f"out/{name}.png"))
