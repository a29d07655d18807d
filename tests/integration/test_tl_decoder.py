"""Refining the decoder of TLControl's tokenizer, and what then takes the refined one."""

from __future__ import annotations

import shutil
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file

from controlmm.data import MotionFolder
from controlmm.models.part_vq_vae import PartVqVae, PartVqVaeConfig
from controlmm.pipelines import TLControl
from controlmm.text.hashing import HashingTextEncoder
from controlmm.training.rvq import reconstruction_errors
from controlmm.training.stage import load_part_tokenizer
from controlmm.training.stages import train_stage

STEPS = 40  # enough for the tiny decoder to learn something


def train(stage, data, root, *, start_from=None, steps=2):
    return train_stage(
        stage,
        data=data,
        size="tiny",
        root=root,
        text_encoder=HashingTextEncoder(64),
        changes={"steps": steps, "validate_every": 20},
        start_from=start_from,
        progress=False,
    )


def test_refining_moves_the_decoder_alone_and_improves_whole_clips(
    tiny_tlcontrol_folder, tiny_data_folder, tmp_path
):
    root = tmp_path / "root"
    train("tl-decoder", tiny_data_folder, root, start_from=tiny_tlcontrol_folder, steps=STEPS)
    before, after = (
        load_file(folder / "model.safetensors")
        for folder in (tiny_tlcontrol_folder / "tokenizer", root / "tl-decoder/best")
    )
    assert before.keys() == after.keys()
    moved = {name.split(".")[0] for name in before if not torch.equal(before[name], after[name])}
    assert moved == {"decoder"}

    clips = list(MotionFolder(tiny_data_folder).clips("val"))
    refined, normalizer = load_part_tokenizer(root)
    with torch.no_grad():
        old = reconstruction_errors(
            PartVqVae.from_pretrained(tiny_tlcontrol_folder / "tokenizer"), normalizer, clips
        )
        new = reconstruction_errors(refined, normalizer, clips)
    assert new["score"] < 0.8 * old["score"]
    assert new["perplexity_0"] == old["perplexity_0"]  # the same tokens


def test_the_transformer_and_the_whole_model_take_the_refined_decoder(command, tiny_data_folder, tmp_path):
    root, model = tmp_path / "root", tmp_path / "model"
    for stage in ("tl-vq", "tl-decoder", "tl-mtt"):
        command(
            "train", stage, "--data", tiny_data_folder, "--out", root, "--config", "tiny",
            "--text", "hashing", "--steps", 3, "--quiet",
        )  # fmt: skip
    command("assemble", root, "--out", model)
    refined = load_file(root / "tl-decoder/best/model.safetensors")
    taken = TLControl.from_pretrained(model).tokenizer.state_dict()
    assert all(torch.equal(taken[name], refined[name]) for name in refined)
    run = (model / "tokenizer" / "run.json").read_text()
    assert run == (root / "tl-decoder" / "run.json").read_text()


def test_a_refined_decoder_of_other_codes_is_refused(tiny_tlcontrol_folder, tiny_data_folder, tmp_path):
    root = tmp_path / "root"
    train("tl-decoder", tiny_data_folder, root, start_from=tiny_tlcontrol_folder)
    shutil.rmtree(root / "tl-vq")
    train("tl-vq", tiny_data_folder, root)
    with pytest.raises(ValueError, match=r"tl-decoder refines another tokenizer than .*tl-vq\. Remove it"):
        train("tl-mtt", tiny_data_folder, root)


def test_a_published_tokenizer_is_refused_since_its_codes_depend_on_the_padding(tiny_data_folder, tmp_path):
    train("tl-vq", tiny_data_folder, tmp_path)
    published = replace(PartVqVaeConfig.tiny(), latent_norm="clip")
    PartVqVae(published).save_pretrained(tmp_path / "tl-vq" / "best")
    with pytest.raises(ValueError, match=r"needs a tokenizer with `latent_norm` 'step'; that in .*tl-vq has"):
        train("tl-decoder", tiny_data_folder, tmp_path)
