"""Imported TLControl networks compute what the formulas say: a NumPy forward over the published names.

Nothing of the package is used for the expected values; float64, one clip, full attention.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from published_layout import random_state
from published_tlcontrol import PART_WIDTHS, SMALL, tokenizer_shapes, transformer_shapes

from controlmm.convert.tlcontrol import import_part_vq, import_transformer

CLOSE = {"rtol": 1e-4, "atol": 1e-4}  # float32 networks against float64 formulas; values are of order one
FRAMES, TOKENS, HEADS = 24, 6, 4


class Published:
    """A published state dict and the layers over it."""

    def __init__(self, state):
        self.arrays = {name: tensor.numpy().astype(np.float64) for name, tensor in state.items()}

    def linear(self, name, x):
        return x @ self.arrays[f"{name}.weight"].T + self.arrays[f"{name}.bias"]

    def norm(self, name, x):
        x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5)
        return x * self.arrays[f"{name}.weight"] + self.arrays[f"{name}.bias"]

    def conv(self, name, x, *, stride=1, padding=1, dilation=1):
        kernel = self.arrays[f"{name}.weight"]
        padded = np.pad(x, ((0, 0), (padding, padding)))
        starts = range(0, padded.shape[1] - dilation * (kernel.shape[2] - 1), stride)
        columns = [
            sum(kernel[:, :, tap] @ padded[:, at + tap * dilation] for tap in range(kernel.shape[2]))
            for at in starts
        ]
        return np.stack(columns, axis=1) + self.arrays[f"{name}.bias"][:, None]

    def stack(self, name, x):
        depth = SMALL.conv.depth
        for block in range(depth):
            dilation = 3 ** (depth - 1 - block)  # the widest first
            hidden = self.conv(
                f"{name}.model.{block}.conv1", np.maximum(x, 0), padding=dilation, dilation=dilation
            )
            x = x + self.conv(f"{name}.model.{block}.conv2", np.maximum(hidden, 0), padding=0)
        return x

    def encoder(self, name, frames):
        x = np.maximum(self.conv(f"{name}.model.0", frames.T), 0)
        for stage in (2, 3):
            x = self.stack(f"{name}.model.{stage}.1", self.conv(f"{name}.model.{stage}.0", x, stride=2))
        return self.conv(f"{name}.model.4", x).T

    def decoder(self, tokens):
        at = "vqvae.decoder.model"
        x = np.maximum(self.conv(f"{at}.0", tokens.T), 0)
        for stage in (2, 3):
            x = np.repeat(self.stack(f"{at}.{stage}.0", x), 2, axis=1)
            x = self.conv(f"{at}.{stage}.2", x)
        return self.conv(f"{at}.6", np.maximum(self.conv(f"{at}.4", x), 0)).T

    def layer(self, name, x):
        stacked = x @ self.arrays[f"{name}.self_attn.in_proj_weight"].T
        stacked = stacked + self.arrays[f"{name}.self_attn.in_proj_bias"]
        size = x.shape[1] // HEADS
        mixed = []
        for head in range(HEADS):
            queries, keys, values = (
                part[:, head * size : (head + 1) * size] for part in np.split(stacked, 3, axis=1)
            )
            scores = np.exp(queries @ keys.T / math.sqrt(size))
            mixed.append(scores / scores.sum(-1, keepdims=True) @ values)
        attended = self.linear(f"{name}.self_attn.out_proj", np.concatenate(mixed, axis=1))
        x = self.norm(f"{name}.norm1", x + attended)
        hidden = np.maximum(self.linear(f"{name}.linear1", x), 0)
        return self.norm(f"{name}.norm2", x + self.linear(f"{name}.linear2", hidden))


def positions(count, width):
    """Sine at even, cosine at odd channels."""
    angles = np.arange(count)[:, None] * np.exp(-np.arange(0, width, 2) * math.log(10000) / width)
    codes = np.zeros((count, width))
    codes[:, ::2], codes[:, 1::2] = np.sin(angles), np.cos(angles)
    return codes


@pytest.fixture(scope="module")
def tokenizer():
    state = random_state(tokenizer_shapes(SMALL), seed=1)
    return Published(state), import_part_vq(state)


def part_channels(part):
    """By hand from the published table: joint by joint position, rotation, velocity; extras last."""
    joints = ((), (3, 6, 9, 12, 15), (13, 16, 18, 20), (14, 17, 19, 21), (1, 4, 7, 10), (2, 5, 8, 11))[part]
    if part == 0:
        return [0, 1, 2, 3, 193, 194, 195]
    channels = []
    for joint in joints:
        channels += range(4 + 3 * (joint - 1), 7 + 3 * (joint - 1))
        channels += range(67 + 6 * (joint - 1), 73 + 6 * (joint - 1))
        channels += range(193 + 3 * joint, 196 + 3 * joint)
    return channels + {4: [259, 260], 5: [261, 262]}.get(part, [])


def test_part_encoders_scale_by_the_norm_over_channels_and_time(tokenizer):
    published, network = tokenizer
    frames = np.random.default_rng(3).normal(size=(FRAMES, 263))
    expected = []
    for part, width in enumerate(PART_WIDTHS):
        channels = part_channels(part)
        assert len(channels) == width
        latents = published.encoder(f"vqvae.limb_encoders.{part}", frames[:, channels])
        expected.append(latents / np.linalg.norm(latents))
    with torch.no_grad():
        actual = network.encode_latents(torch.from_numpy(frames).float()[None])[0]
    np.testing.assert_allclose(actual.numpy(), np.concatenate(expected, axis=1), **CLOSE)


def test_the_decoder_reads_the_codes_of_all_parts_side_by_side(tokenizer):
    published, network = tokenizer
    ids = np.random.default_rng(4).integers(0, SMALL.conv.codes, (TOKENS, 6))
    codes = [published.arrays[f"vqvae.quantizers.{part}.codebook"][ids[:, part]] for part in range(6)]
    expected = published.decoder(np.concatenate(codes, axis=1))
    with torch.no_grad():
        actual = network.decode_ids(torch.from_numpy(ids)[None])[0]
    np.testing.assert_allclose(actual.numpy(), expected, rtol=1e-3, atol=1e-3)  # values of order ten


def test_the_transformer_reads_flat_bundles_and_shares_its_output():
    state = random_state(transformer_shapes(SMALL), seed=2)
    published, network = Published(state), import_transformer(state)
    random = np.random.default_rng(5)
    trajectories, text = random.normal(size=(FRAMES, 6, 3)), random.normal(size=SMALL.text)
    bundles = trajectories.reshape(TOKENS, 4, 6, 3).transpose(0, 2, 1, 3).reshape(TOKENS * 6, 12)
    x = np.concatenate([published.linear("embed_text", text)[None], published.linear("linear_in", bundles)])
    x = x + positions(len(x), SMALL.width)
    for layer in range(SMALL.layers):
        x = published.layer(f"transformer_encoder.layers.{layer}", x)
    x = published.linear("linear_mid_codeIdx", x)
    for layer in range(SMALL.head_layers):
        x = published.layer(f"transformer_codeIdx.layers.{layer}", x)
    expected = published.linear("project_codeIdx", x[1:]).reshape(TOKENS, 6, -1)
    with torch.no_grad():
        actual = network(
            torch.from_numpy(trajectories).float()[None],
            torch.ones(1, FRAMES, 6, 3, dtype=torch.bool),
            torch.from_numpy(text).float()[None],
            torch.ones(1, TOKENS, dtype=torch.bool),
        )[0]
    np.testing.assert_allclose(actual.numpy(), expected, **CLOSE)
