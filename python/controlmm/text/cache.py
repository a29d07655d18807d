"""Pooled text features of a whole data set, encoded once and kept in one file."""

from __future__ import annotations

import hashlib
import json
import os
import warnings
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor
from tqdm import tqdm

from controlmm.text.encoder import IDENTITY_KEYS, TextEncoder

_BATCH = 64


def encode_all(
    texts: Sequence[str], encoder: TextEncoder, cache_file: str | Path | None = None, *, progress: bool = True
) -> Float[Tensor, "N C"]:
    """The pooled feature of every text, row by row; equal texts are encoded once.

    Args:
        texts: ``N`` captions, in any order and with repetitions.
        encoder: The encoder to ask for what the cache does not hold.
        cache_file: A ``.safetensors`` file to read from and add to; ``None`` keeps nothing. A damaged file,
            or one of another encoder, is written anew with a warning.
        progress: Show a progress bar while encoding.
    """
    distinct = list(dict.fromkeys(texts))
    if not distinct:
        return torch.zeros(0, encoder.dim)
    path = None if cache_file is None else Path(cache_file)
    known = {} if path is None else _read(path, encoder)
    missing = [text for text in distinct if _key(text) not in known]
    if missing:
        known |= _encode_missing(missing, encoder, progress=progress)
        if path is not None:
            _write(path, known, encoder)
    return torch.stack([known[_key(text)] for text in texts])


def _encode_missing(texts: list[str], encoder: TextEncoder, *, progress: bool) -> dict[str, Tensor]:
    ordered = sorted(texts, key=len)  # neighbours of similar length waste little on padding
    features: dict[str, Tensor] = {}
    title = f"{encoder.name} text features"
    with tqdm(total=len(ordered), desc=title, unit="text", disable=not progress) as bar:
        for start in range(0, len(ordered), _BATCH):
            batch = ordered[start : start + _BATCH]
            features |= zip(map(_key, batch), encoder.encode(batch).pooled, strict=True)
            bar.update(len(batch))
    return features


def _key(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _identity(encoder: TextEncoder) -> str:
    config = encoder.config()
    return json.dumps({key: config.get(key) for key in IDENTITY_KEYS}, sort_keys=True)


def _checksum(keys: str, pooled: Tensor) -> str:
    digest = hashlib.sha256(keys.encode())
    digest.update(pooled.contiguous().numpy().data)
    return digest.hexdigest()


def _read(path: Path, encoder: TextEncoder) -> dict[str, Tensor]:
    if not path.is_file():
        return {}
    try:
        with safe_open(path, framework="pt") as file:
            header, pooled = file.metadata() or {}, file.get_tensor("pooled")
        identity, keys, checksum = header["encoder"], header["keys"], header["checksum"]
    except (SafetensorError, KeyError, OSError) as error:
        return _built_anew(path, f"it is damaged: {error}")
    if checksum != _checksum(keys, pooled):
        return _built_anew(path, "it is damaged: its checksum does not match")
    if identity != _identity(encoder):
        return _built_anew(path, f"it is of another encoder: {identity}")
    return dict(zip(keys.split(), pooled, strict=True))


def _built_anew(path: Path, reason: str) -> dict[str, Tensor]:
    warnings.warn(f"The text feature cache {path} is built anew ({reason}).", stacklevel=4)
    return {}


def _write(path: Path, features: dict[str, Tensor], encoder: TextEncoder) -> None:
    """Replace the file in one step, so that an interrupted run leaves the old one."""
    keys, pooled = " ".join(features), torch.stack(list(features.values()))
    header = {"encoder": _identity(encoder), "keys": keys, "checksum": _checksum(keys, pooled)}
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f"{path.name}.{os.getpid()}.part")
    save_file({"pooled": pooled}, unfinished, metadata=header)
    unfinished.replace(path)
