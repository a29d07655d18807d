"""Motion files: ``.npz`` (all a motion holds), ``.npy`` (features or joints), ``.bvh`` (animation programs).

``Motion.save`` and ``Motion.load`` find the formats by suffix. Options go through them by name:
``motion.save("walk.bvh", unit="m")``, ``motion.save("walk.npy", what="joints")``,
``Motion.load("walk.bvh", resample=True)``.
"""

from controlmm.io.bvh import BvhFormat
from controlmm.io.npy import NpyFormat
from controlmm.io.npz import NpzFormat

__all__ = ["BvhFormat", "NpyFormat", "NpzFormat"]
