"""The training stages of TLControl on a tiny folder, ours and the published recipes."""

from __future__ import annotations

import pytest
import torch
from safetensors.torch import load_file

from controlmm.data import MotionFolder
from controlmm.models.part_vq_vae import PartVqVae, PartVqVaeConfig
from controlmm.models.trajectory_transformer import TrajectoryTransformer, TrajectoryTransformerConfig
from controlmm.motion.normalizer import Normalizer
from controlmm.ops import gumbel_noise, recover_joints
from controlmm.text.hashing import HashingTextEncoder
from controlmm.training import tl_mtt, tl_vq
from controlmm.training.run_folder import RunFolder
from controlmm.training.stages import train_stage
from controlmm.training.step import StepTaker
from controlmm.training.tokens import TokenSampler

STAGES = ("tl-vq", "tl-mtt", "tl-unsplit")
QUICK = {"steps": 10, "validate_every": 5}


def train(stage, data, root, **changes):
    return train_stage(
        stage,
        data=data,
        size="tiny",
        root=root,
        text_encoder=HashingTextEncoder(64),
        changes=QUICK | changes,
        progress=False,
    )


@pytest.fixture(scope="module")
def trained(tiny_data_folder, tmp_path_factory):
    """A root folder with the stages of TLControl and the ablation's tokenizer, trained for ten steps."""
    root = tmp_path_factory.mktemp("trained")
    for stage in STAGES:
        train(stage, tiny_data_folder, root)
    return root


@pytest.mark.parametrize("stage", STAGES)
def test_every_stage_leaves_weights_and_a_finite_log(trained, stage):
    run = RunFolder(trained / stage)
    assert [record["step"] for record in run.records()] == [5, 10, 10]
    for record in run.records():
        assert torch.isfinite(torch.tensor(list(record.values()))).all()
    assert (run.path / "best" / "model.safetensors").is_file()


