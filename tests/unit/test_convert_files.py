"""Foreign files: nothing in them is executed, opt.txt is read tolerantly, output is whole or absent."""

from __future__ import annotations

import collections
import os
import pickle

import pytest
import torch

from controlmm.convert.options_file import number, parse_options, read_options
from controlmm.convert.output_folder import new_folder
from controlmm.convert.renaming import load_strictly, renamed
from controlmm.convert.torch_file import find_state_dict, read_torch_file


class _Hostile:
    """Leaves a file behind when it is unpickled."""

    def __init__(self, trace):
        self.trace = trace

    def __reduce__(self):
        return os.system, (f"touch {self.trace}",)


def test_training_state_beside_the_weights_is_read(tmp_path):
    network = torch.nn.Linear(2, 2)
    optimizer = torch.optim.AdamW(network.parameters())
    network(torch.ones(1, 2)).sum().backward()
    optimizer.step()
    scheduler = torch.optim.lr_scheduler.MultiStepLR(optimizer, [50_000])
    whole = {"net": network.state_dict(), "opt": optimizer.state_dict(), "scheduler": scheduler.state_dict()}
    torch.save(whole | {"ep": 3, "total_it": 10}, tmp_path / "latest.tar")
    state = find_state_dict(read_torch_file(tmp_path / "latest.tar"), ("vq_model", "net"))
    assert torch.equal(state["weight"], network.weight)


def test_files_of_old_torch_versions_are_read(tmp_path):
    torch.save({"net": {"w": torch.ones(2)}}, tmp_path / "old.tar", _use_new_zipfile_serialization=False)
    assert read_torch_file(tmp_path / "old.tar")["net"]["w"].tolist() == [1, 1]


def test_half_precision_becomes_float32():
    state = find_state_dict({"net": {"w": torch.ones(2).half(), "n": torch.ones(1).long()}}, ("net",))
    assert (state["w"].dtype, state["n"].dtype) == (torch.float32, torch.int64)


@pytest.mark.parametrize(
    "wrap", [lambda x: {"net": x}, lambda x: {"net": {"w": torch.ones(1)}, "extra": [x]}]
)
def test_a_hostile_pickle_is_refused_and_not_executed(tmp_path, wrap):
    trace, file = tmp_path / "trace", tmp_path / "latest.tar"
    torch.save(wrap(_Hostile(trace)), file)
    with pytest.raises(
        ValueError, match=r"latest\.tar is refused: it is damaged or holds the Python object \w+\.system"
    ):
        read_torch_file(file)
    assert not trace.exists()


def test_a_bare_hostile_pickle_is_refused_and_not_executed(tmp_path):
    trace, file = tmp_path / "trace", tmp_path / "latest.tar"
    file.write_bytes(pickle.dumps(_Hostile(trace)))
    with pytest.raises(ValueError, match="is refused: it is damaged or holds Python objects beside tensors"):
        read_torch_file(file)
    assert not trace.exists()


def test_whole_modules_and_foreign_containers_are_refused(tmp_path):
    for value in (torch.nn.Linear(1, 1), {"net": collections.defaultdict(int)}):
        torch.save(value, tmp_path / "x.tar")
        with pytest.raises(ValueError, match="is refused: it is damaged or holds the Python object"):
            read_torch_file(tmp_path / "x.tar")


@pytest.mark.parametrize("cut", [0, 4, 100, 900])
def test_damaged_files_are_named(tmp_path, cut):
    torch.save({"net": {"w": torch.ones(300)}}, tmp_path / "x.tar")
    (tmp_path / "x.tar").write_bytes((tmp_path / "x.tar").read_bytes()[:cut])
    with pytest.raises(ValueError, match=r"x\.tar is (no readable torch file|refused: it is damaged)"):
        read_torch_file(tmp_path / "x.tar")


def test_what_is_no_dictionary_is_refused(tmp_path):
    torch.save([torch.ones(1)], tmp_path / "x.tar")
    with pytest.raises(ValueError, match="must hold a dictionary with string keys, got list"):
        read_torch_file(tmp_path / "x.tar")
    with pytest.raises(FileNotFoundError, match=r"No checkpoint at .*y\.tar"):
        read_torch_file(tmp_path / "y.tar")


def test_options_are_read_by_kind_and_other_lines_are_passed_over():
    text = """------------ Options -------------
batch_size: 256
feat_bias: 5
is_train: True
lr: 0.0002
weight_decay: 1e-05
lr_scheduler: [150000, 250000]
vq_norm: None
window_size = 64
checkpoints_dir: C:\\here: there
empty:
this line says nothing
-------------- End ----------------
"""
    assert parse_options(text) == {
        "batch_size": 256,
        "feat_bias": 5,
        "is_train": True,
        "lr": 0.0002,
        "weight_decay": 1e-5,
        "lr_scheduler": "[150000, 250000]",
        "vq_norm": "None",
        "window_size": 64,
        "checkpoints_dir": "C:\\here: there",
        "empty": "",
    }


def test_missing_options_have_defaults_and_wrong_ones_are_named(tmp_path):
    assert read_options(tmp_path) == {}
    assert number({}, "n_heads", 6) == 6
    assert number({"mu": 1}, "mu", 0.99) == 1.0
    for value in ("six", True, 6.5):
        with pytest.raises(ValueError, match=r"Option 'n_heads' of opt\.txt must be a number such as 6"):
            number({"n_heads": value}, "n_heads", 6)
    (tmp_path / "opt.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match=r"opt\.txt is no text file"):
        read_options(tmp_path)


def test_names_that_fit_no_rule_are_listed():
    rules = [(r"old\.(.+)", r"new.\1")]
    state = {f"foreign{i}": torch.ones(1) for i in range(7)} | {
        "old.w": torch.ones(1),
        "clip.w": torch.ones(1),
    }
    assert list(renamed({"old.w": torch.ones(1), "clip.w": torch.ones(1)}, rules, ignored=["clip.*"])) == [
        "new.w"
    ]
    with pytest.raises(ValueError, match=r"unknown weights: foreign0, .*, foreign4 and 2 more\."):
        renamed(state, rules, ignored=["clip.*"])


def test_missing_unknown_and_misshapen_weights_are_named():
    linear = torch.nn.Linear(2, 3)
    with pytest.raises(ValueError, match="weights of the thing are incomplete: missing bias; unknown other"):
        load_strictly(linear, {"weight": torch.ones(3, 2), "other": torch.ones(1)}, what="thing")
    with pytest.raises(
        ValueError, match=r"Weight weight of the thing must have shape \(3, 2\), got \(2, 3\)"
    ):
        load_strictly(linear, {"weight": torch.ones(2, 3), "bias": torch.ones(3)}, what="thing")


def test_an_output_folder_appears_whole_or_not_at_all(tmp_path):
    out = tmp_path / "deep" / "model"
    with pytest.raises(IsADirectoryError), new_folder(out) as folder:
        folder.write_text("a folder cannot be written to")
    assert list((tmp_path / "deep").iterdir()) == []
    with new_folder(out) as folder:
        (folder / "file").write_text("x")
        assert not out.exists()
    assert [file.name for file in out.iterdir()] == ["file"]
    with (
        pytest.raises(FileExistsError, match=r"exists already\. Choose another folder or remove it first"),
        new_folder(out),
    ):
        pass
