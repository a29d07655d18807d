"""What every text encoder offers, and the check that a model gets the encoder that it was trained with."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

# Other keys of a config (where the weights were found) may differ between two machines.
IDENTITY_KEYS = ("kind", "dim", "version", "weights_sha256")


@dataclass(frozen=True)
class TextFeatures:
    """Features of ``B`` prompts, float32 on the CPU, without gradient.

    Attributes:
        pooled: (B, C) one vector for each prompt.
        tokens: (B, S, C) one vector for each token; padding is zero.
        token_mask: (B, S) true at real tokens, false at padding.
    """

    pooled: Float[Tensor, "B C"]
    tokens: Float[Tensor, "B S C"]
    token_mask: Bool[Tensor, "B S"]


@runtime_checkable
class TextEncoder(Protocol):
    """A frozen text encoder.

    Attributes:
        name: Short name for messages and logs, such as ``"minilm"``.
        dim: Width ``C`` of the pooled and of the token features.
    """

    name: str
    dim: int

    def encode(self, prompts: Sequence[str]) -> TextFeatures:
        """Features of ``prompts``; those of one prompt do not depend on the others in the batch."""

    def config(self) -> dict[str, Any]:
        """What identifies the encoder, JSON-able: ``kind``, ``dim`` and ``version`` or ``weights_sha256``."""


def check_prompts(prompts: Sequence[str]) -> list[str]:
    """The prompts as a list.

    Raises:
        TypeError: If ``prompts`` is one string (which is a sequence of letters), or an item is not a string.
    """
    if isinstance(prompts, str):
        raise TypeError(f"`prompts` must be a sequence of strings, got one string. Pass [{prompts!r}].")
    for index, prompt in enumerate(prompts):
        if not isinstance(prompt, str):
            raise TypeError(f"`prompts[{index}]` must be a string, got {type(prompt).__name__}.")
    return list(prompts)


def no_features(dim: int) -> TextFeatures:
    """The features of no prompts at all."""
    return TextFeatures(torch.zeros(0, dim), torch.zeros(0, 0, dim), torch.zeros(0, 0, dtype=torch.bool))


def warn_cut(cut: int, *, prompts: int, max_tokens: int) -> None:
    """Warn that ``cut`` of the prompts lost their end."""
    if cut:
        message = (
            f"{cut} of {prompts} prompts are longer than {max_tokens} tokens; the rest of them was cut off."
        )
        warnings.warn(message, stacklevel=4)


def check_same_encoder(expected: Mapping[str, Any], actual: TextEncoder | Mapping[str, Any]) -> None:
    """Refuse a text encoder that is not the one a model was trained with.

    Args:
        expected: The ``config()`` stored with the model; what it does not state is not compared.
        actual: The encoder at hand, or its ``config()``.

    Raises:
        ValueError: If the two differ in kind, width, version or weights.
    """
    found = actual if isinstance(actual, Mapping) else actual.config()
    # A model converted from published checkpoints knows the kind of its encoder, not the hash of its weights.
    stated = [key for key in IDENTITY_KEYS if key in expected or key == "kind"]
    differing = [key for key in stated if expected.get(key) != found.get(key)]
    if not differing:
        return
    wanted, got = (", ".join(f"{key}={side.get(key)!r}" for key in differing) for side in (expected, found))
    raise ValueError(
        f"`text_encoder` is not the one that the model was trained with: expected {wanted}, got {got}. "
        f"Pass no `text_encoder` to load the right one."
    )


def weights_sha256(module: nn.Module) -> str:
    """SHA-256 of the names, types and values of a module's weights, whatever file they came from."""
    digest = hashlib.sha256()
    for name, tensor in sorted(module.state_dict().items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().data)
    return digest.hexdigest()
