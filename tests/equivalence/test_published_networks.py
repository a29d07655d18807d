"""Imported networks compute what the papers' formulas say: a NumPy forward over the published names.

Nothing of the package is used for the expected values: convolutions, quantisation, attention and heads are
written here from their formulas, in float64, one clip at a time, without padding.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from published_layout import (
    SMALL,
    SMALL_KIT,
    control_shapes,
    length_shapes,
    masked_shapes,
    random_state,
    residual_shapes,
    rvq_shapes,
)

from controlmm.convert.control import import_control
from controlmm.convert.momask import import_length, import_masked, import_residual, import_rvq
from controlmm.motion.skeleton import HUMANML3D

# float32 networks of a few layers against float64 formulas; values are of order one
CLOSE = {"rtol": 1e-4, "atol": 1e-4}
HEADS = 6
OPTIONS = {"n_heads": HEADS}
FRAMES, TOKENS = 24, 6


class Published:
    """A published state dict and the layers over it."""

    def __init__(self, state: dict[str, torch.Tensor]) -> None:
        self.arrays = {name: tensor.numpy().astype(np.float64) for name, tensor in state.items()}

    def __getitem__(self, name: str) -> np.ndarray:
        return self.arrays[name]

    def linear(self, name: str, x: np.ndarray) -> np.ndarray:
        return x @ self[f"{name}.weight"].T + self[f"{name}.bias"]

    def norm(self, name: str, x: np.ndarray, epsilon: float = 1e-5) -> np.ndarray:
        centred = x - x.mean(-1, keepdims=True)
        spread = np.sqrt((centred**2).mean(-1, keepdims=True) + epsilon)
        return centred / spread * self[f"{name}.weight"] + self[f"{name}.bias"]

    def conv(
        self, name: str, x: np.ndarray, *, stride: int = 1, padding: int = 1, dilation: int = 1
    ) -> np.ndarray:
        """``x`` (channels, time): every output is a sum over taps of a matrix times a shifted column."""
        kernel = self[f"{name}.weight"]
        padded = np.pad(x, ((0, 0), (padding, padding)))
        span = dilation * (kernel.shape[2] - 1)
        starts = range(0, padded.shape[1] - span, stride)
        columns = [
            sum(kernel[:, :, tap] @ padded[:, start + tap * dilation] for tap in range(kernel.shape[2]))
            for start in starts
        ]
        return np.stack(columns, axis=1) + self[f"{name}.bias"][:, None]

    def residual_stack(self, name: str, x: np.ndarray) -> np.ndarray:
        depth = SMALL.depth
        for block in range(depth):
            dilation = 3 ** (depth - 1 - block)  # the widest first
            hidden = self.conv(f"{name}.model.{block}.conv1", relu(x), padding=dilation, dilation=dilation)
            x = x + self.conv(f"{name}.model.{block}.conv2", relu(hidden), padding=0)
        return x

    def encoder(self, name: str, frames: np.ndarray) -> np.ndarray:
        """(frames, channels) -> (tokens, channels)."""
        x = relu(self.conv(f"{name}.model.0", frames.T))
        for stage in (2, 3):
            x = self.conv(f"{name}.model.{stage}.0", x, stride=2)
            x = self.residual_stack(f"{name}.model.{stage}.1", x)
        return self.conv(f"{name}.model.4", x).T

    def decoder(self, tokens: np.ndarray) -> np.ndarray:
        x = relu(self.conv("decoder.model.0", tokens.T))
        for stage in (2, 3):
            x = self.residual_stack(f"decoder.model.{stage}.0", x)
            x = self.conv(f"decoder.model.{stage}.2", np.repeat(x, 2, axis=1))
        return self.conv("decoder.model.6", relu(self.conv("decoder.model.4", x))).T

    def attention(self, name: str, x: np.ndarray) -> np.ndarray:
        stacked = x @ self[f"{name}.in_proj_weight"].T + self[f"{name}.in_proj_bias"]
        queries, keys, values = np.split(stacked, 3, axis=1)
        size = x.shape[1] // HEADS
        mixed = []
        for head in range(HEADS):
            part = slice(head * size, (head + 1) * size)
            weights = softmax(queries[:, part] @ keys[:, part].T / math.sqrt(size))
            mixed.append(weights @ values[:, part])
        return self.linear(f"{name}.out_proj", np.concatenate(mixed, axis=1))

    def encoder_layer(self, name: str, x: np.ndarray) -> np.ndarray:
        x = self.norm(f"{name}.norm1", x + self.attention(f"{name}.self_attn", x))
        hidden = self.linear(f"{name}.linear2", gelu(self.linear(f"{name}.linear1", x)))
        return self.norm(f"{name}.norm2", x + hidden)

    def trunk(self, x: np.ndarray) -> np.ndarray:
        for layer in range(SMALL.layers):
            x = self.encoder_layer(f"seqTransEncoder.layers.{layer}", x)
        return x

    def sequence(self, embedded: np.ndarray, text: np.ndarray, *extra: np.ndarray) -> np.ndarray:
        tokens = self.linear("input_process.poseEmbedding", embedded)
        tokens = tokens + positions(len(tokens), tokens.shape[1])
        return np.concatenate([self.linear("cond_emb", text)[None], *extra, tokens])

    def head(self, x: np.ndarray) -> np.ndarray:
        hidden = gelu(self.linear("output_process.dense", x))
        hidden = self.norm("output_process.LayerNorm", hidden, epsilon=1e-12)
        return self.linear("output_process.poseFinal", hidden)


def relu(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, 0)


def gelu(x: np.ndarray) -> np.ndarray:
    return 0.5 * x * (1 + np.vectorize(math.erf)(x / math.sqrt(2)))


def softmax(x: np.ndarray) -> np.ndarray:
    exponentials = np.exp(x - x.max(-1, keepdims=True))
    return exponentials / exponentials.sum(-1, keepdims=True)


def positions(count: int, width: int) -> np.ndarray:
    code = np.zeros((count, width))
    for position in range(count):
        for pair in range(width // 2):
            angle = position * math.exp(-2 * pair * math.log(10000) / width)
            code[position, 2 * pair], code[position, 2 * pair + 1] = math.sin(angle), math.cos(angle)
    return code


def random_array(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def check(actual: torch.Tensor, expected: np.ndarray) -> None:
    torch.testing.assert_close(actual.detach().double(), torch.from_numpy(expected), **CLOSE)


@pytest.mark.parametrize("size", [SMALL, SMALL_KIT], ids=["t2m", "kit"])
def test_the_tokenizer(size):
    state = random_state(rvq_shapes(size), seed=1)
    published, network = Published(state), import_rvq(state, {})
    frames = random_array(2, FRAMES, size.features)
    encoded = published.encoder("encoder", frames)
    check(network.encode_latents(torch.from_numpy(frames)[None])[0], encoded)

    rest, ids = encoded, []
    for layer in range(size.quantizers):
        codes = published[f"quantizer.layers.{layer}.codebook"]
        distances = ((rest[:, None] - codes[None]) ** 2).sum(-1)
        ids.append(distances.argmin(1))
        rest = rest - codes[ids[-1]]
    assert np.array_equal(network.encode(torch.from_numpy(frames)[None])[0].numpy(), np.stack(ids, axis=1))
    check(
        network.decode_ids(torch.from_numpy(np.stack(ids, axis=1))[None])[0],
        published.decoder(encoded - rest),
    )


def test_the_masked_transformer():
    state = random_state(masked_shapes(SMALL), seed=3)
    published, network = Published(state), import_masked(state, OPTIONS)
    ids, text = np.array([3, 32, 0, 31, 32, 7]), random_array(4, SMALL.text)  # 32 is MASK
    sequence = published.sequence(published["token_emb.weight"][ids], text)
    expected = published.head(published.trunk(sequence)[1:])
    embedded = network.embed(torch.from_numpy(ids)[None])
    check(network(embedded, torch.from_numpy(text)[None], all_valid())[0], expected)


def test_padding_is_attended_by_nobody():
    """A clip of four tokens inside six positions: the last two are PAD."""
    state = random_state(masked_shapes(SMALL), seed=3)
    published, network = Published(state), import_masked(state, OPTIONS)
    ids, text = np.array([3, 32, 0, 31, 33, 33]), random_array(4, SMALL.text)
    sequence = published.sequence(published["token_emb.weight"][ids[:4]], text)
    valid = torch.tensor([[True] * 4 + [False] * 2])
    logits = network(network.embed(torch.from_numpy(ids)[None]), torch.from_numpy(text)[None], valid)
    check(logits[0, :4], published.head(published.trunk(sequence)[1:]))


@pytest.mark.parametrize("joints", [1, 6])
def test_the_control_model(joints):
    """Control encoder, zero linears, copied trunk; the frozen trunk starts from tokens plus hint, too."""
    size = SMALL if joints == 6 else type(SMALL)(**{**vars(SMALL), "joints": 1})
    state = random_state(control_shapes(size), seed=5)
    published = Published(state)
    imported = import_control(state, OPTIONS, HUMANML3D)
    ids, text = np.array([3, 32, 0, 31, 32, 7]), random_array(6, SMALL.text)
    targets, current = random_array(7, FRAMES, 22, 3), random_array(8, FRAMES, 22, 3)
    mask = np.random.default_rng(9).random((FRAMES, 22)) < 0.3

    chosen = [0, 10, 11, 15, 20, 21][:joints]
    difference = ((targets - current) * mask[..., None])[:, chosen].reshape(FRAMES, -1)
    target = (targets * mask[..., None])[:, chosen].reshape(FRAMES, -1)
    encoded = published.encoder("encoder_control", np.concatenate([difference, target], axis=1))
    hint = np.pad(published.linear("first_zero_linear", encoded), ((1, 0), (0, 0)))
    frozen = copied = published.sequence(published["token_emb.weight"][ids], text) + hint
    for layer in range(SMALL.layers):
        copied = published.encoder_layer(f"seqTransEncoder_control.layers.{layer}", copied)
        frozen = published.encoder_layer(f"seqTransEncoder.layers.{layer}", frozen)
        frozen = frozen + published.linear(f"mid_zero_linear.{layer}", copied)

    as_batch = [
        torch.from_numpy(array)[None] for array in (targets, np.repeat(mask[..., None], 3, -1), current)
    ]
    signal = imported.branch.signal(*as_batch)
    sequence = imported.base.sequence(
        imported.base.embed(torch.from_numpy(ids)[None]), torch.from_numpy(text)[None]
    )
    check(imported.branch(imported.base, sequence, signal, all_valid())[0], published.head(frozen[1:]))
    assert set(imported.tokenizer_copy) == set(rvq_shapes(SMALL))


@pytest.mark.parametrize("layer", [1, 2, 3])
def test_the_residual_transformer(layer):
    state = random_state(residual_shapes(SMALL), seed=10)
    published, network = Published(state), import_residual(state, OPTIONS)
    ids = np.random.default_rng(11).integers(0, SMALL.codes, (TOKENS, SMALL.quantizers))
    text = random_array(12, SMALL.text)
    tables_in = [published["token_embed_weight_"][0], *published["embed_proj_shared_weight"]]
    tables_out = [*published["embed_proj_shared_weight"], published["output_proj_weight_"][0]]
    history = sum(tables_in[earlier][ids[:, earlier]] for earlier in range(layer))
    one_hot = np.eye(SMALL.quantizers)[layer]
    sequence = published.sequence(history, text, published.linear("quant_emb", one_hot)[None])
    expected = published.head(published.trunk(sequence)[2:]) @ tables_out[layer - 1].T

    number = torch.tensor([layer])
    ours = network.history(torch.from_numpy(ids)[None], number)
    check(network(ours, number, torch.from_numpy(text)[None], all_valid())[0], expected)


def test_the_length_estimator():
    state = random_state(length_shapes(SMALL), seed=13)
    published, network = Published(state), import_length(state)
    text = random_array(14, SMALL.text)
    hidden = text.astype(np.float64)
    for index in (0, 4, 8):
        hidden = published.norm(f"output.{index + 1}", published.linear(f"output.{index}", hidden))
        hidden = np.where(hidden > 0, hidden, 0.2 * hidden)
    check(network(torch.from_numpy(text)[None])[0], published.linear("output.11", hidden))


def all_valid() -> torch.Tensor:
    return torch.ones(1, TOKENS, dtype=torch.bool)
