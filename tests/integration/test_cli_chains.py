"""``controlmm generate --then``: a motion of several clips."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from controlmm.motion.motion import Motion

PROMPT = "a person walks forward"


def test_clips_go_on_from_each_other(
    command: Callable[..., str], tiny_pipeline_folder: Path, tmp_path: Path
) -> None:
    command(
        "generate", PROMPT, "--seconds", 2, "--then", "he bows: 2.5", "--then", "time 3:00, he waves:2",
        "--preset", "fast", "--formats", "npz", "--out", tmp_path, "--model", tiny_pipeline_folder,
    )  # fmt: skip
    motion = Motion.load(tmp_path / "a-person-walks-forward_0_0.npz")
    assert motion.num_frames == 40 + 50 + 40 - 2 * 16  # neighbours share 0.8 s
    assert motion.text == f"{PROMPT}; he bows; time 3:00, he waves"
