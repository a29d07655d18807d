"""The documents agree with the code: links, commands, joints, the line that CI runs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typer.main import get_command

from controlmm.cli.main import app
from controlmm.motion.formats import known_suffixes
from controlmm.motion.skeleton import HUMANML3D
from controlmm.pipelines import PRESETS

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
DOCUMENTS = (*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md")))


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(document: Path) -> None:
    for target, anchor in re.findall(r"\]\(([^)#:]*)(?:#([^)]*))?\)", document.read_text(encoding="utf-8")):
        linked = document.parent / target if target else document
        assert linked.exists(), f"{document.name} links {target}"
        if anchor:
            titles = re.findall(r"^#+ (.*)$", linked.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in [re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in titles]


def test_the_readme_names_every_command_preset_and_format() -> None:
    for name in get_command(app).commands:  # type: ignore[attr-defined]
        assert f"`controlmm {name}" in README
    for name in PRESETS:
        assert f"`{name}`" in README
    for suffix in known_suffixes():
        assert f"`.{suffix}`" in README


def test_the_control_page_names_every_joint() -> None:
    page = (ROOT / "docs" / "controls.md").read_text(encoding="utf-8")
    assert [name for name in HUMANML3D.joint_names if f"`{name}`" not in page] == []


def test_ci_runs_the_test_command_of_the_readme() -> None:
    lines = [line for line in README.splitlines() if line.startswith("python3 -m venv") and "pytest" in line]
    assert len(lines) == 1
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert "README.md" in script
    assert lines[0] not in script
