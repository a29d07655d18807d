"""The exact mode: joints put on their targets in closed form, the body kept whole."""

from controlmm.generation.exact.meeting import ExactReport, all_meet_exactly, meet_exactly

__all__ = ["ExactReport", "all_meet_exactly", "meet_exactly"]
