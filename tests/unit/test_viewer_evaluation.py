"""Pictures of evaluations are written, in the size of their panels, and say what they show."""

from __future__ import annotations

from pathlib import Path

import torch
from PIL import Image

from controlmm.viewer.evaluation_charts import save_confidence, save_curves, save_tradeoff

WIDTH, HEIGHT = 506, 374  # pixels of a panel


def _size(path: Path) -> tuple[int, int]:
    with Image.open(path) as picture:
        return picture.size


def test_one_panel_for_each_group_of_the_tradeoff(tmp_path: Path) -> None:
    groups = {
        "published": [("MDM", 10.1, 59.6, 0.698)],
        "ours": [("fast", 0.5, 0.0, 2.0), ("slow", 9.0, 0.3, 1.0)],
    }
    path = save_tradeoff(groups, tmp_path / "new" / "figure2.png", title="Error, FID and time")
    assert _size(path) == (2 * WIDTH, HEIGHT)


def test_one_panel_for_each_metric_of_the_curves(tmp_path: Path) -> None:
    panels = {"error": {"ours": [1.0, 2.0]}, "FID": {"ours": [3.0, float("nan")]}, "R": {"ours": [0.1, 0.2]}}
    assert _size(save_curves(["1", "196"], panels, tmp_path / "curves.png")) == (3 * WIDTH, HEIGHT)


def test_confidence_has_a_map_for_each_case_and_a_panel_of_means(tmp_path: Path) -> None:
    maps = {
        f"case {index}": torch.rand(4, 9, generator=torch.Generator().manual_seed(index))
        for index in range(5)
    }
    maps["case 0"][:, 7:] = torch.nan  # tokens that no clip has
    means = {name: confidence.nanmean(1) for name, confidence in maps.items()}
    path = save_confidence(maps, means, tmp_path / "confidence.png")
    assert _size(path) == (3 * WIDTH, 2 * HEIGHT)
    with Image.open(path) as picture:
        assert len(picture.convert("RGB").getcolors(maxcolors=10**6)) > 100
