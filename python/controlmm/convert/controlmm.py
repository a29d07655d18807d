"""Published ControlMM / MaskControl and MoMask folders -> one model folder for :class:`ControlMM`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import torch

from controlmm.convert.control import check_same_tokenizer, control_joints, import_control
from controlmm.convert.momask import import_length, import_masked, import_residual, import_rvq
from controlmm.convert.output_folder import check_free, new_folder
from controlmm.convert.report import ConversionReport, short_path
from controlmm.convert.run_folders import Checkpoint, find_checkpoints
from controlmm.convert.statistics import read_statistics
from controlmm.models.control_branch import ControlBranch, ControlBranchConfig
from controlmm.models.masked_transformer import MaskedTransformer
from controlmm.motion.normalizer import Normalizer
from controlmm.motion.skeleton import Skeleton
from controlmm.nn.checkpoint import PretrainedModel
from controlmm.pipelines import folder as files
from controlmm.pipelines.checks import check_sizes
from controlmm.pipelines.controlmm import ControlMM

ControlKind = Literal["joints", "pelvis"]
CLIP_DIM = 512  # ViT-B/32, which all published checkpoints were trained with

_LAYOUT = {
    "tokenizer": "rvq_*/model/net_best_fid.tar with meta/mean.npy and meta/std.npy",
    "residual transformer": "tres_*/model/net_best_fid.tar",
    "control": "*CtrlNet*/model/latest.tar or, without control branch, t2m_*/model/latest.tar",
}


def convert(paths: Sequence[Path], out: Path, *, control: ControlKind | None = None) -> ConversionReport:
    """Write the model folder ``out`` from published checkpoints.

    Args:
        paths: The authors' folder (``checkpoints/t2m``), or single run folders or files of it.
        out: Folder to write; it appears when everything has gone well.
        control: Which control checkpoint to take, the one for six joints or the one for the pelvis;
            ``None`` takes the first of the two that is there.

    Raises:
        FileExistsError: If ``out`` exists and is not empty.
        FileNotFoundError: If a network or the statistics are missing.
        ValueError: If a file is refused or damaged, holds other weights than it should, or two do not belong
            together.
    """
    check_free(out)
    report = ConversionReport(out)
    found, others = find_checkpoints(paths)
    normalizer, networks = _networks(found, control, report)
    unused = [checkpoint.file for checkpoint in found if checkpoint.file not in report.used.values()]
    report.notes += [f"{short_path(path)} was left: another took its place." for path in unused]
    report.notes += [f"{short_path(path)} was left: it holds no network of this model." for path in others]
    with new_folder(out) as folder:
        for name, network in networks.items():
            network.save_pretrained(folder / name)
        normalizer.save(folder / files.NORMALIZER_FILE)
        files.write_json(folder / files.TEXT_ENCODER_FILE, {"kind": "clip", "dim": CLIP_DIM})
        (folder / "README.md").write_text(report.card(), encoding="utf-8")
        files.write_json(folder / files.PIPELINE_FILE, {"kind": ControlMM.kind, "format": files.FORMAT})
    return report


def _networks(
    found: Sequence[Checkpoint], control: ControlKind | None, report: ConversionReport
) -> tuple[Normalizer, dict[str, PretrainedModel]]:
    """Statistics, and the networks under the names of their folders."""
    rvq_file = _needed(found, "tokenizer", report)
    residual_file = _needed(found, "residual transformer", report)
    normalizer = read_statistics(rvq_file.folder)
    tokenizer = import_rvq(rvq_file.state, rvq_file.options)
    residual = import_residual(residual_file.state, residual_file.options)
    control_file = _control_file(found, control, normalizer.skeleton)
    if control_file is None:
        base, branch = _without_branch(
            _needed(found, "masked transformer", report), normalizer.skeleton, report
        )
    else:
        base, branch = _with_branch(control_file, rvq_file, normalizer.skeleton, report)
    check_sizes(
        tokenizer=tokenizer.config,
        transformer=base.config,
        residual=residual.config,
        control=branch.config,
        skeleton=normalizer.skeleton,
        text_dim=CLIP_DIM,
    )
    networks = {"tokenizer": tokenizer, "transformer": base, "residual": residual, "control": branch}
    length_file = _only([c for c in found if c.role == "length estimator"], "length estimator")
    if length_file is not None:
        networks["length"] = import_length(length_file.state)
        report.used["length estimator"] = length_file.file
    return normalizer, networks


def _with_branch(
    file: Checkpoint, rvq_file: Checkpoint, skeleton: Skeleton, report: ConversionReport
) -> tuple[MaskedTransformer, ControlBranch]:
    imported = import_control(file.state, file.options, skeleton)
    check_same_tokenizer(
        imported.tokenizer_copy, rvq_file.state, control_file=file.file, rvq_file=rvq_file.file
    )
    report.used["control"] = report.used["masked transformer"] = file.file
    report.notes.append("The control checkpoint brings the base transformer that it was trained with.")
    return imported.base, imported.branch


def _without_branch(
    file: Checkpoint, skeleton: Skeleton, report: ConversionReport
) -> tuple[MaskedTransformer, ControlBranch]:
    """The plain base, and a branch that changes nothing: controls are then met by editing alone."""
    base = import_masked(file.state, file.options)
    sizes = base.config
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        config = ControlBranchConfig(
            width=sizes.width, heads=sizes.heads, layers=sizes.layers, feedforward=sizes.feedforward
        )
        branch = ControlBranch.beside(base, config.for_skeleton(skeleton))
    report.notes.append("No control checkpoint: the model follows its targets by editing alone.")
    return base, branch


def _control_file(
    found: Sequence[Checkpoint], kind: ControlKind | None, skeleton: Skeleton
) -> Checkpoint | None:
    by_kind: dict[ControlKind, list[Checkpoint]] = {"joints": [], "pelvis": []}
    for checkpoint in found:
        if checkpoint.role == "control":
            is_pelvis = len(control_joints(checkpoint.state, skeleton)) == 1
            by_kind["pelvis" if is_pelvis else "joints"].append(checkpoint)
    if kind is None:
        return _only(by_kind["joints"] or by_kind["pelvis"], "control")
    if not by_kind[kind]:
        raise FileNotFoundError(f"No control checkpoint of kind {kind!r} among the checkpoints.")
    return _only(by_kind[kind], "control")


def _needed(found: Sequence[Checkpoint], role: str, report: ConversionReport) -> Checkpoint:
    checkpoint = _only([c for c in found if c.role == role], role)
    if checkpoint is None:
        wanted = "; ".join(f"{name}: {layout}" for name, layout in _LAYOUT.items())
        have = ", ".join(f"{c.role} ({c.file})" for c in found)
        raise FileNotFoundError(f"No {role} among the checkpoints. Found: {have}. Expected {wanted}.")
    report.used[role] = checkpoint.file
    return checkpoint


def _only(candidates: Sequence[Checkpoint], role: str) -> Checkpoint | None:
    if len(candidates) > 1:
        folders = ", ".join(str(candidate.folder) for candidate in candidates)
        raise ValueError(
            f"There are {len(candidates)} checkpoints for the {role}: {folders}. "
            "Pass the run folders that you want one by one."
        )
    return candidates[0] if candidates else None
