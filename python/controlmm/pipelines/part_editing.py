"""TLControl on a motion that exists: codes of what is kept stay, all others are predicted around them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from controlmm.generation.code_prediction import CodePrediction
from controlmm.generation.noise import clip_seeds
from controlmm.generation.solvers import Progress
from controlmm.pipelines.edit_scene import EditScene, held_term
from controlmm.pipelines.motion_editing import edit_result
from controlmm.pipelines.output import GenerationResult
from controlmm.pipelines.tlcontrol_presets import TLControlPreset

if TYPE_CHECKING:
    from controlmm.pipelines.tlcontrol import TLControl


def run_part_edit(
    pipeline: TLControl,
    scene: EditScene,
    *,
    exact: bool,
    samples: int,
    preset: TLControlPreset,
    seed: int,
    progress: Progress | None,
) -> GenerationResult:
    """See :meth:`TLControl.edit`.

    Raises:
        ValueError: If nothing is kept.
    """
    started = time.perf_counter()
    if not scene.kept.any():
        raise ValueError(
            "`keep` or `keep_parts` must name what stays: TLControl predicts all codes at once and cannot "
            "draw a few of a motion's own anew. ControlMM.edit can."
        )
    latents = _predicted(pipeline, scene, clip_seeds(seed, samples), preset)
    latents = _optimised(pipeline, scene, latents, preset, exact=exact, progress=progress)
    features = pipeline.decoder.clip_features(latents)[:, : scene.source.num_frames]
    return edit_result(scene, features, latents, started)


def _predicted(
    pipeline: TLControl, scene: EditScene, seeds: Sequence[int], preset: TLControlPreset
) -> Float[Tensor, "B L C"]:
    """The network sees the trajectories of what is kept and of the controls."""
    held, shown = scene.held, scene.shown
    targets = torch.where(held, scene.source.joints, shown.targets)
    given_targets, given = _batch(pipeline, (targets, held | shown.mask), len(seeds))
    valid = torch.ones(len(seeds), given.shape[1] // pipeline.decoder.downsample, dtype=torch.bool)
    text = pipeline.text_encoder.encode([scene.prompt]).pooled.expand(len(seeds), -1)
    prediction = CodePrediction(
        pipeline.transformer, pipeline.decoder, text, valid, seeds, guidance_scale=preset.guidance_scale
    )
    latents = prediction.latents(given_targets, given, rounds=preset.rounds, temperature=preset.temperature)
    source, is_kept = _source_latents(pipeline, scene, given.shape[1])
    return torch.where(is_kept[None, :, None], source, latents)


def _source_latents(
    pipeline: TLControl, scene: EditScene, padded: int
) -> tuple[Float[Tensor, "1 L C"], Bool[Tensor, "L"]]:
    """Codes of the source, and the tokens all of whose frames are kept as whole poses."""
    tokenizer, step = pipeline.tokenizer, pipeline.decoder.downsample
    features = pipeline.decoder.normalizer.normalize(scene.source.features.float())
    missing = -len(features) % step  # the last frame is repeated to fill the last token
    filled = torch.cat([features, features[-1:].expand(missing, -1)])
    behind = (0, 0, 0, padded - len(filled))
    latents = tokenizer.quantizer.lookup(tokenizer.encode(nn.functional.pad(filled, behind)[None]))
    whole = nn.functional.pad(scene.whole, (0, missing), value=True)
    whole = nn.functional.pad(whole, (0, padded - len(whole)))
    return latents, whole.unflatten(0, (-1, step)).all(1)


def _optimised(
    pipeline: TLControl,
    scene: EditScene,
    latents: Float[Tensor, "B L C"],
    preset: TLControlPreset,
    *,
    exact: bool,
    progress: Progress | None,
) -> Float[Tensor, "B L C"]:
    """Towards controls and parts, and whole poses if they are to be exact.

    Kept poses are thousands of coordinates, a control may be one: their errors are averaged apart.
    """
    samples, padded = len(latents), latents.shape[1] * pipeline.decoder.downsample
    terms, held, shown = scene.terms(samples, padded), scene.held & exact, scene.shown
    wanted = (shown.targets, shown.mask)
    if shown.is_empty:
        wanted = (scene.source.joints, held)
    elif held.any():
        terms = (*terms, held_term(scene.source.joints, held, samples=samples, padded=padded))
    targets, mask = _batch(pipeline, wanted, samples)
    if not preset.iterations or not (mask.any() or terms):
        return latents
    valid = torch.ones(latents.shape[:2], dtype=torch.bool)
    return pipeline.refined_latents(latents, valid, targets, mask, preset, terms=terms, progress=progress)


def _batch(
    pipeline: TLControl, dense: tuple[Tensor, Tensor], samples: int
) -> tuple[Float[Tensor, "B T J 3"], Bool[Tensor, "B T J 3"]]:
    """Targets and mask for all samples, padded to the frames that the networks work on."""
    missing = (0, 0, 0, 0, 0, pipeline.padded_frames(len(dense[1])) - len(dense[1]))
    targets, mask = (nn.functional.pad(x, missing).expand(samples, -1, -1, -1) for x in dense)
    return targets, mask
