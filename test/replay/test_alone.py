# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What executions would have taken alone: by hand, and what holds for any."""

from __future__ import annotations

from collections.abc import Sequence

from hypothesis import given, settings
from hypothesis import strategies as st
from mddag_executor.core import NEVER
from mddag_executor.replay import alone as module
from mddag_executor.replay.alone import alone, colder, Recorded
import numpy as np
from pytest import approx, MonkeyPatch

Ran = tuple[float, float, float, int]
"""When it could start, what it took, its CPU time (-1: not known); whose lock it has, 0: none."""


def of(
    *ran: Ran, cpus: int = 0, here: Sequence[int] | None = None,
    callbacks: Sequence[int] | None = None, workers: int = NEVER,
) -> list[float]:
    """Return what executions would have taken alone; all in ms."""
    could, took, cpu, held = (np.array(column) for column in zip(*ran))
    times = [np.rint(each * 1e6).astype(np.int64) for each in (could, took)]
    cpu = np.where(cpu < 0, -1, np.rint(cpu * 1e6)).astype(np.int64)
    interpreter = np.array(here) if here is not None else np.maximum(held, 1)
    callback = np.arange(len(ran)) if callbacks is None else np.array(callbacks)
    warm = np.zeros(len(ran), dtype=np.bool_)
    found = alone(Recorded(*times, cpu, held > 0, interpreter, callback, warm), cpus, workers)
    return [float(each) for each in np.round(found / 1e6, 1)]


def test_two_that_held_it_at_the_same_time() -> None:
    # they took turns, the first one had the first
    assert of((0, 19, 10, 1), (0, 20, 10, 1)) == [10, 10]
    # one was overtaken by another
    assert of((0, 13, 10, 1), (2, 6, 3, 1)) == approx([10, 3], abs=0.1)
    # in processes of their own they had nothing to share
    assert of((0, 13, 10, 1), (2, 6, 3, 2)) == [13, 6]


def test_what_the_machine_does_not_explain_is_its_own() -> None:
    assert of((0, 20, 10, 1), (30, 20, 20, 1)) == [20, 20]
    assert of((0, 20, -1, 0), (0, 20, 10, 0)) == [20, 20]


def test_one_that_waits_got_the_lock_late() -> None:
    # it needs the lock for 0.3 ms when it goes on
    waits = (0, 6, 0.4, 0)
    assert of(waits, (4, 20, 19.7, 1)) == [5, 19.7]
    assert of(waits, (7, 20, 20, 1)) == [6, 20]
    assert of(waits, (4, 20, 20, 1), here=[1, 2]) == [6, 20]


def test_cpus_that_were_busy() -> None:
    assert of((0, 17, 10, 0), (0, 20, 10, 0), cpus=1) == approx([10, 10], abs=1.2)
    assert of((0, 20, 10, 0), (0, 20, 10, 0), cpus=3) == [20, 20]
    assert of((0, 20, 10, 0), (0, 20, 10, 0)) == [20, 20]


def test_what_others_did_that_nobody_explains() -> None:
    """It counts unless nothing is to run beside it."""
    quiet = [(100 * i, 12, 10, 1) for i in range(1, 6)]
    disturbed, other = (0, 20, 10, 0), (0, 20, 0.1, 0)
    executions = [disturbed, *quiet, other]
    callbacks = [0, 0, 0, 0, 0, 0, 1]
    for workers, expected in ((NEVER, 20), (2, 20), (1, 12)):
        found = of(*executions, callbacks=callbacks, workers=workers)
        assert found == approx([expected, *[12] * 5, 20], abs=0.15)


def test_one_that_waits_is_delayed_by_others_too() -> None:
    """It sleeps for 5 ms, and was twice as long where others ran beside it."""
    by_itself = [(100 * i, 5, 0.1, 0) for i in range(1, 6)]
    executions = [(0, 10, 0.1, 0), *by_itself, (0, 20, 0.1, 0)]
    callbacks = [0, 0, 0, 0, 0, 0, 1]
    for workers, expected in ((NEVER, 10), (1, 5)):
        found = of(*executions, callbacks=callbacks, workers=workers)
        assert found == approx([expected, *[5] * 5, 20], abs=0.15)


def test_what_is_left_where_fewer_run_beside_one() -> None:
    """It lost 20 ms while three others ran beside it, for 15 of 30 ms only one of them."""
    by_itself = [(100 * i, 10, 10, 0) for i in range(1, 6)]
    executions = [(0, 30, 10, 0), *by_itself, (0, 30, 0.1, 0), *[(0, 15, 0.1, 0)] * 2]
    callbacks = [0] * 6 + [1, 2, 2]
    for workers, expected in ((1, 10), (2, 20), (3, 20), (4, 30)):
        found = of(*executions, callbacks=callbacks, workers=workers)
        assert found[:6] == approx([expected, *[10] * 5], abs=0.15)


def test_what_takes_more_where_the_worker_had_slept() -> None:
    """Of the second callback too little is known: the difference is that of the first."""
    callback = np.array([0] * 10 + [1, 1])
    warm = np.array([True, False] * 6)
    took = np.array([100, 130] * 5 + [500, 10])
    assert colder(callback, warm, took).tolist() == [-30, 30] * 5 + [-30, 5]


def test_a_long_recording_goes_window_by_window(monkeypatch: MonkeyPatch) -> None:
    monkeypatch.setattr(module, 'WINDOW', 3)
    first = (0, 19, 10, 1), (0, 20, 10, 1), (30, 20, 20, 1), (50, 13, 10, 1), (52, 6, 3, 1)
    later = [(could + 100, took, cpu, held) for could, took, cpu, held in first]
    assert of(*first, *later) == 2 * of(*first) == approx(2 * [10, 10, 20, 10, 3], abs=0.1)


@settings(deadline=None)
@given(st.lists(st.tuples(
    st.integers(0, 10), st.integers(0, 10), st.integers(-1, 10), st.integers(0, 2)),
    min_size=1, max_size=20), st.integers(0, 3), st.integers(1, 5), st.integers(1, 30),
    st.integers(1, 4))
def test_never_longer_and_alone_never_less_than_it_computed(
    ran: list[Ran], cpus: int, callbacks: int, window: int, workers: int
) -> None:
    """Also where the windows part what runs."""
    with MonkeyPatch.context() as patch:
        patch.setattr(module, 'WINDOW', window)
        found = of(
            *ran, cpus=cpus, callbacks=[i % callbacks for i in range(len(ran))],
            workers=workers)
    for (_, took, cpu, _), alone_ in zip(ran, found):
        assert min(cpu, took) <= alone_ <= took
