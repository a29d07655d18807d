"""Gauss-Newton and what it stands on, against autograd, finite differences and dense linear algebra."""

from __future__ import annotations

import pytest
import torch

from controlmm.generation.code_spread import CodeSpread
from controlmm.generation.control_residuals import ControlResiduals
from controlmm.generation.frozen_decoder import FrozenDecoder
from controlmm.generation.frozen_layers import neighbours
from controlmm.generation.kinematic_rows import KinematicPattern
from controlmm.generation.objective import ControlObjective
from controlmm.generation.partial_decoder import PartialDecoder, controlled_joints
from controlmm.generation.sensitivity import measure_sensitivity
from controlmm.generation.solvers import Stopping, gauss_newton
from controlmm.generation.solvers.metric import Metric
from controlmm.models.rvq_vae import frame_mask
from controlmm.nn.conv import ConvDecoder, DecoderEnds
from controlmm.ops import masked_consistency_loss, recover_joints

ROUNDING = 1e-5  # of float32 sums in another order
CHANNELS = (0, 1, 2, 3, 7, 8, 9)


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def make_decoder(
    *, depth: int = 2, downsample: int = 4, is_always_on: bool = False, ends: DecoderEnds = "zeros"
) -> ConvDecoder:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        decoder = ConvDecoder(8, 12, width=8, depth=depth, downsample=downsample, dropout=0.0, ends=ends)
    if is_always_on:  # biases so large that every rectifier stays on: the decoder is linear
        for name, parameter in decoder.named_parameters():
            if name.endswith("bias"):
                parameter.data.fill_(100.0)
            elif not name.startswith("exit"):
                parameter.data.abs_()
    return decoder.eval().requires_grad_(False)


@pytest.mark.parametrize("ends", ["zeros", "repeat"])
@pytest.mark.parametrize("downsample", [2, 4, 8])
@pytest.mark.parametrize("tokens", [1, 2, 5, 13])
def test_frozen_decoder_agrees_with_autograd(tokens, downsample, ends):
    decoder, latents = make_decoder(ends=ends, downsample=downsample), random(3, tokens, 8)
    frozen = FrozenDecoder(decoder)
    features, tape = frozen.forward(latents, CHANNELS)
    leaf = latents.clone().requires_grad_()
    expected = decoder(leaf.mT).mT[..., CHANNELS]
    torch.testing.assert_close(features, expected.detach(), rtol=ROUNDING, atol=ROUNDING)
    cotangent = random(*features.shape, seed=1)
    (gradient,) = torch.autograd.grad(expected, leaf, cotangent)
    torch.testing.assert_close(frozen.pull(tape, cotangent), gradient, rtol=1e-4, atol=ROUNDING)


