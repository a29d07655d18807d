"""The colours of all pictures."""

from __future__ import annotations

LEFT = "#2878c8"
RIGHT = "#e0582b"
TRUNK = "#3b4252"
TORSO = "#9aa5b8"
PAPER = "#ffffff"
INK = "#22262e"
FAINT = "#8a93a3"
GRID = "#dfe3ea"
PATH = "#5b6577"
OBSTACLE = "#7a6a4f"
TARGET_EDGE = "#1b1b1b"
# One for each controlled joint; with more joints than these (whole poses) targets take the limbs' colours.
CONTROL = ("#c2185b", "#00897b", "#f2a900", "#6a3fb5", "#43a047", "#8d5b2b")


def paler(color: str, opacity: float) -> str:
    """``color`` (``#rrggbb``) mixed with the paper, opaque, so that overlapping strokes do not show."""
    channels = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
    return "#" + "".join(f"{round(255 + opacity * (channel - 255)):02x}" for channel in channels)
