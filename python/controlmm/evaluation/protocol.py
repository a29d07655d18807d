"""The papers' evaluation: batches of 32 test samples, repeats with new draws, one file a batch.

A killed run loses at most one batch: the same call goes on where it was stopped.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from controlmm.evaluation.batch_scores import BatchScores, score_batch
from controlmm.evaluation.control_draws import ControlSetting, draw_mask
from controlmm.evaluation.evaluators import Evaluator
from controlmm.evaluation.frechet import frechet_distance
from controlmm.evaluation.motion_sources import Batch, Generated, MotionSource, RealMotion, padded_features
from controlmm.evaluation.random_streams import stream
from controlmm.evaluation.retrieval import GROUP
from controlmm.evaluation.row_folders import labelled_folders, shared_folders
from controlmm.evaluation.row_multimodality import MOTIONS, row_multimodality
from controlmm.evaluation.scores import RowScores, repeat_scores
from controlmm.evaluation.test_set import MAX_FRAMES, Sample, TestSet


@dataclass(frozen=True)
class Protocol:
    """How an evaluation draws, and on how much.

    Attributes:
        repeats: Evaluations with other captions, crops, controls and noise.
        limit: Samples a repeat, rounded down to whole batches of 32; ``None`` takes all. Fewer than 32 make
            one incomplete batch, for which R-precision is not defined.
        seed: Of all draws.
        mask_padding: See :func:`controlmm.evaluation.batch_scores.score_batch`.
        multimodality: Texts for which generated rows make 30 motions each, rounded down to whole batches of
            32 as ``limit``; the papers take 100. 0 leaves multimodality out.
    """

    repeats: int = 1
    limit: int | None = None
    seed: int = 0
    mask_padding: bool = False
    multimodality: int = 0

    def __post_init__(self) -> None:
        for name, value in (("repeats", self.repeats), ("limit", self.limit)):
            if value is not None and value < 1:
                raise ValueError(f"`{name}` must be at least 1, got {value}.")
        for name in ("seed", "multimodality"):
            if getattr(self, name) < 0:
                raise ValueError(f"`{name}` must not be negative, got {getattr(self, name)}.")

    def clips(self, available: int) -> int:
        """Samples in a repeat when there are ``available``."""
        return _whole_groups(available if self.limit is None else min(self.limit, available))

    def batches(self, available: int) -> int:
        """Batches of a repeat."""
        return -(-self.clips(available) // GROUP)

    def varied_batches(self, available: int) -> int:
        """Batches of a repeat whose texts get several motions."""
        return -(-_whole_groups(min(self.multimodality, self.clips(available))) // GROUP)


@dataclass(frozen=True)
class Row:
    """One row of a table: where motions come from and what is controlled."""

    label: str
    source: MotionSource
    setting: ControlSetting = field(default_factory=lambda: ControlSetting("none"))


def evaluate_rows(
    rows: Sequence[Row],
    test_set: TestSet,
    evaluator: Evaluator,
    protocol: Protocol,
    out: str | Path,
    *,
    is_shared: bool = False,
    progress: bool = True,
) -> list[RowScores]:
    """Scores of all rows, on the same samples; those with the same setting also meet the same targets.

    Args:
        rows: Rows with different labels.
        test_set: Items to draw from.
        evaluator: Makes the embeddings; must take the features of ``test_set``.
        protocol: Repeats, limit, seed.
        out: Folder for a file a batch; what is there already is not computed again.
        is_shared: Whether batches are kept by what they are instead of by the row's label: then tables with
            equal rows share them, and a folder may hold evaluations of any settings.
        progress: Show a progress bar.

    Raises:
        ValueError: If a row's folder holds another evaluation, a setting is unknown, or widths do not fit.
            Nothing has run then.
    """
    width = test_set.items[0].features.shape[1]
    if evaluator.feature_dim != width:
        raise ValueError(
            f"The evaluator takes features of width {evaluator.feature_dim}, the data has {width}."
        )
    available = len(test_set.items)
    shared = {
        "protocol": _identity(protocol, available), "data": test_set.sha256,
        "captions": list(test_set.kinds), "split": test_set.split, "evaluator": evaluator.name,
    }  # fmt: skip
    for row in rows:
        row.setting.check(test_set.skeleton)
    whats = [{**row.source.describe(), **asdict(row.setting)} for row in rows]
    labels, claims, root = (
        [row.label for row in rows],
        [what | shared for what in whats],
        Path(out) / "batches",
    )
    folders = shared_folders(claims, root) if is_shared else labelled_folders(labels, claims, root)
    steps = sum(_steps(row, protocol, available) for row in rows)
    with tqdm(total=steps, unit="batch", disable=not progress) as bar:
        return [
            _evaluate_row(row, {"label": row.label, **what}, test_set, evaluator, protocol, folder, bar)
            for row, what, folder in zip(rows, whats, folders, strict=True)
        ]


def _steps(row: Row, protocol: Protocol, available: int) -> int:
    """Times that the row has motions made."""
    varied = MOTIONS * protocol.varied_batches(available) if isinstance(row.source, Generated) else 0
    return protocol.repeats * (protocol.batches(available) + varied)


def batches_of(
    test_set: TestSet, setting: ControlSetting, protocol: Protocol, repeat: int
) -> Iterator[list[tuple[Sample, Any]]]:
    """Samples with their control masks, in batches of 32."""
    count = protocol.clips(len(test_set.items))
    samples = test_set.samples(seed=protocol.seed, repeat=repeat)[:count]
    for first in range(0, count, GROUP):
        yield [
            (
                sample,
                draw_mask(
                    setting,
                    sample.length,
                    test_set.skeleton,
                    frames=MAX_FRAMES,
                    generator=stream(protocol.seed, repeat, sample.id, "control"),
                ),
            )
            for sample in samples[first : first + GROUP]
        ]


def _evaluate_row(
    row: Row,
    about: dict[str, Any],
    test_set: TestSet,
    evaluator: Evaluator,
    protocol: Protocol,
    folder: Path,
    bar: Any,
) -> RowScores:
    repeats: dict[str, list[float]] = {}
    for repeat in range(protocol.repeats):
        found = []
        bar.set_description(row.label)
        for number, pairs in enumerate(batches_of(test_set, row.setting, protocol, repeat)):
            file = folder / f"repeat_{repeat:03d}_batch_{number:03d}.safetensors"
            scores = BatchScores.load(file)
            if scores is None:
                samples, masks = zip(*pairs, strict=True)
                batch = Batch.of(samples, masks, seed=protocol.seed, repeat=repeat)
                produced = row.source.motions(batch)
                scores = score_batch(batch, produced, evaluator, mask_padding=protocol.mask_padding)
                scores.save(file)
            found.append(scores)
            bar.update()
        values = repeat_scores(found, seed=protocol.seed, repeat=repeat)
        if isinstance(row.source, Generated) and protocol.multimodality:
            values["multimodality"] = _multimodality(row, test_set, evaluator, protocol, folder, repeat, bar)
        if isinstance(row.source, RealMotion):
            values["fid"] = _fid_of_another_draw(test_set, evaluator, protocol, repeat, found)
        for name, value in values.items():
            repeats.setdefault(name, []).append(value)
    return RowScores(row.label, repeats, protocol.clips(len(test_set.items)), about)


def _multimodality(
    row: Row,
    test_set: TestSet,
    evaluator: Evaluator,
    protocol: Protocol,
    folder: Path,
    repeat: int,
    bar: Any,
) -> float:
    bar.set_description(f"{row.label}, multimodality")
    pairs = batches_of(test_set, row.setting, protocol, repeat)
    batches = (
        Batch.of(*zip(*batch, strict=True), seed=protocol.seed, repeat=repeat)
        for batch in itertools.islice(pairs, protocol.varied_batches(len(test_set.items)))
    )
    return row_multimodality(
        row.source,
        batches,
        evaluator,
        folder,
        seed=protocol.seed,
        repeat=repeat,
        mask_padding=protocol.mask_padding,
        done=bar.update,
    )


def _whole_groups(count: int) -> int:
    """``count`` rounded down to whole groups, unless it is less than one."""
    return count // GROUP * GROUP or count


def _fid_of_another_draw(
    test_set: TestSet,
    evaluator: Evaluator,
    protocol: Protocol,
    repeat: int,
    batches: Sequence[BatchScores],
) -> float:
    """Recordings against other crops of the same recordings: the published "real" FID."""
    count = protocol.clips(len(test_set.items))
    if count < 2:
        return math.nan
    others = test_set.samples(seed=protocol.seed, repeat=repeat, draw_name="other crop")[:count]
    embeddings = []
    for first in range(0, count, GROUP):
        group = others[first : first + GROUP]
        lengths = torch.tensor([sample.length for sample in group])
        embeddings.append(evaluator.embed_motions(padded_features(group), lengths))
    return frechet_distance(torch.cat([batch.real for batch in batches]), torch.cat(embeddings))


def _identity(protocol: Protocol, available: int) -> dict[str, Any]:
    """What decides a batch: neither how many repeats there are, nor how many whole batches."""
    fields = asdict(protocol)
    del fields["repeats"], fields["multimodality"]
    if protocol.clips(available) % GROUP == 0:
        fields["limit"] = None
    return fields
