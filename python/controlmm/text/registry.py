"""Rebuilds a text encoder from the config that a model was saved with."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from controlmm.text.encoder import TextEncoder, check_same_encoder

KINDS = ("minilm", "clip", "hashing")


def load_text_encoder(config: Mapping[str, Any], *, folder: str | Path | None = None) -> TextEncoder:
    """The encoder that ``config`` describes.

    Args:
        config: ``kind`` and what the encoder's ``config()`` gave beside it; only ``kind`` must be there.
        folder: Where the weights are. By default the weights package (MiniLM) or ``config["source"]`` (CLIP).

    Raises:
        ValueError: If the kind is unknown, or the weights found are not the ones that ``config`` names.
        ModuleNotFoundError: If a package is missing; the message says how to install it.
    """
    encoder = _build(config, folder)
    check_same_encoder({**encoder.config(), **config}, encoder)
    return encoder


def _build(config: Mapping[str, Any], folder: str | Path | None) -> TextEncoder:
    kind = config.get("kind")
    if kind == "minilm":
        from controlmm.text.minilm import MiniLmTextEncoder

        return MiniLmTextEncoder(folder)
    if kind == "clip":
        from controlmm.text.clip import DEFAULT_HUB_ID, ClipTextEncoder

        return ClipTextEncoder(folder if folder is not None else config.get("source", DEFAULT_HUB_ID))
    if kind == "hashing":
        from controlmm.text.hashing import HashingTextEncoder

        return HashingTextEncoder(config["dim"]) if "dim" in config else HashingTextEncoder()
    raise ValueError(f"Unknown text encoder {kind!r}. Use one of: {', '.join(KINDS)}.")
