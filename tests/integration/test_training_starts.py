"""Refining a decoder, and training from weights that are there already."""

from __future__ import annotations

import hashlib
import json
import shutil

import pytest
import torch
from safetensors.torch import load_file

from controlmm.data import MotionFolder
from controlmm.models.masked_transformer import MaskedTransformer
from controlmm.models.rvq_vae import RvqVae
from controlmm.pipelines import ControlMM
from controlmm.text.hashing import HashingTextEncoder
from controlmm.training.run_folder import RunFolder
from controlmm.training.rvq import reconstruction_errors
from controlmm.training.stage import load_tokenizer
from controlmm.training.stages import train_stage

STEPS = 40  # enough for the tiny decoder to learn something
UNTRAINED = 1e-9  # rate at which a step moves no weight by more than the tolerance below
MOVED = 1e-6


def train(stage, data, root, *, start_from=None, options=None, **changes):
    return train_stage(
        stage,
        data=data,
        size="tiny",
        root=root,
        text_encoder=HashingTextEncoder(64),
        changes={"steps": 2, "validate_every": 20} | changes,
        start_from=start_from,
        options=options or {},
        progress=False,
    )


@pytest.fixture
def model(tiny_pipeline_folder):
    """The folder of a whole model (untrained weights)."""
    return tiny_pipeline_folder


def test_refining_moves_the_decoder_alone_and_improves_whole_clips(model, tiny_data_folder, tmp_path):
    root = tmp_path / "root"
    train("rvq-decoder", tiny_data_folder, root, start_from=model, steps=STEPS)
    before, after = (
        load_file(f / "model.safetensors") for f in (model / "tokenizer", root / "rvq-decoder/best")
    )
    moved = {name.split(".")[0] for name in before if not torch.equal(before[name], after[name])}
    assert moved == {"decoder"}

    clips = list(MotionFolder(tiny_data_folder).clips("val"))
    refined, normalizer = load_tokenizer(root)
    with torch.no_grad():
        old = reconstruction_errors(RvqVae.from_pretrained(model / "tokenizer"), normalizer, clips)
        new = reconstruction_errors(refined, normalizer, clips)
    assert new["score"] < 0.8 * old["score"]
    (last,) = [
        r for r in RunFolder(root / "rvq-decoder").records() if r.get("val_score") and r["step"] == STEPS
    ]
    assert {"val_perplexity_0", "val_perplexity_2", "val_local", "val_global"} <= last.keys()


@pytest.mark.parametrize("ends", [None, "repeat"])
def test_a_decoder_may_be_refined_for_other_ends(model, tiny_data_folder, tmp_path, ends):
    train("rvq-decoder", tiny_data_folder, tmp_path, start_from=model, options={"ends": ends} if ends else {})
    trained = RvqVae.from_pretrained(model / "tokenizer").config.decoder_ends
    assert trained == "zeros"
    refined, _ = load_tokenizer(tmp_path)
    assert refined.decoder.ends == refined.config.decoder_ends == (ends or trained)


def test_a_refined_decoder_of_other_codes_is_refused(model, tiny_data_folder, tmp_path):
    train("rvq-decoder", tiny_data_folder, tmp_path, start_from=model)
    shutil.rmtree(tmp_path / "rvq")
    train("rvq", tiny_data_folder, tmp_path)
    with pytest.raises(ValueError, match=r"rvq-decoder refines another tokenizer than .*rvq\. Remove it"):
        load_tokenizer(tmp_path)


def test_a_decoder_is_not_refined_for_other_codes_than_the_roots(model, tiny_data_folder, tmp_path):
    train("rvq", tiny_data_folder, tmp_path)
    with pytest.raises(
        ValueError, match=r"tokenizer has other codes than .*rvq; a decoder can only be refined"
    ):
        train("rvq-decoder", tiny_data_folder, tmp_path, start_from=model)
    assert not (tmp_path / "rvq-decoder").exists()


