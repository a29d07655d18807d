"""A pipeline on disk."""

from __future__ import annotations

import json
import shutil

import pytest
import torch

from controlmm.controls import JointControl
from controlmm.generation.editing import EditingBudget
from controlmm.pipelines import ControlMM, Preset
from controlmm.text.hashing import HashingTextEncoder

QUICK = Preset(EditingBudget(latent_iterations=3), steps=2)
WRIST = JointControl("right_wrist", [5], [[-0.3, 1.2, 0.2]])
HALF = 2**-11  # relative rounding of float16

FILES = [
    "normalizer.safetensors",
    "pipeline.json",
    "text_encoder.json",
    *(
        f"{part}/{name}"
        for part in ("control", "residual", "tokenizer", "transformer")
        for name in ("config.json", "model.safetensors")
    ),
]


def motion_of(pipeline: ControlMM, **options) -> torch.Tensor:
    return pipeline("walk", frames=16, preset=QUICK, **options).best.joints


def test_the_folder_has_the_agreed_files(tiny_pipeline_folder):
    files = [
        str(path.relative_to(tiny_pipeline_folder))
        for path in tiny_pipeline_folder.rglob("*")
        if path.is_file()
    ]
    assert sorted(files) == sorted(FILES)


@pytest.mark.parametrize("controls", [[], [WRIST]], ids=["text", "control"])
def test_a_saved_pipeline_generates_the_same_motions(tiny_pipeline, tiny_pipeline_folder, controls):
    loaded = ControlMM.from_pretrained(tiny_pipeline_folder)
    assert torch.equal(motion_of(loaded, controls=controls), motion_of(tiny_pipeline, controls=controls))
    assert loaded.num_parameters == tiny_pipeline.num_parameters


def test_half_precision_halves_the_folder_and_changes_weights_by_rounding_only(tiny_pipeline, tmp_path):
    full, half = tmp_path / "full", tmp_path / "half"
    tiny_pipeline.save_pretrained(full)
    tiny_pipeline.save_pretrained(half, dtype=torch.float16)
    sizes = [sum(f.stat().st_size for f in path.rglob("model.safetensors")) for path in (half, full)]
    assert sizes[0] < 0.65 * sizes[1]
    loaded = ControlMM.from_pretrained(half)
    for name, value in tiny_pipeline.transformer.state_dict().items():
        other = loaded.transformer.state_dict()[name]
        assert other.dtype == torch.float32
        torch.testing.assert_close(other, value, rtol=HALF, atol=1e-7)
    assert torch.isfinite(motion_of(loaded, controls=[WRIST])).all()
    assert torch.equal(loaded.decoder.normalizer.std, tiny_pipeline.decoder.normalizer.std)  # never halved


def test_networks_are_frozen_and_in_evaluation_mode(tiny_pipeline_folder):
    loaded = ControlMM.from_pretrained(tiny_pipeline_folder)
    for network in (loaded.decoder.tokenizer, loaded.transformer, loaded.residual, loaded.control):
        assert not network.training
        assert not any(parameter.requires_grad for parameter in network.parameters())


@pytest.mark.parametrize("name", FILES)
def test_every_missing_file_is_named(tiny_pipeline_folder, name):
    (tiny_pipeline_folder / name).unlink()
    with pytest.raises(FileNotFoundError, match=name.rpartition("/")[2].replace(".", r"\.")):
        ControlMM.from_pretrained(tiny_pipeline_folder)


@pytest.mark.parametrize("name", [name for name in FILES if name.endswith(".safetensors")])
def test_every_truncated_file_is_named(tiny_pipeline_folder, name):
    file = tiny_pipeline_folder / name
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(ValueError, match=name.replace(".", r"\.")):
        ControlMM.from_pretrained(tiny_pipeline_folder)


@pytest.mark.parametrize("name", [name for name in FILES if name.endswith(".json")])
def test_every_broken_json_file_is_named(tiny_pipeline_folder, name):
    (tiny_pipeline_folder / name).write_text('{"kind": ')
    with pytest.raises(ValueError, match=name.replace(".", r"\.")):
        ControlMM.from_pretrained(tiny_pipeline_folder)


def test_a_missing_folder_and_a_folder_without_pipeline_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"No model folder at .*nowhere"):
        ControlMM.from_pretrained(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"holds no pipeline: pipeline\.json is missing"):
        ControlMM.from_pretrained(tmp_path)


@pytest.mark.parametrize(
    "about", [{"kind": "tlcontrol", "format": 1}, {"kind": "controlmm", "format": 99}, {}]
)
def test_other_kinds_and_formats_are_refused(tiny_pipeline_folder, about):
    (tiny_pipeline_folder / "pipeline.json").write_text(json.dumps(about))
    with pytest.raises(ValueError, match="expected 'controlmm', format 1"):
        ControlMM.from_pretrained(tiny_pipeline_folder)


def test_another_text_encoder_is_refused(tiny_pipeline_folder):
    with pytest.raises(
        ValueError, match=r"`text_encoder` is not the one that the model was trained with: .*64.*32"
    ):
        ControlMM.from_pretrained(tiny_pipeline_folder, text_encoder=HashingTextEncoder(32))
    ControlMM.from_pretrained(tiny_pipeline_folder, text_encoder=HashingTextEncoder(64))


def test_an_unknown_text_encoder_is_refused(tiny_pipeline_folder):
    (tiny_pipeline_folder / "text_encoder.json").write_text('{"kind": "oracle"}')
    with pytest.raises(
        ValueError, match=r"Unknown text encoder 'oracle'\. Use one of: minilm, clip, hashing"
    ):
        ControlMM.from_pretrained(tiny_pipeline_folder)


def test_networks_of_two_models_are_not_mixed(tiny_pipeline_folder):
    transformer, residual = tiny_pipeline_folder / "transformer", tiny_pipeline_folder / "residual"
    shutil.copy(residual / "model.safetensors", transformer / "model.safetensors")
    with pytest.raises(ValueError, match=r"transformer/model\.safetensors does not fit its config\.json"):
        ControlMM.from_pretrained(tiny_pipeline_folder)
