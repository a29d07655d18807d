"""Multimodality of a row: several motions for each of a few texts, one file for every 32 motions."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from controlmm.evaluation.evaluators import Evaluator
from controlmm.evaluation.motion_sources import Batch, MotionSource
from controlmm.evaluation.random_streams import stream, stream_seed
from controlmm.evaluation.variety import multimodality
from controlmm.io.atomic import replaced_on_success

MOTIONS = 30  # of each text, as the papers have it
_EMBEDDINGS = "motions"


def row_multimodality(
    source: MotionSource,
    batches: Iterator[Batch],
    evaluator: Evaluator,
    folder: Path,
    *,
    seed: int,
    repeat: int,
    mask_padding: bool,
    done: Callable[[], object],
) -> float:
    """Mean distance of ten random pairs of the 30 motions of a text, over the texts of ``batches``.

    The motions of a text differ in their noise alone: lengths and targets stay.

    Args:
        source: What makes the motions.
        batches: Texts, lengths and targets.
        evaluator: Makes the embeddings.
        folder: For a file a batch and motion; what is there already is not computed again.
        seed: Of the evaluation.
        repeat: Of the evaluation.
        mask_padding: See :func:`controlmm.evaluation.batch_scores.score_batch`.
        done: Called after each of the ``MOTIONS`` of each batch.
    """
    texts = []
    for number, batch in enumerate(batches):
        drawn = []
        for index in range(MOTIONS):
            file = folder / f"repeat_{repeat:03d}_batch_{number:03d}_motion_{index:02d}.safetensors"
            embeddings = _read(file)
            if embeddings is None:
                embeddings = _embedded(
                    source, _with_noise(batch, seed, repeat, index), evaluator, mask_padding
                )
                file.parent.mkdir(parents=True, exist_ok=True)
                with replaced_on_success(file) as partial:
                    save_file({_EMBEDDINGS: embeddings.contiguous()}, partial)
            drawn.append(embeddings)
            done()
        texts.append(torch.stack(drawn, dim=1))
    return multimodality(torch.cat(texts), generator=stream(seed, repeat, "multimodality"))


def _with_noise(batch: Batch, seed: int, repeat: int, index: int) -> Batch:
    seeds = [stream_seed(seed, repeat, sample.id, "noise", index) for sample in batch.samples]
    return dataclasses.replace(batch, noise_seeds=seeds)


def _embedded(
    source: MotionSource, batch: Batch, evaluator: Evaluator, mask_padding: bool
) -> Float[Tensor, "B E"]:
    produced = source.motions(batch)
    sees_padding = produced.has_padding and not mask_padding
    embeddings: Tensor = evaluator.embed_motions(produced.features, batch.lengths, sees_padding=sees_padding)
    return embeddings


def _read(file: Path) -> Tensor | None:
    """``None`` if the file is missing or damaged, so that it is made again."""
    if not file.is_file():
        return None
    try:
        return load_file(file)[_EMBEDDINGS]
    except (SafetensorError, KeyError):
        return None
