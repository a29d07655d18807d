"""Progress of a generation on the terminal: one bar a phase."""

from __future__ import annotations

from types import TracebackType
from typing import Any, Self


class PhaseBars:
    """A pipeline's ``progress`` callback that draws a bar for each phase, one after the other, on stderr."""

    def __init__(self, *, enabled: bool) -> None:
        self._enabled = enabled
        self._phase = ""
        self._bar: Any = None

    def __call__(self, phase: str, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` steps of ``phase`` are done."""
        from tqdm import tqdm

        if not self._enabled:
            return
        if phase != self._phase:
            self._close()
            self._phase, self._bar = phase, tqdm(desc=phase, total=total, unit="step")
        self._bar.update(done - self._bar.n)

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()
