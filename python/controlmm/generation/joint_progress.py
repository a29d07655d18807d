"""One progress for several tasks that run side by side."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int], None]  # phase, steps done, steps in all
_Phase = tuple[str, int]  # its name, and how many of that name the task had before
_Report = tuple[str, int, int]  # phase, steps done, steps in all


class JointProgress:
    """Passes on what the task says that is farthest behind; it never goes back.

    Tasks go through the same phases in the same order, but each may leave some out.

    Args:
        progress: Whom to tell.
        tasks: How many there are.
    """

    def __init__(self, progress: Progress | None, tasks: int) -> None:
        self._progress = progress
        self._order: list[_Phase] = []
        self._ways: dict[int, list[_Phase]] = {task: [] for task in range(tasks)}  # of tasks that run
        self._latest: dict[int, _Report] = {}
        self._told: tuple[_Phase, int] | None = None

    def tell(self, task: int, report: _Report | None) -> None:
        """``task`` has said this, or has ended."""
        if self._progress is None:
            return
        if report is None:
            del self._ways[task]
        else:
            self._enter(task, report)
        if not self._ways or not all(self._ways.values()):
            return  # a task that has said nothing yet is the one that is farthest behind
        places = {running: (way[-1], self._latest[running][1]) for running, way in self._ways.items()}
        slowest = min(places, key=lambda running: self._rank(places[running]))
        if self._told is None or self._rank(places[slowest]) > self._rank(self._told):
            self._told = places[slowest]
            self._progress(*self._latest[slowest])

    def _enter(self, task: int, report: _Report) -> None:
        """Write a report down. A phase that nobody was in before comes next after the task's last one."""
        way, before = self._ways[task], self._latest.get(task)
        self._latest[task] = report
        if before is not None and before[0] == report[0] and before[1] <= report[1]:
            return
        phase = report[0], sum(name == report[0] for name, _ in way)
        if phase not in self._order:
            self._order.insert(self._order.index(way[-1]) + 1 if way else 0, phase)
        way.append(phase)

    def _rank(self, place: tuple[_Phase, int]) -> tuple[int, int]:
        return self._order.index(place[0]), place[1]
