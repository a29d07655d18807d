"""Data-parallel training: two processes of torchrun against one with the double batch."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

import controlmm
from controlmm.nn.quantizer import EmaCodebook
from controlmm.training.processes import Processes, device_of_process

Command = Callable[..., str]
PATIENCE = 240  # seconds for two processes on a busy machine


def arguments(stage: str, data: Path, root: Path) -> list[str]:
    """Dropout of captions, masks, code draws, dead codes: everything that is random is on."""
    return [
        "train", stage, "--data", str(data), "--config", "tiny", "--text", "hashing", "--out", str(root),
        "--steps", "6", "--batch-size", "3", "--average-decay", "0.9", "--validate-every", "3",
        "--threads", "1", "--quiet",
    ]  # fmt: skip


def in_two_processes(*program: str) -> str:
    started = subprocess.run(
        [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", *program],
        env={**os.environ, "OMP_NUM_THREADS": "1"}, timeout=PATIENCE, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert started.returncode == 0, started.stderr
    return started.stdout


@pytest.mark.parametrize("stage", ["rvq", "masked"])
def test_two_processes_train_as_one_with_the_double_batch(
    stage: str, tiny_data_folder: Path, tmp_path: Path, command: Command
) -> None:
    """Bit for bit: a sum of two numbers does not depend on their order."""
    together, alone = tmp_path / "together", tmp_path / "alone"
    if stage != "rvq":
        for root in (together, alone):
            command(*arguments("rvq", tiny_data_folder, root))
    in_two_processes("--module", controlmm.__name__, *arguments(stage, tiny_data_folder, together))
    command(*arguments(stage, tiny_data_folder, alone), "--shards", "2")

    for file in ("checkpoint.safetensors", "best/model.safetensors"):
        expected, actual = (load_file(root / stage / file) for root in (alone, together))
        assert expected.keys() == actual.keys()
        for name, value in expected.items():
            assert torch.equal(actual[name], value), name
    logs = [(root / stage / "metrics.jsonl").read_text() for root in (alone, together)]
    assert logs[0] == logs[1]
    assert '"loss"' in logs[0] or '"val_score"' in logs[0]
    (start,) = (together / stage / "starts.jsonl").read_text().splitlines()  # one process writes
    assert json.loads(start)["processes"] == 2
    settings = json.loads((together / stage / "run.json").read_text())["settings"]
    assert (settings["shards"], settings["batch_size"]) == (2, 3)


LEAVES_ALONE = """
import os
import torch
from controlmm.training.processes import joined_processes

with joined_processes() as team:
    weight = torch.nn.Parameter(torch.ones(2))
    optimizer = torch.optim.AdamW([weight])  # imports what keeps groups as default arguments
    weight.sum().backward()
    optimizer.step()
    team.sum_([weight.detach()])
names = [open(f"/proc/self/task/{task}/comm").read().strip() for task in os.listdir("/proc/self/task")]
print([name for name in names if "gloo" in name])
"""


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="threads are listed on Linux only")
def test_no_thread_of_the_group_outlives_it(tmp_path: Path) -> None:
    """One that did has aborted a process while the interpreter ended."""
    script = tmp_path / "leaves_alone.py"
    script.write_text(LEAVES_ALONE, encoding="utf-8")
    assert in_two_processes(str(script)).count("[]") == 2


def test_each_process_takes_its_part_of_the_shards() -> None:
    assert [list(Processes(rank, 2).share_of(4)) for rank in range(2)] == [[0, 1], [2, 3]]
    assert list(Processes().share_of(3)) == [0, 1, 2]


def test_a_process_alone_changes_no_tensor() -> None:
    tensor = torch.arange(3.0)
    Processes().sum_([tensor])
    Processes().copy_from_first_(tensor, has_one=False)
    assert tensor.tolist() == [0, 1, 2]
    assert Processes().agree([1.5]) == [1.5]


def test_a_device_that_is_not_there_is_named() -> None:
    assert device_of_process("cpu") == torch.device("cpu")
    with pytest.raises(ValueError, match=r"`device` must be one that torch can use here.*got 'warp'"):
        device_of_process("warp")
    if not torch.cuda.is_available():
        with pytest.raises(ValueError, match=r"`device` must be one that torch can use here.*got 'cuda:0'"):
            device_of_process("cuda")


def test_deferred_updates_of_two_batches_are_one_update_of_their_union() -> None:
    """The codebook after both deferred batches equals one that saw their vectors as a single batch."""
    vectors = torch.randn(40, 4, generator=torch.Generator().manual_seed(0))
    ids = torch.arange(40) % 5
    deferred, direct = EmaCodebook(5, 4, decay=0.9), EmaCodebook(5, 4, decay=0.9)
    for book in (deferred, direct):
        book.codes.copy_(vectors[:5])
        book.ema_sum.copy_(book.codes * 4)
        book.ema_count.fill_(4.0)
    before = deferred.codes.clone()
    deferred.is_deferred = True
    deferred.update(vectors[:20], ids[:20])
    deferred.update(vectors[20:], ids[20:])
    assert torch.equal(deferred.codes, before)
    deferred.apply_update(deferred.pending())
    direct.update(vectors, ids)
    torch.testing.assert_close(deferred.codes, direct.codes, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(deferred.ema_count, direct.ema_count)


def test_forgotten_updates_change_nothing() -> None:
    book = EmaCodebook(3, 2, decay=0.9)
    book.codes.copy_(torch.arange(6.0).view(3, 2))
    book.is_deferred = True
    book.update(torch.ones(4, 2), torch.tensor([0, 1, 2, 0]))
    book.forget_pending()
    book.apply_update(book.pending())
    assert torch.equal(book.codes, torch.arange(6.0).view(3, 2))
