"""From code-space latents to joints in metres: the path that every objective differentiates through."""

from __future__ import annotations

from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from controlmm.models.tokenizer import MotionTokenizer
from controlmm.motion.normalizer import Normalizer
from controlmm.ops import recover_joints


class MotionDecoder(nn.Module):
    """The tokenizer's decoder, the feature statistics and the kinematics in one, weights frozen.

    Latents are sums of code vectors, (B, L, C). ``frames`` (B, T) marks the frames of each clip, so that a
    clip's motion does not depend on the padding of its batch.
    """

    def __init__(self, tokenizer: MotionTokenizer, normalizer: Normalizer) -> None:
        super().__init__()
        self.tokenizer = tokenizer.eval().requires_grad_(False)
        self.normalizer = normalizer

    @property
    def downsample(self) -> int:
        """Frames for each token."""
        return self.tokenizer.downsample

    def features(
        self, latents: Float[Tensor, "B L C"], frames: Bool[Tensor, "B T"] | None = None
    ) -> Float[Tensor, "B T D"]:
        """De-normalised features."""
        return self.normalizer.denormalize(self.tokenizer.decode(latents, frames).float())

    def forward(
        self, latents: Float[Tensor, "B L C"], frames: Bool[Tensor, "B T"] | None = None
    ) -> Float[Tensor, "B T J 3"]:
        """Global joint positions in metres."""
        return recover_joints(self.features(latents, frames), joints=self.normalizer.skeleton.num_joints)

    def base_latents(self, ids: Int[Tensor, "B L"], valid: Bool[Tensor, "B L"]) -> Float[Tensor, "B L C"]:
        """Base codes of partly masked tokens: the mean code where the id is no code, zero in padding."""
        codes = self.tokenizer.base_codes
        is_code = (ids >= 0) & (ids < len(codes))
        looked_up = codes[ids.clamp(0, len(codes) - 1)]
        latents = looked_up.where(is_code[..., None], codes.mean(0))
        return latents * valid[..., None]
