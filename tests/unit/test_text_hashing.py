"""The hashing encoder: the same numbers everywhere, and a little sense of likeness."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import torch

from controlmm.text import HashingTextEncoder

# Written down once; a change means that models trained with the encoder no longer fit: raise VERSION.
KNOWN_PROMPT = "a person walks forward"
KNOWN_START = (-0.0497, 0.0224, -0.2292, 0.0738)
KNOWN_ATOL = 1e-4  # the table has four decimals


def test_features_are_the_known_ones():
    start = HashingTextEncoder(64).encode([KNOWN_PROMPT]).pooled[0, :4]
    torch.testing.assert_close(start, torch.tensor(KNOWN_START), rtol=0.0, atol=KNOWN_ATOL)


def test_features_are_the_same_in_a_process_with_another_hash_seed():
    code = (
        "from controlmm.text import HashingTextEncoder as H;"
        f"print(H(32).encode([{KNOWN_PROMPT!r}]).pooled.numpy().tobytes().hex())"
    )
    environment = os.environ | {"PYTHONHASHSEED": "7", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    output = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    ).stdout
    assert output.strip() == HashingTextEncoder(32).encode([KNOWN_PROMPT]).pooled.numpy().tobytes().hex()


def test_shared_words_and_stems_make_prompts_alike():
    encoder = HashingTextEncoder(512)
    base, stems, other = encoder.encode(
        ["a person walks forward", "the person walked forwards", "someone does two backflips"]
    ).pooled
    assert base @ stems > base @ other + 0.1


def test_word_order_and_letter_case():
    encoder = HashingTextEncoder(64)
    left, right, upper = encoder.encode(
        ["turn left then right", "turn right then left", "TURN left, then Right!"]
    ).pooled
    assert not torch.allclose(left, right)
    torch.testing.assert_close(left, upper)


def test_shapes_and_padding():
    features = HashingTextEncoder(48).encode(["bow", "a person bows", "..."])
    assert features.pooled.shape == (3, 48)
    assert features.tokens.shape == (3, 3, 48)
    assert features.token_mask.tolist() == [[True, False, False], [True, True, True], [False, False, False]]
    assert not features.tokens[0, 1:].any()
    assert not features.pooled[2].any()


def test_a_prompt_does_not_depend_on_its_batch():
    encoder = HashingTextEncoder(64)
    together = encoder.encode(["bow", "a person walks in a circle"]).pooled[0]
    assert torch.equal(together, encoder.encode(["bow"]).pooled[0])


@pytest.mark.parametrize("dim", [7, 64, 512])
def test_any_width(dim):
    assert HashingTextEncoder(dim).encode(["walk"]).pooled.norm() == pytest.approx(1.0, abs=1e-6)


def test_no_prompts_and_bad_arguments():
    assert HashingTextEncoder(8).encode([]).pooled.shape == (0, 8)
    with pytest.raises(ValueError, match="`dim` must be at least 1, got 0"):
        HashingTextEncoder(0)
    with pytest.raises(TypeError, match="must be a sequence of strings"):
        HashingTextEncoder().encode("walk")
