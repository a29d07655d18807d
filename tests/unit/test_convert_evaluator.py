"""The published evaluator's files, read safely and turned into one folder."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from controlmm.convert.evaluator import convert_evaluator
from controlmm.data import Caption
from controlmm.evaluation.evaluators import PublishedEvaluator, load_evaluator
from controlmm.models.text_motion_matching import MatchingConfig, TextMotionMatching

WORDS = ("sos", "eos", "unk", "a", "person", "walk")


class Published:
    """The authors' files with seeded weights of small networks."""

    def __init__(self, folder: Path) -> None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            self.network = TextMotionMatching(MatchingConfig.tiny()).eval()
        self.checkpoint, self.statistics, self.words = (
            folder / "finest.tar",
            folder / "comp",
            folder / "glove",
        )
        parts = ("movement_encoder", "motion_encoder", "text_encoder")
        self.states = {part: getattr(self.network, part).state_dict() for part in parts}
        self.save(opt_text_encoder={"state": {}, "param_groups": [{"lr": 1e-4}]}, epoch=29, iter=100)
        (self.statistics / "meta").mkdir(parents=True)
        random = np.random.default_rng(0)
        np.save(self.statistics / "meta" / "mean.npy", random.normal(size=263))
        np.save(self.statistics / "meta" / "std.npy", random.uniform(0.5, 2, size=263))
        self.words.mkdir()
        np.save(self.words / "our_vab_data.npy", random.normal(size=(len(WORDS), 300)))
        # Rows need not come in order.
        index = {word: row for row, word in reversed(list(enumerate(WORDS)))}
        (self.words / "our_vab_idx.pkl").write_bytes(pickle.dumps(index))

    def save(self, **others: object) -> None:
        torch.save({**self.states, **others}, self.checkpoint)

    def convert(self, out: Path) -> Path:
        return convert_evaluator(self.checkpoint, statistics=self.statistics, words=self.words, out=out).out


@pytest.fixture
def published(tmp_path: Path) -> Published:
    return Published(tmp_path)


def test_the_folder_gives_the_networks_statistics_and_words_back(
    published: Published, tmp_path: Path
) -> None:
    evaluator = load_evaluator(published.convert(tmp_path / "out"))
    assert isinstance(evaluator, PublishedEvaluator)
    assert evaluator.feature_dim == 263
    mean, std = (
        torch.from_numpy(np.load(published.statistics / "meta" / f"{name}.npy")) for name in ("mean", "std")
    )
    features = torch.randn(2, 40, 263, generator=torch.Generator().manual_seed(1))
    lengths = torch.tensor([40, 24])
    raw = (features * std + mean).float()
    torch.testing.assert_close(
        evaluator.embed_motions(raw, lengths), published.network.embed_motions(features, lengths)
    )
    table = torch.from_numpy(np.load(published.words / "our_vab_data.npy")).float()
    caption = Caption("a person", tokens=("a/DET", "person/NOUN"))
    words = torch.zeros(1, 22, 300)
    words[0, :4], words[0, 4:] = table[[0, 3, 4, 1]], table[2]
    tags = torch.nn.functional.one_hot(torch.tensor([[14, 2, 1, 14] + [14] * 18]), 15).float()
    expected = published.network.embed_words(words, tags, torch.tensor([4]))
    torch.testing.assert_close(evaluator.embed_captions([caption]), expected)


def test_captions_without_tokens_are_refused(published: Published, tmp_path: Path) -> None:
    evaluator = load_evaluator(published.convert(tmp_path / "out"))
    with pytest.raises(ValueError, match="has no word/TAG tokens, which this evaluator needs"):
        evaluator.embed_captions([Caption("a person walks")])


class _Hostile:
    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[object, ...]:
        return os.system, (f"touch {self.trace}",)


@pytest.mark.parametrize("where", ["checkpoint", "words"])
def test_a_hostile_file_is_refused_without_running_it(
    published: Published, tmp_path: Path, where: str
) -> None:
    trace = tmp_path / "trace"
    if where == "checkpoint":
        published.save(epoch=_Hostile(trace))
    else:
        (published.words / "our_vab_idx.pkl").write_bytes(pickle.dumps({"sos": _Hostile(trace)}))
    with pytest.raises(ValueError, match="is refused: it is damaged or holds"):
        published.convert(tmp_path / "out")
    assert not trace.exists()
    assert not (tmp_path / "out").exists()


def _drop_motion(published: Published) -> None:
    del published.states["motion_encoder"]
    published.save()


def _drop_weight(published: Published) -> None:
    del published.states["text_encoder"]["pos_emb.bias"]
    published.save()


def _widen_index(published: Published) -> None:
    index = {word: row + 1 for row, word in enumerate(WORDS)}
    (published.words / "our_vab_idx.pkl").write_bytes(pickle.dumps(index))


def _no_index(published: Published) -> None:
    (published.words / "our_vab_idx.pkl").write_bytes(pickle.dumps(list(WORDS)))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_drop_motion, "is no text-motion evaluator: it lacks motion_encoder"),
        (_drop_weight, r"The weights of the text encoder are incomplete: missing pos_emb\.bias"),
        (_widen_index, "names rows beyond the 6"),
        (_no_index, "must hold a dictionary from words to rows"),
    ],
)
def test_damaged_files_are_named(
    published: Published, tmp_path: Path, damage: Callable[[Published], None], message: str
) -> None:
    damage(published)
    with pytest.raises(ValueError, match=message):
        published.convert(tmp_path / "out")


def test_missing_files_are_named(published: Published, tmp_path: Path) -> None:
    (published.words / "our_vab_data.npy").unlink()
    with pytest.raises(FileNotFoundError, match=r"No our_vab_data\.npy"):
        published.convert(tmp_path / "out")
    with pytest.raises(FileNotFoundError, match="Train one with `controlmm train evaluator`, or convert"):
        load_evaluator(tmp_path / "nowhere")
