"""Solvers of editing: an objective and latents in, better latents out."""

from controlmm.generation.joint_progress import Progress
from controlmm.generation.solvers.adamw import adamw
from controlmm.generation.solvers.gauss_newton import gauss_newton
from controlmm.generation.solvers.gradient import gradient_descent
from controlmm.generation.solvers.lbfgs import LbfgsTolerance, lbfgs
from controlmm.generation.solvers.stopping import Reason, Solution, Stopping

__all__ = [
    "LbfgsTolerance",
    "Progress",
    "Reason",
    "Solution",
    "Stopping",
    "adamw",
    "gauss_newton",
    "gradient_descent",
    "lbfgs",
]
