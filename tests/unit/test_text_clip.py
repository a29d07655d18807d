"""The CLIP text tower: on a tiny random network here, since no package carries the real weights."""

from __future__ import annotations

import json
import sys

import pytest
import torch

from controlmm.text import ClipTextEncoder, load_text_encoder

PADDING_ATOL = 1e-5  # float32 sums in another order
WORDS = ("a", "person", "walks", "bows")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A CLIP folder with a vocabulary of letters and four words, and random weights."""
    transformers = pytest.importorskip("transformers")
    path = tmp_path_factory.mktemp("clip")
    letters = [chr(code) for code in range(ord("a"), ord("z") + 1)]
    merges, tokens = [], []
    for word in WORDS:
        parts = [*word[:-1], f"{word[-1]}</w>"]
        while len(parts) > 1:
            merges.append(f"{parts[0]} {parts[1]}")
            parts[:2] = ["".join(parts[:2])]
            tokens.append(parts[0])
    endings = [f"{letter}</w>" for letter in letters]
    names = list(dict.fromkeys([*letters, *endings, *tokens, "<|startoftext|>", "<|endoftext|>"]))
    ids = {token: index for index, token in enumerate(names)}
    (path / "vocab.json").write_text(json.dumps(ids), encoding="utf-8")
    (path / "merges.txt").write_text("\n".join(["#version: 0.2", *dict.fromkeys(merges)]), encoding="utf-8")
    torch.manual_seed(0)
    config = transformers.CLIPTextConfig(
        vocab_size=len(ids), hidden_size=16, intermediate_size=32, projection_dim=12, num_hidden_layers=2,
        num_attention_heads=2, max_position_embeddings=9,
        bos_token_id=ids["<|startoftext|>"], eos_token_id=ids["<|endoftext|>"],
    )  # fmt: skip
    transformers.CLIPTextModelWithProjection(config).save_pretrained(path)
    return path


def test_pooled_is_the_projected_state_of_the_end_mark(folder):
    features = ClipTextEncoder(folder).encode(["a person walks", "bows"])
    assert features.pooled.shape == (2, 12)
    assert features.pooled.dtype == torch.float32
    assert features.token_mask.sum(1).tolist() == [5, 3]  # start and end marks included
    torch.testing.assert_close(features.pooled, torch.stack([features.tokens[0, 4], features.tokens[1, 2]]))
    assert not torch.allclose(features.pooled.norm(dim=1), torch.ones(2), atol=0.05)


def test_a_prompt_does_not_depend_on_its_batch(folder):
    encoder = ClipTextEncoder(folder)
    together = encoder.encode(["a person walks", "bows"]).pooled[1]
    torch.testing.assert_close(together, encoder.encode(["bows"]).pooled[0], rtol=0.0, atol=PADDING_ATOL)


def test_half_precision_weights_are_run_in_float32(folder, tmp_path):
    transformers = pytest.importorskip("transformers")
    network = transformers.CLIPTextModelWithProjection.from_pretrained(folder).half()
    network.save_pretrained(tmp_path)
    for name in ("vocab.json", "merges.txt"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    assert ClipTextEncoder(tmp_path).encode(["bows"]).pooled.dtype == torch.float32


def test_a_long_prompt_is_cut_with_a_warning(folder):
    with pytest.warns(UserWarning, match="1 of 1 prompts are longer than 9 tokens"):
        assert ClipTextEncoder(folder).encode(["a person walks " * 5]).tokens.shape == (1, 9, 12)


def test_it_is_rebuilt_from_its_config(folder, tmp_path):
    encoder = ClipTextEncoder(folder)
    config = json.loads(json.dumps(encoder.config()))
    assert config["source"] == str(folder)
    assert load_text_encoder(config).config() == config
    with pytest.raises(ValueError, match="expected weights_sha256='00'"):
        load_text_encoder(config | {"weights_sha256": "00"})


def test_no_prompts(folder):
    assert ClipTextEncoder(folder).encode([]).pooled.shape == (0, 12)


def test_an_empty_folder_is_reported_in_one_line(tmp_path):
    pytest.importorskip("transformers")
    with pytest.raises(FileNotFoundError, match="No CLIP weights could be loaded from") as caught:
        ClipTextEncoder(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_missing_folder_is_not_taken_for_a_hub_id(tmp_path):
    pytest.importorskip("transformers")
    with pytest.raises(FileNotFoundError, match=r"No CLIP folder at '.*nowhere'. Pass a hub id, or a folder"):
        ClipTextEncoder(tmp_path / "nowhere")


def test_without_transformers_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'controlmm\[clip\]'"):
        ClipTextEncoder("anywhere")
