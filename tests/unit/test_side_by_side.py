"""Tasks in threads of their own: results, what threads inherit, progress, errors, interruption."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch

from controlmm.generation.joint_progress import JointProgress
from controlmm.generation.one_thread import allowed_threads, one_thread
from controlmm.generation.shares import in_shares, shares_of
from controlmm.generation.side_by_side import side_by_side
from controlmm.ops import use_backend
from controlmm.ops.backend import requested_backend

SOON = 5.0  # seconds: what ends at once takes milliseconds, what would hang for ever takes longer


@pytest.fixture(autouse=True)
def three_threads() -> Iterator[None]:
    before, running = torch.get_num_threads(), threading.active_count()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)
    assert threading.active_count() == running, "a task goes on"


def run(*tasks: Callable[[Any], Any], **options: Any) -> list[Any]:
    return side_by_side(tasks, **options)


def endless(progress: Any) -> None:
    """Reports until it is stopped."""
    for step in range(10**9):
        progress("walking", min(step, 5), 5)
        time.sleep(0.001)


def test_results_come_in_the_order_of_the_tasks():
    pauses = (0.05, 0.0, 0.02, 0.0, 0.01)
    assert run(*[lambda _, pause=pause: time.sleep(pause) or pause for pause in pauses]) == list(pauses)


def test_tasks_run_at_the_same_time_in_as_many_threads_as_torch_may_take():
    together = threading.Barrier(3, timeout=SOON)
    with one_thread():
        places = run(*[lambda _: (together.wait(), threading.get_ident())[1]] * 3)
    assert len(set(places)) == 3
    assert threading.get_ident() not in places


@pytest.mark.parametrize("tasks", [1, 4])
def test_one_thread_or_one_task_stays_with_the_caller(tasks):
    torch.set_num_threads(1 if tasks > 1 else 3)
    places = run(*[lambda _: (threading.get_ident(), torch.get_num_threads())] * tasks)
    assert places == [(threading.get_ident(), torch.get_num_threads())] * tasks


def test_a_task_takes_one_core_also_where_it_would_share_its_work():
    def counts(_):
        inner = run(*[lambda _: threading.get_ident()] * 2)
        return torch.get_num_threads(), allowed_threads(), set(inner) == {threading.get_ident()}

    assert run(counts, counts) == [(1, 1, True)] * 2
    assert (torch.get_num_threads(), allowed_threads()) == (3, 3)


def test_threads_inherit_what_torch_and_we_keep_for_each():
    def seen(_):
        return (
            torch.is_grad_enabled(),
            torch.is_inference_mode_enabled(),
            torch.is_autocast_enabled("cpu"),
            requested_backend(None),
        )

    assert run(seen, seen) == [(True, False, False, "auto")] * 2
    with torch.no_grad(), torch.autocast("cpu", dtype=torch.bfloat16), use_backend("reference"):
        assert run(seen, seen) == [(False, False, True, "reference")] * 2
    with torch.inference_mode():
        assert run(seen, seen) == [(False, True, False, "auto")] * 2


def test_the_first_error_reaches_the_caller_and_ends_the_others():
    def fails(_):
        raise ZeroDivisionError("no step is left")

    started = time.perf_counter()
    with pytest.raises(ZeroDivisionError, match="no step"):
        run(endless, fails, endless, endless)
    assert time.perf_counter() - started < SOON


def test_an_error_of_the_callback_ends_all():
    def refuses(*_: Any) -> None:
        raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        run(endless, endless, progress=refuses)


def test_ctrl_c_ends_all():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # shells' background jobs ignore it
    try:
        with pytest.raises(KeyboardInterrupt):
            run(endless, endless, lambda _: os.kill(os.getpid(), signal.SIGINT))
    finally:
        signal.signal(signal.SIGINT, before)


def test_progress_is_called_by_the_caller_only_and_never_goes_back():
    calls = []

    def walks(phases):
        def task(progress):
            for phase, steps in phases:
                for done in range(1, steps + 1):
                    time.sleep(0.0005)
                    progress(phase, done, 9)

        return task

    def note(*call: Any) -> None:
        assert threading.current_thread() is threading.main_thread()
        calls.append(call)

    run(
        walks([("drawing", 9), ("editing", 9)]),
        walks([("drawing", 9), ("stepping", 4), ("editing", 7)]),
        walks([("drawing", 9), ("editing", 2)]),
        progress=note,
    )
    order = [call[0] for call in calls]
    assert order == sorted(order, key=["drawing", "stepping", "editing"].index)
    for phase in set(order):
        done = [call[1] for call in calls if call[0] == phase]
        assert done == sorted(set(done))


def test_the_task_that_is_farthest_behind_is_shown():
    calls = []
    joint = JointProgress(lambda *call: calls.append(call), 2)
    joint.tell(0, ("drawing", 1, 2))
    assert calls == []  # the other has said nothing yet
    joint.tell(1, ("drawing", 2, 2))
    joint.tell(1, ("editing", 3, 9))
    assert calls == [("drawing", 1, 2)]
    joint.tell(0, ("drawing", 2, 2))
    joint.tell(0, ("stepping", 1, 4))  # between the two, although the other left it out
    joint.tell(1, None)
    assert calls[1:] == [("drawing", 2, 2), ("stepping", 1, 4)]
    joint.tell(0, ("editing", 1, 9))
    joint.tell(0, ("drawing", 1, 2))  # a second round
    joint.tell(0, None)
    assert calls[3:] == [("editing", 1, 9), ("drawing", 1, 2)]


def test_shares_cost_about_the_same_and_hold_every_clip_once():
    generator = torch.Generator().manual_seed(0)
    costs = torch.randint(40, 197, (33,), generator=generator).tolist()
    for count in (1, 2, 3, 40):
        shares = shares_of(costs, count)
        assert len(shares) == min(count, 33)
        assert sorted(torch.cat(shares).tolist()) == list(range(33))
        sums = [sum(costs[clip] for clip in share.tolist()) for share in shares]
        assert max(sums) - min(sums) <= max(costs)
    assert [len(share) for share in shares_of([196] * 12, 3)] == [4, 4, 4]
    assert [share.tolist() for share in shares_of([], 2)] == [[]]


def test_clips_come_back_in_their_order():
    def squares(rows, _):
        return rows.double()[:, None] ** 2

    result = in_shares(squares, [5, 1, 4, 2, 3, 9, 9], threads=3)
    assert result[:, 0].tolist() == [clip**2 for clip in range(7)]