def test_trajectory_statistics_are_those_of_the_six_joints_of_the_training_split(trained, tiny_data_folder):
    joints = torch.cat(
        [
            recover_joints(clip.features[None], joints=22)[0]
            for clip in MotionFolder(tiny_data_folder).clips("train")
        ]
    )[:, [0, 15, 20, 21, 10, 11]].reshape(-1, 3)
    model = TrajectoryTransformer.from_pretrained(trained / "tl-mtt" / "best")
    torch.testing.assert_close(model.trajectory_mean, joints.mean(0), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(model.trajectory_std, joints.std(0, correction=0), rtol=1e-4, atol=1e-5)


class KilledError(Exception):
    """The kill."""


def test_a_killed_and_resumed_run_equals_the_unbroken_one_bit_by_bit(
    trained, tiny_data_folder, tmp_path, monkeypatch
):
    (tmp_path / "normalizer.safetensors").symlink_to(trained / "normalizer.safetensors")
    (tmp_path / "tl-vq").symlink_to(trained / "tl-vq")
    take = StepTaker.take

    def killed_at_eight(self, step):
        if step == 7:
            raise KilledError
        return take(self, step)

    monkeypatch.setattr(StepTaker, "take", killed_at_eight)
    with pytest.raises(KilledError):
        train("tl-mtt", tiny_data_folder, tmp_path)
    monkeypatch.setattr(StepTaker, "take", take)
    train("tl-mtt", tiny_data_folder, tmp_path)
    expected = load_file(trained / "tl-mtt" / "checkpoint.safetensors")
    actual = load_file(tmp_path / "tl-mtt" / "checkpoint.safetensors")
    assert expected.keys() == actual.keys()
    assert all(torch.equal(expected[key], actual[key]) for key in expected)
    assert expected["model.batches_seen"] == 10


def test_the_tokenizer_is_needed_first(tiny_data_folder, tmp_path):
    with pytest.raises(
        FileNotFoundError, match=r"tl-vq holds no trained stage\. Run `controlmm train tl-vq`"
    ):
        train("tl-mtt", tiny_data_folder, tmp_path)


@pytest.fixture(scope="module")
def clips(tiny_data_folder):
    """Clips of the training split, and statistics that fit them."""
    every = list(MotionFolder(tiny_data_folder).clips("train"))
    return every, Normalizer.fit(clip.features for clip in every)


def published_tokenizer() -> PartVqVaeConfig:
    config = PartVqVaeConfig.tiny()
    return type(config)(**{**vars(config), "latent_norm": "clip"})


def test_the_published_tokenizer_recipe_is_a_mean_square_over_padded_clips(clips):
    every, normalizer = clips
    torch.manual_seed(0)
    recipe = tl_vq.PartVqRecipe(published_tokenizer(), normalizer, every, every)
    seen = []
    recipe.model.register_forward_hook(lambda _, arguments, output: seen.append((arguments[0], output)))
    losses = recipe.loss(3)
    target, (decoded, quantized) = seen[0]
    assert target.shape == (3, 196, 263)
    assert (target[:, -1] == 0).all()  # all clips are shorter: zeros behind them
    expected = (decoded - target).square().mean() + 0.001 * 6 * quantized.commitment
    torch.testing.assert_close(losses["loss"], expected)


def test_the_published_transformer_recipe_sees_padded_clips_and_weighs_the_reconstruction(clips):
    every, normalizer = clips
    torch.manual_seed(0)
    tokenizer = PartVqVae(published_tokenizer())
    tokenizer.train()(torch.randn(8, 196, 263))  # fills the codebooks
    encoder = HashingTextEncoder(64)
    texts = sorted({caption.text for clip in every for caption in clip.captions})
    features = dict(zip(texts, encoder.encode(texts).pooled, strict=True))
    samplers = [TokenSampler(every, normalizer, tokenizer.eval(), features, progress=False) for _ in range(2)]
    config = TrajectoryTransformerConfig.tiny()
    config = type(config)(**{**vars(config), "form": "published"})
    recipe = tl_mtt.TrajectoryRecipe(config, tokenizer, normalizer, *samplers)
    assert recipe.masking == "paper"
    shapes = []
    recipe.model.register_forward_hook(lambda _, arguments, output: shapes.append(output.shape))
    losses = recipe.loss(3)
    assert shapes == [(3, 49, 6, 16)]
    expected = losses["cross_entropy"] + 0.001 * losses["reconstruction"]
    torch.testing.assert_close(losses["loss"], expected)
    losses["loss"].backward()
    assert all(p.grad is None for p in tokenizer.parameters())
    assert recipe.model.bundle_proj.weight.grad.abs().max() > 0


def test_codes_are_drawn_from_the_logits_of_their_part_straight_through():
    torch.manual_seed(0)
    tokenizer = PartVqVae(PartVqVaeConfig.tiny()).eval()
    books = [tokenizer.quantizer.book(part).codes.normal_() for part in range(6)]
    logits = torch.randn(2, 5, 6, 16, requires_grad=True)
    latents = tl_mtt.draw_codes(logits, tokenizer.quantizer, seed=11)
    for part, book in enumerate(books):
        ids = (logits[:, :, part] + gumbel_noise((2, 5, 16), seed=11 + part)).argmax(-1)
        assert torch.equal(latents.unflatten(-1, (6, 4))[:, :, part], book[ids])
    weights = torch.randn(4)
    (latents.unflatten(-1, (6, 4))[:, :, 3] @ weights).sum().backward()
    assert logits.grad[:, :, 3].abs().max() > 0
    assert logits.grad[:, :, [0, 1, 2, 4, 5]].abs().max() == 0


def test_the_cross_entropy_weighs_clips_alike_whatever_their_length():
    torch.manual_seed(0)
    logits = torch.randn(2, 6, 6, 16)
    ids = torch.randint(16, (2, 6, 6))
    ids[1, 2:] = -1
    alone = [
        tl_mtt._clip_cross_entropy(logits[i : i + 1, :n], ids[i : i + 1, :n]) for i, n in ((0, 6), (1, 2))
    ]
    torch.testing.assert_close(tl_mtt._clip_cross_entropy(logits, ids), torch.stack(alone).mean())
