"""The exact mode: joints put on their targets in closed form, the body kept whole."""

from controlmm.generation.exact.meeting import ExactReport, meet_exactly

__all__ = ["ExactReport", "meet_exactly"]
