"""The feature cache: each text is encoded once, and a bad file never gives bad features."""

from __future__ import annotations

import pytest
import torch
from safetensors.torch import load_file, save_file

from controlmm.text import HashingTextEncoder, encode_all

TEXTS = ["a person walks", "bow", "a person walks", "jump"]


class CountingEncoder(HashingTextEncoder):
    """Remembers what it was asked for."""

    def __init__(self, dim: int = 16) -> None:
        super().__init__(dim)
        self.asked: list[str] = []

    def encode(self, prompts):
        self.asked += prompts
        return super().encode(prompts)


def encode(encoder, path, texts=TEXTS):
    return encode_all(texts, encoder, path, progress=False)


def test_rows_follow_the_texts_and_equal_texts_are_encoded_once(tmp_path):
    encoder = CountingEncoder()
    pooled = encode(encoder, tmp_path / "cache.safetensors")
    assert sorted(encoder.asked) == sorted(set(TEXTS))
    torch.testing.assert_close(pooled, HashingTextEncoder(16).encode(TEXTS).pooled)


def test_a_second_run_encodes_only_what_is_new(tmp_path):
    path = tmp_path / "deep" / "cache.safetensors"
    first = encode(CountingEncoder(), path)
    again = CountingEncoder()
    assert torch.equal(encode(again, path), first)
    assert again.asked == []
    encode(again, path, ["bow", "crawl"])
    assert again.asked == ["crawl"]
    assert encode(CountingEncoder(), path, [*TEXTS, "crawl"]).shape == (5, 16)


def test_without_a_file_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert encode(HashingTextEncoder(16), None).shape == (4, 16)
    assert list(tmp_path.iterdir()) == []


def test_no_texts():
    assert encode(HashingTextEncoder(16), None, []).shape == (0, 16)


def test_only_the_finished_file_is_left(tmp_path):
    encode(HashingTextEncoder(16), tmp_path / "cache.safetensors")
    assert [path.name for path in tmp_path.iterdir()] == ["cache.safetensors"]


@pytest.mark.parametrize("damage", ["cut", "garbage", "flipped", "foreign"])
def test_a_damaged_cache_is_built_anew_with_a_warning(tmp_path, damage):
    path = tmp_path / "cache.safetensors"
    expected = encode(HashingTextEncoder(16), path)
    content = bytearray(path.read_bytes())
    if damage == "cut":
        path.write_bytes(content[:-20])
    elif damage == "garbage":
        path.write_bytes(b"not a cache")
    elif damage == "flipped":
        content[-5] ^= 0xFF
        path.write_bytes(content)
    else:
        save_file({"weights": torch.zeros(3)}, path)
    encoder = CountingEncoder()
    with pytest.warns(UserWarning, match="is built anew"):
        assert torch.equal(encode(encoder, path), expected)
    assert len(encoder.asked) == 3
    assert load_file(path)["pooled"].shape == (3, 16)


def test_a_cache_of_another_encoder_is_not_used(tmp_path):
    path = tmp_path / "cache.safetensors"
    encode(HashingTextEncoder(16), path)
    with pytest.warns(UserWarning, match=r"is built anew \(it is of another encoder"):
        assert encode(HashingTextEncoder(24), path).shape == (4, 24)


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "cache.safetensors"
    encode(HashingTextEncoder(16), path)
    before = path.read_bytes()

    def full_disk(*args, **kwargs):
        raise OSError("No space left on device")

    monkeypatch.setattr("controlmm.text.cache.save_file", full_disk)
    with pytest.raises(OSError, match="No space left"):
        encode(HashingTextEncoder(16), path, ["crawl"])
    assert path.read_bytes() == before
