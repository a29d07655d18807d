"""GLB files, read back by another library and by the words of the glTF 2.0 specification."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
import torch

from controlmm.motion.motion import Motion
from controlmm.motion.rotation_fit import fit_rotations
from controlmm.motion.skeleton import KIT

PLACES = 1e-5  # metres; the file holds float32


@pytest.fixture
def path(walking, tmp_path):
    return walking.save(tmp_path / "walk.glb")


def chunks(path):
    """The JSON and the numbers of a file, as section 4.4 of the specification lays them out."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    found, at = {}, 12
    while at < len(data):
        size, kind = struct.unpack_from("<I4s", data, at)
        assert size % 4 == 0
        found[kind] = data[at + 8 : at + 8 + size]
        at += 8 + size
    return json.loads(found[b"JSON"]), found[b"BIN\0"]


def values(document, numbers, accessor):
    about = document["accessors"][accessor]
    view = document["bufferViews"][about["bufferView"]]
    kind = {5126: "<f4", 5121: "u1", 5123: "<u2"}[about["componentType"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[about["type"]]
    assert view["byteOffset"] % 4 == 0
    flat = np.frombuffer(numbers, kind, about["count"] * width, view["byteOffset"])
    return flat.reshape(about["count"], width).astype(np.float64)


def rotation(quaternion):
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def world(document, pose=None):
    """Matrices of all nodes, those of ``pose`` (node, path) -> value in place of their own."""
    matrices, stack = {}, [(node, np.eye(4)) for node in document["scenes"][0]["nodes"]]
    while stack:
        node, above = stack.pop()
        own = dict(document["nodes"][node])
        for name in ("translation", "rotation"):
            own[name] = (pose or {}).get((node, name), own.get(name, [0, 0, 0, 1][-4:]))
        local = np.eye(4)
        local[:3, :3] = rotation(own["rotation"])
        local[:3, 3] = own["translation"][:3]
        matrices[node] = above @ local
        stack += [(child, matrices[node]) for child in own.get("children", [])]
    return matrices


def pose_at(document, numbers, frame):
    animation = document["animations"][0]
    pose = {}
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        target = channel["target"]
        pose[target["node"], target["path"]] = values(document, numbers, sampler["output"])[frame]
    return pose


def test_the_animation_plays_the_fitted_motion(walking, path):
    document, numbers = chunks(path)
    fitted = fit_rotations(walking.joints).joints.numpy()
    for frame in (0, 17, 59):
        matrices = world(document, pose_at(document, numbers, frame))
        joints = np.stack([matrices[joint][:3, 3] for joint in range(22)])
        np.testing.assert_allclose(joints, fitted[frame], atol=PLACES)
    names = [node["name"] for node in document["nodes"]]
    assert names == [*walking.skeleton.joint_names, "body"]
    times = values(document, numbers, document["animations"][0]["samplers"][0]["input"])[:, 0]
    np.testing.assert_allclose(times, np.arange(60) / 20, atol=1e-6)
    assert document["animations"][0]["name"] == "a person walks forward"


def test_the_body_follows_its_skeleton(walking, path):
    """A corner at a joint stays there: joint matrix times inverse bind matrix, as the specification says."""
    document, numbers = chunks(path)
    skin, mesh = document["skins"][0], document["meshes"][0]["primitives"][0]["attributes"]
    bound = values(document, numbers, skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    rest = world(document)
    for joint in range(22):
        np.testing.assert_allclose(rest[joint] @ bound[joint], np.eye(4), atol=PLACES)
    corners = values(document, numbers, mesh["POSITION"])
    owners = values(document, numbers, mesh["JOINTS_0"])[:, 0].astype(int)
    assert (values(document, numbers, mesh["WEIGHTS_0"]) == [1, 0, 0, 0]).all()
    matrices = world(document, pose_at(document, numbers, 30))
    moved = [matrices[j] @ bound[j] @ [*corner, 1] for corner, j in zip(corners, owners, strict=True)]
    elbow = walking.skeleton.joint_names.index("left_elbow")
    distance = np.linalg.norm(np.array(moved)[:, :3] - matrices[elbow][:3, 3], axis=1)
    assert (distance < PLACES).sum() == 8  # four faces at the end of the upper arm, four of the lower one
    assert corners[:, 1].min() == pytest.approx(0, abs=0.06)  # stands on the floor at rest


def test_another_library_finds_a_whole_body(path):
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.load(path)
    meshes = list(scene.geometry.values())
    assert len(meshes) == 3  # left, right, trunk
    body = trimesh.util.concatenate(meshes)
    body.merge_vertices(merge_norm=True)
    assert body.is_watertight
    assert body.is_winding_consistent
    assert body.volume > 0  # faces look outwards
    low, high = body.bounds
    assert 1.3 < high[1] - low[1] < 2.0
    assert "left_wrist" in scene.graph.nodes
    wrist, _ = scene.graph["left_wrist"]
    shoulder, _ = scene.graph["left_shoulder"]
    assert wrist[0, 3] > shoulder[0, 3] > 0  # the left arm lies along +X in the T-pose


def test_kit_bodies_are_written_in_metres_at_their_own_rate(tmp_path):
    generator = torch.Generator().manual_seed(0)
    rest = torch.linspace(0, 1700, 21)[:, None] * torch.tensor([0.2, 1.0, 0.1])
    motion = Motion(rest + 100 * torch.rand(12, 21, 3, generator=generator), skeleton=KIT)
    document, numbers = chunks(motion.save(tmp_path / "kit.glb"))
    matrices = world(document, pose_at(document, numbers, 5))
    np.testing.assert_allclose(matrices[0][:3, 3], motion.joints[5, 0].numpy() / 1000, atol=PLACES)
    times = values(document, numbers, document["animations"][0]["samplers"][0]["input"])[:, 0]
    assert times[1] == pytest.approx(1 / KIT.fps)


def test_a_glb_is_not_read(path):
    with pytest.raises(ValueError, match=r"\.glb files are written, not read\. Load the \.npz or \.bvh"):
        Motion.load(path)
