"""Controls from a NumPy array of joint positions, NaN where nothing is controlled."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from controlmm.controls.document import FPS, ControlFile
from controlmm.controls.joint import JointControl
from controlmm.motion.skeleton import SKELETONS, skeleton_of_joints

_NAMES = ("positions", "joints")
_BODY_SIZES = tuple(skeleton.num_joints for skeleton in SKELETONS.values())


def parse_npy(content: bytes) -> ControlFile:
    """Controls from one array (T, 22, 3) in metres; every joint that has a number becomes a joint control.

    Raises:
        ValueError: If it is no such array.
    """
    return _from_array(_load(content))


def parse_npz(content: bytes) -> ControlFile:
    """As :func:`parse_npy`, from the array ``positions`` or ``joints``, or the only one in the archive.

    Raises:
        ValueError: If there is no such array.
    """
    archive = _load(content)
    if not isinstance(archive, np.lib.npyio.NpzFile):
        raise ValueError("not an .npz archive.")
    with archive:
        names = archive.files
        chosen = [name for name in _NAMES if name in names] or (names if len(names) == 1 else [])
        if not chosen:
            raise ValueError(
                f"expected an array named {' or '.join(_NAMES)}, got {', '.join(names) or 'none'}."
            )
        try:
            array = archive[chosen[0]]
        except Exception as error:  # damaged bytes, see `_load`
            raise ValueError(f"not a readable .npz archive ({error}).") from error
    return _from_array(array)


def _load(content: bytes) -> Any:
    try:
        return np.load(io.BytesIO(content), allow_pickle=False)
    except Exception as error:  # damaged bytes raise a dozen kinds, even tokenizer and zlib errors
        raise ValueError(f"not a readable NumPy file ({error}).") from error


def _from_array(array: Any) -> ControlFile:
    if not isinstance(array, np.ndarray) or not np.issubdtype(array.dtype, np.floating):
        raise ValueError(f"expected an array of floats, got {getattr(array, 'dtype', type(array).__name__)}.")
    if array.ndim != 3 or array.shape[1] not in _BODY_SIZES or array.shape[2] != 3:
        raise ValueError(
            f"expected an array of shape (T, 22, 3), metres, NaN where free; got {array.shape}. "
            "For the path of one joint write a CSV file with the columns frame,joint,x,y,z."
        )
    names = skeleton_of_joints(array.shape[1]).joint_names
    is_held = ~np.isnan(array)
    if not is_held.any():
        raise ValueError("every value is NaN, so the array controls nothing.")
    controls = [
        _joint_control(names[j], array[:, j], is_held[:, j]) for j in range(len(names)) if is_held[:, j].any()
    ]
    return ControlFile(controls, seconds=len(array) / FPS)


def _joint_control(name: str, points: np.ndarray[Any, Any], is_held: np.ndarray[Any, Any]) -> JointControl:
    frames = np.flatnonzero(is_held.any(axis=1))
    cells = points.astype(object)
    cells[~is_held] = None
    try:
        return JointControl(name, frames=frames, positions=cells[frames])
    except ValueError as error:
        raise ValueError(f"joint {name}: {error}") from error
