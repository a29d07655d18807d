"""Plain NumPy arrays as the field exchanges them: features (``new_joint_vecs``), joints (``new_joints``)."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy import ndarray

from controlmm.io.atomic import replaced_on_success
from controlmm.motion.motion import Motion
from controlmm.motion.skeleton import SKELETONS


class NpyFormat:
    """Reader and writer of ``.npy``: (T, 263) or (T, 251) features, or (T, 22, 3) or (T, 21, 3) joints."""

    @staticmethod
    def save(motion: Motion, path: Path, *, what: Literal["features", "joints"] | None = None) -> None:
        """Write one float32 array.

        Args:
            motion: The motion.
            path: File to write, replaced as a whole.
            what: ``"features"`` (T, D) or ``"joints"`` (T, J, 3); ``None``: features if there are any.

        Raises:
            ValueError: If ``what`` is unknown, or names features that the motion does not have.
        """
        if what not in (None, "features", "joints"):
            raise ValueError(f"`what` must be 'features' or 'joints', got {what!r}.")
        if what == "features" and motion.features is None:
            raise ValueError("`what` is 'features', but the motion has only joints. Use what='joints'.")
        array = motion.joints if what == "joints" or motion.features is None else motion.features
        with replaced_on_success(path) as partial:
            np.save(partial, array.detach().to("cpu", torch.float32).numpy(), allow_pickle=False)

    @staticmethod
    def load(path: Path) -> Motion:
        """Read features or joints; the shape says which.

        Raises:
            ValueError: If the file is damaged, holds no numbers, or has another shape.
        """
        array = _read(path)
        try:
            return _motion_of(array)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None


def _read(path: Path) -> ndarray:
    try:
        with path.open("rb") as file:
            return np.lib.format.read_array(file, allow_pickle=False)
    except (FileNotFoundError, PermissionError):
        raise
    except Exception as error:  # NumPy's header parser lets through whatever Python's tokenizer raises
        reason = " ".join(str(error).split())[:100]
        raise ValueError(f"{path}: damaged or not a NumPy array ({reason}).") from None


def _motion_of(array: ndarray) -> Motion:
    if array.dtype.kind not in "fiu":
        raise ValueError(f"expected numbers, got {array.dtype}.")
    values = torch.from_numpy(array.astype(np.float32))
    if not torch.isfinite(values).all():
        raise ValueError("expected finite numbers, the file holds NaN or infinity.")
    has_frames = array.ndim > 0 and len(array) > 0
    for skeleton in SKELETONS.values():
        if has_frames and array.shape[1:] == (skeleton.feature_dim,):
            return Motion.from_features(values)
        if has_frames and array.shape[1:] == (skeleton.num_joints, 3):
            return Motion(joints=values, skeleton=skeleton)
    raise ValueError(
        "expected features (T, 263) or (T, 251), or joints (T, 22, 3) or (T, 21, 3), with T >= 1, "
        f"got {array.shape}."
    )
