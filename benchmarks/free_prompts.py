"""Sixty prompts in words of our own, from no caption: how many motions do what was asked.

python -m benchmarks.free_prompts [--model FOLDER] [--samples 4] [--data DATA]

Every prompt is also asked with left and right exchanged, and then the mirrored facts are expected.
Facts are measured on the joints (:mod:`controlmm.evaluation.facts`).
"""

import argparse
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from controlmm import ControlMM
from controlmm.data import MotionFolder
from controlmm.evaluation.facts import Range, measured_facts, mirrored_expectation, missed
from controlmm.motion.mirror import mirror_text

PROMPTS_FILE = Path(__file__).with_name("free_prompts.json")


@dataclass(frozen=True)
class FreePrompt:
    """What is asked, for how long, and what must be measured then."""

    prompt: str
    seconds: float
    expect: Mapping[str, Range]

    def mirrored(self) -> "FreePrompt":
        return FreePrompt(mirror_text(self.prompt), self.seconds, mirrored_expectation(self.expect))


def load_prompts(path: Path = PROMPTS_FILE) -> list[FreePrompt]:
    """The prompts of a JSON file: a list of objects with ``prompt``, ``seconds``, ``expect``."""
    entries = json.loads(path.read_text(encoding="utf-8"))
    return [
        FreePrompt(e["prompt"], e["seconds"], {name: tuple(limits) for name, limits in e["expect"].items()})
        for e in entries
    ]


def known_captions(prompts: Iterable[FreePrompt], captions: Iterable[str]) -> list[str]:
    """Prompts that are a caption already, small and capital letters and the final period not counted."""
    plain = {_plain(caption) for caption in captions}
    return [p.prompt for p in prompts if _plain(p.prompt) in plain]


def misses(pipeline: ControlMM, prompt: FreePrompt, *, samples: int, seed: int) -> list[list[str]]:
    """For each of ``samples`` motions the facts that are not as expected."""
    result = pipeline(prompt.prompt, seconds=prompt.seconds, samples=samples, seed=seed, preset="fast")
    return [missed(measured_facts(motion.joints), prompt.expect) for motion in result]


def main() -> None:
    """Print one row for each prompt and the totals."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", type=Path, help="model folder; by default the one that ships")
    parser.add_argument("--samples", type=int, default=4, help="motions for each prompt and its mirror image")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--data", type=Path, help="folder whose captions must not hold a prompt")
    arguments = parser.parse_args()
    prompts = load_prompts()
    if arguments.data is not None:
        _refuse_known(prompts, arguments.data)
    pipeline = ControlMM.from_pretrained(arguments.model)
    print(f"{'as written':>10} {'mirrored':>8}  prompt")
    totals = []
    for prompt in prompts:
        rows = [
            misses(pipeline, version, samples=arguments.samples, seed=arguments.seed)
            for version in (prompt, prompt.mirrored())
        ]
        totals.append([_held(row) for row in rows])
        failed = sorted({name for row in rows for names in row for name in names})
        counts = [f"{_held(row)}/{arguments.samples}" for row in rows]
        print(f"{counts[0]:>10} {counts[1]:>8}  {prompt.prompt}  [{', '.join(failed)}]", flush=True)
    for index, title in enumerate(("as written", "mirrored")):
        held = sum(row[index] for row in totals)
        first = held / (len(prompts) * arguments.samples)
        most = sum(2 * row[index] > arguments.samples for row in totals)
        print(f"{title}: {first:.1%} of the motions hold; {most} of {len(prompts)} prompts in most motions")


def _refuse_known(prompts: Sequence[FreePrompt], data: Path) -> None:
    folder = MotionFolder(data)
    captions = (
        caption.text
        for split in ("train", "val", "test")
        for c in folder.clips(split)
        for caption in c.captions
    )
    known = known_captions(prompts, captions)
    if known:
        raise SystemExit(f"These prompts are captions of {data}: {'; '.join(known)}")


def _held(row: Sequence[Sequence[str]]) -> int:
    return sum(not names for names in row)


def _plain(text: str) -> str:
    return " ".join(text.lower().split()).rstrip(".")


if __name__ == "__main__":
    main()
