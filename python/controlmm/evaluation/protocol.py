"""The papers' evaluation: batches of 32 test samples, repeats with new draws, one file a batch.

A killed run loses at most one batch: the same call goes on where it was stopped.
"""

from __future__ import annotations

import json
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
from controlmm.evaluation.motion_sources import Batch, MotionSource, RealMotion, padded_features
from controlmm.evaluation.random_streams import stream
from controlmm.evaluation.retrieval import GROUP
from controlmm.evaluation.scores import RowScores, repeat_scores
from controlmm.evaluation.test_set import MAX_FRAMES, Sample, TestSet
from controlmm.io.atomic import replaced_on_success

ROW_FILE = "row.json"


@dataclass(frozen=True)
class Protocol:
    """How an evaluation draws, and on how much.

    Attributes:
        repeats: Evaluations with other captions, crops, controls and noise.
        limit: Samples a repeat, rounded down to whole batches of 32; ``None`` takes all. Fewer than 32 make
            one incomplete batch, for which R-precision is not defined.
        seed: Of all draws.
        mask_padding: See :func:`controlmm.evaluation.batch_scores.score_batch`.
    """

    repeats: int = 1
    limit: int | None = None
    seed: int = 0
    mask_padding: bool = False

    def __post_init__(self) -> None:
        for name, value in (("repeats", self.repeats), ("limit", self.limit)):
            if value is not None and value < 1:
                raise ValueError(f"`{name}` must be at least 1, got {value}.")
        if self.seed < 0:
            raise ValueError(f"`seed` must not be negative, got {self.seed}.")

    def clips(self, available: int) -> int:
        """Samples in a repeat when there are ``available``."""
        count = available if self.limit is None else min(self.limit, available)
        return count // GROUP * GROUP or count


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
    progress: bool = True,
) -> list[RowScores]:
    """Scores of all rows, on the same samples; those with the same setting also meet the same targets.

    Args:
        rows: Rows with different labels.
        test_set: Items to draw from.
        evaluator: Makes the embeddings; must take the features of ``test_set``.
        protocol: Repeats, limit, seed.
        out: Folder for a file a batch; what is there already is not computed again.
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
    folders = _folders(rows, Path(out))
    shared = {
        "protocol": _identity(protocol), "data": test_set.sha256, "captions": list(test_set.kinds),
        "split": test_set.split, "evaluator": evaluator.name,
    }  # fmt: skip
    abouts = []
    for row, folder in zip(rows, folders, strict=True):
        row.setting.check(test_set.skeleton)
        abouts.append({"label": row.label, **row.source.describe(), **asdict(row.setting)})
        _claim(folder, {**abouts[-1], **shared})
    batches = -(-protocol.clips(len(test_set.items)) // GROUP)
    with tqdm(total=len(rows) * protocol.repeats * batches, unit="batch", disable=not progress) as bar:
        return [
            _evaluate_row(row, about, test_set, evaluator, protocol, folder, bar)
            for row, about, folder in zip(rows, abouts, folders, strict=True)
        ]


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
        if isinstance(row.source, RealMotion):
            values["fid"] = _fid_of_another_draw(test_set, evaluator, protocol, repeat, found)
        for name, value in values.items():
            repeats.setdefault(name, []).append(value)
    return RowScores(row.label, repeats, protocol.clips(len(test_set.items)), about)


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


def _identity(protocol: Protocol) -> dict[str, Any]:
    """All but the number of repeats: more of them go on where fewer ended."""
    fields = asdict(protocol)
    del fields["repeats"]
    return fields


def _folders(rows: Sequence[Row], out: Path) -> list[Path]:
    names = ["".join(c if c.isalnum() else "-" for c in row.label.lower()).strip("-") for row in rows]
    if len(set(names)) < len(names):
        raise ValueError(f"Rows must have different labels, got {', '.join(row.label for row in rows)}.")
    return [out / "batches" / name for name in names]


def _claim(folder: Path, about: dict[str, Any]) -> None:
    """Write down what the folder holds, or check that it holds just that."""
    file = folder / ROW_FILE
    text = json.dumps(about, indent=2, sort_keys=True) + "\n"
    if file.is_file():
        try:
            before = json.loads(file.read_text(encoding="utf-8"))
        except json.JSONDecodeError:
            before = {}
        now = json.loads(text)
        changed = sorted(key for key in before.keys() | now.keys() if before.get(key) != now.get(key))
        if changed:
            raise ValueError(
                f"{folder} holds an evaluation with another {', '.join(changed)}. Go on with the same "
                "settings or choose another `--out`."
            )
        return
    folder.mkdir(parents=True, exist_ok=True)
    with replaced_on_success(file) as partial:
        partial.write_text(text, encoding="utf-8")
