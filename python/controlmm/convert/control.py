"""MaskControl's control checkpoint: retrained base, control branch and a copy of the tokenizer in one."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import torch

from controlmm.convert.momask import IGNORED, MASKED_RULES, encoder_rules, import_masked
from controlmm.convert.options_file import Options
from controlmm.convert.renaming import Rule, count_indices, load_strictly, renamed, weight
from controlmm.convert.torch_file import StateDict
from controlmm.models.control_branch import ControlBranch, ControlBranchConfig
from controlmm.models.masked_transformer import MaskedTransformer
from controlmm.motion.skeleton import Skeleton

_CHANNELS = 6  # of the signal a joint: difference and target
_TOKENIZER = "vq_model."
_BRANCH_RULES: tuple[Rule, ...] = (
    (r"first_zero_linear\.(.+)", r"first_zero.\1"),
    (r"mid_zero_linear\.(.+)", r"mid_zeros.\1"),
    (r"seqTransEncoder_control\.(layers\..+)", r"\1"),
)


@dataclass(frozen=True)
class ControlImport:
    """The networks of a control checkpoint."""

    base: MaskedTransformer
    branch: ControlBranch
    tokenizer_copy: StateDict  # published names, empty if the file has none


def import_control(state: StateDict, options: Options, skeleton: Skeleton) -> ControlImport:
    """Base transformer and control branch; which joints it was trained for follows from the signal's width.

    Raises:
        ValueError: If weights are missing, unknown or misshapen.
    """
    copy = {name.removeprefix(_TOKENIZER): t for name, t in state.items() if name.startswith(_TOKENIZER)}
    networks = {name: tensor for name, tensor in state.items() if not name.startswith(_TOKENIZER)}
    is_base = re.compile("|".join([*(old for old, _ in MASKED_RULES), *IGNORED]))
    base = import_masked({name: t for name, t in networks.items() if is_base.fullmatch(name)}, options)
    own = {name: tensor for name, tensor in networks.items() if not is_base.fullmatch(name)}
    return ControlImport(base, _branch(own, base, skeleton), copy)


def control_joints(state: StateDict, skeleton: Skeleton) -> tuple[int, ...]:
    """The joints that a control checkpoint's signal names: the root alone or the papers' six.

    Raises:
        ValueError: If the signal has another width.
    """
    channels = weight(state, "encoder_control.model.0.weight", what="control branch").shape[1]
    for joints in ((0,), skeleton.control_joints):
        if channels == _CHANNELS * len(joints):
            return joints
    raise ValueError(
        f"The control signal of the checkpoint has {channels} channels; expected {_CHANNELS} (pelvis) or "
        f"{_CHANNELS * len(skeleton.control_joints)} (six joints)."
    )


def check_same_tokenizer(
    copy: StateDict, tokenizer: StateDict, *, control_file: Path, rvq_file: Path
) -> None:
    """Refuse a control checkpoint whose own copy of the tokenizer is not the stand-alone one.

    Raises:
        ValueError: If the two differ in a name or a value.
    """
    if not copy:
        return
    unlike = sorted(
        name
        for name in copy.keys() | tokenizer.keys()
        if name not in copy or name not in tokenizer or not torch.equal(copy[name], tokenizer[name])
    )
    if unlike:
        raise ValueError(
            f"{control_file} was trained with another tokenizer than {rvq_file}: its copy (vq_model.*) "
            f"differs in {len(unlike)} of {len(tokenizer)} weights, first in {unlike[0]}. "
            "Take both from the same training."
        )


def _branch(state: StateDict, base: MaskedTransformer, skeleton: Skeleton) -> ControlBranch:
    stages = count_indices(state, r"encoder_control\.model\.(\d+)\.0\.weight")
    joints = control_joints(state, skeleton)
    sizes = base.config
    config = ControlBranchConfig(
        width=sizes.width,
        heads=sizes.heads,
        layers=sizes.layers,
        feedforward=sizes.feedforward,
        dropout=sizes.dropout,
        joints=joints,
        has_observation_mask=False,
        encoder_width=state["encoder_control.model.0.weight"].shape[0],
        encoder_depth=count_indices(state, r"encoder_control\.model\.2\.1\.model\.(\d+)\."),
        downsample=2**stages,
        into_frozen_trunk=True,
    )
    network = ControlBranch(config)
    rules = [*_BRANCH_RULES, *encoder_rules("encoder_control", stages)]
    load_strictly(network, renamed(state, rules), what="control branch")
    return network.eval()
