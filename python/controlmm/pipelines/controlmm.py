"""ControlMM: text plus 3D control in, human motion out.

Source: Pinyoanuntapong et al., ControlMM / MaskControl, ICCV 2025.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from controlmm.controls import Control, DenseControls, densify
from controlmm.generation.editing import Progress, edit_latents
from controlmm.generation.masked_decoding import (
    DecodingRequest,
    decode_from_text,
    decode_with_control,
    fill_residual_layers,
)
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.generation.noise import ClipNoise, clip_seeds
from controlmm.generation.objective import ControlObjective, control_error
from controlmm.models.control_branch import ControlBranch
from controlmm.models.masked_transformer import MaskedTransformer
from controlmm.models.residual_transformer import ResidualTransformer
from controlmm.models.rvq_vae import RvqVae, frame_mask
from controlmm.motion.ground import grounded
from controlmm.motion.motion import Motion
from controlmm.motion.normalizer import Normalizer
from controlmm.motion.skeleton import Skeleton
from controlmm.nn.checkpoint import PretrainedModel
from controlmm.pipelines import folder as files
from controlmm.pipelines.checks import check_masks_end, check_sampling, check_sizes, frame_count
from controlmm.pipelines.output import GenerationResult
from controlmm.pipelines.placement import moved, start_position
from controlmm.pipelines.presets import Preset, resolve_preset
from controlmm.text import TextEncoder, check_prompt, check_same_encoder, load_text_encoder

KIND = "controlmm"
MAX_FRAMES = 196


class ControlMM:
    """Generates motions of the 22 HumanML3D joints from a prompt and spatial controls.

    Example:
        >>> pipeline = ControlMM.from_pretrained()
        >>> result = pipeline("a person walks forward", seconds=4, seed=1)
        >>> result.best.save("walk.bvh")
    """

    def __init__(
        self,
        *,
        tokenizer: RvqVae,
        transformer: MaskedTransformer,
        residual: ResidualTransformer,
        control: ControlBranch,
        normalizer: Normalizer,
        text_encoder: TextEncoder,
    ) -> None:
        control.config.check_base(transformer.config)
        check_sizes(
            tokenizer=tokenizer.config,
            transformer=transformer.config,
            residual=residual.config,
            control=control.config,
            skeleton=normalizer.skeleton,
            text_dim=text_encoder.dim,
        )
        self.transformer = transformer.eval().requires_grad_(False)
        self.residual = residual.eval().requires_grad_(False)
        self.control = control.eval().requires_grad_(False)
        self.decoder = MotionDecoder(tokenizer, normalizer)
        self.text_encoder = text_encoder

    @classmethod
    def from_pretrained(
        cls, path: str | Path | None = None, *, text_encoder: TextEncoder | None = None
    ) -> ControlMM:
        """Load a pipeline folder; without a path, the trained model that comes with the package.

        Args:
            path: A folder written by :meth:`save_pretrained`.
            text_encoder: Use this one instead of loading the one that the folder names; it must equal it.

        Raises:
            FileNotFoundError: If the folder or one of its files is missing.
            ValueError: If a file is damaged, or the text encoder is not the one used in training.
            ModuleNotFoundError: If the text encoder's weights are not installed.
        """
        folder = files.resolve_folder(path)
        files.check_kind(folder, KIND)
        encoder_config = files.read_json(folder / files.TEXT_ENCODER_FILE)
        if text_encoder is None:
            text_encoder = load_text_encoder(encoder_config)
        else:
            check_same_encoder(encoder_config, text_encoder)
        return cls(
            tokenizer=RvqVae.from_pretrained(folder / "tokenizer"),
            transformer=MaskedTransformer.from_pretrained(folder / "transformer"),
            residual=ResidualTransformer.from_pretrained(folder / "residual"),
            control=ControlBranch.from_pretrained(folder / "control"),
            normalizer=Normalizer.load(folder / files.NORMALIZER_FILE),
            text_encoder=text_encoder,
        )

    def save_pretrained(self, path: str | Path, *, dtype: torch.dtype = torch.float32) -> Path:
        """Write the pipeline as a folder (safetensors and JSON); ``dtype=torch.float16`` halves it."""
        folder = Path(path)
        folder.mkdir(parents=True, exist_ok=True)
        for name, network in self._networks().items():
            network.save_pretrained(folder / name, dtype=dtype)
        self.decoder.normalizer.save(folder / files.NORMALIZER_FILE)
        files.write_json(folder / files.TEXT_ENCODER_FILE, self.text_encoder.config())
        files.write_json(folder / files.PIPELINE_FILE, {"kind": KIND, "format": files.FORMAT})
        return folder

    @property
    def skeleton(self) -> Skeleton:
        """The joints that motions have and controls may name."""
        return self.decoder.normalizer.skeleton

    @property
    def num_parameters(self) -> int:
        """Parameters of all networks, the text encoder not counted."""
        return sum(p.numel() for network in self._networks().values() for p in network.parameters())

    @torch.no_grad()
    def __call__(
        self,
        prompt: str,
        *,
        seconds: float | None = None,
        frames: int | None = None,
        controls: Sequence[Control] = (),
        samples: int = 1,
        preset: str | Preset = "balanced",
        guidance_scale: float | None = None,
        seed: int = 0,
        progress: Progress | None = None,
    ) -> GenerationResult:
        """Generate ``samples`` motions.

        Without height targets each motion is stood on the floor: its lowest joint touches y = 0.

        Args:
            prompt: What the person does, in words.
            seconds: Length, 0.4 to 9.8 s; or pass ``frames`` (8 to 196, at 20 fps). 6 s without either.
            frames: Length in frames.
            controls: Targets in metres, Y up, ground at y = 0. The body starts facing +Z (its left is +X), at
                x = z = 0 unless a control names the pelvis at frame 0. Contradicting or impossible frames are
                refused.
            samples: How many motions; sample ``i`` is the same however many are asked for.
            preset: ``fast``, ``balanced``, ``accurate`` (the papers' iteration counts) or a :class:`Preset`.
            guidance_scale: How strongly the text counts; ``None`` takes the preset's.
            seed: Same seed, same motions.
            progress: Called as ``progress(phase, done, total)`` during long loops.

        Raises:
            ValueError: If an argument is unusable; nothing has run then.
        """
        started = time.perf_counter()
        prompt = check_prompt(prompt)
        check_sampling(samples=samples, seed=seed)
        count = frame_count(seconds=seconds, frames=frames, skeleton=self.skeleton, max_frames=MAX_FRAMES)
        plan = resolve_preset(preset)
        if guidance_scale is not None:
            plan = dataclasses.replace(plan, guidance_scale=guidance_scale)
        dense = densify(controls, count, self.skeleton)
        origin = start_position(dense)
        canonical = moved(dense, -origin)

        text = self.text_encoder.encode([prompt]).pooled.expand(samples, -1)
        latents = self.generate_latents(
            text,
            lengths=[count] * samples,
            targets=canonical.targets.expand(samples, -1, -1, -1),
            mask=canonical.mask.expand(samples, -1, -1, -1),
            seeds=clip_seeds(seed, samples),
            preset=plan,
            progress=progress,
        )
        features = self.decoder.features(latents)[:, :count]
        if not dense.mask[..., 1].any():
            features = grounded(features)
        motions = tuple(self._motion(clip, prompt, dense, origin) for clip in features)
        joints = torch.stack([motion.joints for motion in motions])
        error = control_error(joints, dense.targets.expand_as(joints), dense.mask.expand_as(joints))
        return GenerationResult(motions, error, latents, time.perf_counter() - started)

    @torch.no_grad()
    def generate_latents(
        self,
        text: Float[Tensor, "B E"],
        *,
        lengths: Sequence[int],
        targets: Float[Tensor, "B T J 3"],
        mask: Bool[Tensor, "B T J 3"],
        seeds: Sequence[int],
        preset: Preset,
        progress: Progress | None = None,
    ) -> Float[Tensor, "B L C"]:
        """Latents of a batch of clips of different texts, lengths and targets (canonical frame).

        Clips without any target are decoded from text alone, the control branch off.

        Raises:
            ValueError: If a target lies after the end of its clip.
        """
        check_masks_end(mask, lengths)
        step = self.decoder.downsample
        tokens = torch.tensor([-(-length // step) for length in lengths])
        valid = frame_mask(tokens, int(tokens.max()))
        targets, mask = (_padded(dense, valid.shape[1] * step) for dense in (targets, mask))
        is_controlled = mask.flatten(1).any(1)
        latents = torch.zeros(*valid.shape, self.decoder.tokenizer.config.code_dim)

        def request_for(rows: Tensor) -> DecodingRequest:
            return DecodingRequest(
                text[rows],
                valid[rows],
                ClipNoise([seeds[row] for row in rows.tolist()]),
                steps=preset.steps,
                guidance_scale=preset.guidance_scale,
                progress=progress,
            )

        free, controlled = (~is_controlled).nonzero()[:, 0], is_controlled.nonzero()[:, 0]
        if len(free):
            latents[free] = self._from_text(request_for(free), preset)
        if len(controlled):
            request = request_for(controlled)
            latents[controlled] = self._from_control(request, targets[controlled], mask[controlled], preset)
        return latents

    def _from_text(self, request: DecodingRequest, preset: Preset) -> Tensor:
        base_ids = decode_from_text(self.transformer, request)
        ids = fill_residual_layers(
            self.residual, base_ids, request, guidance_scale=preset.residual_guidance_scale
        )
        return self.decoder.tokenizer.quantizer.lookup(ids)

    def _from_control(
        self, request: DecodingRequest, targets: Tensor, mask: Tensor, preset: Preset
    ) -> Tensor:
        frames = request.valid.repeat_interleave(self.decoder.downsample, dim=1)
        keep = request.valid[..., None].float()
        objective = ControlObjective(self.decoder, targets, mask, frames)
        logits = decode_with_control(
            self.transformer,
            self.control,
            self.decoder,
            objective,
            request,
            logits_iterations=preset.budget.logits_iterations,
        )
        base_ids = torch.where(request.valid, logits.argmax(-1), -1)
        ids = fill_residual_layers(
            self.residual, base_ids, request, guidance_scale=preset.residual_guidance_scale
        )
        ids[..., 0] = -1  # the base layer stays a soft mixture, only the residual layers are hard
        tokenizer = self.decoder.tokenizer
        latents = logits.softmax(-1) @ tokenizer.base_codes * keep + tokenizer.quantizer.lookup(ids)
        edited, _ = edit_latents(
            latents,
            objective,
            iterations=preset.budget.latent_iterations,
            rate=preset.budget.latent_rate * tokenizer.base_codes.std().item(),
            decays_rate=preset.budget.decays_rate,
            keep=keep,
            progress=request.progress,
        )
        return edited

    def _motion(self, features: Tensor, prompt: str, controls: DenseControls, origin: Tensor) -> Motion:
        motion = Motion.from_features(features.contiguous(), text=prompt)
        extra = {} if controls.is_empty else {"targets": controls.targets, "mask": controls.mask}
        return dataclasses.replace(motion, joints=motion.joints + origin, extra=extra)

    def _networks(self) -> dict[str, PretrainedModel]:
        return {
            "tokenizer": self.decoder.tokenizer,
            "transformer": self.transformer,
            "residual": self.residual,
            "control": self.control,
        }


def _padded(dense: Tensor, frames: int) -> Tensor:
    return nn.functional.pad(dense, (0, 0, 0, 0, 0, frames - dense.shape[1]))
