"""The public calls: text plus control in, motion out."""

from controlmm.pipelines.controlmm import ControlMM
from controlmm.pipelines.output import GenerationResult
from controlmm.pipelines.presets import PRESETS, Preset

__all__ = ["PRESETS", "ControlMM", "GenerationResult", "Preset"]
