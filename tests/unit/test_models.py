"""The four networks: published sizes, padding, control, tables, configurations."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from controlmm.models.control_branch import ControlBranch, ControlBranchConfig
from controlmm.models.masked_transformer import MaskedTransformer, MaskedTransformerConfig
from controlmm.models.residual_transformer import ResidualTransformer, ResidualTransformerConfig
from controlmm.models.rvq_vae import RvqVae, RvqVaeConfig, frame_mask
from controlmm.motion.skeleton import HUMANML3D, KIT
from controlmm.nn.trunk import drop_text, sinusoidal_positions

SAME_CLIP = 1e-5  # float32 sums over another batch size and length
NETWORKS = [
    (RvqVae, RvqVaeConfig),
    (MaskedTransformer, MaskedTransformerConfig),
    (ResidualTransformer, ResidualTransformerConfig),
    (ControlBranch, ControlBranchConfig),
]


@pytest.mark.parametrize(
    ("network", "config", "millions"),
    [
        (RvqVae, RvqVaeConfig.paper(), 19.44),
        (MaskedTransformer, MaskedTransformerConfig.paper(), 12.05),
        (ResidualTransformer, ResidualTransformerConfig.paper(), 13.36),
        (ControlBranch, ControlBranchConfig.published(), 21.42),
        (ControlBranch, replace(ControlBranchConfig.published(), joints=(0,)), 21.37),
    ],
)
def test_paper_configurations_have_the_published_sizes(network, config, millions):
    with torch.device("meta"):
        count = sum(parameter.numel() for parameter in network(config).parameters())
    assert round(count / 1e6, 2) == millions


@pytest.mark.parametrize("size", ["tiny", "small", "paper"])
def test_branches_trained_here_are_told_which_targets_exist(size):
    """A target of zero must not look like none; only the published layout cannot tell them apart."""
    told, published = getattr(ControlBranchConfig, size)(), ControlBranchConfig.published()
    for config, differs in ((told, True), (published, False)):
        branch = ControlBranch(replace(config, encoder_width=8, layers=1))
        zero, none = torch.zeros(1, 4, 22, 3), torch.zeros(1, 4, 22, 3, dtype=torch.bool)
        at_origin = none.clone()
        at_origin[:, 2, 0] = True
        signals = [branch.signal(zero, mask, zero) for mask in (at_origin, none)]
        assert torch.equal(*signals) != differs


@pytest.mark.parametrize("size", ["tiny", "small", "paper"])
def test_control_branches_fit_the_masked_transformers_of_their_size(size):
    getattr(ControlBranchConfig, size)().check_base(getattr(MaskedTransformerConfig, size)())


@pytest.mark.parametrize(("network", "config"), NETWORKS)
def test_fresh_weights_are_a_function_of_the_seed(network, config):
    states = []
    for _ in range(2):
        torch.manual_seed(7)
        states.append(network(config.tiny()).state_dict())
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])


@pytest.fixture
def masked() -> MaskedTransformer:
    torch.manual_seed(0)
    return MaskedTransformer(MaskedTransformerConfig.tiny()).eval()


@pytest.fixture
def residual() -> ResidualTransformer:
    torch.manual_seed(0)
    return ResidualTransformer(ResidualTransformerConfig.tiny()).eval()


def token_batch() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Ids of two clips of 9 and 5 tokens, their validity, text vectors."""
    generator = torch.Generator().manual_seed(0)
    valid = frame_mask(torch.tensor([9, 5]), 9)
    return torch.randint(32, (2, 9), generator=generator), valid, torch.randn(2, 64, generator=generator)


def test_padding_does_not_change_the_logits_of_a_clip(masked):
    ids, valid, text = token_batch()
    padded = masked(masked.embed(ids), text, valid)
    alone = masked(masked.embed(ids[1:, :5]), text[1:], valid[1:, :5])
    torch.testing.assert_close(padded[1:, :5], alone, rtol=0, atol=SAME_CLIP)


