"""The closed end: joints put on their targets, bones given their lengths, without any network."""

from controlmm.generation.exact.meeting import ExactReport, all_meet_exactly, meet_exactly

__all__ = ["ExactReport", "all_meet_exactly", "meet_exactly"]
