"""The rows of TLControl's tables, with ControlMM on the same clips, controls and seeds beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from controlmm.evaluation.control_draws import ControlSetting
from controlmm.evaluation.controlmm_tables import check_is_kit
from controlmm.evaluation.motion_sources import Generated, MotionSource, RealMotion
from controlmm.evaluation.optimized_codes import EVALUATIONS, FEEDFORWARD, ITERATIONS, OptimizedCodes
from controlmm.evaluation.protocol import Row
from controlmm.evaluation.report import Column
from controlmm.evaluation.reproduction import Line, Reproduction
from controlmm.evaluation.scores import RowScores
from controlmm.motion.skeleton import KIT
from controlmm.pipelines.controlmm import ControlMM
from controlmm.pipelines.presets import PRESETS
from controlmm.pipelines.tlcontrol import TLControl
from controlmm.pipelines.tlcontrol_presets import TLCONTROL_PRESETS

WHOLE_PATHS = 196  # keyframes: TLControl is given whole trajectories
JOINTS = {  # as the paper calls them
    "pelvis": "pelvis", "head": "head", "left hand": "left_wrist", "right hand": "right_wrist",
    "left foot": "left_foot", "right foot": "right_foot", "all six": "all",
}  # fmt: skip
PAPER = replace(TLCONTROL_PRESETS["paper"], foot="none")
JOINT_SETS = {
    "both hands": "left_wrist+right_wrist", "upper body": "left_wrist+right_wrist+head",
    "both feet": "left_foot+right_foot", "lower body": "left_foot+right_foot+pelvis",
}  # fmt: skip
ACCURACIES = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
MASKED_SHARES = (0.0, 0.25, 0.5, 0.75, 0.9, 0.95)
_WORK = (
    Column("feed-forward cm", FEEDFORWARD, 2, 100.0),
    Column("iterations", ITERATIONS, 0),
    Column("evaluations", EVALUATIONS, 0),
)
_JOINT_METRICS = {title: f"average_of_{joint}" for title, joint in JOINTS.items() if joint != "all"}


@dataclass(frozen=True)
class Duel:
    """Two models under their presets.

    Attributes:
        tlcontrol: TLControl, as the paper's equation 4 has it: its preset ``paper`` without the foot term
            that only the released code has.
        controlmm: ControlMM beside it.
        presets: Its presets.
    """

    tlcontrol: TLControl
    controlmm: ControlMM
    presets: Sequence[str] = ("balanced",)

    def sources(self) -> dict[str, MotionSource]:
        """What gets a line in each setting, by name."""
        found: dict[str, MotionSource] = {"TLControl": OptimizedCodes(self.tlcontrol, PAPER)}
        for name in self.presets:
            found[f"ControlMM {name}"] = Generated(self.controlmm, PRESETS[name])
        return found

    def lines(self, settings: dict[str, ControlSetting]) -> list[Line]:
        """A line for each source in each setting."""
        return [
            Line((name, title), Row(f"{name} {title}", source, setting))
            for title, setting in settings.items()
            for name, source in self.sources().items()
        ]


def table1(duel: Duel) -> Reproduction:
    """Single joints and all six, whole trajectories."""
    settings = {title: ControlSetting(control, WHOLE_PATHS) for title, control in JOINTS.items()}
    real = Line(("Real", "-"), Row("real motion", RealMotion(), settings["pelvis"]))
    return Reproduction("tl-table1", [real, *duel.lines(settings)], extra=_WORK)


def table2(duel: Duel) -> Reproduction:
    """KIT-ML: the root, and the average over the six joints, each alone.

    Raises:
        ValueError: If the models are not of KIT-ML.
    """
    check_is_kit(duel.tlcontrol.skeleton, "tl-table2")
    names = [KIT.joint_names[joint] for joint in KIT.control_joints]
    source = duel.sources()["TLControl"]
    lines = [
        Line(("TLControl", name), Row(f"TLControl {name}", source, ControlSetting(name, WHOLE_PATHS)))
        for name in names
    ]
    real = Line(("Real", "-"), Row("real motion", RealMotion(), ControlSetting("pelvis", WHOLE_PATHS)))
    average = (("TLControl", "average"), range(1, 1 + len(names)))
    return Reproduction("tl-table2", [real, *lines], average=average)


def table3(duel: Duel) -> Reproduction:
    """Seconds of one frame, one controlled joint."""
    lines = duel.lines({"pelvis": ControlSetting("pelvis", WHOLE_PATHS)})
    return Reproduction("tl-table3", lines, own_table=_frame_seconds)


def table4(duel: Duel) -> Reproduction:
    """Average error of all six joints against the accuracy setting of the optimiser."""
    setting = ControlSetting("all", WHOLE_PATHS)
    lines = [
        Line(
            ("TLControl", f"{accuracy:.0e}"),
            Row(
                f"accuracy {accuracy:.0e}",
                OptimizedCodes(duel.tlcontrol, replace(PAPER, tolerance=accuracy)),
                setting,
            ),
        )
        for accuracy in ACCURACIES
    ]
    return Reproduction("tl-table4", lines, own_table=_accuracy_columns)


def figure7(duel: Duel) -> Reproduction:
    """Quality and error against the share of the frames that is masked, all six joints."""
    settings = {
        f"{share:.0%}": ControlSetting("all", float(1 - share) if share else WHOLE_PATHS)
        for share in MASKED_SHARES
    }
    columns = ("method", "frames masked", "FID", "R3", "Div", "Avg cm")
    return Reproduction("tl-figure7", duel.lines(settings), columns=columns, extra=_WORK)


def supplement2(duel: Duel) -> Reproduction:
    """Hands, upper body, feet, lower body: whole trajectories."""
    settings = {title: ControlSetting(control, WHOLE_PATHS) for title, control in JOINT_SETS.items()}
    lines = [Line((f"{line.keys[1]}, {line.keys[0]}",), line.row) for line in duel.lines(settings)]
    return Reproduction("tl-supplement2", lines, extra=_WORK)


TABLES: dict[str, Callable[[Duel], Reproduction]] = {
    "tl-table1": table1,
    "tl-table2": table2,
    "tl-table3": table3,
    "tl-table4": table4,
    "tl-fig7": figure7,
    "tl-supplement2": supplement2,
}
KIT_TABLES = ("tl-table2",)


def _frame_seconds(scores: Sequence[RowScores]) -> tuple[list[str], list[list[str]]]:
    """Whole seconds of all clips over all their frames."""
    each = [score["seconds"].mean / score["frames"].mean for score in scores]
    cells = [
        ["s/frame", *(f"{seconds:.4f}" for seconds in each)],
        ["frames/s", *(f"{1 / seconds:.1f}" for seconds in each)],
    ]
    return ["", *(score.label for score in scores)], cells


def _accuracy_columns(scores: Sequence[RowScores]) -> tuple[list[str], list[list[str]]]:
    batch = 32  # clips, the paper's
    cells = [["runtime per batch (s)", *(f"{batch * score['seconds'].mean:.2f}" for score in scores)]]
    for title, metric in {**_JOINT_METRICS, "average": "average_joint"}.items():
        cells.append([title, *(f"{100 * score[metric].mean:.2f}" for score in scores)])
    for title in (ITERATIONS, EVALUATIONS):
        cells.append([title, *(f"{score[title].mean:.0f}" for score in scores)])
    return ["", *(score.label.removeprefix("accuracy ") for score in scores)], cells
