"""The rows of ControlMM's tables: which controls, densities, presets and ablations they compare."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from controlmm.evaluation.control_draws import DENSITIES, ControlSetting
from controlmm.evaluation.motion_sources import Generated, RealMotion
from controlmm.evaluation.protocol import Row
from controlmm.evaluation.reproduction import Line, Reproduction
from controlmm.evaluation.scores import RowScores
from controlmm.models.control_branch import ControlBranch
from controlmm.motion.skeleton import KIT, Skeleton
from controlmm.pipelines.controlmm import ControlMM
from controlmm.pipelines.presets import PRESETS, Preset

JOINTS = ("pelvis", "left_foot", "right_foot", "head", "left_wrist", "right_wrist")
STEPS = (1, 2, 4, 6, 8, 10)
_LOGITS, _CODEBOOK, _FAST = (
    100,
    600,
    100,
)  # iterations in each decoding step; at the end; at the end of "fast"
_PELVIS = ControlSetting("pelvis")


@dataclass(frozen=True)
class Study:
    """What the rows are made with.

    Attributes:
        pipeline: The model.
        effort: Share of the papers' editing iterations, for a quick look; 1 takes all.
        presets: Presets of ours that get lines beside the paper's, in the tables where that makes sense.
    """

    pipeline: ControlMM
    effort: float = 1.0
    presets: Sequence[str] = ()

    def __post_init__(self) -> None:
        if not 0 < self.effort <= 1:
            raise ValueError(f"`effort` must be above 0 and at most 1, got {self.effort}.")

    def paper_preset(self, *, logits: int, codebook: int, steps: int = 10) -> Preset:
        """The paper's editing with these iteration counts, times ``effort``."""
        accurate = PRESETS["paper-accurate"]
        budget = replace(
            accurate.budget,
            logits_iterations=round(self.effort * logits),
            latent_iterations=round(self.effort * codebook),
        )
        return replace(accurate, budget=budget, steps=steps)

    @property
    def fast(self) -> Preset:
        """The paper's Fast."""
        return self.paper_preset(logits=0, codebook=_FAST)

    @property
    def medium(self) -> Preset:
        """The paper's Medium."""
        return self.paper_preset(logits=0, codebook=_CODEBOOK)

    @property
    def accurate(self) -> Preset:
        """The paper's Accurate, which its tables use where they do not say otherwise."""
        return self.paper_preset(logits=_LOGITS, codebook=_CODEBOOK)

    def line(self, keys: tuple[str, ...], preset: Preset, setting: ControlSetting = _PELVIS) -> Line:
        """A line of the model under ``preset``."""
        return Line(keys, Row(" ".join(keys), Generated(self.pipeline, preset), setting))

    def own(self, keys: Callable[[str], tuple[str, ...]], setting: ControlSetting = _PELVIS) -> list[Line]:
        """A line for each preset of ours."""
        return [self.line(keys(name), PRESETS[name], setting) for name in self.presets]


def without_control_model(pipeline: ControlMM) -> ControlMM:
    """The pipeline with a fresh motion control model, which changes nothing: its last layers are zero.

    Its residual layers do not see the targets either.
    """
    plain = copy.copy(pipeline)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)  # equal in every run, though what is drawn has no effect
        fresh = ControlBranch.beside(pipeline.transformer, pipeline.control.config)
    plain.control = fresh.eval().requires_grad_(False)
    plain.residual_control = None
    return plain


def table1(study: Study) -> Reproduction:
    """Control of single joints and of their combinations."""
    real = Line(("-", "Real", "-"), Row("real motion", RealMotion(), _PELVIS))
    singles = [
        study.line(("all joints", "ControlMM", joint), study.accurate, ControlSetting(joint))
        for joint in JOINTS
    ]
    cross = ControlSetting("cross")
    return Reproduction(
        "table1",
        [
            real,
            *singles,
            study.line(("all joints", "ControlMM", "cross"), study.accurate, cross),
            *study.own(lambda name: ("all joints", name, "pelvis")),
            *study.own(lambda name: ("all joints", name, "cross"), cross),
        ],
        average=(("all joints", "ControlMM", "average"), range(1, 7)),
        notes=["One model serves the pelvis and all other joints; the paper trained one of each."],
    )


def table2(study: Study) -> Reproduction:
    """Upper body from text, lower body given: pelvis and feet at all frames."""
    lower = ControlSetting("lower", 196)
    lines = [
        Line(("Real",), Row("real motion", RealMotion(), lower)),
        study.line(("ControlMM",), study.accurate, lower),
    ]
    return Reproduction("table2", [*lines, *study.own(lambda name: (name,), lower)])


