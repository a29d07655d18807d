"""Feature statistics: normalised features are ``(x - mean) / std`` per channel."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from controlmm.motion.layout import feature_layout
from controlmm.motion.skeleton import Skeleton, skeleton_of_width

# HumanML3D's option says 5, but the public scripts divide the same array twice, so every published checkpoint
# and the evaluator carry 25.
ROOT_CONTACT_BIAS = 25.0


class Normalizer(nn.Module):
    """Mean and standard deviation of every feature channel. They belong to one checkpoint and fit no other.

    The root and contact channels weigh ``root_contact_bias`` times more, because their errors add up along
    the path.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, mean: Float[Tensor, "D"], std: Float[Tensor, "D"]) -> None:
        super().__init__()
        skeleton_of_width(mean.shape[-1])
        if mean.ndim != 1 or mean.shape != std.shape:
            raise ValueError(
                f"`mean` and `std` must both be (D,), got {tuple(mean.shape)}, {tuple(std.shape)}."
            )
        unusable = ~(torch.isfinite(mean) & torch.isfinite(std) & (std > 0))
        if unusable.any():
            channel = int(unusable.nonzero()[0])
            raise ValueError(
                "`mean` must be finite and `std` finite and positive in every channel, but channel "
                f"{channel} has mean {float(mean[channel]):g} and std {float(std[channel]):g}."
            )
        self.register_buffer("mean", mean.float())
        self.register_buffer("std", std.float())

    @property
    def skeleton(self) -> Skeleton:
        """The skeleton whose features these statistics describe."""
        return skeleton_of_width(self.mean.shape[0])

    @classmethod
    def fit(
        cls, clips: Iterable[Float[Tensor, "T D"]], *, root_contact_bias: float = ROOT_CONTACT_BIAS
    ) -> Normalizer:
        """Statistics over all frames of ``clips`` (de-normalised features), one standard deviation a group.

        Raises:
            ValueError: If there are no clips, or a group of channels never changes.
        """
        mean, std = channel_statistics(clips)
        return cls(mean, biased_std(std, root_contact_bias))

    def normalize(self, features: Float[Tensor, "*B D"]) -> Float[Tensor, "*B D"]:
        """De-normalised (metres, radians) to normalised features."""
        return (features - self.mean) / self.std

    def denormalize(self, features: Float[Tensor, "*B D"]) -> Float[Tensor, "*B D"]:
        """Normalised to de-normalised features."""
        return features * self.std + self.mean

    def save(self, path: Path) -> None:
        """Write ``mean`` and ``std`` as safetensors."""
        from safetensors.torch import save_file

        save_file({"mean": self.mean.contiguous(), "std": self.std.contiguous()}, path)

    @classmethod
    def load(cls, path: Path) -> Normalizer:
        """Read statistics written by :meth:`save`.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If the file is damaged.
        """
        from safetensors import SafetensorError
        from safetensors.torch import load_file

        if not path.is_file():
            raise FileNotFoundError(f"No feature statistics at {path}.")
        try:
            tensors = load_file(path)
            return cls(tensors["mean"], tensors["std"])
        except (SafetensorError, KeyError) as error:
            raise ValueError(f"{path} holds no readable feature statistics: {error}.") from error


def channel_statistics(
    clips: Iterable[Float[Tensor, "T D"]],
) -> tuple[Float[Tensor, "D"], Float[Tensor, "D"]]:
    """Mean per channel, and standard deviation averaged inside each of the seven groups, both float64.

    Raises:
        ValueError: If there are no clips.
    """
    count, total, squares = 0, None, None
    for clip in clips:
        clip = clip.double()
        count += len(clip)
        total = clip.sum(0) if total is None else total + clip.sum(0)
        squares = clip.square().sum(0) if squares is None else squares + clip.square().sum(0)
    if total is None or squares is None or count == 0:
        raise ValueError("Feature statistics need at least one clip, got none.")
    mean = total / count
    std = (squares / count - mean.square()).clamp(min=0).sqrt()
    for group in feature_layout(skeleton_of_width(len(mean))).groups:
        std[group] = std[group].mean()
    return mean, std


def biased_std(std: Float[Tensor, "D"], root_contact_bias: float) -> Float[Tensor, "D"]:
    """``std`` with the root and contact groups divided by ``root_contact_bias``, so that they weigh more.

    Raises:
        ValueError: If the bias is not positive.
    """
    if not root_contact_bias > 0:
        raise ValueError(f"`root_contact_bias` must be positive, got {root_contact_bias}.")
    layout = feature_layout(skeleton_of_width(len(std)))
    std = std.clone()
    for group in (layout.root_yaw_velocity, layout.root_velocity, layout.root_height, layout.foot_contacts):
        std[group] /= root_contact_bias
    return std
