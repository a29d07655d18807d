"""TLControl's published files to a model folder: layout, statistics, refusals."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
import torch
from published_tlcontrol import (
    PAPER,
    SMALL,
    TOKENIZER,
    TRANSFORMER,
    tokenizer_shapes,
    transformer_shapes,
    write_published,
)

from controlmm.controls import JointControl
from controlmm.convert.pickled_array import read_vector
from controlmm.convert.tlcontrol import convert
from controlmm.models.part_vq_vae import PartVqVaeConfig
from controlmm.models.trajectory_transformer import TrajectoryTransformerConfig
from controlmm.pipelines import TLControl, TLControlPreset
from controlmm.text.hashing import HashingTextEncoder


class ClipStub(HashingTextEncoder):
    """Stands for CLIP: its kind and width, hashed features."""

    def config(self):
        return {"kind": "clip", "dim": self.dim, "weights_sha256": "any"}


def load(folder):
    return TLControl.from_pretrained(folder, text_encoder=ClipStub(512))


@pytest.fixture
def published(tmp_path):
    return write_published(tmp_path / "authors", SMALL)


def test_a_published_folder_becomes_a_pipeline_that_generates(published, tmp_path):
    report = convert([published], tmp_path / "model")
    pipeline = load(tmp_path / "model")
    control = JointControl("pelvis", frames=[0, 20], positions=[[0, 0.9, 0], [0, 0.9, 0.5]])
    result = pipeline("a person walks", frames=24, controls=[control], preset=TLControlPreset(iterations=3))
    assert result.best.joints.shape == (24, 22, 3)
    assert torch.isfinite(result.best.joints).all()
    assert result.latents.shape[1] == 49
    assert {"tokenizer", "trajectory transformer", "mean of 263", "std of 263"} < set(report.used)


def test_statistics_are_the_checkpoints_own(published, tmp_path):
    convert([published], tmp_path / "model")
    pipeline = load(tmp_path / "model")
    mean = pickle.loads((published / "motion_mean.pkl").read_bytes())
    assert torch.equal(pipeline.decoder.normalizer.mean, torch.from_numpy(mean))
    assert torch.equal(pipeline.transformer.trajectory_std, torch.tensor([0.5, 0.6, 0.9]))


def test_without_trajectory_statistics_those_of_the_demo_are_taken(published, tmp_path):
    (published / "traj_mean.pt").unlink()
    report = convert([published], tmp_path / "model")
    mean = load(tmp_path / "model").transformer.trajectory_mean
    assert torch.equal(mean, torch.tensor([0.00015, 0.7405, 0.3502]))
    assert any("No trajectory statistics" in note for note in report.notes)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (TOKENIZER, "No tokenizer among the files: a bare state dict"),
        (TRANSFORMER, "No trajectory transformer among the files"),
        ("motion_std.pkl", "No feature statistics among the files: two vectors of 263 numbers"),
    ],
)
def test_missing_files_are_named_and_nothing_is_written(published, tmp_path, name, message):
    (published / name).unlink()
    with pytest.raises(FileNotFoundError, match=message):
        convert([published], tmp_path / "model")
    assert not (tmp_path / "model").exists()


@pytest.mark.parametrize("file", [TOKENIZER, TRANSFORMER])
def test_unknown_and_missing_weights_are_named(published, tmp_path, file):
    state = torch.load(published / file, weights_only=True)
    torch.save({**state, "vqvae.extra.weight": torch.ones(2)}, published / file)
    with pytest.raises(ValueError, match=r"unknown weights: (vqvae\.)?extra\.weight"):
        convert([published], tmp_path / "model")
    dropped = next(name for name in state if name.endswith("conv2.bias") or name.endswith("norm2.bias"))
    torch.save({name: tensor for name, tensor in state.items() if name != dropped}, published / file)
    with pytest.raises(ValueError, match="are incomplete: missing"):
        convert([published], tmp_path / "model")


class Evil:
    """Would run a function when it is unpickled."""

    def __reduce__(self):
        return (print, ("executed",))


def test_pickled_statistics_cannot_run_code(published, tmp_path, capsys):
    (published / "motion_mean.pkl").write_bytes(pickle.dumps(Evil()))
    with pytest.raises(ValueError, match=r"motion_mean\.pkl is refused: .* Nothing of it was executed"):
        convert([published], tmp_path / "model")
    assert "executed" not in capsys.readouterr().out


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_pickled_arrays_of_every_protocol_are_read(tmp_path, protocol):
    values = np.array([0.5, -1.0, 2.0], dtype=np.float32)
    path = tmp_path / "mean.pkl"
    path.write_bytes(pickle.dumps(values, protocol=protocol))
    assert torch.equal(read_vector(path), torch.tensor([0.5, -1.0, 2.0], dtype=torch.float64))


@pytest.mark.parametrize("content", [b"", b"no array", pickle.dumps([1, 2]), pickle.dumps(np.ones((2, 2)))])
def test_anything_but_a_vector_of_numbers_is_refused(tmp_path, content):
    path = tmp_path / "mean.npy"
    path.write_bytes(content)
    with pytest.raises(ValueError, match="must hold one vector of floating-point numbers"):
        read_vector(path)


@pytest.mark.parametrize(
    ("name", "shapes"), [("tlcontrol_vqvae", tokenizer_shapes), ("tlcontrol_mtt", transformer_shapes)]
)
def test_the_layout_of_these_tests_is_that_of_the_authors_classes(shared, name, shapes):
    lines = (shared / "reference" / "state_dicts" / f"{name}.tsv").read_text().splitlines()[1:]
    dumped = {line.split("\t")[0]: tuple(map(int, line.split("\t")[1].split("x"))) for line in lines}
    assert dumped == shapes(PAPER)


def test_the_published_sizes_become_the_paper_configurations():
    """From shapes alone: the weights of the full size take seconds to draw."""
    from controlmm.convert.tlcontrol import import_part_vq, import_transformer

    with torch.device("meta"):
        vq = {name: torch.empty(shape) for name, shape in tokenizer_shapes(PAPER).items()}
        mtt = {name: torch.empty(shape) for name, shape in transformer_shapes(PAPER).items()}
        assert import_part_vq(vq).config == PartVqVaeConfig.paper()
        assert import_transformer(mtt).config == TrajectoryTransformerConfig.paper()
    assert math.prod((512, 12)) == mtt["linear_in.weight"].numel()


def test_the_command_converts_and_refuses_what_belongs_to_controlmm(published, tmp_path, command, refused):
    printed = command("convert", published, "--out", tmp_path / "model", "--kind", "tlcontrol")
    assert "trajectory transformer" in printed
    assert load(tmp_path / "model").kind == "tlcontrol"
    error = refused(
        "convert", published, "--out", tmp_path / "other", "--kind", "tlcontrol", "--control", "pelvis"
    )
    assert "`--control` is for --kind controlmm" in error
