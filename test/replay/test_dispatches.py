# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How late executions were dispatched: what could have started when."""

from collections.abc import Sequence

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.replay.dispatches import Dispatches
import numpy as np


def dispatches(n_workers: int, executions: Sequence[tuple[int, int | None, int, int, int]]
               ) -> Dispatches:
    worker, group, ready, start, end = (
        np.array([-1 if each is None else each for each in column], dtype=np.int64)
        for column in zip(*executions))
    return Dispatches(n_workers, worker, group, ready, start, end, np.ones_like(worker))


def late(n_workers: int, *executions: tuple[int, int | None, int, int, int]) -> list[int]:
    return dispatches(n_workers, executions).late().tolist() if executions else []


def test_an_idle_worker_could_have_taken_it_at_once() -> None:
    assert late(2, (0, None, 100, 130, 500)) == [30]


def test_all_busy_it_waits_for_its_worker() -> None:
    assert late(1, (0, None, 0, 0, 400), (0, None, 100, 430, 500)) == [0, 30]


def test_a_worker_is_warm_that_has_only_just_ended_another() -> None:
    found = dispatches(2, [
        (worker, None, 1000 * start, 1000 * start, 1000 * end) for worker, start, end in (
            (0, 500, 510), (0, 600, 700), (1, 710, 720), (0, 801, 810))])
    assert found.warm().tolist() == [False, True, False, False]


def test_left_to_a_busy_worker_although_another_was_idle() -> None:
    # the first one's worker takes what it started itself: the second one has nothing to do
    assert late(2, (0, None, 0, 0, 400), (0, None, 350, 430, 500)) == [0, 80]


def test_those_that_are_ready_before_it_take_the_idle_workers() -> None:
    executions = (0, None, 0, 0, 400), (1, None, 90, 150, 420), (0, None, 100, 430, 500)
    assert late(2, *executions) == [0, 60, 30]


def test_it_waits_for_its_group_beside_idle_workers() -> None:
    assert late(7, (0, 5, 0, 0, 400), (1, 5, 100, 410, 500)) == [0, 10]


def test_others_may_have_taken_the_workers_while_its_group_was_busy() -> None:
    executions = ((0, 5, 0, 0, 400), (0, None, 390, 400, 500), (0, 5, 100, 510, 600),
                  (1, None, 0, 0, 600))
    assert late(2, *executions) == [0, 0, 10, 0]


def test_an_unknown_worker_is_not_waited_for() -> None:
    assert late(1, (-1, None, 0, 0, 400), (-1, None, 100, 430, 500)) == [0, 330]


@given(st.lists(st.tuples(st.integers(0, 50), st.integers(1, 40)), max_size=20))
def test_a_schedule_without_overhead_has_none(jobs: list[tuple[int, int]]) -> None:
    free = [0, 0, 0]
    executions = []
    for ready, takes in sorted(jobs):  # first come, first served
        worker = free.index(min(free))
        start = max(ready, free[worker])
        free[worker] = start + takes
        executions.append((worker, None, ready, start, free[worker]))
    assert late(3, *executions) == [0] * len(jobs)


def test_waiting_for_what_computes_is_not_late() -> None:
    """Three that compute, one after the other; a fourth overtakes; one that only waits."""
    ms = 1_000_000
    first, overtakes, second, waits, third = range(5)
    found = dispatches(5, [
        (0, None, 0, 30, 10 * ms), (3, None, 4 * ms, 5 * ms + 7, 6 * ms),
        (1, None, 0, 10 * ms + 50, 20 * ms), (4, None, 12 * ms, 13 * ms + 9, 22 * ms),
        (2, None, 15 * ms, 20 * ms + 60, 30 * ms)])
    # who overtakes and who only waits could begin at once; the machine tells why they did not
    assert found.late([first, second, third, overtakes]).tolist() == [
        30, ms + 7, 50, ms + 9, 60]
    assert waits == 3