def test_what_stands_in_padding_does_not_matter(masked):
    ids, valid, text = token_batch()
    other = torch.where(valid, ids, masked.pad_id)
    difference = masked(masked.embed(other), text, valid) - masked(masked.embed(ids), text, valid)
    assert difference[valid].abs().max() == 0


def test_text_changes_the_logits(masked):
    ids, valid, text = token_batch()
    logits = [masked(masked.embed(ids), vector, valid) for vector in (text, torch.zeros_like(text))]
    assert (logits[0] - logits[1]).abs().max() > 1e-4


def test_soft_tokens_of_one_hot_rows_are_the_hard_ones(masked):
    ids, _, _ = token_batch()
    soft = masked.embed_soft(torch.nn.functional.one_hot(ids, 32).float())
    torch.testing.assert_close(soft, masked.embed(ids), rtol=0, atol=1e-6)


def test_mask_and_pad_have_no_logits_but_embeddings(masked):
    ids, valid, text = token_batch()
    assert (masked.mask_id, masked.pad_id, masked.token_embedding.num_embeddings) == (32, 33, 34)
    assert masked(masked.embed(ids), text, valid).shape == (2, 9, 32)


def test_too_many_tokens_are_refused(masked):
    with pytest.raises(ValueError, match="At most 98 tokens are possible, got 99"):
        masked.sequence(torch.zeros(1, 99, 16), torch.zeros(1, 64))


def test_position_codes_are_the_published_ones():
    codes = sinusoidal_positions(50, 384)
    assert codes[7, 10] == pytest.approx(torch.sin(torch.tensor(7 * 10000 ** (-10 / 384))).item(), abs=1e-6)
    assert codes[7, 11] == pytest.approx(torch.cos(torch.tensor(7 * 10000 ** (-10 / 384))).item(), abs=1e-6)


def control_inputs(masked, branch):
    ids, valid, text = token_batch()
    generator = torch.Generator().manual_seed(1)
    targets, current = torch.randn(2, 2, 36, 22, 3, generator=generator)
    mask = torch.rand(2, 36, 22, 3, generator=generator) < 0.1
    return masked.sequence(masked.embed(ids), text), branch.signal(targets, mask, current), valid


@pytest.mark.parametrize("into_frozen_trunk", [True, False])
def test_a_fresh_control_branch_changes_nothing(masked, into_frozen_trunk):
    ids, valid, text = token_batch()
    config = ControlBranchConfig.tiny()
    config = type(config)(**{**vars(config), "into_frozen_trunk": into_frozen_trunk})
    branch = ControlBranch.beside(masked, config).eval()
    sequence, signal, _ = control_inputs(masked, branch)
    assert torch.equal(branch(masked, sequence, signal, valid), masked(masked.embed(ids), text, valid))


@pytest.mark.parametrize("zero", ["first_zero", "mid_zeros.0", "mid_zeros.1"])
def test_every_zero_linear_speaks_to_the_frozen_trunk(masked, zero):
    branch = ControlBranch.beside(masked, ControlBranchConfig.tiny()).eval()
    sequence, signal, valid = control_inputs(masked, branch)
    before = branch(masked, sequence, signal, valid)
    torch.nn.init.normal_(branch.get_submodule(zero).weight)
    assert (branch(masked, sequence, signal, valid) - before)[valid].abs().max() > 1e-4


def test_the_control_trunk_sees_the_hint(masked):
    """With the frozen trunk left out of it, the first zero linear still changes the residuals."""
    config = ControlBranchConfig.tiny()
    config = type(config)(**{**vars(config), "into_frozen_trunk": False})
    branch = ControlBranch.beside(masked, config).eval()
    torch.nn.init.normal_(branch.mid_zeros[0].weight)
    sequence, signal, valid = control_inputs(masked, branch)
    before = branch(masked, sequence, signal, valid)
    torch.nn.init.normal_(branch.first_zero.weight)
    assert (branch(masked, sequence, signal, valid) - before)[valid].abs().max() > 1e-4


