"""A motion: joint positions over time, with the features they were decoded from when there are any."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.motion.formats import format_for
from controlmm.motion.skeleton import HUMANML3D, Skeleton, skeleton_of_width
from controlmm.ops import recover_joints


@dataclass(frozen=True)
class Motion:
    """One clip of human motion.

    Example:
        >>> motion = Motion.load("walk.npz")
        >>> motion.save("walk.bvh")

    Attributes:
        joints: (T, J, 3) global joint positions in metres (KIT-ML: millimetres), Y up, ground at y = 0.
        features: (T, D) de-normalised HumanML3D features, or ``None`` for motions that have only positions.
        skeleton: Names and hierarchy of the joints.
        text: The prompt or caption, may be empty.
        extra: What a format carries beside the motion (targets of the controls, fitting errors).
    """

    joints: Float[Tensor, "T J 3"]
    features: Float[Tensor, "T D"] | None = None
    skeleton: Skeleton = HUMANML3D
    text: str = ""
    extra: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        expected = (self.skeleton.num_joints, 3)
        if self.joints.ndim != 3 or tuple(self.joints.shape[1:]) != expected or len(self.joints) == 0:
            raise ValueError(
                f"`joints` must have shape (T, {expected[0]}, 3) with T >= 1 for the {self.skeleton.name} "
                f"skeleton, got {tuple(self.joints.shape)}."
            )
        if not torch.isfinite(self.joints).all():
            frame = int((~torch.isfinite(self.joints)).flatten(1).any(1).nonzero()[0])
            raise ValueError(f"`joints` must be finite; frame {frame} holds NaN or infinity.")
        width = (len(self.joints), self.skeleton.feature_dim)
        if self.features is not None and tuple(self.features.shape) != width:
            raise ValueError(f"`features` must have shape {width}, got {tuple(self.features.shape)}.")

    @classmethod
    def from_features(cls, features: Float[Tensor, "T D"], *, text: str = "") -> Motion:
        """Decode de-normalised features (263 or 251 wide) into a motion.

        Raises:
            ValueError: If the width is neither 263 nor 251, or a value is not finite.
        """
        skeleton = skeleton_of_width(features.shape[-1])
        joints = recover_joints(features[None], joints=skeleton.num_joints)[0]
        return cls(joints=joints, features=features, skeleton=skeleton, text=text)

    @property
    def num_frames(self) -> int:
        """Number of frames ``T``."""
        return len(self.joints)

    @property
    def fps(self) -> float:
        """Frames per second (20 for HumanML3D, 12.5 for KIT-ML)."""
        return self.skeleton.fps

    @property
    def seconds(self) -> float:
        """Duration in seconds."""
        return self.num_frames / self.fps

    def save(self, path: str | Path, **options: Any) -> Path:
        """Write the motion in the format that the suffix names: npz, npy, bvh, glb, png, gif, mp4.

        Options belong to the format, see ``controlmm.io`` and ``controlmm.viewer``. Missing parent folders
        are made. Returns the path.

        Raises:
            ValueError: If no format has that suffix.
        """
        path = Path(path)
        writer = format_for(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        writer.save(self, path, **options)
        return path

    @classmethod
    def load(cls, path: str | Path, **options: Any) -> Motion:
        """Read a motion from an ``.npz``, ``.npy`` (features or joints) or ``.bvh`` file.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If the format is unknown or the file is damaged.
        """
        path = Path(path)
        reader = format_for(path)
        if not path.is_file():
            raise FileNotFoundError(f"No motion file at {path}.")
        motion: Motion = reader.load(path, **options)
        return motion
