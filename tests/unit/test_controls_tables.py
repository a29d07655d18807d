"""Controls from CSV tables and NumPy arrays: the user's own trajectory."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from controlmm.controls import densify, load_controls


def csv_file(tmp_path, text):
    path = tmp_path / "path.csv"
    path.write_text(text, encoding="utf-8")
    return path


def complaint_about(path):
    try:
        load_controls(path)
    except ValueError as error:
        return str(error)
    return ""


def error_of(path):
    with pytest.raises(ValueError, match=re.escape(str(path))) as caught:
        load_controls(path)
    assert "\n" not in str(caught.value)
    return str(caught.value).removeprefix(f"{path}: ")


# --- CSV ------------------------------------------------------------


def test_a_table_gives_one_control_for_each_joint(tmp_path):
    file = load_controls(
        csv_file(
            tmp_path, "frame,joint,x,y,z\n0,pelvis,0,,0\n10,right_wrist,-0.3,1.2,0.5\n\n20,pelvis,0,,1.5\n"
        )
    )
    assert [control.label for control in file.controls] == ["pelvis", "right_wrist"]
    dense = densify(file.controls, 21)
    assert dense.targets[20, 0].tolist() == [0, 0, 1.5]
    assert dense.mask[20, 0].tolist() == [True, False, True]
    assert dense.mask[10, 21].all()
    assert (file.seconds, file.text) == (None, None)


def test_column_order_case_spaces_index_and_byte_order_mark(tmp_path):
    path = tmp_path / "path.csv"
    path.write_text("Z, Y ,X,Joint,Frame\r\n3, 2, 1, 15, 4\r\n", encoding="utf-8-sig", newline="")
    dense = densify(load_controls(path).controls, 5)
    assert dense.targets[4, 15].tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "line 1: the columns must be frame,joint,x,y,z, got nothing."),
        ("0,pelvis,0,0,0\n", "line 1: the columns must be frame,joint,x,y,z, got 0,pelvis,0,0,0."),
        ("frame,joint,x,y,z\n", "the table has no rows, so it controls nothing."),
        (
            "frame;joint;x;y;z\n0;pelvis;0;0;0\n",
            "line 1: the columns must be frame,joint,x,y,z, got frame;joint;x;y;z. Separate them by commas.",
        ),
        ("frame,joint,x,y,z\n0,pelvis,0,0\n", "line 2: expected 5 values (frame,joint,x,y,z), got 4."),
        ("frame,joint,x,y,z\n0,pelvis,0,0,0,0\n", "line 2: expected 5 values (frame,joint,x,y,z), got 6."),
        (
            "frame,joint,x,y,z\n0,pelvis,0,0,0\n1.5,pelvis,0,0,0\n",
            "line 3: `frame` must be a whole number from 0, got '1.5'.",
        ),
        ("frame,joint,x,y,z\n-1,pelvis,0,0,0\n", "line 2: `frame` must be a whole number from 0, got '-1'."),
        ("frame,joint,x,y,z\n0,,0,0,0\n", "line 2: `joint` is empty. Name a joint, such as pelvis."),
        (
            "frame,joint,x,y,z\n0,pelvis,0,up,0\n",
            "line 2: `y` must be a number in metres or empty, got 'up'.",
        ),
        (
            "frame,joint,x,y,z\n0,tail,0,0,0\n",
            'joint tail: Unknown joint "tail". The humanml3d skeleton has:',
        ),
        (
            "frame,joint,x,y,z\n7,pelvis,0,nan,0\n",
            "joint pelvis: `positions[0]` (frame 7) must be finite, got (0, nan, 0).",
        ),
        (
            "frame,joint,x,y,z\n7,pelvis,0,0,0\n7,pelvis,0,0,0\n",
            "joint pelvis: `frames` names frame 7 twice.",
        ),
        ("frame,joint,x,y,z\n7,pelvis,,,\n", "joint pelvis: Every axis is free at frame 7."),
    ],
    ids=[
        "empty", "no header", "no rows", "semicolons", "short row", "long row", "frame 1.5", "frame -1",
        "no joint", "text", "unknown joint", "nan", "doubled", "all free",
    ],
)  # fmt: skip
def test_a_mistake_in_a_table_is_named(tmp_path, text, expected):
    assert error_of(csv_file(tmp_path, text)).startswith(expected)


def test_bytes_that_are_no_text_are_refused(tmp_path):
    (tmp_path / "path.csv").write_bytes(b"\xff\xfe\x00")
    assert error_of(tmp_path / "path.csv").startswith("not a CSV table in UTF-8")


# --- NumPy ------------------------------------------------------------


def sparse_targets():
    array = np.full((30, 22, 3), np.nan, dtype=np.float32)
    array[::10, 0] = [0.1, 0.9, 0.2]
    array[5, 21, 1] = 1.6
    return array


def test_an_array_controls_where_it_has_numbers(tmp_path):
    array = sparse_targets()
    np.save(tmp_path / "a.npy", array)
    file = load_controls(tmp_path / "a.npy")
    dense = densify(file.controls, 30)
    assert file.seconds == 1.5
    assert torch.equal(dense.mask, torch.from_numpy(~np.isnan(array)))
    assert torch.equal(dense.targets, torch.from_numpy(np.nan_to_num(array)))


@pytest.mark.parametrize("names", [("positions",), ("joints", "fps"), ("anything",)])
def test_an_archive_gives_its_positions_or_only_array(tmp_path, names):
    np.savez(
        tmp_path / "a.npz",
        **{name: sparse_targets() if i == 0 else np.array(20) for i, name in enumerate(names)},
    )
    assert [control.label for control in load_controls(tmp_path / "a.npz").controls] == [
        "pelvis",
        "right_wrist",
    ]


@pytest.mark.parametrize(
    ("array", "expected"),
    [
        (
            np.zeros((5, 3)),
            "expected an array of shape (T, 22, 3), metres, NaN where free; got (5, 3). For the path of one",
        ),
        (np.zeros((5, 22, 2)), "expected an array of shape (T, 22, 3)"),
        (np.zeros((5, 22, 3), dtype=int), "expected an array of floats, got int64."),
        (np.full((5, 22, 3), np.nan), "every value is NaN, so the array controls nothing."),
        (
            np.full((5, 22, 3), np.inf),
            "joint pelvis: `positions[0]` (frame 0) must be finite, got (inf, inf, inf).",
        ),
        (np.array([{}], dtype=object), "not a readable NumPy file (Object arrays cannot be loaded"),
    ],
    ids=["one joint", "two axes", "integers", "all nan", "infinite", "pickled"],
)
def test_a_wrong_array_is_refused(tmp_path, array, expected):
    np.save(tmp_path / "a.npy", array)
    assert error_of(tmp_path / "a.npy").startswith(expected)


def test_wrong_archives_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", one=np.zeros(1), two=np.zeros(1))
    assert error_of(tmp_path / "a.npz") == "expected an array named positions or joints, got one, two."
    np.save(tmp_path / "b.npy", sparse_targets())
    (tmp_path / "b.npy").rename(tmp_path / "b.npz")
    assert error_of(tmp_path / "b.npz") == "not an .npz archive."
    np.savez(tmp_path / "c.npz", positions=np.array([{}], dtype=object))
    assert error_of(tmp_path / "c.npz").startswith("not a readable .npz archive (Object arrays cannot be")
    np.savez(tmp_path / "d.npz", positions=sparse_targets())
    (tmp_path / "d.npz").rename(tmp_path / "d.npy")
    assert error_of(tmp_path / "d.npy").startswith("expected an array of floats, got NpzFile.")


@settings(max_examples=600, deadline=None)
@given(suffix=st.sampled_from(["npy", "npz", "csv"]), cut=st.floats(0, 1), flip=st.integers(0, 10_000))
def test_a_damaged_file_loads_or_says_why(tmp_path_factory, suffix, cut, flip):
    path = tmp_path_factory.mktemp("damaged") / f"a.{suffix}"
    if suffix == "npy":
        np.save(path, sparse_targets())
    elif suffix == "npz":
        np.savez_compressed(path, positions=sparse_targets())
    else:
        path.write_text("frame,joint,x,y,z\n0,pelvis,0,0,0\n", encoding="utf-8")
    content = bytearray(path.read_bytes())
    content[flip % len(content)] ^= 0x55
    path.write_bytes(content[: max(1, int(cut * len(content)))])
    complaint = complaint_about(path)
    assert not complaint or complaint.startswith(f"{path}: ")
    assert "\n" not in complaint
