# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What executions would have taken alone: by hand, and what holds for any."""

from __future__ import annotations

from collections.abc import Sequence

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.replay.alone import alone, held_for
import numpy as np

Ran = tuple[int, int, int, int]
"""Start, how long it took, its CPU time (-1: not known), and the interpreter it held (0: none)."""


def of(*ran: Ran, cpus: int = 0, here: Sequence[int] | None = None) -> list[int]:
    start, took, cpu, held = np.array(ran, dtype=np.int64).T
    interpreter = np.array(here) if here is not None else np.maximum(held, 1)
    return alone(start, took, cpu, held, interpreter, cpus).tolist()


def test_two_that_held_it_at_the_same_time() -> None:
    assert of((0, 20, 10, 1), (0, 20, 10, 1)) == [10, 10]
    # one is overtaken by another, and they take turns
    assert of((0, 13, 10, 1), (2, 6, 3, 1)) == [10, 3]
    # in processes of their own they had nothing to share
    assert of((0, 13, 10, 1), (2, 6, 3, 2)) == [13, 6]


def test_what_nobody_explains_is_its_own() -> None:
    assert of((0, 20, 10, 1), (30, 20, 20, 1)) == [20, 20]
    assert of((0, 20, -1, 0), (0, 20, 10, 0)) == [20, 20]
    # the machine stood still for 10 while both had begun: that was once
    assert of((0, 30, 10, 1), (0, 30, 10, 1)) == [15, 15]


def test_one_that_waits_got_the_lock_late() -> None:
    ms = 1_000_000
    # it computed for 0.4 ms, of that 0.3 at its end, when the other one had computed for long
    waits = (0, 6 * ms, 400_000, 0)
    assert of((0, 20 * ms, 20 * ms, 1), waits) == [20 * ms, 5 * ms]
    # the other one had just begun
    assert of((5_500_000, 20 * ms, 20 * ms, 1), waits) == [20 * ms, 6 * ms - 200_000]
    assert of((7 * ms, 20 * ms, 20 * ms, 1), waits) == [20 * ms, 6 * ms]
    assert of((0, 20 * ms, 20 * ms, 1), waits, here=[1, 2]) == [20 * ms, 6 * ms]


def test_cpus_that_were_busy() -> None:
    assert of((0, 20, 10, 0), (0, 20, 10, 0), cpus=1) == [10, 10]
    assert of((0, 20, 10, 0), (0, 20, 10, 0), cpus=2) == [20, 20]
    assert of((0, 20, 10, 0), (0, 20, 10, 0)) == [20, 20]


def test_held_for() -> None:
    begins, ends = np.array([10, 12, 30]), np.array([20, 25, 40])
    assert held_for(np.array([5, 10, 15, 22, 25, 26, 33]), begins, ends).tolist() == [
        0, 0, 5, 12, 15, 0, 3]


@given(st.lists(st.tuples(
    st.integers(0, 10 ** 7), st.integers(0, 10 ** 7), st.integers(-1, 10 ** 7),
    st.integers(0, 2)), min_size=1, max_size=20), st.integers(0, 3))
def test_never_longer_and_never_less_than_it_computed(ran: list[Ran], cpus: int) -> None:
    for (_, took, cpu, _), found in zip(ran, of(*ran, cpus=cpus)):
        assert min(cpu, took) <= found <= took
