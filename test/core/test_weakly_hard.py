# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Weakly hard deadlines: the sliding window against all windows, counted one by one."""

from __future__ import annotations

from random import Random

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.core.weakly_hard import MissWindow


def worst_of(missed: list[bool], of: int) -> int:
    return max(sum(missed[begin:begin + of]) for begin in range(max(1, len(missed))))


@given(st.lists(st.booleans(), max_size=40), st.integers(2, 12), st.randoms())
def test_the_worst_window(missed: list[bool], of: int, random: Random) -> None:
    jobs = [job for job, miss in enumerate(missed) if miss] * 2
    random.shuffle(jobs)
    known = len(jobs) // 2
    window = MissWindow(of)
    for job in jobs[:known]:
        window.add(job)
    assert window.worst_with(jobs[known:]) == worst_of(missed, of)
    so_far = [job in jobs[:known] for job in range(len(missed))]
    assert window.worst == worst_of(so_far, of)
    for job in jobs[known:]:
        window.add(job)
    assert window.worst == worst_of(missed, of)


def test_what_is_long_over_is_forgotten() -> None:
    window = MissWindow(10)
    for job in range(0, 100_000, 5):
        window.add(job)
        window.add(max(0, job - 100))   # late, and in no order
    assert window.worst == 2
    assert len(window._jobs) < 3 * (window.of + window.ORDER)


def test_by_hand() -> None:
    window = MissWindow(100)
    for job in (3, 102):
        window.add(job)
    assert window.worst == 2
    window = MissWindow(100)
    for job in (3, 103):
        window.add(job)
    assert window.worst == 1