def test_control_in_padding_does_not_reach_the_clip(masked):
    branch = ControlBranch.beside(masked, ControlBranchConfig.tiny()).eval()
    for zero in (branch.first_zero, *branch.mid_zeros):
        torch.nn.init.normal_(zero.weight)
    sequence, signal, valid = control_inputs(masked, branch)
    padded = branch(masked, sequence, signal, valid)
    alone = branch(masked, sequence[1:, :6], signal[1:, :20], valid[1:, :5])
    torch.testing.assert_close(padded[1:, :5], alone, rtol=0, atol=10 * SAME_CLIP)  # logits grew tenfold


def test_the_copied_trunk_is_the_bases_and_trains_apart(masked):
    branch = ControlBranch.beside(masked, ControlBranchConfig.tiny())
    for name, value in masked.layers.state_dict().items():
        assert torch.equal(branch.layers.state_dict()[name], value)
        assert branch.layers.state_dict()[name].data_ptr() != value.data_ptr()


def test_the_control_signal_is_difference_target_and_mask_joint_by_joint():
    branch = ControlBranch(ControlBranchConfig(width=8, heads=1, layers=1, joints=(0, 20), encoder_width=4))
    targets, current = torch.zeros(1, 4, 22, 3), torch.full((1, 4, 22, 3), 5.0)
    mask = torch.zeros(1, 4, 22, 3, dtype=torch.bool)
    targets[0, 2, 20] = torch.tensor([1.0, 2.0, 3.0])
    targets[0, 1, 0] = 7.0  # not controlled
    mask[0, 2, 20, [0, 2]] = True
    signal = branch.signal(targets, mask, current)
    assert signal.shape == (1, 4, 18)
    expected = torch.zeros(18)
    expected[[3, 5]] = torch.tensor([-4.0, -2.0])
    expected[[9, 11]] = torch.tensor([1.0, 3.0])
    expected[[15, 17]] = 1.0
    assert torch.equal(signal[0, 2], expected)
    assert signal[0, [0, 1, 3]].abs().max() == 0


def test_a_branch_of_another_size_is_refused(masked):
    with pytest.raises(
        ValueError, match=r"\(16, 2, 3, 32\), but the masked transformer has \(16, 2, 2, 32\)"
    ):
        ControlBranch.beside(masked, ControlBranchConfig(width=16, heads=2, layers=3, feedforward=32))


def test_control_joints_follow_the_skeleton():
    assert ControlBranchConfig.small().for_skeleton(HUMANML3D) == ControlBranchConfig.small()
    assert ControlBranchConfig.paper().for_skeleton(HUMANML3D) == ControlBranchConfig.paper()
    assert ControlBranchConfig.small().for_skeleton(KIT).joints == tuple(range(21))
    assert ControlBranchConfig.paper().for_skeleton(KIT).joints == KIT.control_joints


def test_history_sums_the_tables_of_the_earlier_layers(residual):
    ids = torch.tensor([[[3, 5, 7], [-1, -1, -1]]])  # one clip: a token and padding
    tables = [residual.first_table[0], residual.shared_tables[0]]
    pad = residual.pad_id
    for layer in (1, 2):
        expected = sum(tables[i][ids[0, 0, i]] for i in range(layer))
        padding = sum(tables[i][pad] for i in range(layer))
        actual = residual.history(ids, torch.tensor([layer]))
        torch.testing.assert_close(actual[0], torch.stack([expected, padding]), rtol=0, atol=1e-7)


def test_inner_tables_serve_as_input_and_output():
    config = ResidualTransformerConfig(
        codebook_size=8, num_quantizers=6, token_dim=4, width=8, heads=1, layers=1
    )
    residual = ResidualTransformer(config)
    inputs, outputs = residual.input_tables(), residual.output_tables()
    assert inputs.shape == outputs.shape == (5, 9, 4)
    assert torch.equal(inputs[1:], outputs[:-1])
    assert torch.equal(inputs[1:], residual.shared_tables)
    assert not torch.equal(inputs[0], outputs[4])