def test_a_model_of_the_other_system_lends_nothing(model, tiny_data_folder, tmp_path):
    with pytest.raises(ValueError, match=r"holds a pipeline of kind 'controlmm'.*expected 'tlcontrol'"):
        train("tl-mtt", tiny_data_folder, tmp_path / "root", start_from=model)
    assert not (tmp_path / "root").exists()


def test_a_model_lends_its_earlier_stages_and_its_weights(model, tiny_data_folder, tmp_path):
    train("masked", tiny_data_folder, tmp_path, start_from=model, learning_rate=UNTRAINED)
    started = load_file(tmp_path / "masked" / "best" / "model.safetensors")
    for name, value in load_file(model / "transformer" / "model.safetensors").items():
        torch.testing.assert_close(started[name], value, rtol=0, atol=MOVED)
    lent = tmp_path / "rvq" / "best" / "model.safetensors"
    assert lent.read_bytes() == (model / "tokenizer" / "model.safetensors").read_bytes()
    names = {path.name for path in tmp_path.iterdir()}
    assert names - {"pipeline"} == {"masked", "rvq", "normalizer.safetensors", "text_encoder.json"}
    told = json.loads((tmp_path / "masked" / "run.json").read_text())
    given = (model / "transformer" / "model.safetensors").read_bytes()
    assert told["built_on"]["start_from"] == hashlib.sha256(given).hexdigest()


def test_all_transformers_start_from_a_model_and_become_a_model_again(
    model, tiny_data_folder, tmp_path, command
):
    for stage in ("masked", "residual", "control"):
        train(stage, tiny_data_folder, tmp_path, start_from=model)
    command("assemble", tmp_path, "--out", tmp_path / "again")
    pipeline = ControlMM.from_pretrained(tmp_path / "again")
    assert pipeline("a person walks", frames=16, preset="fast").best.num_frames == 16


def test_what_the_root_has_already_is_kept(model, tiny_data_folder, tmp_path):
    train("rvq", tiny_data_folder, tmp_path)
    own = (tmp_path / "rvq" / "best" / "model.safetensors").read_bytes()
    train("masked", tiny_data_folder, tmp_path, start_from=model)
    assert (tmp_path / "rvq" / "best" / "model.safetensors").read_bytes() == own


def test_a_network_folder_alone_lends_only_its_weights(model, tiny_data_folder, tmp_path):
    with pytest.raises(FileNotFoundError, match="rvq holds no trained stage"):
        train("masked", tiny_data_folder, tmp_path, start_from=model / "transformer")
    train("rvq", tiny_data_folder, tmp_path)
    train("masked", tiny_data_folder, tmp_path, start_from=model / "transformer", learning_rate=UNTRAINED)
    started = MaskedTransformer.from_pretrained(tmp_path / "masked" / "best")
    given = MaskedTransformer.from_pretrained(model / "transformer")
    torch.testing.assert_close(started.head[-1].weight, given.head[-1].weight, rtol=0, atol=MOVED)


@pytest.mark.filterwarnings("ignore:The text feature cache")  # of the other encoder, on purpose
def test_weights_that_are_missing_or_do_not_fit_are_named(model, tiny_data_folder, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"No weights to start 'masked' from in .*config\.json"):
        train("masked", tiny_data_folder, tmp_path, start_from=tmp_path)
    with pytest.raises(ValueError, match=r"Stage 'rvq' cannot start from given weights"):
        train("rvq", tiny_data_folder, tmp_path, start_from=model)
    with pytest.raises(ValueError, match=r"transformer do not fit this data and text encoder.*text_proj"):
        train_stage(
            "masked",
            data=tiny_data_folder,
            size="tiny",
            root=tmp_path,
            text_encoder=HashingTextEncoder(32),
            start_from=model,
            progress=False,
        )


def test_a_model_with_another_text_encoder_lends_nothing(model, tiny_data_folder, tmp_path):
    written = (model / "text_encoder.json").read_text()
    (tmp_path / "text_encoder.json").write_text(written.replace('"dim": 64', '"dim": 32'))
    with pytest.raises(ValueError, match="`text_encoder` is not the one"):
        train("masked", tiny_data_folder, tmp_path, start_from=model)
    assert not (tmp_path / "rvq").exists()
