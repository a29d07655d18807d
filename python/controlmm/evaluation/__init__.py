"""Metrics of generated motion."""

from controlmm.evaluation.control_errors import ControlErrors, control_errors
from controlmm.evaluation.frechet import frechet_distance
from controlmm.evaluation.intervals import Interval, interval
from controlmm.evaluation.plausibility import (
    bone_length_deviation,
    contact_consistency,
    floor_penetration,
    mean_jerk,
)
from controlmm.evaluation.reconstruction import (
    code_perplexity,
    code_usage,
    global_error,
    root_aligned_error,
)
from controlmm.evaluation.retrieval import matching_distance, r_precision
from controlmm.evaluation.skating import foot_skating_ratio, published_skating_ratio
from controlmm.evaluation.variety import diversity, multimodality

__all__ = [
    "ControlErrors",
    "Interval",
    "bone_length_deviation",
    "code_perplexity",
    "code_usage",
    "contact_consistency",
    "control_errors",
    "diversity",
    "floor_penetration",
    "foot_skating_ratio",
    "frechet_distance",
    "global_error",
    "interval",
    "matching_distance",
    "mean_jerk",
    "multimodality",
    "published_skating_ratio",
    "r_precision",
    "root_aligned_error",
]