def test_tables_of_their_own_count_once_beside_the_bias():
    torch.manual_seed(0)
    config = replace(ResidualTransformerConfig.tiny(), shares_tables=False)
    network = ResidualTransformer(config).eval()
    torch.nn.init.normal_(network.output_bias)
    assert network.input_tables().data_ptr() != network.output_tables().data_ptr()
    history, text = torch.randn(2, 4, 16), torch.randn(2, 64)
    layer, valid = torch.tensor([1, 2]), torch.ones(2, 4, dtype=torch.bool)
    logits = network(history, layer, text, valid)
    bias = network.output_bias.data.clone()
    network.output_bias.data.zero_()
    scores = network(history, layer, text, valid)
    torch.testing.assert_close(logits, scores + bias[[0, 1]][:, None])
    network.own_output_tables.data.mul_(3)
    torch.testing.assert_close(network(history, layer, text, valid), 3 * scores)


def test_each_layer_is_scored_by_its_own_table(residual):
    ids, valid, text = token_batch()
    history = residual.history(ids[..., None].expand(-1, -1, 3), torch.tensor([1, 2]))
    layers = torch.tensor([1, 2])
    before = residual(history, layers, text, valid)
    with torch.no_grad():
        residual.last_table += 1.0  # the output table of layer 2
    after = residual(history, layers, text, valid)
    assert torch.equal(after[0], before[0])
    assert not torch.allclose(after[1], before[1])


def test_padding_does_not_change_the_residual_logits(residual):
    ids, valid, text = token_batch()
    full = torch.where(valid, ids, -1)[..., None].expand(-1, -1, 3)
    layer = torch.tensor([2, 1])
    padded = residual(residual.history(full, layer), layer, text, valid)
    alone = residual(residual.history(full[1:, :5], layer[1:]), layer[1:], text[1:], valid[1:, :5])
    torch.testing.assert_close(padded[1:, :5], alone, rtol=0, atol=SAME_CLIP)


def test_a_short_clip_in_a_padded_batch_is_tokenised_as_alone():
    torch.manual_seed(0)
    tokenizer = RvqVae(RvqVaeConfig.tiny()).eval()
    for book in tokenizer.quantizer.books:
        book.codes.normal_()
    features, frames = torch.randn(2, 40, 263), frame_mask(torch.tensor([40, 12]), 40)
    ids = tokenizer.encode(features, frames)
    assert torch.equal(ids[1:, :3], tokenizer.encode(features[1:, :12]))
    assert (ids[1, 3:] == -1).all()
    decoded = tokenizer.decode_ids(ids, frames)
    torch.testing.assert_close(decoded[1:, :12], tokenizer.decode_ids(ids[1:, :3]), rtol=0, atol=SAME_CLIP)


def test_frames_that_make_no_whole_token_are_refused():
    with pytest.raises(ValueError, match="`features` must have a multiple of 4 frames, got 10"):
        RvqVae(RvqVaeConfig.tiny()).encode(torch.zeros(1, 10, 263))


def test_text_is_dropped_clip_by_clip():
    torch.manual_seed(0)
    text = torch.ones(4000, 3)
    dropped = drop_text(text, 0.1)
    is_kept = dropped.any(1)
    assert torch.equal(dropped[is_kept], text[is_kept])
    assert (~is_kept).float().mean() == pytest.approx(0.1, abs=4 * (0.1 * 0.9 / 4000) ** 0.5)