def table3(study: Study) -> Reproduction:
    """Logits editing, codebook editing and the motion control model, alone and together."""
    plain = without_control_model(study.pipeline)
    lines = []
    for number in range(8):
        logits, codebook, model = number in (1, 3, 5, 7), number in (2, 3, 6, 7), number >= 4
        preset = study.paper_preset(logits=_LOGITS * logits, codebook=_CODEBOOK * codebook)
        keys = (str(number + 1), *("x" if part else "-" for part in (logits, codebook, model)))
        source = Generated(study.pipeline if model else plain, preset)
        lines.append(Line(keys, Row(f"ablation {number + 1}", source, _PELVIS)))
    return Reproduction("table3", lines)


def table4(study: Study) -> Reproduction:
    """Keyframes of the pelvis."""
    return Reproduction(
        "table4",
        [study.line((str(d),), study.accurate, ControlSetting("pelvis", d)) for d in DENSITIES]
        + [
            study.line((f"{density}, {name}",), PRESETS[name], ControlSetting("pelvis", density))
            for name in study.presets
            for density in DENSITIES
        ],
    )


def table5(study: Study) -> Reproduction:
    """Seconds against quality and error; presets of ours too, all if none is named."""
    own = study.presets or [name for name in PRESETS if not name.startswith("paper-")]
    study = replace(study, presets=tuple(own))
    papers = {"Fast": study.fast, "Medium": study.medium, "Accurate": study.accurate}
    lines = [study.line((f"ControlMM-{name}",), preset) for name, preset in papers.items()]
    return Reproduction("table5", [*lines, *study.own(lambda name: (f"preset {name}",))])


def table6(study: Study) -> Reproduction:
    """Seconds of each component: differences of runs that have one component more."""
    none = study.paper_preset(logits=0, codebook=0)
    return Reproduction(
        "table6",
        [
            study.line(("text only",), none, ControlSetting("none")),
            study.line(("with motion control model",), none),
            study.line(("with codebook editing",), study.medium),
            study.line(("with logits editing",), study.accurate),
        ],
        own_table=_component_seconds,
    )


def table7(study: Study) -> Reproduction:
    """The paper's Fast on all joints."""
    settings = {joint: ControlSetting(joint) for joint in (*JOINTS, "cross")}
    settings["lower body"] = ControlSetting("lower")
    lines = [study.line((name,), study.fast, setting) for name, setting in settings.items()]
    return Reproduction("table7", lines, average=(("average",), range(6)))


def table8(study: Study) -> Reproduction:
    """Decoding steps with logits editing and the motion control model."""
    presets = {steps: study.paper_preset(logits=_LOGITS, codebook=_CODEBOOK, steps=steps) for steps in STEPS}
    return Reproduction("table8", [study.line((str(steps),), preset) for steps, preset in presets.items()])


def table9(study: Study) -> Reproduction:
    """Decoding steps without both."""
    plain = without_control_model(study.pipeline)
    lines = []
    for steps in STEPS:
        preset = study.paper_preset(logits=0, codebook=_CODEBOOK, steps=steps)
        lines.append(Line((str(steps),), Row(f"{steps} steps", Generated(plain, preset), _PELVIS)))
    return Reproduction("table9", lines)


def table10(study: Study) -> Reproduction:
    """KIT-ML, control of the root.

    Raises:
        ValueError: If the model is not of KIT-ML.
    """
    check_is_kit(study.pipeline.skeleton, "table10")
    real = Line(("Real",), Row("real motion", RealMotion(), _PELVIS))
    return Reproduction("table10", [real, study.line(("ControlMM",), study.accurate)])


def check_is_kit(skeleton: Skeleton, table: str) -> None:
    """Raise ``ValueError`` unless the skeleton is KIT-ML's."""
    if skeleton != KIT:
        raise ValueError(
            f"{table} is of KIT-ML: pass a KIT-ML folder as `--data`, and a model and an evaluator of it."
        )


TABLES: dict[str, Callable[[Study], Reproduction]] = {
    maker.__name__: maker
    for maker in (table1, table2, table3, table4, table5, table6, table7, table8, table9, table10)
}
KIT_TABLES = ("table10",)


def _component_seconds(scores: Sequence[RowScores]) -> tuple[list[str], list[list[str]]]:
    base, model, codebook, logits = (score["seconds"].mean for score in scores)
    parts = (base, model - base, codebook - model, logits - codebook, logits)
    titles = ["s a clip", "base", "motion control model", "codebook editing", "logits editing", "full"]
    return titles, [["ours", *(f"{part:.2f}" for part in parts)]]
