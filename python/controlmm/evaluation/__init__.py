"""Metrics of generated motion."""

from controlmm.evaluation.skating import foot_skating_ratio

__all__ = ["foot_skating_ratio"]
