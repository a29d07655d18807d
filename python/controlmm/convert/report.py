"""What a conversion took, left and wrote."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path


@dataclass
class ConversionReport:
    """For people to read: the command prints it, and the model folder keeps a card of it."""

    out: Path
    used: dict[str, Path] = field(default_factory=dict)  # role of a network -> file it came from
    notes: list[str] = field(default_factory=list)

    def lines(self) -> list[str]:
        """One line a network, then the notes."""
        width = max(map(len, self.used), default=0)
        taken = [f"{role:<{width}}  {path}" for role, path in self.used.items()]
        return taken + [f"note: {note}" for note in self.notes]

    def card(self) -> str:
        """A README for the model folder: every network's file with its hash, and the notes."""
        rows = [f"| {role} | `{short_path(path)}` | `{_sha256(path)}` |" for role, path in self.used.items()]
        lines = [
            "# A converted model",
            "",
            "Made by `controlmm convert` from published checkpoints. The weights keep their files' licence.",
            "",
            "| network | file | SHA-256 |",
            "| --- | --- | --- |",
            *rows,
            "",
            *(f"- {note}" for note in self.notes),
        ]
        return "\n".join(lines) + "\n"


def short_path(path: Path) -> str:
    """Run folder, ``model`` and file: where it lay on one machine says nothing to others."""
    return "/".join(path.parts[-3:])


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
