"""The package's own file: everything a motion holds, in a NumPy archive without pickled objects."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy import ndarray

from controlmm.controls import ControlFile
from controlmm.controls.json_reader import parse_json
from controlmm.controls.json_writer import format_json
from controlmm.io.atomic import replaced_on_success
from controlmm.motion.motion import Motion
from controlmm.motion.skeleton import SKELETONS, Skeleton

_REQUIRED = ("joints", "skeleton", "fps")
_CONTROLS = ("targets", "mask")
_SCENE = ("obstacles", "timeline")
_MAX_BYTES = 1 << 30  # a clip of 196 frames takes 0.3 MB; a gigabyte unpacked is an attack or a mistake


class NpzFormat:
    """Reader and writer of ``.npz``.

    Arrays: ``joints`` (T, J, 3) float32 in the skeleton's unit, ``features`` (T, D) float32 if there are any,
    ``fps``, ``skeleton`` and ``text``; for a controlled motion ``targets`` (T, J, 3) float32 and ``mask``
    (T, J, 3) bool, the coordinates that were asked for; with obstacles or a timeline ``scene``, their JSON
    document.
    """

    @staticmethod
    def save(motion: Motion, path: Path) -> None:
        """Write the motion, and the targets, mask, obstacles and timeline in ``motion.extra``, if any.

        Raises:
            ValueError: If targets or mask do not have the shape of the joints.
        """
        arrays: dict[str, Any] = {
            "joints": _float32(motion.joints),
            "fps": np.float64(motion.fps),
            "skeleton": np.str_(motion.skeleton.name),
            "text": np.str_(motion.text),
        }
        if motion.features is not None:
            arrays["features"] = _float32(motion.features)
        arrays |= _controls_of(motion)
        scene = {name: motion.extra[name] for name in _SCENE if motion.extra.get(name)}
        if scene:
            arrays["scene"] = np.str_(format_json(ControlFile(**scene)))
        with replaced_on_success(path) as partial:
            np.savez_compressed(partial, **arrays)

    @staticmethod
    def load(path: Path) -> Motion:
        """Read a file that :meth:`save` wrote.

        Raises:
            ValueError: If the file is damaged, not a motion, or inconsistent.
        """
        arrays = _read_arrays(path)
        missing = [name for name in _REQUIRED if name not in arrays]
        if missing:
            raise ValueError(
                f"{path}: not a motion archive, it lacks {', '.join(missing)} "
                f"(found: {', '.join(arrays)[:200] or 'nothing'})."
            )
        try:
            return _motion_of(arrays)
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path}: {error}") from None


def _float32(tensor: torch.Tensor) -> ndarray:
    return tensor.detach().to("cpu", torch.float32).numpy()


def _controls_of(motion: Motion) -> dict[str, ndarray]:
    types: dict[str, Any] = {"targets": np.float32, "mask": np.bool_}
    found = {
        name: np.asarray(motion.extra[name], types[name])
        for name in _CONTROLS
        if motion.extra.get(name) is not None
    }
    for name, array in found.items():
        _check_shape(name, array, tuple(motion.joints.shape))
    return found


def _check_shape(name: str, array: ndarray, expected: tuple[int, ...]) -> None:
    if array.shape != expected:
        raise ValueError(f"`{name}` must have shape {expected}, as `joints` has, got {array.shape}.")


def _read_arrays(path: Path) -> dict[str, ndarray]:
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > _MAX_BYTES:
            raise ValueError(f"it unpacks to {size} bytes")
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (FileNotFoundError, PermissionError):
        raise
    except Exception as error:  # NumPy's header parser lets through whatever Python's tokenizer raises
        reason = " ".join(str(error).split())[:100]
        raise ValueError(f"{path}: damaged or not a NumPy archive ({reason}).") from None


def _motion_of(arrays: dict[str, ndarray]) -> Motion:
    skeleton = _skeleton_of(arrays)
    extra: dict[str, Any] = {}
    for name in _CONTROLS:
        if name in arrays:
            _check_shape(name, arrays[name], arrays["joints"].shape)
            dtype = torch.bool if name == "mask" else torch.float32
            extra[name] = _tensor(name, arrays[name]).to(dtype)
    if "scene" in arrays:
        document = parse_json(str(arrays["scene"]).encode())
        extra |= {name: getattr(document, name) for name in _SCENE if getattr(document, name)}
    features = _tensor("features", arrays["features"]) if "features" in arrays else None
    if features is not None and not torch.isfinite(features).all():
        raise ValueError("`features` must be finite, the file holds NaN or infinity.")
    text = str(arrays["text"]) if "text" in arrays else ""
    return Motion(
        joints=_tensor("joints", arrays["joints"]),
        features=features,
        skeleton=skeleton,
        text=text,
        extra=extra,
    )


def _skeleton_of(arrays: dict[str, ndarray]) -> Skeleton:
    name = str(arrays["skeleton"])
    if name not in SKELETONS:
        raise ValueError(f"unknown skeleton {name[:40]!r}, expected one of: {', '.join(SKELETONS)}.")
    skeleton = SKELETONS[name]
    if arrays["fps"].shape != () or float(arrays["fps"]) != skeleton.fps:
        raise ValueError(
            f"`fps` must be {skeleton.fps:g} for the {name} skeleton, got {str(arrays['fps'])[:40]}."
        )
    return skeleton


def _tensor(name: str, array: ndarray) -> torch.Tensor:
    if array.dtype.kind not in "fiub":
        raise ValueError(f"`{name}` must hold numbers, got {array.dtype}.")
    return torch.from_numpy(array.astype(np.float32))
