"""What a conversion took, left and wrote."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path


@dataclass
class ConversionReport:
    """For people to read: the command prints it, the model card keeps it."""

    out: Path
    used: dict[str, Path] = field(default_factory=dict)  # role of a network -> file it came from
    notes: list[str] = field(default_factory=list)

    def lines(self) -> list[str]:
        """One line a network, then the notes."""
        width = max(map(len, self.used), default=0)
        taken = [f"{role:<{width}}  {path}" for role, path in self.used.items()]
        return taken + [f"note: {note}" for note in self.notes]
