"""Word vectors and classes of the published evaluator's sentences."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from controlmm.text.word_vectors import WordVectors

WORDS = ["sos", "eos", "unk", "a", "person", "walk", "left", "green"]
VERB, NOUN, LOC, ACT, OTHER = 0, 1, 9, 12, 14


@pytest.fixture
def vectors() -> WordVectors:
    return WordVectors(WORDS, torch.arange(len(WORDS) * 300.0).reshape(-1, 300))


def test_marks_and_padding(vectors: WordVectors) -> None:
    found = vectors.encode([["a/DET", "person/NOUN"]])
    assert found.lengths.tolist() == [4]
    rows = (found.words[0, :, 0] / 300).tolist()
    assert rows == [0, 3, 4, 1] + [2] * 18  # sos a person eos unk ...
    assert found.tags.argmax(-1)[0].tolist() == [OTHER, 2, NOUN, OTHER] + [OTHER] * 18
    assert found.words.shape == (1, 22, 300)


def test_a_word_of_its_own_class_loses_its_part_of_speech(vectors: WordVectors) -> None:
    found = vectors.encode([["walk/VERB", "left/ADJ", "green/XX"]])
    assert found.tags.argmax(-1)[0, 1:4].tolist() == [ACT, LOC, OTHER]


def test_an_unknown_word_is_unk_even_if_its_class_is_known(vectors: WordVectors) -> None:
    found = vectors.encode([["jump/VERB"]])
    assert found.words[0, 1, 0].item() / 300 == 2
    assert found.tags.argmax(-1)[0, 1].item() == OTHER


def test_long_sentences_keep_their_first_twenty_words(vectors: WordVectors) -> None:
    exactly, longer = vectors.encode([["a/DET"] * 20]), vectors.encode([["a/DET"] * 20 + ["walk/VERB"] * 9])
    assert exactly.lengths.tolist() == longer.lengths.tolist() == [22]
    assert torch.equal(exactly.words, longer.words)


def test_they_are_read_back_as_written(vectors: WordVectors, tmp_path: Path) -> None:
    vectors.save(tmp_path)
    sentence = [["a/DET", "person/NOUN", "walk/VERB"]]
    assert torch.equal(WordVectors.load(tmp_path).encode(sentence).words, vectors.encode(sentence).words)


def test_what_cannot_be_used_is_named(vectors: WordVectors, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="`words` lacks eos, unk"):
        WordVectors(["sos"], torch.zeros(1, 300))
    with pytest.raises(ValueError, match=r"`vectors` must be \(N, C\) for the 8 words, got \(3, 300\)"):
        WordVectors(WORDS, torch.zeros(3, 300))
    with pytest.raises(ValueError, match="Sentence 1 has no word/TAG tokens"):
        vectors.encode([["a/DET"], []])
    with pytest.raises(ValueError, match="A token must be word/TAG, got 'walk'"):
        vectors.encode([["walk"]])
    with pytest.raises(FileNotFoundError, match=r"No words\.txt"):
        WordVectors.load(tmp_path)
