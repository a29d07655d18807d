"""The published text-motion evaluator with its word vectors -> one folder.

Source: the files of Guo et al., CVPR 2022 (``text_mot_match``, ``Comp_v6_KLD*``, ``glove``).
"""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import torch

from controlmm.convert.output_folder import check_free, new_folder
from controlmm.convert.renaming import load_strictly, weight
from controlmm.convert.report import ConversionReport
from controlmm.convert.statistics import read_statistics
from controlmm.convert.torch_file import find_state_dict, read_torch_file
from controlmm.models.text_motion_matching import MatchingConfig, TextMotionMatching
from controlmm.text.word_vectors import WordVectors

_PARTS = ("movement_encoder", "motion_encoder", "text_encoder")  # also the keys in the checkpoint
_VECTORS, _INDEX = "our_vab_data.npy", "our_vab_idx.pkl"


def convert_evaluator(checkpoint: Path, *, statistics: Path, words: Path, out: Path) -> ConversionReport:
    """Write the evaluator folder ``out``.

    Args:
        checkpoint: ``text_mot_match/model/finest.tar``.
        statistics: The folder with ``meta/mean.npy`` and ``meta/std.npy`` that it was trained with
            (``Comp_v6_KLD005``; KIT-ML: ``Comp_v6_KLD005`` of its own).
        words: The folder with ``our_vab_data.npy`` and ``our_vab_idx.pkl``.
        out: Folder to write; it appears when everything has gone well.

    Raises:
        FileExistsError: If ``out`` exists and is not empty.
        FileNotFoundError: If a file is missing.
        ValueError: If a file is refused or damaged, or weights are missing, unknown or misshapen.
    """
    check_free(out)
    loaded = read_torch_file(checkpoint)
    states = {part: find_state_dict(loaded, (part,)) for part in _PARTS}
    missing = [part for part, state in states.items() if state is None]
    if missing:
        raise ValueError(f"{checkpoint} is no text-motion evaluator: it lacks {', '.join(missing)}.")
    known = {part: state for part, state in states.items() if state is not None}
    network = TextMotionMatching(_config(known), read_statistics(statistics))
    for part, state in known.items():
        load_strictly(getattr(network, part), state, what=part.replace("_", " "))
    vectors = _read_words(words)
    with new_folder(out) as folder:
        network.save_pretrained(folder)
        vectors.save(folder)
    used = {"networks": checkpoint, "statistics": statistics, "word vectors": words}
    return ConversionReport(out, used=used)


def _config(states: dict[str, dict[str, torch.Tensor]]) -> MatchingConfig:
    movement = weight(states["movement_encoder"], "main.0.weight", what="movement encoder")
    motion = weight(states["motion_encoder"], "hidden", what="motion encoder")
    text = weight(states["text_encoder"], "hidden", what="text encoder")
    return MatchingConfig(
        feature_dim=movement.shape[1] + 4,  # the contacts
        width=movement.shape[0],
        motion_hidden=motion.shape[-1],
        text_hidden=text.shape[-1],
    )


def _read_words(folder: Path) -> WordVectors:
    for name in (_VECTORS, _INDEX):
        if not (folder / name).is_file():
            raise FileNotFoundError(f"No {name} in {folder}; the published glove folder has it.")
    try:
        table = torch.from_numpy(np.load(folder / _VECTORS, allow_pickle=False)).float()
    except (ValueError, OSError, EOFError) as error:
        raise ValueError(f"{folder / _VECTORS} is no plain array of numbers, or is damaged.") from error
    rows = _read_index(folder / _INDEX)
    if max(rows.values()) >= len(table):
        raise ValueError(f"{folder / _INDEX} names rows beyond the {len(table)} of {_VECTORS}.")
    return WordVectors(list(rows), table[list(rows.values())])


class _PlainUnpickler(pickle.Unpickler):
    """Reads built-in containers, numbers and strings; anything that would have to be imported is refused."""

    def find_class(self, module: str, name: str) -> Any:
        raise pickle.UnpicklingError(f"{module}.{name}")


def _read_index(path: Path) -> dict[str, int]:
    try:
        with path.open("rb") as file:
            index = _PlainUnpickler(file).load()
    except Exception as error:  # damaged bytes make the unpickler fail in every way there is
        raise ValueError(
            f"{path} is refused: it is damaged or holds Python objects. Nothing of it was executed."
        ) from error
    is_index = isinstance(index, dict) and all(
        isinstance(word, str) and isinstance(row, int) and row >= 0 for word, row in index.items()
    )
    if not is_index or not index:
        raise ValueError(f"{path} must hold a dictionary from words to rows.")
    return dict(index)
