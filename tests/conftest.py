"""Fixtures of all test folders: a synthetic walk, a data folder of walks, an untrained tiny pipeline."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from controlmm.data import Caption, Clip, write_folder
from controlmm.models.control_branch import ControlBranch, ControlBranchConfig
from controlmm.models.masked_transformer import MaskedTransformer, MaskedTransformerConfig
from controlmm.models.motion_text_matcher import MatcherConfig, MotionTextMatcher
from controlmm.models.part_vq_vae import PartVqVae, PartVqVaeConfig
from controlmm.models.residual_transformer import ResidualTransformer, ResidualTransformerConfig
from controlmm.models.rvq_vae import RvqVae, RvqVaeConfig
from controlmm.models.trajectory_transformer import TrajectoryTransformer, TrajectoryTransformerConfig
from controlmm.motion.features import canonicalize, joints_to_features
from controlmm.motion.normalizer import ROOT_CONTACT_BIAS, Normalizer, biased_std, channel_statistics
from controlmm.motion.skeleton import HUMANML3D
from controlmm.pipelines import ControlMM, TLControl
from controlmm.text.hashing import HashingTextEncoder

STRIDE = 22  # frames of two steps
DECIDED = 30.0  # times fresh weights: logits as peaked and texts as audible as after training
SMALLEST_STD = 0.01  # of a synthetic channel: a walk hardly moves some of them


def pytest_configure() -> None:
    """Where several processes share the tests, each takes its part of the processor, and its commands too."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "0"))
    if workers:
        torch.set_num_threads(max(1, torch.get_num_threads() // workers))
        os.environ.setdefault("OMP_NUM_THREADS", str(torch.get_num_threads()))


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of reference data beside the repository."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not folder.is_dir():
        pytest.skip("../shared, the reference data beside this checkout, is not there")
    return folder


def make_walk(frames: int, *, turn: float = 0.3, heading: float = 0.0, speed: float = 0.05) -> torch.Tensor:
    """(T, 22, 3) float64 joints in metres of a walk that turns left by ``turn`` radians.

    Forward kinematics by hand: the legs and arms swing about the sideways axis, the upper body leans a
    little. Bone lengths are HumanML3D's.
    """
    phase = 2 * math.pi * torch.arange(frames, dtype=torch.float64) / STRIDE
    yaw = heading + turn * torch.arange(frames, dtype=torch.float64) / max(1, frames - 1)
    swing = 0.5 * torch.sin(phase)
    pitch = {1: -swing, 4: -swing, 7: 0.35 - swing, 2: swing, 5: swing, 8: 0.35 + swing, 3: 0.1 + 0 * swing}
    pitch |= {16: swing, 18: swing - 0.4, 20: swing - 0.8, 17: -swing, 19: -swing - 0.4, 21: -swing - 0.8}
    step = speed * torch.stack([torch.sin(yaw), 0 * yaw, torch.cos(yaw)], dim=-1)
    root = step.cumsum(0) - step[:1] + torch.tensor([0.3, 0.93, -0.2], dtype=torch.float64)
    root[:, 1] += 0.02 * torch.cos(2 * phase)
    joints = [root]
    for parent, offset, joint in zip(
        HUMANML3D.parents[1:], HUMANML3D.rest_offsets()[1:], range(1, 22), strict=True
    ):
        bone = _pitched(offset, pitch.get(joint, 0.05 * torch.cos(phase)))
        joints.append(joints[parent] + turned(bone, yaw))
    return torch.stack(joints, dim=1)


def _pitched(offset: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    x, y, z = offset
    return torch.stack(
        [x + 0 * angle, y * angle.cos() - z * angle.sin(), y * angle.sin() + z * angle.cos()], dim=-1
    )


def turned(points: torch.Tensor, yaw: torch.Tensor | float) -> torch.Tensor:
    """``points`` (..., 3) turned left about Y by ``yaw`` radians, which broadcasts with the leading axes."""
    yaw = torch.as_tensor(yaw, dtype=points.dtype)
    x, y, z = points.unbind(-1)
    return torch.stack([x * yaw.cos() + z * yaw.sin(), y, z * yaw.cos() - x * yaw.sin()], dim=-1)


@pytest.fixture(scope="session")
def walk() -> Callable[..., torch.Tensor]:
    """:func:`make_walk`, for tests that need walks of their own."""
    return make_walk


@pytest.fixture(scope="session")
def yawed() -> Callable[..., torch.Tensor]:
    """:func:`turned`, for tests that turn a scene."""
    return turned


@pytest.fixture
def walking_joints() -> torch.Tensor:
    """(60, 22, 3) float32 joints of a walk, canonical: on the ground, frame 0 at the origin facing +Z."""
    return canonicalize(make_walk(60))


def synthetic_normalizer() -> Normalizer:
    """Plausible statistics of features of synthetic walks."""
    walks = [make_walk(80, turn=turn) for turn in (-1.0, 0.2, 1.5)]
    mean, std = channel_statistics(joints_to_features(canonicalize(joints)) for joints in walks)
    return Normalizer(mean, biased_std(std.clamp(min=SMALLEST_STD), ROOT_CONTACT_BIAS))


@pytest.fixture
def tiny_pipeline() -> ControlMM:
    """An untrained pipeline of tiny networks; its codebooks hold seeded random codes."""
    return make_tiny_pipeline()


def make_tiny_pipeline() -> ControlMM:
    """See :func:`tiny_pipeline`."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(5)
        tokenizer = RvqVae(RvqVaeConfig.tiny())
        for layer in range(tokenizer.config.num_quantizers):
            tokenizer.quantizer.book(layer).codes.normal_()
        _amplify(tokenizer.decoder)
        transformer = MaskedTransformer(MaskedTransformerConfig.tiny())
        transformer.head[-1].weight.data.mul_(DECIDED)
        transformer.text_proj.weight.data.mul_(DECIDED)
        control = ControlBranch.beside(transformer, ControlBranchConfig.tiny())
        residual = ResidualTransformer(ResidualTransformerConfig.tiny())
        for zero in (control.first_zero, *control.mid_zeros):
            torch.nn.init.normal_(zero.weight, std=0.1)
    return ControlMM(
        tokenizer=tokenizer,
        transformer=transformer,
        residual=residual,
        control=control,
        normalizer=synthetic_normalizer(),
        text_encoder=HashingTextEncoder(64),
    )


def _amplify(decoder: torch.nn.Module) -> None:
    """Weights that pass the latents on at full strength; fresh ones let motions hardly differ."""
    for module in decoder.modules():
        if isinstance(module, torch.nn.Conv1d):
            torch.nn.init.kaiming_normal_(module.weight)


def make_tiny_tlcontrol() -> TLControl:
    """An untrained TLControl of tiny networks; its codebooks hold seeded random codes."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(6)
        tokenizer = PartVqVae(PartVqVaeConfig.tiny())
        for part in range(tokenizer.config.num_parts):
            tokenizer.quantizer.book(part).codes.normal_()
        _amplify(tokenizer.decoder)
        transformer = TrajectoryTransformer(TrajectoryTransformerConfig.tiny())
        for out in transformer.to_codes:
            out.weight.data.mul_(DECIDED)
        transformer.text_proj.weight.data.mul_(DECIDED)
    return TLControl(
        tokenizer=tokenizer,
        transformer=transformer,
        normalizer=synthetic_normalizer(),
        text_encoder=HashingTextEncoder(64),
    )


@pytest.fixture
def tiny_tlcontrol() -> TLControl:
    """See :func:`make_tiny_tlcontrol`."""
    return make_tiny_tlcontrol()


@pytest.fixture
def tiny_tlcontrol_folder(tmp_path: Path) -> Path:
    """The tiny TLControl as written by ``save_pretrained``."""
    return make_tiny_tlcontrol().save_pretrained(tmp_path / "tlcontrol")


@pytest.fixture
def tiny_pipeline_folder(tmp_path: Path) -> Path:
    """The tiny pipeline as written by ``save_pretrained``."""
    return make_tiny_pipeline().save_pretrained(tmp_path / "pipeline")


@pytest.fixture(scope="session")
def tiny_data_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A HumanML3D-style folder of walks with captions, mirrored ones counted: train 6, val 4, test 2."""
    folder = tmp_path_factory.mktemp("tiny_data")
    turns = {"train": (0.0, 0.8, -1.2), "val": (0.5, -0.5), "test": (1.0,)}
    clips = [
        Clip(
            id=f"{split}_{index}",
            joints=make_walk(70 + 5 * index, turn=turn, heading=0.4 * index),
            captions=(
                Caption("a person walks forward and turns left", "annotator"),
                Caption("someone takes a few steps", "template"),
            ),
            source="synthetic",
            licence="CC0-1.0",
            split=split,
        )
        for split, all_turns in turns.items()
        for index, turn in enumerate(all_turns)
    ]
    write_folder(clips, folder, progress=False)
    return folder


@pytest.fixture(scope="session")
def tiny_evaluator_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained in-project evaluator of tiny size, with the statistics of synthetic walks."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(9)
        config = MatcherConfig.tiny().for_data(HUMANML3D.feature_dim, HashingTextEncoder(64).config())
        matcher = MotionTextMatcher(config, synthetic_normalizer())
    folder = tmp_path_factory.mktemp("evaluator")
    matcher.save_pretrained(folder)
    return folder
