"""What a network in training makes of a few validation clips, the same ones every time, to look at."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from controlmm.data.clip import FeatureClip
from controlmm.generation.controlled_layers import ControlledLayers
from controlmm.generation.decoding_request import DecodingRequest
from controlmm.generation.masked_decoding import (
    decode_from_text,
    decode_with_control,
    fill_residual_layers,
)
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.generation.noise import ClipNoise, clip_seeds
from controlmm.generation.objective import ControlObjective
from controlmm.models.masked_transformer import MaskedTransformer
from controlmm.models.residual_transformer import ResidualTransformer
from controlmm.models.rvq_vae import frame_mask
from controlmm.motion.normalizer import Normalizer
from controlmm.ops import recover_joints
from controlmm.training.recipe import Recipe, Sample
from controlmm.training.stage import NORMALIZER_FILE, StageInputs, best_weights, load_tokenizer

_SHOWN = 3  # clips
_FRAMES = 40, 196  # shortest and longest clip worth a look
_PELVIS = 0


@dataclass(frozen=True)
class _Shown:
    """A few clips, padded to the longest."""

    features: Float[Tensor, "B T D"]  # normalised
    frames: Bool[Tensor, "B T"]
    captions: list[str]

    def samples(
        self, recorded: Float[Tensor, "B T J 3"], made: Float[Tensor, "B T J 3"], note: str = ""
    ) -> list[Sample]:
        lengths = self.frames.sum(1).tolist()
        return [
            Sample(caption + note, recorded[i, :length].float(), made[i, :length].float())
            for i, (caption, length) in enumerate(zip(self.captions, lengths, strict=True))
        ]


def rebuilt_clips(recipe: Recipe, inputs: StageInputs) -> Sequence[Sample]:
    """Clips through a tokenizer in training and back."""
    decoder = MotionDecoder(_on_cpu(recipe.model), Normalizer.load(inputs.root / NORMALIZER_FILE))
    shown = _shown(inputs, decoder)
    latents = decoder.tokenizer.quantizer.lookup(decoder.tokenizer.encode(shown.features, shown.frames))
    return shown.samples(_recorded(decoder, shown), decoder(latents, shown.frames), " (rebuilt)")


def clips_from_text(recipe: Recipe, inputs: StageInputs) -> Sequence[Sample]:
    """Motions that a masked transformer decodes from the clips' captions; base codes only."""
    decoder = MotionDecoder(*load_tokenizer(inputs.root))
    shown = _shown(inputs, decoder)
    request = _request(shown, decoder, inputs)
    ids = decode_from_text(_on_cpu(recipe.model), request)
    latents = decoder.base_latents(ids, request.valid)
    return shown.samples(
        _recorded(decoder, shown), decoder(latents, shown.frames), " (from text, base codes)"
    )


def clips_with_residual_layers(recipe: Recipe, inputs: StageInputs) -> Sequence[Sample]:
    """The clips' own base codes, with the finer layers that a residual transformer adds."""
    decoder = MotionDecoder(*load_tokenizer(inputs.root))
    shown = _shown(inputs, decoder)
    request = _request(shown, decoder, inputs)
    base_ids = decoder.tokenizer.encode(shown.features, shown.frames)[..., 0]
    ids = fill_residual_layers(_on_cpu(recipe.model), base_ids, request)
    latents = decoder.tokenizer.quantizer.lookup(ids)
    return shown.samples(
        _recorded(decoder, shown), decoder(latents, shown.frames), " (own base codes, finer layers made)"
    )


def clips_with_control(recipe: Recipe, inputs: StageInputs) -> Sequence[Sample]:
    """Motions from the captions and the recorded paths of the pelvis; base codes only, no editing."""
    decoder = MotionDecoder(*load_tokenizer(inputs.root))
    base = MaskedTransformer.from_pretrained(best_weights(inputs.root, "masked"))
    shown = _shown(inputs, decoder)
    request = _request(shown, decoder, inputs)
    recorded = _recorded(decoder, shown)
    objective = ControlObjective(decoder, recorded, _pelvis_path(recorded, shown), shown.frames)
    logits = decode_with_control(base, _on_cpu(recipe.model), decoder, objective, request)
    latents = logits.softmax(-1) @ decoder.tokenizer.base_codes * request.valid[..., None]
    return shown.samples(recorded, decoder(latents, shown.frames), " (text and path, base codes)")


def clips_with_controlled_layers(recipe: Recipe, inputs: StageInputs) -> Sequence[Sample]:
    """The clips' own base codes and their pelvis paths, with the finer layers that follow them."""
    decoder = MotionDecoder(*load_tokenizer(inputs.root))
    residual = ResidualTransformer.from_pretrained(best_weights(inputs.root, "residual"))
    shown = _shown(inputs, decoder)
    request = _request(shown, decoder, inputs)
    base_ids = decoder.tokenizer.encode(shown.features, shown.frames)[..., 0]
    base = decoder.base_latents(base_ids, request.valid)
    recorded = _recorded(decoder, shown)
    control = ControlledLayers(_on_cpu(recipe.model), decoder, recorded, _pelvis_path(recorded, shown), base)
    ids = fill_residual_layers(residual, base_ids, request, control=control)
    latents = decoder.tokenizer.quantizer.lookup(ids)
    note = " (own base codes and path, finer layers made)"
    return shown.samples(recorded, decoder(latents, shown.frames), note)


def _pelvis_path(recorded: Float[Tensor, "B T J 3"], shown: _Shown) -> Bool[Tensor, "B T J 3"]:
    """Which coordinates are given: the pelvis in all frames."""
    mask = torch.zeros(recorded.shape, dtype=torch.bool)
    mask[..., _PELVIS, :] = shown.frames[..., None]
    return mask


def _on_cpu(network: Any) -> Any:
    """A copy to generate with; the loop's own network stays where it is, in training."""
    return copy.deepcopy(network).cpu().eval()


def _shown(inputs: StageInputs, decoder: MotionDecoder) -> _Shown:
    """Clips spread evenly over the validation list; those with a caption and a usual length if there are."""
    step = decoder.downsample
    usual = [clip for clip in inputs.val_clips if clip.captions and len(clip.features) >= _FRAMES[0]]
    clips = _spread(usual or [clip for clip in inputs.val_clips if len(clip.features) >= step])
    lengths = [min(len(clip.features), _FRAMES[1]) // step * step for clip in clips]
    features = pad_sequence(
        [
            decoder.normalizer.normalize(clip.features[:length])
            for clip, length in zip(clips, lengths, strict=True)
        ],
        batch_first=True,
    )
    captions = [clip.captions[0].text if clip.captions else clip.id for clip in clips]
    return _Shown(features, frame_mask(torch.tensor(lengths), features.shape[1]), captions)


def _spread(clips: Sequence[FeatureClip]) -> list[FeatureClip]:
    return [clips[(2 * i + 1) * len(clips) // (2 * _SHOWN)] for i in range(min(_SHOWN, len(clips)))]


def _request(shown: _Shown, decoder: MotionDecoder, inputs: StageInputs) -> DecodingRequest:
    assert inputs.text_encoder is not None  # the stage uses text
    text = inputs.text_encoder.encode(shown.captions).pooled
    valid = shown.frames[:, :: decoder.downsample]
    return DecodingRequest(text, valid, ClipNoise(clip_seeds(0, len(text))))


def _recorded(decoder: MotionDecoder, shown: _Shown) -> Float[Tensor, "B T J 3"]:
    normalizer = decoder.normalizer
    return recover_joints(normalizer.denormalize(shown.features), joints=normalizer.skeleton.num_joints)