@pytest.mark.parametrize("ends", ["zeros", "repeat"])
def test_tangents_of_the_frozen_decoder_are_finite_differences(ends):
    decoder = make_decoder(ends=ends).double()
    latents, tangent = random(2, 6, 8).double(), random(2, 6, 8, seed=4)
    frozen, step = FrozenDecoder(decoder, dtype=torch.float64), 1e-6
    _, tape = frozen.forward(latents, CHANNELS)
    shifted = [frozen.forward(latents + sign * step * tangent, CHANNELS)[0] for sign in (1, -1)]
    difference = (shifted[0] - shifted[1]) / (2 * step)
    torch.testing.assert_close(frozen.push(tape, tangent.double()), difference, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("ends", ["zeros", "repeat"])
def test_tangents_and_gradients_are_adjoint(ends):
    decoder, latents = make_decoder(ends=ends), random(2, 6, 8)
    frozen = FrozenDecoder(decoder)
    features, tape = frozen.forward(latents, CHANNELS)
    tangent, cotangent = random(2, 6, 8, seed=1), random(*features.shape, seed=2)
    forward = (frozen.push(tape, tangent) * cotangent).sum()
    back = (frozen.pull(tape, cotangent) * tangent).sum()
    torch.testing.assert_close(forward, back, rtol=1e-4, atol=1e-4)


def test_a_decoder_decodes_inside_inference_mode_and_outside():
    """Its memory for neighbouring frames grows with the longest batch and outlives the mode it grew in."""
    frozen = FrozenDecoder(make_decoder())
    with torch.inference_mode():
        inside, _ = frozen.forward(random(3, 2000, 8), CHANNELS)
    outside, _ = frozen.forward(random(3, 2000, 8), CHANNELS)
    assert torch.equal(inside, outside)


@pytest.mark.parametrize(("frames", "distance"), [(7, 1), (7, 3), (3, 3), (2, 9)])
def test_neighbours_of_frames(frames, distance):
    x = random(2, frames, 5)
    padded = torch.nn.functional.pad(x, (0, 0, distance, distance))
    expected = torch.cat([padded[:, at : at + frames] for at in (0, distance, 2 * distance)], dim=2)
    neighbours(random(3, 9, 5, seed=1), 2)  # leaves what must not be seen
    assert torch.equal(neighbours(x, distance), expected)


def test_neighbours_of_clips_that_lie_end_to_end():
    clips = [random(1, frames, 5, seed=frames) for frames in (2, 7, 1, 4)]
    for distance in (1, 3, 9):
        expected = [neighbours(clip, distance).clone() for clip in clips]
        neighbours(random(3, 9, 5, seed=1), 2)  # leaves what must not be seen
        assert torch.equal(neighbours(torch.cat(clips, 1), distance, (2, 7, 1, 4)), torch.cat(expected, 1))


@pytest.mark.parametrize("ends", ["zeros", "repeat"])
def test_clips_that_lie_end_to_end_are_decoded_as_each_by_itself(ends):
    frozen, lengths = FrozenDecoder(make_decoder(ends=ends)), (5, 1, 13, 2)
    clips = [random(1, tokens, 8, seed=tokens) for tokens in lengths]
    seeds = [random(1, 4 * tokens, len(CHANNELS), seed=tokens) for tokens in lengths]
    features, tape = frozen.forward(torch.cat(clips, 1), CHANNELS, lengths)
    together = features, frozen.pull(tape, torch.cat(seeds, 1)), frozen.push(tape, torch.cat(clips, 1))
    alone: list[list[torch.Tensor]] = [[], [], []]
    for clip, seed in zip(clips, seeds, strict=True):
        single, own = frozen.forward(clip, CHANNELS)
        for kept, result in zip(alone, (single, frozen.pull(own, seed), frozen.push(own, clip)), strict=True):
            kept.append(result)
    for whole, parts in zip(together, alone, strict=True):
        assert torch.equal(whole, torch.cat(parts, 1))


def test_latents_that_are_looked_at_again_decode_alike(monkeypatch):
    """By other channels, after other latents, by another decoder, and after they have been written into."""
    passes, run = [], FrozenDecoder._run
    monkeypatch.setattr(FrozenDecoder, "_run", lambda *given: passes.append(None) or run(*given))
    frozen, other = FrozenDecoder(make_decoder()), FrozenDecoder(make_decoder(depth=1))
    latents = random(2, 5, 8)

    def passes_for(decoder, channels):
        before = len(passes)
        found, tape = decoder.forward(latents, channels, is_looked_at_again=True)
        count = len(passes) - before
        plain, plain_tape = decoder.forward(latents, channels)
        assert torch.equal(found, plain)
        gradient = random(*plain.shape, seed=1)
        assert torch.equal(decoder.pull(tape, gradient), decoder.pull(plain_tape, gradient))
        return count

    assert [passes_for(frozen, channels) for channels in (CHANNELS, (2,), CHANNELS)] == [1, 0, 0]
    assert [passes_for(decoder, CHANNELS) for decoder in (other, frozen, frozen)] == [1, 1, 0]
    latents[0, 0] += 1
    assert [passes_for(frozen, CHANNELS) for _ in range(2)] == [1, 0]


def test_a_packed_decoder_sees_new_weights(tiny_pipeline):
    decoder, latents = tiny_pipeline.decoder, random(1, 6, 16)
    before, _ = decoder.frozen().forward(latents, CHANNELS)
    with torch.no_grad():
        decoder.tokenizer.decoder.exit.weight.mul_(2)
    after, _ = decoder.frozen().forward(latents, CHANNELS)
    assert (after - before).abs().max() > 0.01
    expected = decoder.tokenizer.decode(latents)[..., CHANNELS]
    torch.testing.assert_close(after, expected, rtol=ROUNDING, atol=ROUNDING)


def test_bfloat16_decodes_nearly_the_same():
    decoder, latents = make_decoder(), random(2, 6, 8)
    exact, _ = FrozenDecoder(decoder).forward(latents, CHANNELS)
    rough, _ = FrozenDecoder(decoder, dtype=torch.bfloat16).forward(latents, CHANNELS)
    assert 0 < (rough - exact).abs().max() < 0.03 * exact.abs().max()  # 8 bits, six layers


def test_controlled_joints_begin_with_the_pelvis():
    mask = torch.zeros(2, 4, 22, 3, dtype=torch.bool)
    assert controlled_joints(mask) == (0,)
    mask[0, 1, 20, 1] = mask[1, 3, 10, 0] = True
    assert controlled_joints(mask) == (0, 10, 20)


def test_partly_decoded_clips_do_not_depend_on_the_clips_beside_them(tiny_pipeline):
    """Bitwise: packed products give a row the same number in any batch, and padding is not decoded."""
    decoder, frames = tiny_pipeline.decoder, frame_mask(torch.tensor([24, 16, 24]), 24)
    latents, cotangent = random(3, 6, 16), random(3, 24, 7, seed=1)
    together = PartialDecoder(decoder, (0, 20), frames)
    decoded = together.decode(latents)
    gradient = together.pull(decoded, cotangent)
    assert decoded.features[1, 16:].abs().max() == 0
    assert gradient[1, 4:].abs().max() == 0
    for clip, length in enumerate([24, 16, 24]):
        alone = PartialDecoder(decoder, (0, 20), frames[clip : clip + 1, :length])
        single = alone.decode(latents[clip : clip + 1, : length // 4])
        assert torch.equal(single.features[0], decoded.features[clip, :length])
        pulled = alone.pull(single, cotangent[clip : clip + 1, :length])
        assert torch.equal(pulled[0], gradient[clip, : length // 4])


def test_the_step_is_the_least_norm_solution():
    """With the decoder's own Jacobian and next to no damping, ``J^T M r`` is ``pinv(J) r``."""
    decoder, latents = FrozenDecoder(make_decoder(), dtype=torch.float64), random(1, 5, 8).double()
    channels, std = tuple(range(10)), random(10, seed=1).double().abs() + 0.5
    features, tape = decoder.forward(latents, channels)
    seeds = torch.eye(200).double().reshape(200, 10, 20).mT
    jacobian = decoder.pull(tape.select(torch.zeros(200, dtype=torch.long)), seeds).flatten(1).double()
    mask = torch.zeros(20, 3, 3, dtype=torch.bool)
    mask[7], mask[15, 0], mask[18, 2] = True, True, True
    scaled = features[0].double() * std
    joints = recover_joints(scaled[None], joints=3)[0]
    rows = KinematicPattern(mask, std).rows(scaled, joints)
    whole = rows.dense(10).mT.flatten(1) @ jacobian
    residual = random(int(mask.sum()), seed=6).double()
    metric = Metric(
        rows.gram((jacobian @ jacobian.T).reshape(10, 20, 10, 20), torch.arange(10)), damping=1e-12
    )
    value, weights = metric.weigh(residual)
    expected = torch.linalg.pinv(whole) @ residual
    torch.testing.assert_close(whole.T @ weights, expected, rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(torch.tensor(value), (0.5 * expected.square().sum()).float())


def test_sensitivity_of_a_linear_decoder_is_its_jacobians_product():
    """Rectifiers that are always on make all rows shifted copies; away from the ends nothing is cut off."""
    decoder = FrozenDecoder(make_decoder(depth=1, is_always_on=True))
    channels, tokens = (0, 3, 4), 13
    measured = measure_sensitivity(
        decoder, random(2, 25, 8), channels, downsample=4, spread=CodeSpread(torch.eye(8))
    )
    assert measured.scatter.max() < 1e-4 * measured.mean.square().sum((2, 3)).max()
    _, tape = decoder.forward(random(1, tokens, 8), channels)
    count = len(channels) * 4 * tokens
    seeds = torch.eye(count).reshape(count, len(channels), 4 * tokens).mT
    jacobian = decoder.pull(tape.select(torch.zeros(count, dtype=torch.long)), seeds).flatten(1)
    expected = (jacobian @ jacobian.T).reshape(3, 52, 3, 52)
    middle = slice(20, 32)  # a channel sees 5 tokens to each side
    torch.testing.assert_close(
        measured.gram(tokens)[:, middle, :, middle], expected[:, middle, :, middle], rtol=1e-3, atol=1e-3
    )


@pytest.fixture
def scene(tiny_pipeline):
    """Three clips of 24 and 16 frames, joints to be moved a little from where random codes put them."""
    decoder, frames = tiny_pipeline.decoder, frame_mask(torch.tensor([24, 16, 24]), 24)
    keep = frames[:, ::4, None].float()
    latents = decoder.tokenizer.base_codes[:18].reshape(3, 6, 16) * keep
    targets = decoder(latents, frames) + 0.1 * random(3, 24, 22, 3, seed=1)
    mask = torch.zeros(3, 24, 22, 3, dtype=torch.bool)
    mask[0, 20, 0] = mask[1, 9, 20] = mask[1, 14, 0, 0] = mask[2, 3, 15] = mask[2, 21, 10] = True
    return decoder, targets, mask, frames, latents, keep


def test_gauss_newton_meets_sparse_targets_to_a_millimetre(scene):
    decoder, targets, mask, frames, latents, keep = scene
    stopping = Stopping(iterations=80, error=1e-3)
    solution = gauss_newton(ControlResiduals(decoder, targets, mask, frames), latents, keep, stopping)
    assert solution.reasons == ("target met",) * 3
    joints = decoder(solution.latents, frames)
    error = masked_consistency_loss(joints, targets, mask, norm="l2", reduction="clip")
    assert error.max() <= 1e-3
    assert [errors[-1] <= 1e-3 for errors in solution.errors]


def test_gauss_newton_and_the_control_objective_agree_on_the_loss(scene):
    decoder, targets, mask, frames, latents, _ = scene
    residuals = ControlResiduals(decoder, targets, mask, frames)
    objective = ControlObjective(decoder, targets, mask, frames)
    expected, gradient = objective.value_and_gradient(latents)
    probes = residuals.probe(latents)
    losses = torch.tensor([probe.loss for probe in probes])
    torch.testing.assert_close(losses, expected, rtol=1e-4, atol=1e-9)
    pulled = residuals.pull([2 * probe.residual / len(probe.residual) for probe in probes])
    torch.testing.assert_close(pulled, gradient, rtol=1e-3, atol=ROUNDING)


@pytest.mark.parametrize("threads", [1, 2])
def test_a_clips_solution_does_not_depend_on_batch_padding_or_threads(scene, threads):
    decoder, targets, mask, frames, latents, keep = scene
    stopping = Stopping(iterations=8)
    together = gauss_newton(ControlResiduals(decoder, targets, mask, frames), latents, keep, stopping)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        for clip, length in enumerate([24, 16, 24]):
            rows = slice(clip, clip + 1)
            alone = ControlResiduals(
                decoder, targets[rows, :length], mask[rows, :length], frames[rows, :length]
            )
            tokens = length // 4
            single = gauss_newton(alone, latents[rows, :tokens], keep[rows, :tokens], stopping)
            assert torch.equal(single.losses[0], together.losses[clip])
            assert torch.equal(single.latents[0], together.latents[clip, :tokens])
    finally:
        torch.set_num_threads(before)


def test_a_clips_solution_does_not_depend_on_which_joints_others_lead(scene):
    decoder, targets, _, _, latents, keep = scene
    frames, keep = torch.ones(3, 24, dtype=torch.bool), torch.ones_like(keep)
    mask = torch.zeros(3, 24, 22, 3, dtype=torch.bool)
    for clip, joints in enumerate([(0, 10, 20, 21), (11, 15), (0, 3, 5, 7, 9, 16, 18)]):
        mask[clip, :, joints] = True
    stopping = Stopping(iterations=8)
    together = gauss_newton(ControlResiduals(decoder, targets, mask, frames), latents, keep, stopping)
    for clip in range(3):
        rows = slice(clip, clip + 1)
        alone = ControlResiduals(decoder, targets[rows], mask[rows], frames[rows])
        single = gauss_newton(alone, latents[rows], keep[rows], stopping)
        assert torch.equal(single.latents[0], together.latents[clip])
        assert torch.equal(single.losses[0], together.losses[clip])


def test_fixed_tokens_stay_and_the_others_meet_the_target(scene):
    decoder, targets, mask, frames, latents, keep = scene
    held = keep.clone()
    held[:, :2] = 0
    mask = mask.clone()
    mask[2, 3] = False  # no frame of the fixed part can be wanted elsewhere
    solution = gauss_newton(
        ControlResiduals(decoder, targets, mask, frames), latents, held, Stopping(iterations=30, error=1e-3)
    )
    assert torch.equal(solution.latents[:, :2], latents[:, :2])
    assert all(errors.min() < 0.3 * errors[0] for errors in solution.errors)


def test_a_root_that_should_start_elsewhere_does_not_spoil_the_rest(scene):
    """Features cannot say where the root is at frame 0: no latents move it."""
    decoder, targets, _, frames, latents, keep = scene
    mask = torch.zeros(3, 24, 22, 3, dtype=torch.bool)
    mask[:, 0, 0, 0] = mask[:, 12, 0, 0] = True
    targets = targets.clone()
    targets[:, 0, 0, 0] = 0.01
    solution = gauss_newton(
        ControlResiduals(decoder, targets, mask, frames), latents, keep, Stopping(iterations=20)
    )
    joints = decoder(solution.latents, frames)
    assert (joints[:, 12, 0, 0] - targets[:, 12, 0, 0]).abs().max() < 1e-3


def test_clips_without_targets_are_done_at_once(scene):
    decoder, targets, _, frames, latents, keep = scene
    nothing = torch.zeros(3, 24, 22, 3, dtype=torch.bool)
    solution = gauss_newton(
        ControlResiduals(decoder, targets, nothing, frames), latents, keep, Stopping(iterations=5)
    )
    assert torch.equal(solution.latents, latents)
    assert solution.evaluations.tolist() == [1, 1, 1]
