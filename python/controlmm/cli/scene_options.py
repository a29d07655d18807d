"""Options of ``controlmm generate`` that name files with obstacles, timelines and motions to edit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from controlmm.controls import Avoid, ControlFile


def all_obstacles(document: ControlFile | None, path: Path | None) -> tuple[Avoid, ...]:
    """Obstacles of the control file and of the file of obstacles together.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is broken or holds no obstacle.
    """
    from controlmm.controls import as_avoids, load_controls

    avoided = as_avoids(document.obstacles) if document else ()
    if path is None:
        return avoided
    scene = load_controls(path)
    if not scene.obstacles:
        raise ValueError(
            f'{path} holds no obstacles. Give them as "obstacles": [...], see docs/obstacles.md.'
        )
    return avoided + as_avoids(scene.obstacles)
