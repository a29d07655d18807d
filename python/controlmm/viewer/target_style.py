"""How control targets look, the same in every panel and in the moving pictures."""

from __future__ import annotations

from typing import Any

from controlmm.viewer import palette
from controlmm.viewer.scene import Scene
from controlmm.viewer.stick_figure import joint_colors

_DENSE = 40  # more targets than this on one joint run together: small dots instead of diamonds


def traced_joints(scene: Scene) -> list[int]:
    """Controlled joints whose way is drawn: all of them, or none when whole poses are controlled."""
    joints = scene.controlled_joints()
    return joints if len(joints) <= len(palette.CONTROL) else []


def target_color(scene: Scene, joint: int) -> str:
    """Colour of a joint's targets and trail."""
    traced = traced_joints(scene)
    return palette.CONTROL[traced.index(joint)] if traced else joint_colors(scene.skeleton)[joint]


def is_dense(scene: Scene, joint: int) -> bool:
    """Whether the joint has so many targets that they form a line."""
    return int(scene.is_controlled[:, joint].sum()) > _DENSE


def target_marker(scene: Scene, joint: int, *, scale: float = 1.0, is_single: bool = False) -> dict[str, Any]:
    """Matplotlib line properties for the targets of one joint; ``is_single`` where only one is shown."""
    style: dict[str, Any] = {"linestyle": "none", "markeredgecolor": palette.TARGET_EDGE}
    style |= {"color": target_color(scene, joint)}
    if not traced_joints(scene):
        return style | {"marker": "o", "markersize": 4.5 * scale, "markeredgewidth": 0.8 * scale}
    if is_dense(scene, joint) and not is_single:
        return style | {"marker": "o", "markersize": 3.4 * scale, "markeredgewidth": 0.3 * scale}
    return style | {"marker": "D", "markersize": 6.5 * scale, "markeredgewidth": 0.9 * scale}
