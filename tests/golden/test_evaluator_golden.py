"""The published evaluator with weights by formula against an independent forward (golden/evaluator_*.npz)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from controlmm.models.text_motion_matching import MatchingConfig, TextMotionMatching

MOTION_ROUNDING = 1e-5  # of float32 sums over 1,024 hidden units in another order; values of order 1
TEXT_ROUNDING = 5e-5  # values of order 3
WIDTHS = {"t2m": 263, "kit": 251}


def _network(feature_dim: int) -> TextMotionMatching:
    """Weights ``0.08 sin(0.5 + 0.7319 i + 13.37 k)``, 1 more in the LayerNorms' scale."""
    network = TextMotionMatching(MatchingConfig(feature_dim=feature_dim)).eval()
    k = 0
    for part in ("motion_encoder", "movement_encoder", "text_encoder"):
        state = getattr(network, part).state_dict()
        for name in sorted(state):
            i = np.arange(state[name].numel(), dtype=np.float64)
            values = 0.08 * np.sin(0.5 + 0.7319 * i + 13.37 * k) + (name == "output_net.1.weight")
            state[name] = torch.from_numpy(values).float().reshape(state[name].shape)
            k += 1
        getattr(network, part).load_state_dict(state)
    assert k == 42
    return network


@pytest.fixture(scope="module", params=WIDTHS)
def case(request: pytest.FixtureRequest, shared: Path) -> tuple[TextMotionMatching, dict[str, torch.Tensor]]:
    arrays = np.load(shared / "reference" / "golden" / f"evaluator_{request.param}.npz")
    return _network(WIDTHS[request.param]), {name: torch.from_numpy(arrays[name]) for name in arrays}


Case = tuple[TextMotionMatching, dict[str, torch.Tensor]]


@torch.no_grad()
def test_motions_come_back_in_the_order_of_the_input(case: Case) -> None:
    network, golden = case
    assert golden["m_lens"].tolist() != sorted(golden["m_lens"].tolist(), reverse=True)
    # The golden motion is as it stands, with its own padding.
    found = network.embed_motions(golden["motion"], golden["m_lens"], sees_padding=True)
    torch.testing.assert_close(found, golden["motion_embedding"], rtol=0, atol=MOTION_ROUNDING)


@torch.no_grad()
def test_snippets(case: Case) -> None:
    network, golden = case
    found = network.movement_encoder(golden["motion"][..., :-4])
    torch.testing.assert_close(found[:, :3, :16], golden["movement_first"], rtol=0, atol=MOTION_ROUNDING)


@torch.no_grad()
def test_texts(case: Case) -> None:
    network, golden = case
    found = network.embed_words(golden["word_emb"], golden["pos_onehot"], golden["cap_lens"])
    torch.testing.assert_close(found, golden["text_embedding"], rtol=0, atol=TEXT_ROUNDING)


@torch.no_grad()
def test_padding_is_seen_only_on_request(case: Case) -> None:
    network, golden = case
    lengths, motion = golden["m_lens"], golden["motion"].clone()
    expected = network.embed_motions(motion, lengths)
    for row, length in enumerate(lengths.tolist()):
        motion[row, length:] += 1.0
    assert torch.equal(network.embed_motions(motion, lengths), expected)
    seen = network.embed_motions(motion, lengths, sees_padding=True)
    assert not torch.equal(seen[lengths < 196], expected[lengths < 196])
    assert torch.equal(seen[lengths == 196], expected[lengths == 196])


@pytest.mark.parametrize("part", ["motion_encoder", "movement_encoder", "text_encoder"])
def test_state_dict_is_the_published_one(shared: Path, part: str) -> None:
    lines = (shared / "reference" / "state_dicts" / f"t2m_eval_{part}.tsv").read_text().splitlines()
    expected = {name: shape for name, shape, *_ in (line.split("\t") for line in lines[1:])}
    state = getattr(TextMotionMatching(MatchingConfig()), part).state_dict()
    assert {name: "x".join(map(str, tensor.shape)) for name, tensor in state.items()} == expected
