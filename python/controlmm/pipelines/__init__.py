"""The public calls: text plus control in, motion out."""

from controlmm.pipelines.controlmm import ControlMM
from controlmm.pipelines.loading import load_pipeline
from controlmm.pipelines.output import GenerationResult
from controlmm.pipelines.presets import PRESETS, Preset
from controlmm.pipelines.tlcontrol import TLControl
from controlmm.pipelines.tlcontrol_presets import TLCONTROL_PRESETS, TLControlPreset

__all__ = [
    "PRESETS",
    "TLCONTROL_PRESETS",
    "ControlMM",
    "GenerationResult",
    "Preset",
    "TLControl",
    "TLControlPreset",
    "load_pipeline",
]