@pytest.mark.parametrize(
    ("config", "changes", "message"),
    [
        (RvqVaeConfig, {"downsample": 3}, "`downsample` must be a power of two and at least 2, got 3"),
        (RvqVaeConfig, {"width": 0}, "Sizes must be positive"),
        (RvqVaeConfig, {"quantize_dropout": 1.5}, r"`quantize_dropout` must be in \[0, 1\]"),
        (MaskedTransformerConfig, {"heads": 5}, "`width` must be a multiple of `heads`, got 384 and 5"),
        (
            ResidualTransformerConfig,
            {"num_quantizers": 2},
            "`num_quantizers` must be at least 3 to share tables",
        ),
        (
            ResidualTransformerConfig,
            {"num_quantizers": 1, "shares_tables": False},
            "must be at least 2, got 1",
        ),
        (ControlBranchConfig, {"encoder": "mlp"}, r"`encoder` must be one of .*, got 'mlp'"),
        (ControlBranchConfig, {"joints": ()}, "`joints` must name at least one joint"),
    ],
)
def test_impossible_configurations_are_refused(config, changes, message):
    with pytest.raises(ValueError, match=message):
        config(**changes)


def test_a_projection_maps_the_frames_of_each_token_alone():
    """The paper's "projection layer": no token hears of its neighbours, as in the convolutions it does."""
    for kind, hears in (("projection", False), ("convolution", True)):
        torch.manual_seed(0)
        branch = ControlBranch(replace(ControlBranchConfig.tiny(), encoder=kind)).eval()
        signal = torch.randn(1, branch.config.signal_dim, 12, generator=torch.Generator().manual_seed(1))
        moved = signal.clone()
        moved[:, :, 4:8] += 1
        difference = (branch.encoder(moved) - branch.encoder(signal)).abs().amax((0, 1))
        assert difference[1] > 0
        assert (difference[[0, 2]].max() > 0) == hears


def test_a_projected_signal_is_silent_in_padding():
    branch = ControlBranch(replace(ControlBranchConfig.tiny(), encoder="projection")).eval()
    frames = frame_mask(torch.tensor([8]), 12)
    assert branch.encoder(torch.zeros(1, branch.config.signal_dim, 12), frames)[..., 2].abs().max() == 0


@pytest.mark.parametrize("into_frozen_trunk", [True, False])
def test_the_hint_enters_the_frozen_trunk_only_if_it_should(masked, into_frozen_trunk):
    """With silent middle linears the hint can reach the logits by no other way."""
    config = replace(ControlBranchConfig.tiny(), into_frozen_trunk=into_frozen_trunk)
    branch = ControlBranch.beside(masked, config).eval()
    torch.nn.init.normal_(branch.first_zero.weight, generator=torch.Generator().manual_seed(0))
    ids = torch.zeros(1, 3, dtype=torch.long)
    valid = torch.ones(1, 3, dtype=torch.bool)
    sequence = masked.sequence(masked.embed(ids), torch.ones(1, 64))
    signal = torch.randn(1, 12, config.signal_dim, generator=torch.Generator().manual_seed(1))
    changed = not torch.equal(branch(masked, sequence, signal, valid), masked.logits(sequence, valid))
    assert changed == into_frozen_trunk


@pytest.mark.parametrize("layers", [6, 7])
def test_six_quantisers_or_six_beside_the_base(layers):
    """ "6 residual layers" reads as seven in all; the published weights have six."""
    tokenizer = RvqVae(replace(RvqVaeConfig.tiny(), num_quantizers=layers)).eval()
    residual = ResidualTransformer(replace(ResidualTransformerConfig.tiny(), num_quantizers=layers)).eval()
    ids = tokenizer.encode(torch.randn(1, 8, 263))
    assert ids.shape == (1, 2, layers)
    last = torch.tensor([layers - 1])
    history = residual.history(ids, last)
    logits = residual(history, last, torch.ones(1, 64), torch.ones(1, 2, dtype=torch.bool))
    assert logits.shape == (1, 2, 33)


@pytest.mark.parametrize("token_dim", [384, 512])
def test_token_embeddings_have_the_trunks_width_or_the_codes(token_dim):
    config = replace(MaskedTransformerConfig.paper(), token_dim=token_dim, layers=1)
    network = MaskedTransformer(config)
    ids = torch.zeros(1, 3, dtype=torch.long)
    assert network.embed(ids).shape == (1, 3, token_dim)
    assert network.sequence(network.embed(ids), torch.ones(1, 512)).shape == (1, 4, 384)
