"""The text tower of OpenAI CLIP ViT-B/32, as the published checkpoints of the field use it.

Source: Radford et al., "Learning Transferable Visual Models From Natural Language Supervision", ICML 2021.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from controlmm.text.encoder import TextFeatures, check_prompts, no_features, warn_cut, weights_sha256

DEFAULT_HUB_ID = "openai/clip-vit-base-patch32"
_LAYOUT = "config.json, model.safetensors, vocab.json and merges.txt (or tokenizer.json)"
_log = logging.getLogger(__name__)


class ClipTextEncoder:
    """CLIP's text tower in float32; ``pooled`` (B, 512) is the projected feature, **not** of unit length.

    Needs the extra ``clip`` (transformers) and the weights, in a local folder or from the Hugging Face hub.
    """

    name = "clip"

    def __init__(self, folder: str | Path = DEFAULT_HUB_ID) -> None:
        """Load from a local folder in transformers' layout, or from a hub id such as the default.

        Raises:
            ModuleNotFoundError: If transformers is not installed.
            FileNotFoundError: If the folder does not exist, or the hub cannot be reached.
            ValueError: If the folder does not hold a CLIP text tower.
        """
        self.source = str(folder)
        self._tokenizer, self._network = _load(self.source)
        self.dim = int(self._network.config.projection_dim)
        self.max_tokens = int(self._network.config.max_position_embeddings)

    def encode(self, prompts: Sequence[str]) -> TextFeatures:
        """Projected feature at the end-of-text mark as ``pooled``; projected hidden states as ``tokens``.

        A prompt longer than the model's limit (77 tokens) is cut, with a warning.

        Raises:
            TypeError: If ``prompts`` is not a sequence of strings.
        """
        texts = check_prompts(prompts)
        if not texts:
            return no_features(self.dim)
        self._warn_if_cut(texts)
        batch = self._tokenizer(
            texts, padding="longest", truncation=True, max_length=self.max_tokens, return_tensors="pt"
        )
        mask = batch["attention_mask"].bool()
        with torch.no_grad():
            output = self._network(**batch)
            tokens = self._network.text_projection(output.last_hidden_state) * mask[..., None]
        return TextFeatures(output.text_embeds, tokens, mask)

    def config(self) -> dict[str, Any]:
        """Kind, width, SHA-256 of the weights, and where they came from."""
        return {"kind": "clip", "dim": self.dim, "weights_sha256": self._sha256, "source": self.source}

    @cached_property
    def _sha256(self) -> str:
        return weights_sha256(self._network)

    def _warn_if_cut(self, texts: list[str]) -> None:
        cut = sum(len(ids) > self.max_tokens for ids in self._tokenizer(texts, verbose=False)["input_ids"])
        warn_cut(cut, prompts=len(texts), max_tokens=self.max_tokens)


def _load(source: str) -> tuple[Any, Any]:
    try:
        from transformers import CLIPTextModelWithProjection, CLIPTokenizerFast
    except ImportError as error:
        raise ModuleNotFoundError(
            "The CLIP text encoder needs transformers. Run: pip install 'controlmm[clip]'"
        ) from error
    _announce(source)
    try:
        tokenizer = CLIPTokenizerFast.from_pretrained(source)
        network = CLIPTextModelWithProjection.from_pretrained(source, dtype=torch.float32)
    except OSError as error:
        reason = " ".join(str(error).split())
        raise FileNotFoundError(
            f"No CLIP weights could be loaded from {source!r} ({reason}). Pass a folder that holds {_LAYOUT}."
        ) from error
    return tokenizer, network.eval().requires_grad_(False)


def _announce(source: str) -> None:
    path = Path(source)
    if path.is_dir():
        return
    if path.is_absolute() or source.startswith((".", "~")) or source.count("/") != 1:
        raise FileNotFoundError(
            f"No CLIP folder at {source!r}. Pass a hub id, or a folder that holds {_LAYOUT}."
        )
    _log.warning("Loading the CLIP text tower %s from the Hugging Face hub or its local cache.", source)
