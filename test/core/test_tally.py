# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Counts of the core's decisions."""

from __future__ import annotations

from collections import deque
from fractions import Fraction
import math

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.core import quantile, Tables, Tally
from mddag_executor.core.state import (
    ABORTED,
    COMPLETED,
    Decision,
    DROP,
    EXPIRED,
    JOB_END,
    LATE,
    SINK_ABORTED,
    SINK_EXPIRED,
    SINK_IN_TIME,
    SINK_LATE,
    SINK_MISSED,
)
from mddag_executor.core.tally import Latest
import pytest

from .task_sets import declaration, examples

US = 1_000


def tally(keep: int | None = None) -> Tally:
    task_set = declaration([
        {'node': '/n', 'name': 's', 'timer': '100us', 'publishes': ['/s'], 'dag': 'd'},
        {'node': '/n', 'name': 'x', 'subscription': '/s', 'deadline': '10us'},
        {'node': '/n', 'name': 'y', 'subscription': '/s', 'deadline': '20us'}])
    return Tally(task_set, Tables.build(task_set), keep)


def done(vertex: int, job: int, response: int) -> Decision:
    """Return the decision on a completion; jobs are released each 100 us."""
    release = 100 * US * job
    deadline, time = release + 10 * US * vertex, release + response
    return (SINK_LATE if time > deadline else SINK_IN_TIME, 0, vertex, job, deadline, time)


def test_a_tally_of_everything() -> None:
    counts = tally()
    for _ in range(5):
        counts.released(0)
    counts.released(1)  # the undeclared DAG's jobs are nobody's to judge
    counts.add([done(1, 0, 10 * US), done(2, 0, 3 * US), (JOB_END, 0, -1, 0, COMPLETED, 1)])
    assert not counts.missed
    counts.add([done(1, 1, 10 * US + 1), done(2, 1, 20 * US), (JOB_END, 0, -1, 1, LATE, 1)])
    counts.add([done(1, 2, 5 * US), (SINK_EXPIRED, 0, 2, 2, 220 * US, -1),
                (JOB_END, 0, -1, 2, EXPIRED, 1)])
    counts.add([(SINK_ABORTED, 0, 1, 3, 310 * US, -1), (SINK_ABORTED, 0, 2, 3, 320 * US, -1),
                (JOB_END, 0, -1, 3, ABORTED, 1), (DROP, 0, 2, 3, 17, 1)])
    counts.add([(SINK_MISSED, 0, 1, 4, 410 * US, -1)])
    assert counts.dropped == 1
    assert counts.result() == {
        'deadline_missed': True, 'never_due': [],
        'first_miss': {'dag': 'd', 'vertex': '/n:x', 'job': 1, 'deadline_ns': 110 * US,
                       'completed_ns': 110 * US + 1},
        'dags': {'d': {
            'jobs': 5,
            'ends': {'completed': 1, 'late': 1, 'aborted': 1, 'expired': 1, 'failed': 0,
                     'dropped': 0},
            'sinks': {
                '/n:x': {'relative_deadline_ns': 10 * US, 'completed': 3, 'late': 2,
                         'overdue': 1, 'expired': 0, 'failed': 0, 'aborted': 1,
                         'dropped': 0,
                         'response_ns': {'min': 5 * US, 'median': 10 * US, 'p99': 10 * US + 1,
                                         'max': 10 * US + 1}},
                '/n:y': {'relative_deadline_ns': 20 * US, 'completed': 2, 'late': 0,
                         'overdue': 0, 'expired': 1, 'failed': 0, 'aborted': 1,
                         'dropped': 0,
                         'response_ns': {'min': 3 * US, 'median': 3 * US, 'p99': 20 * US,
                                         'max': 20 * US}}}}}}


@pytest.mark.parametrize('kind', [SINK_EXPIRED, SINK_ABORTED, SINK_MISSED])
def test_every_kind_of_miss_is_one(kind: int) -> None:
    counts = tally()
    counts.add([(kind, 0, 2, 7, 720 * US, -1)])
    assert counts.result()['first_miss'] == {
        'dag': 'd', 'vertex': '/n:y', 'job': 7, 'deadline_ns': 720 * US, 'completed_ns': None}


def test_a_bounded_tally_keeps_the_extremes_and_the_last() -> None:
    counts = tally(keep=3)
    counts.add([done(1, job, us * US) for job, us in enumerate((1, 9, 4, 5, 6))])
    sink = counts.result()['dags']['d']['sinks']['/n:x']
    assert sink['completed'] == 5
    assert sink['response_ns'] == {
        'min': 1 * US, 'median': 5 * US, 'p99': 6 * US, 'max': 9 * US}


@examples(200)
@given(st.lists(st.integers(-2 ** 63, 2 ** 63 - 1), max_size=40), st.none() | st.integers(0, 9))
def test_the_latest_are_as_in_a_deque(values: list[int], keep: int | None) -> None:
    latest, expected = Latest(keep), deque[int](maxlen=keep)
    for value in values:
        latest.append(value)
        expected.append(value)
        assert list(latest) == list(expected)
    assert len(latest) == len(expected) and bool(latest) == bool(expected)
    size = len(expected)
    assert [latest[i] for i in range(-size, size)] == [expected[i] for i in range(-size, size)]
    for beyond in (size, -size - 1):
        with pytest.raises(IndexError):
            latest[beyond]


def test_what_exceeds_64_bits_is_the_nearest_within() -> None:
    latest = Latest(2)
    for value in (7, 2 ** 64, -2 ** 64):
        latest.append(value)
    assert list(latest) == [2 ** 63 - 1, -2 ** 63]


@examples(200)
@given(st.lists(st.integers(0, 1000), min_size=1, max_size=400).map(sorted),
       st.sampled_from([(0.0, 0), (0.5, 50), (0.9, 90), (0.95, 95), (0.99, 99), (1.0, 100)]))
def test_quantiles_are_nearest_ranks(ordered: list[int], share: tuple[float, int]) -> None:
    rank = max(1, math.ceil(Fraction(share[1], 100) * len(ordered)))
    assert quantile(ordered, share[0]) == ordered[rank - 1]
