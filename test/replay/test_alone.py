# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What executions would have taken alone: by hand, and what holds for any."""

from __future__ import annotations

from collections.abc import Sequence

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.replay.alone import alone, computing, time_of
import numpy as np

Ran = tuple[int, int, int, int]
"""Start, how long it took, its CPU time (-1: not known), and whose lock it computes with, if."""


def of(
    *ran: Ran, cpus: int = 0, here: Sequence[int] | None = None,
    callbacks: Sequence[int] | None = None,
) -> list[int]:
    start, took, cpu, held = np.array(ran, dtype=np.int64).T
    interpreter = np.array(here) if here is not None else np.maximum(held, 1)
    callback = np.arange(len(ran)) if callbacks is None else np.array(callbacks)
    return alone(start, took, cpu, callback, held > 0, interpreter, cpus).tolist()


def test_two_that_held_it_at_the_same_time() -> None:
    assert of((0, 20, 10, 1), (0, 20, 10, 1)) == [10, 10]
    # one is overtaken by another, and they take turns
    assert of((0, 13, 10, 1), (2, 6, 3, 1)) == [10, 3]
    # in processes of their own they had nothing to share
    assert of((0, 13, 10, 1), (2, 6, 3, 2)) == [13, 6]


def test_what_nobody_explains_is_its_own() -> None:
    assert of((0, 20, 10, 1), (30, 20, 20, 1)) == [20, 20]
    assert of((0, 20, -1, 0), (0, 20, 10, 0)) == [20, 20]
    # they computed at the same time for 5
    assert of((0, 20, 10, 1), (15, 20, 15, 1)) == [15, 15]


def test_what_a_callback_waits_for_is_told_by_those_that_nobody_disturbed() -> None:
    quiet = [(100 * i, 12, 10, 1) for i in range(1, 4)]
    disturbed, other = (0, 20, 10, 1), (0, 20, 10, 1)
    assert of(disturbed, *quiet, other, callbacks=[0, 0, 0, 0, 1]) == [12, 12, 12, 12, 10]


def test_one_that_waits_got_the_lock_late() -> None:
    ms = 1_000_000
    # it computed for 0.4 ms, of that 0.3 at its end, when the other one computed
    waits = (0, 6 * ms, 400_000, 0)
    quiet = [(100 * ms * i, 5 * ms, 400_000, 0) for i in range(1, 4)]

    def found(other: int, **options: Sequence[int]) -> int:
        return of(waits, *quiet, (other, 20 * ms, 20 * ms, 1), callbacks=[0, 0, 0, 0, 1],
                  **options)[0]

    assert found(0) == 5 * ms
    # the other one had just begun
    assert found(5_500_000) == 6 * ms - 500_000
    assert found(7 * ms) == 6 * ms
    assert found(0, here=[1, 1, 1, 1, 2]) == 6 * ms


def test_cpus_that_were_busy() -> None:
    assert of((0, 20, 10, 0), (0, 20, 10, 0), cpus=1) == [10, 10]
    assert of((0, 20, 10, 0), (0, 20, 10, 0), cpus=3) == [20, 20]
    assert of((0, 20, 10, 0), (0, 20, 10, 0)) == [20, 20]


def test_who_computes() -> None:
    """One that was stretched by others, one that waits, one of which nothing is known."""
    took = np.array([10, 30, 50, 20, 20, 20])
    cpu = np.array([10, 10, 10, 2, 2, -1])
    assert computing(np.array([0, 0, 0, 1, 1, 2]), took, cpu).tolist() == [
        True, True, True, False, False, False]


def test_time_of() -> None:
    begins, ends = np.array([10, 12, 30]), np.array([20, 25, 40])
    when = np.array([5, 10, 15, 22, 25, 26, 33, 50])
    assert time_of(begins, ends, 0)(when).tolist() == [0, 0, 5, 12, 15, 15, 18, 25]
    assert time_of(begins, ends, 1)(when).tolist() == [0, 0, 3, 8, 8, 8, 8, 8]
    assert time_of(begins[:0], ends[:0], 0)(when).tolist() == [0] * 8


@given(st.lists(st.tuples(
    st.integers(0, 10 ** 7), st.integers(0, 10 ** 7), st.integers(-1, 10 ** 7),
    st.integers(0, 2)), min_size=1, max_size=20), st.integers(0, 3), st.integers(1, 5))
def test_never_longer_and_never_less_than_it_computed(
    ran: list[Ran], cpus: int, callbacks: int
) -> None:
    found = of(*ran, cpus=cpus, callbacks=[i % callbacks for i in range(len(ran))])
    for (_, took, cpu, _), alone_ in zip(ran, found):
        assert min(cpu, took) <= alone_ <= took
