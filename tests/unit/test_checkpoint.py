"""save_pretrained / from_pretrained of networks."""

from __future__ import annotations

import json

import pytest
import torch

from controlmm.models.rvq_vae import RvqVae, RvqVaeConfig

HALF = 2**-11  # relative rounding of float16


@pytest.fixture
def tokenizer() -> RvqVae:
    torch.manual_seed(0)
    tokenizer = RvqVae(RvqVaeConfig.tiny()).train()
    tokenizer(torch.randn(2, 64, 263))  # fills the codebooks
    return tokenizer.eval()


@pytest.fixture
def folder(tokenizer, tmp_path):
    tokenizer.save_pretrained(tmp_path)
    return tmp_path


def test_a_network_comes_back_in_evaluation_mode(tokenizer, folder):
    loaded = RvqVae.from_pretrained(folder)
    assert not loaded.training
    assert loaded.config == tokenizer.config
    features = torch.randn(1, 16, 263)
    assert torch.equal(loaded(features)[0], tokenizer(features)[0])
    assert torch.equal(loaded.encode(features), tokenizer.encode(features))


def test_what_only_training_needs_stays_out_of_the_file(folder):
    from safetensors.torch import load_file

    names = set(load_file(folder / "model.safetensors"))
    assert not any("ema_" in name for name in names)
    assert any(name.endswith("codes") for name in names)
    assert {file.name for file in folder.iterdir()} == {"config.json", "model.safetensors"}


def test_half_precision_files_are_half_the_size_and_load_as_float32(tokenizer, folder, tmp_path):
    half = tmp_path / "half"
    tokenizer.save_pretrained(half, dtype=torch.float16)
    sizes = [(path / "model.safetensors").stat().st_size for path in (half, folder)]
    assert sizes[0] < 0.6 * sizes[1]
    loaded = RvqVae.from_pretrained(half).state_dict()
    for name, value in tokenizer.state_dict().items():
        if "ema_" not in name:
            assert loaded[name].dtype == value.dtype
            torch.testing.assert_close(loaded[name], value, rtol=HALF, atol=1e-6)


@pytest.mark.parametrize("keep", [0, 5, 1000, -4])
def test_truncated_weights_are_named(folder, keep):
    file = folder / "model.safetensors"
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(ValueError, match=r"model\.safetensors is damaged or truncated"):
        RvqVae.from_pretrained(folder)


@pytest.mark.parametrize(
    ("name", "message"), [("config.json", "No config.json in"), ("model.safetensors", "No weights at")]
)
def test_missing_files_are_named(folder, name, message):
    (folder / name).unlink()
    with pytest.raises(FileNotFoundError, match=message):
        RvqVae.from_pretrained(folder)


def test_weights_of_another_size_are_refused(folder):
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**config, "width": 24}))
    with pytest.raises(
        ValueError, match=r"model\.safetensors does not fit its config\.json: .*size mismatch"
    ):
        RvqVae.from_pretrained(folder)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"width": 16', r"config\.json is no valid configuration"),
        ("[1]", "unexpected list for RvqVaeConfig"),
        ('{"widht": 16}', r"unexpected \['widht'\] for RvqVaeConfig"),
        ('{"width": "wide"}', r"config\.json is no valid configuration"),
        ('{"downsample": 5}', "`downsample` must be a power of two"),
    ],
)
def test_broken_configurations_are_named(folder, text, message):
    (folder / "config.json").write_text(text)
    with pytest.raises(ValueError, match=message):
        RvqVae.from_pretrained(folder)


def test_lists_in_the_file_become_tuples_again(tmp_path):
    from controlmm.models.control_branch import ControlBranch, ControlBranchConfig

    ControlBranch(ControlBranchConfig.tiny()).save_pretrained(tmp_path)
    assert ControlBranch.from_pretrained(tmp_path).config == ControlBranchConfig.tiny()


def test_saving_over_an_old_network_replaces_it(tokenizer, folder):
    with torch.no_grad():
        tokenizer.decoder.exit.bias += 1
    tokenizer.save_pretrained(folder)
    assert torch.equal(RvqVae.from_pretrained(folder).decoder.exit.bias, tokenizer.decoder.exit.bias)
