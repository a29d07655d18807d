"""Tasks side by side, each in a thread of its own that takes one core.

A batch of clips fills more cores this way than by operators that threads share: those are small, and at each
of them all threads would wait for the slowest. What a task computes depends neither on how many run at once
nor on which thread runs it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import copy_context
from functools import partial
from queue import SimpleQueue
from typing import Any, TypeVar

import torch

from controlmm.generation.joint_progress import JointProgress, Progress
from controlmm.generation.one_thread import allowed_threads, take_one_core

_Result = TypeVar("_Result")
_Report = tuple[str, int, int]  # phase, steps done, steps in all
Task = Callable[[Progress | None], _Result]


class _StoppedError(Exception):
    """Ends a task whose result nobody waits for any more."""


def side_by_side(tasks: Sequence[Task[_Result]], *, progress: Progress | None = None) -> list[_Result]:
    """Results of all tasks, by as many threads as the caller lets torch use.

    Args:
        tasks: Each is given a ``progress`` to call during its loops.
        progress: Called from the caller's thread only, with what the task says that is farthest behind.

    Raises:
        BaseException: What the first task that fails raises, or what interrupts the caller. Other tasks end
            when they report the next time, before this returns.
    """
    threads = min(allowed_threads(), len(tasks))
    if threads <= 1:
        return [task(progress) for task in tasks]
    shown = JointProgress(progress, len(tasks))
    mail: SimpleQueue[tuple[int, _Report | None]] = SimpleQueue()  # task, and None when it ended
    is_over, state = threading.Event(), _TorchState()

    def send(task: int, phase: str, done: int, total: int) -> None:
        if is_over.is_set():
            raise _StoppedError
        mail.put((task, (phase, done, total)))

    def run(task: int) -> _Result:
        if is_over.is_set():
            raise _StoppedError
        with state.applied():
            return tasks[task](partial(send, task))

    with ThreadPoolExecutor(threads) as pool:
        try:
            # Context variables (the backend) go along; one context cannot be in two threads.
            futures = [pool.submit(copy_context().run, run, task) for task in range(len(tasks))]
            for task, future in enumerate(futures):
                future.add_done_callback(partial(_tell_end, mail, task))
            running = len(tasks)
            while running:
                task, report = mail.get()
                if report is None:
                    futures[task].result()  # or what it raised
                    running -= 1
                shown.tell(task, report)
        finally:
            is_over.set()
    return [future.result() for future in futures]


def _tell_end(mail: SimpleQueue[tuple[int, _Report | None]], task: int, _: Future[Any]) -> None:
    mail.put((task, None))


class _TorchState:
    """What torch keeps for each thread and a new one must be told."""

    def __init__(self) -> None:
        self._takes_gradients = torch.is_grad_enabled()
        self._is_inference = torch.is_inference_mode_enabled()
        self._is_autocast = torch.is_autocast_enabled("cpu")
        self._autocast_dtype = torch.get_autocast_dtype("cpu")

    @contextmanager
    def applied(self) -> Iterator[None]:
        """The same in the thread that calls this, which from then on takes one core."""
        take_one_core()
        with (
            torch.inference_mode(self._is_inference),
            torch.set_grad_enabled(self._takes_gradients),
            torch.autocast("cpu", dtype=self._autocast_dtype, enabled=self._is_autocast),
        ):
            yield
