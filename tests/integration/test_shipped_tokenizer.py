"""The tokenizer in the package rebuilds recordings that it was not trained on, up to their ends."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from controlmm.evaluation.test_set import read_test_set
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.models.rvq_vae import RvqVae
from controlmm.motion.normalizer import Normalizer
from controlmm.ops import recover_joints
from controlmm.pipelines.folder import shipped_folder

MODEL = shipped_folder("small")
CLIPS, FRAMES = 48, 80

pytestmark = pytest.mark.skipif(not (MODEL / "tokenizer").is_dir(), reason="no model in this installation")


@pytest.fixture(scope="module")
def recorded_and_rebuilt(shared: Path) -> tuple[torch.Tensor, torch.Tensor]:
    """(B, T, J, 3) metres."""
    items = read_test_set(shared / "data", sources=("cmu",)).items
    features = torch.stack([item.features[:FRAMES] for item in items if len(item.features) >= FRAMES][:CLIPS])
    tokenizer = RvqVae.from_pretrained(MODEL / "tokenizer")
    normalizer = Normalizer.load(MODEL / "normalizer.safetensors")
    decoder = MotionDecoder(tokenizer, normalizer)
    with torch.no_grad():
        latents = tokenizer.quantizer.lookup(tokenizer.encode(normalizer.normalize(features)))
    return tuple(recover_joints(x, joints=22) for x in (features, decoder.clip_features(latents)))


def test_joints_are_rebuilt(recorded_and_rebuilt):
    recorded, rebuilt = (joints - joints[:, :, :1] for joints in recorded_and_rebuilt)
    assert (recorded - rebuilt).norm(dim=-1).mean() < 0.04


@pytest.mark.parametrize("end", [0, -1], ids=["first", "last"])
def test_ends_do_not_pop(recorded_and_rebuilt, end):
    """With zeros beyond a clip in the decoder, they accelerated twice as much as recordings."""
    recorded, rebuilt = (
        joints.diff(n=2, dim=1)[:, end].norm(dim=-1).mean() for joints in recorded_and_rebuilt
    )
    assert rebuilt < 1.3 * recorded
