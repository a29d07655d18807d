"""Published folders to a model folder: layout, optional parts, mismatches, refusals."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from published_layout import (
    JOINTS,
    MASKED,
    PAPER,
    PELVIS,
    RESIDUAL,
    RVQ,
    SMALL,
    SMALL_KIT,
    Sizes,
    control_shapes,
    length_shapes,
    masked_shapes,
    random_state,
    residual_shapes,
    rvq_shapes,
    write_published,
    write_run,
)

from controlmm.controls import JointControl
from controlmm.convert.controlmm import convert
from controlmm.models.control_branch import ControlBranchConfig
from controlmm.models.length_estimator import LengthEstimator
from controlmm.models.masked_transformer import MaskedTransformerConfig
from controlmm.models.residual_transformer import ResidualTransformerConfig
from controlmm.models.rvq_vae import RvqVaeConfig
from controlmm.pipelines import ControlMM
from controlmm.text.hashing import HashingTextEncoder


class ClipStub(HashingTextEncoder):
    """Stands for CLIP: its kind and width, hashed features."""

    def config(self):
        return {"kind": "clip", "dim": self.dim, "weights_sha256": "any"}


def load(folder, size: Sizes = SMALL):
    return ControlMM.from_pretrained(folder, text_encoder=ClipStub(size.text))


@pytest.fixture
def published(tmp_path):
    return write_published(tmp_path / "t2m", SMALL)


def test_a_published_folder_becomes_a_pipeline_that_generates(published, tmp_path):
    report = convert([published], tmp_path / "model")
    pipeline = load(tmp_path / "model")
    result = pipeline(
        "a person walks",
        frames=24,
        controls=[JointControl("pelvis", frames=[0, 20], positions=[[0, 0.9, 0], [0, 0.9, 0.5]])],
        preset="fast",
    )
    assert result.best.joints.shape == (24, 22, 3)
    assert torch.isfinite(result.best.joints).all()
    assert pipeline.control.config.joints == (0, 10, 11, 15, 20, 21)
    assert set(report.used) == {
        "tokenizer", "residual transformer", "masked transformer", "control", "length estimator"
    }  # fmt: skip


def test_statistics_are_the_checkpoints_own(published, tmp_path):
    import numpy as np

    convert([published], tmp_path / "model")
    std = np.load(published / RVQ / "meta" / "std.npy")
    assert torch.equal(load(tmp_path / "model").decoder.normalizer.std, torch.from_numpy(std).float())


def test_imports_keep_the_published_signal_and_feed_the_frozen_trunk(published, tmp_path):
    convert([published], tmp_path / "model")
    config = load(tmp_path / "model").control.config
    assert (config.has_observation_mask, config.into_frozen_trunk) == (False, True)


def test_the_base_comes_from_the_control_checkpoint(published, tmp_path):
    """It was retrained there; the plain masked transformer beside it is another network."""
    report = convert([published], tmp_path / "model")
    expected = random_state(control_shapes(SMALL), seed=5)["token_emb.weight"]
    assert torch.equal(load(tmp_path / "model").transformer.token_embedding.weight, expected)
    assert "The control checkpoint brings the base transformer that it was trained with." in report.notes


def test_the_kind_of_control_can_be_chosen_and_follows_from_the_signals_width(published, tmp_path):
    convert([published], tmp_path / "model", control="pelvis")
    assert load(tmp_path / "model").control.config.joints == (0,)


def test_a_kind_of_control_that_is_not_there_is_named(tmp_path):
    root = write_published(tmp_path / "t2m", SMALL, leave_out=[PELVIS])
    with pytest.raises(FileNotFoundError, match="No control checkpoint of kind 'pelvis'"):
        convert([root], tmp_path / "model", control="pelvis")
    assert not (tmp_path / "model").exists()


def test_without_a_control_checkpoint_the_branch_changes_nothing(tmp_path):
    root = write_published(tmp_path / "t2m", SMALL, leave_out=[JOINTS, PELVIS])
    report = convert([root], tmp_path / "model")
    pipeline = load(tmp_path / "model")
    assert not any(zero.weight.any() for zero in (pipeline.control.first_zero, *pipeline.control.mid_zeros))
    expected = random_state(masked_shapes(SMALL), seed=2)["token_emb.weight"]
    assert torch.equal(pipeline.transformer.token_embedding.weight, expected)
    assert "No control checkpoint: the model follows its targets by editing alone." in report.notes


def test_a_kit_folder_becomes_a_pipeline_that_generates(tmp_path):
    root = write_published(tmp_path / "kit", SMALL_KIT)
    convert([root], tmp_path / "model")
    pipeline = load(tmp_path / "model")
    assert pipeline.control.config.joints == (0, 4, 7, 10, 15, 20)
    assert pipeline("a person walks", frames=24, preset="fast").best.joints.shape == (24, 21, 3)


def test_single_runs_and_files_can_be_given(published, tmp_path):
    runs = [published / RVQ, published / RESIDUAL / "model" / "net_best_fid.tar", published / PELVIS]
    convert(runs, tmp_path / "model")
    assert load(tmp_path / "model").control.config.joints == (0,)


def test_the_length_estimator_comes_along(published, tmp_path):
    convert([published], tmp_path / "model")
    estimator = LengthEstimator.from_pretrained(tmp_path / "model" / "length")
    expected = random_state(length_shapes(SMALL), seed=4)["output.11.weight"]
    assert torch.equal(estimator.layers[11].weight, expected)


@pytest.mark.parametrize(
    ("run", "file", "old", "new"),
    [(RVQ, "net_best_fid.tar", "vq_model", "net"), (MASKED, "latest.tar", "t2m_transformer", "trans")],
)
def test_older_key_names_are_known(tmp_path, run, file, old, new):
    root = write_published(tmp_path / "t2m", SMALL, leave_out=[JOINTS, PELVIS])
    path = root / run / "model" / file
    checkpoint = torch.load(path, weights_only=True)
    torch.save({new: checkpoint[old]}, path)
    convert([root], tmp_path / "model")
    assert (tmp_path / "model" / "pipeline.json").is_file()


def test_optional_parts_may_be_missing_or_there(published, tmp_path):
    """No opt.txt, no tokenizer copy, no position codes; CLIP weights and optimiser states beside the rest."""
    for options in published.glob("*/opt.txt"):
        options.unlink()
    path = published / JOINTS / "model" / "latest.tar"
    state = torch.load(path, weights_only=True)["ct2m_transformer"]
    state = {n: t for n, t in state.items() if not n.startswith(("vq_model.", "position_enc"))}
    state["clip_model.ln_final.weight"] = torch.ones(3)
    optimizer = torch.optim.AdamW([torch.nn.Parameter(torch.ones(2))])
    torch.save({"ct2m_transformer": state, "opt_t2m_transformer": optimizer.state_dict()}, path)
    convert([published], tmp_path / "model")
    assert load(tmp_path / "model").transformer.config == replace(
        MaskedTransformerConfig(), codebook_size=32, token_dim=16, width=24, layers=2, feedforward=32
    )


def test_another_tokenizer_inside_the_control_checkpoint_is_refused(published, tmp_path):
    path = published / JOINTS / "model" / "latest.tar"
    state = torch.load(path, weights_only=True)["ct2m_transformer"]
    state["vq_model.decoder.model.0.bias"][3] += 1e-3
    torch.save({"ct2m_transformer": state}, path)
    with pytest.raises(
        ValueError,
        match=r"trained with another tokenizer than .*differs in 1 of \d+ weights, first in decoder",
    ):
        convert([published], tmp_path / "model")
    assert not (tmp_path / "model").exists()


@pytest.mark.parametrize(
    ("leave_out", "message"),
    [
        ([RVQ], r"No tokenizer among the checkpoints\. Found: .*Expected tokenizer: rvq_"),
        ([RESIDUAL], r"No residual transformer among the checkpoints\. Found: .*tres_"),
        ([MASKED, JOINTS, PELVIS], r"No masked transformer among the checkpoints\."),
    ],
)
def test_what_is_missing_is_named_with_where_it_should_be(tmp_path, leave_out, message):
    root = write_published(tmp_path / "t2m", SMALL, leave_out=leave_out)
    with pytest.raises(FileNotFoundError, match=message):
        convert([root], tmp_path / "model")


def test_missing_statistics_and_an_empty_folder_are_named(published, tmp_path):
    (published / RVQ / "meta" / "std.npy").unlink()
    with pytest.raises(FileNotFoundError, match=r"No std\.npy in .*meta\. The tokenizer's own statistics"):
        convert([published], tmp_path / "model")
    (tmp_path / "nothing").mkdir()
    with pytest.raises(FileNotFoundError, match=r"No published checkpoint in .*Expected run folders"):
        convert([tmp_path / "nothing"], tmp_path / "model")
    with pytest.raises(FileNotFoundError, match="No file or folder at"):
        convert([tmp_path / "nowhere"], tmp_path / "model")


def test_statistics_that_are_no_plain_arrays_are_refused(published, tmp_path):
    import numpy as np

    file = published / RVQ / "meta" / "std.npy"
    np.save(file, np.array([{"a": 1}], dtype=object))
    with pytest.raises(ValueError, match=r"std\.npy is no plain array of numbers, or is damaged"):
        convert([published], tmp_path / "model")
    np.save(file, np.ones(10))
    with pytest.raises(ValueError, match=r"meta holds no feature statistics: `mean` and `std` must both be"):
        convert([published], tmp_path / "model")
    np.save(file, np.arange(263))
    with pytest.raises(ValueError, match=r"std\.npy must hold floating-point numbers"):
        convert([published], tmp_path / "model")


def test_two_runs_for_one_network_are_named(published, tmp_path):
    write_run(
        published / "tres_other", "latest.tar", {"res_transformer": random_state(residual_shapes(SMALL), 9)}
    )
    with pytest.raises(
        ValueError, match=r"There are 2 checkpoints for the residual transformer: .*one by one"
    ):
        convert([published], tmp_path / "model")


def test_what_is_left_is_said_so(published, tmp_path):
    write_run(
        published / "text_mot_match", "finest.tar", {"movement_encoder": {"main.0.weight": torch.ones(1)}}
    )
    report = convert([published], tmp_path / "model")
    assert "text_mot_match/model/finest.tar was left: it holds no network of this model." in report.notes
    for unused in (MASKED, PELVIS):
        assert f"{unused}/model/latest.tar was left: another took its place." in report.notes
    assert len(report.notes) == 4


def test_parts_of_different_sizes_are_refused(published, tmp_path):
    other = replace(SMALL, codes=16)
    write_run(
        published / RESIDUAL, "net_best_fid.tar", {"res_transformer": random_state(residual_shapes(other), 3)}
    )
    with pytest.raises(
        ValueError, match="The parts do not fit: `codebook_size` of `residual` must be 32, got 16"
    ):
        convert([published], tmp_path / "model")


def test_unknown_variants_are_refused(published, tmp_path):
    (published / RVQ / "opt.txt").write_text("vq_act: gelu\n")
    with pytest.raises(ValueError, match=r"Option 'vq_act' of opt\.txt is 'gelu'; only the published 'relu'"):
        convert([published], tmp_path / "model")


def test_a_residual_transformer_without_shared_tables_is_refused(published, tmp_path):
    (published / RESIDUAL / "opt.txt").write_text("share_weight: False\n")
    with pytest.raises(ValueError, match="was trained without `share_weight`; no such one is published"):
        convert([published], tmp_path / "model")


def test_nothing_is_overwritten(published, tmp_path):
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "mine").write_text("x")
    with pytest.raises(FileExistsError, match="exists already"):
        convert([published], tmp_path / "model")


# The dumps of the authors' classes, where the reference data is there.

DUMPS = {
    "rvq_vae": rvq_shapes(PAPER),
    "masked_transformer": masked_shapes(PAPER),
    "residual_transformer": residual_shapes(PAPER),
    "control_transformer_all_joints": control_shapes(PAPER),
    "control_transformer_pelvis": control_shapes(replace(PAPER, joints=1)),
    "length_estimator": length_shapes(PAPER),
}


@pytest.mark.parametrize("name", DUMPS)
def test_the_layout_of_these_tests_is_that_of_the_authors_classes(shared, name):
    lines = (shared / "reference" / "state_dicts" / f"{name}.tsv").read_text().splitlines()[1:]
    rows = [line.split("\t") for line in lines]
    assert {key: tuple(map(int, shape.split("x"))) for key, shape, *_ in rows} == DUMPS[name]
    assert {dtype for _, _, dtype, _ in rows} == {"float32"}


def test_checkpoints_of_the_published_size_become_the_paper_configurations(shared, tmp_path):
    root = write_published(tmp_path / "t2m", PAPER, leave_out=[PELVIS, MASKED])
    convert([root], tmp_path / "model")
    pipeline = load(tmp_path / "model", PAPER)
    assert pipeline.decoder.tokenizer.config == RvqVaeConfig.paper()
    assert pipeline.transformer.config == MaskedTransformerConfig.paper()
    assert pipeline.residual.config == ResidualTransformerConfig.paper()
    assert pipeline.control.config == ControlBranchConfig.published()
