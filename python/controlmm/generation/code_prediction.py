"""TLControl's prediction: codes of all body parts from text and trajectories, in one pass or in a few."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.generation.code_sampling import draw_part_codes
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.models.trajectory_transformer import TrajectoryTransformer

_VARIED_TEMPERATURE = 1.0  # a fair draw of what the network thinks possible; at 0.5 an arm hardly moves


@dataclass(frozen=True, eq=False)
class CodePrediction:
    """The networks with the text and the targets of a batch.

    Attributes:
        transformer: Text and trajectories to logits.
        decoder: Codes to joints.
        text: (B, E), the text encoder's pooled vectors.
        valid: (B, L), tokens of each clip.
        seeds: One a clip.
        guidance_scale: How strongly the text counts.
    """

    transformer: TrajectoryTransformer
    decoder: MotionDecoder
    text: Float[Tensor, "B E"]
    valid: Bool[Tensor, "B L"]
    seeds: Sequence[int]
    guidance_scale: float = 1.0

    def latents(
        self,
        targets: Float[Tensor, "B T J 3"],
        mask: Bool[Tensor, "B T J 3"],
        *,
        rounds: int,
        temperature: float,
        varied: int | None = None,
    ) -> Float[Tensor, "B L C"]:
        """Codes drawn from what the network predicts, as latents.

        The parts of one pass do not know of each other: legs may walk while the root glides. A round decodes
        the motion of a pass and gives its six trajectories, where nothing else is given, to the next pass;
        the last pass takes the most likely codes.

        Args:
            targets: Metres, the networks' frame, padded to whole tokens.
            mask: The coordinates that are given.
            rounds: Passes before the last one. The paper has none.
            temperature: Of the draws; 0 takes the most likely codes.
            varied: Part that is drawn anew for each clip, from the same predictions; all else is the same as
                for the first clip.
        """
        filled, known = targets, mask.clone()
        seeds = self.seeds if varied is None else [self.seeds[0]] * len(self.seeds)
        for _ in range(rounds):
            drawn = draw_part_codes(self._logits(filled, known), seeds, temperature=temperature)
            filled, known = self._with_trajectories(drawn, targets, mask)
        last = 0.0 if rounds else temperature
        ids = draw_part_codes(self._logits(filled, known), seeds, temperature=last)
        if varied is not None:  # its own trajectory must not say what it was
            joint = self.transformer.config.joints[varied]
            known[:, :, joint] = mask[:, :, joint]
            logits = self._logits(filled, known)
            anew = draw_part_codes(logits, self.seeds, temperature=_VARIED_TEMPERATURE)
            ids[1:, :, varied] = anew[1:, :, varied]
        return self._latents(ids)

    def _logits(
        self, targets: Float[Tensor, "B T J 3"], mask: Bool[Tensor, "B T J 3"]
    ) -> Float[Tensor, "B L P K"]:
        trajectories, given = self.transformer.trajectories(targets, mask)
        logits: Tensor = self.transformer(trajectories, given, self.text, self.valid)
        if self.guidance_scale != 1:
            without = self.transformer(trajectories, given, torch.zeros_like(self.text), self.valid)
            logits = without + self.guidance_scale * (logits - without)
        return logits

    def _with_trajectories(
        self, ids: Int[Tensor, "B L P"], targets: Float[Tensor, "B T J 3"], mask: Bool[Tensor, "B T J 3"]
    ) -> tuple[Float[Tensor, "B T J 3"], Bool[Tensor, "B T J 3"]]:
        """Targets with the six trajectories of the decoded codes where nothing is given."""
        frames = self.valid.repeat_interleave(self.decoder.downsample, dim=1)
        known = torch.zeros_like(mask)
        known[:, :, list(self.transformer.config.joints)] = frames[..., None, None]
        return targets.where(mask, self.decoder(self._latents(ids), frames)), known | mask

    def _latents(self, ids: Int[Tensor, "B L P"]) -> Float[Tensor, "B L C"]:
        latents: Tensor = self.decoder.tokenizer.quantizer.lookup(ids.where(self.valid[..., None], -1))
        return latents
