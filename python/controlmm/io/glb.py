"""GLB files (binary glTF 2.0): an animated skeleton with a simple body, for Blender, engines and browsers.

The whole format is one JSON text and one block of numbers, so that no library is needed to write it. Units
are metres, Y up, front +Z, as glTF wants them.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from controlmm.io.atomic import replaced_on_success
from controlmm.io.bone_mesh import BoneMesh, bone_mesh
from controlmm.motion.motion import Motion
from controlmm.motion.rotation_fit import BoneLengths, RotationFit, fit_rotations

_METRES = {"m": 1.0, "mm": 0.001}  # of a skeleton's unit
_FLOAT, _BYTE, _SHORT = 5126, 5121, 5123  # glTF's component types
_ARRAY_BUFFER, _INDEX_BUFFER = 34962, 34963
_TYPES = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (16,): "MAT4"}
_GLB_MAGIC, _GLB_VERSION, _JSON_CHUNK, _BINARY_CHUNK = 0x46546C67, 2, 0x4E4F534A, 0x004E4942


class GlbFormat:
    """Writer of ``.glb``."""

    @staticmethod
    def save(motion: Motion, path: Path, *, bone_lengths: BoneLengths = "clip") -> None:
        """Fit rigid bones to the motion, as for ``.bvh``, and write them with a body to look at.

        Args:
            motion: Any motion of the HumanML3D or KIT-ML skeleton. Its rotation features are not used.
            path: File to write, replaced as a whole.
            bone_lengths: ``"clip"`` (mean over the clip) or ``"reference"`` (the skeleton's published ones).

        Raises:
            ValueError: If an option is unknown.
        """
        fit = fit_rotations(motion.joints, motion.skeleton, bone_lengths=bone_lengths)
        document = _Document()
        rest = _rest_positions(fit)
        document.add_skeleton(fit, rest)
        document.add_body(bone_mesh(fit, rest * _METRES[fit.skeleton.unit]))
        document.add_animation(fit, motion.text)
        with replaced_on_success(path) as partial:
            partial.write_bytes(document.packed())

    @staticmethod
    def load(path: Path) -> Motion:
        """Not supported: always raises ``ValueError``."""
        raise ValueError(f"{path}: .glb files are written, not read. Load the .npz or .bvh.")


class _Document:
    """A glTF document under construction: its JSON, and the numbers that it refers to."""

    def __init__(self) -> None:
        self._numbers = bytearray()
        self._json: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "controlmm"},
            "scene": 0,
            "bufferViews": [],
            "accessors": [],
        }

    def add_skeleton(self, fit: RotationFit, rest: ndarray) -> None:
        """One node a joint, resting in the T-pose on the floor, and the skin that binds the body to them."""
        skeleton, metres = fit.skeleton, _METRES[fit.skeleton.unit]
        offsets = fit.offsets.numpy() * metres
        nodes: list[dict[str, Any]] = []
        for joint, name in enumerate(skeleton.joint_names):
            children = [j for j, parent in enumerate(skeleton.parents) if parent == joint]
            place = offsets[joint] if joint else rest[0] * metres
            node: dict[str, Any] = {"name": name, "translation": place.tolist(), "rotation": [0, 0, 0, 1]}
            nodes.append(node | ({"children": children} if children else {}))
        binding = np.tile(np.eye(4), (len(nodes), 1, 1))
        binding[:, :3, 3] = -rest * metres
        matrices = self._accessor(binding.transpose(0, 2, 1).reshape(-1, 16).astype(np.float32))  # by columns
        joints = list(range(len(nodes)))
        self._json["skins"] = [{"joints": joints, "skeleton": 0, "inverseBindMatrices": matrices}]
        self._json["nodes"] = [*nodes, {"name": "body", "mesh": 0, "skin": 0}]
        self._json["scenes"] = [{"nodes": [0, len(nodes)]}]

    def add_body(self, mesh: BoneMesh) -> None:
        """The mesh, one primitive a colour; every corner follows one joint."""
        attributes = {
            "POSITION": self._accessor(mesh.positions, target=_ARRAY_BUFFER, has_bounds=True),
            "NORMAL": self._accessor(mesh.normals, target=_ARRAY_BUFFER),
            "JOINTS_0": self._accessor(_first_of_four(mesh.joints).astype(np.uint8), target=_ARRAY_BUFFER),
            "WEIGHTS_0": self._accessor(
                _first_of_four(np.ones(len(mesh.joints))).astype(np.float32), target=_ARRAY_BUFFER
            ),
        }
        primitives, materials = [], []
        for name, (color, indices) in mesh.faces.items():
            surface = {"baseColorFactor": [*color, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.8}
            materials.append({"name": name, "pbrMetallicRoughness": surface})
            corners = self._accessor(indices.reshape(-1).astype(np.uint16), target=_INDEX_BUFFER)
            primitives.append({"attributes": attributes, "indices": corners, "material": len(materials) - 1})
        self._json["materials"] = materials
        self._json["meshes"] = [{"name": "body", "primitives": primitives}]

    def add_animation(self, fit: RotationFit, text: str) -> None:
        """Rotations of all joints and positions of the root, one key a frame."""
        rotations = fit.local_rotations.numpy()[..., [1, 2, 3, 0]]  # glTF: x, y, z, w
        root = fit.root_positions.numpy() * _METRES[fit.skeleton.unit]
        seconds = np.arange(len(root)) / fit.skeleton.fps
        times = self._accessor(seconds.astype(np.float32), has_bounds=True)
        curves = [(0, "translation", root)]
        curves += [(joint, "rotation", rotations[:, joint]) for joint in range(rotations.shape[1])]
        samplers: list[dict[str, int]] = []
        channels: list[dict[str, Any]] = []
        for node, path, values in curves:
            channels.append({"sampler": len(samplers), "target": {"node": node, "path": path}})
            samplers.append({"input": times, "output": self._accessor(values.astype(np.float32))})
        name = text or "motion"
        self._json["animations"] = [{"name": name, "samplers": samplers, "channels": channels}]

    def packed(self) -> bytes:
        """The file: a header, the JSON, the numbers, each padded to four bytes."""
        self._json["buffers"] = [{"byteLength": len(self._numbers)}]
        text = json.dumps(self._json, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        chunks = b"".join(
            struct.pack("<II", len(data), kind) + data
            for data, kind in ((text, _JSON_CHUNK), (bytes(self._numbers), _BINARY_CHUNK))
        )
        return struct.pack("<III", _GLB_MAGIC, _GLB_VERSION, 12 + len(chunks)) + chunks

    def _accessor(self, values: ndarray, *, target: int | None = None, has_bounds: bool = False) -> int:
        """Number of a new accessor to ``values`` (N, ...)."""
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self._numbers), "byteLength": values.nbytes}
        self._json["bufferViews"].append(view | ({} if target is None else {"target": target}))
        self._numbers += values.tobytes()
        self._numbers += bytes(-len(self._numbers) % 4)
        kinds = {"float32": _FLOAT, "uint8": _BYTE, "uint16": _SHORT}
        accessor: dict[str, Any] = {
            "bufferView": len(self._json["bufferViews"]) - 1,
            "componentType": kinds[values.dtype.name],
            "count": len(values),
            "type": _TYPES[values.shape[1:]],
        }
        if has_bounds:
            accessor |= {name: np.atleast_1d(edge(values, axis=0)).tolist() for name, edge in _BOUNDS}
        self._json["accessors"].append(accessor)
        return len(self._json["accessors"]) - 1


_BOUNDS = (("min", np.min), ("max", np.max))


def _first_of_four(values: ndarray) -> ndarray:
    """(N,) as (N, 4): a corner may follow four joints, ours follow one."""
    return np.pad(values[:, None], ((0, 0), (0, 3)))


def _rest_positions(fit: RotationFit) -> ndarray:
    """(J, 3) joints of the T-pose, standing on the floor."""
    positions = np.zeros((fit.skeleton.num_joints, 3))
    for joint, parent in enumerate(fit.skeleton.parents):
        if parent >= 0:  # parents come first
            positions[joint] = positions[parent] + fit.offsets[joint].numpy()
    positions[:, 1] -= positions[:, 1].min()
    return positions
