# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Counts of the core's decisions, stops of the machine, and the worst window of a sink."""

from collections import deque
from fractions import Fraction
import math

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.core import quantile, Tables, Tally
from mddag_executor.core.state import (
    SINK_IN_TIME,
    SINK_LATE,
)
from mddag_executor.core.stops import KEEP_MISSES, KEEP_STOPS, Stops
from mddag_executor.core.tally import Latest
from mddag_executor.core.weakly_hard import MissWindow
import pytest

from ..conftest import examples
from .task_sets import declaration

US = 1_000


def tally(keep=None):
    task_set = declaration([
        {'node': '/n', 'name': 's', 'timer': '100us', 'publishes': ['/s'], 'dag': 'd'},
        {'node': '/n', 'name': 'x', 'subscription': '/s', 'deadline': '10us'},
        {'node': '/n', 'name': 'y', 'subscription': '/s', 'deadline': '20us'}])
    return Tally(task_set, Tables.build(task_set), keep)


def done(vertex, job, response):
    """Return the decision on a completion; jobs are released each 100 us."""
    release = 100 * US * job
    deadline, time = release + 10 * US * vertex, release + response
    return (SINK_LATE if time > deadline else SINK_IN_TIME, 0, vertex, job, deadline, time)


def test_a_bounded_tally_keeps_the_extremes_and_the_last():
    counts = tally(keep=3)
    counts.add([done(1, job, us * US) for job, us in enumerate((1, 9, 4, 5, 6))])
    sink = counts.result()['dags']['d']['sinks']['/n:x']
    assert sink['completed'] == 5
    assert sink['response_ns'] == {
        'min': 1 * US, 'median': 5 * US, 'p99': 6 * US, 'max': 9 * US}


@examples(200)
@given(st.lists(st.integers(-2 ** 63, 2 ** 63 - 1), max_size=40), st.none() | st.integers(0, 9))
def test_the_latest_are_as_in_a_deque(values, keep):
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


def test_what_exceeds_64_bits_is_the_nearest_within():
    latest = Latest(2)
    for value in (7, 2 ** 64, -2 ** 64):
        latest.append(value)
    assert list(latest) == [2 ** 63 - 1, -2 ** 63]


@examples(200)
@given(st.lists(st.integers(0, 1000), min_size=1, max_size=400).map(sorted),
       st.sampled_from([(0.0, 0), (0.5, 50), (0.9, 90), (0.95, 95), (0.99, 99), (1.0, 100)]))
def test_quantiles_are_nearest_ranks(ordered, share):
    rank = max(1, math.ceil(Fraction(share[1], 100) * len(ordered)))
    assert quantile(ordered, share[0]) == ordered[rank - 1]


def test_a_miss_is_counted_whether_it_is_known_before_or_after_the_stop():
    stops = Stops()
    stops.missed(0, 99, 100)      # over before
    stops.missed(50, 100, 350)    # 250 late, and 250 of it stood still
    stops.missed(50, 99, 350)     # 251 late
    stops.missed(120, 130, -1)    # a period that was skipped
    stops.missed(99, 130, -1)     # it was released before
    stops.stopped(100, 400)
    stops.missed(150, 160, 410)   # all of it within
    stops.missed(400, 900, 901)   # released as it ends
    stops.stopped(1000, 1100)
    stops.missed(90, 5000, 5001)  # both explain it: once
    assert stops.result() == {
        'count': 2, 'total_ns': 400, 'misses': 4,
        'latest': [{'begin_ns': 100, 'end_ns': 400}, {'begin_ns': 1000, 'end_ns': 1100}]}


spans = st.tuples(st.integers(0, 60), st.integers(0, 20)).map(lambda s: (s[0], s[0] + s[1]))


late = st.tuples(spans, st.integers(1, 30)).map(lambda s: (*s[0], s[0][1] + s[1]))
never = spans.map(lambda s: (*s, -1))


@given(st.lists(spans, max_size=5), st.lists(late | never, max_size=10), st.randoms())
def test_the_order_in_which_they_become_known_does_not_matter(found, misses, random):
    events = [('stopped', *each) for each in found] + [('missed', *each) for each in misses]
    random.shuffle(events)
    stops = Stops()
    for name, *times in events:
        getattr(stops, name)(*times)
    assert stops.result()['misses'] == sum(
        any(begin <= release <= end if completed < 0 else
            completed - max(0, min(end, completed) - max(begin, release)) <= deadline
            for begin, end in found)
        for release, deadline, completed in misses)


def test_what_is_kept_is_bounded_and_the_counts_are_whole():
    stops = Stops()
    for i in range(3 * KEEP_STOPS):
        stops.missed(1000 * i, 1000 * i + 1, 1000 * i + 2)
        stops.stopped(1000 * i + 500, 1000 * i + 510)
    for _ in range(3 * KEEP_MISSES):
        stops.missed(-10, -5, -1)
    result = stops.result()
    assert (result['count'], result['total_ns']) == (3 * KEEP_STOPS, 30 * KEEP_STOPS)
    assert len(result['latest']) == KEEP_STOPS
    assert len(stops._unexplained) == KEEP_MISSES


def worst_of(missed, of):
    return max(sum(missed[begin:begin + of]) for begin in range(max(1, len(missed))))


@given(st.lists(st.booleans(), max_size=40), st.integers(2, 12), st.randoms())
def test_the_worst_window(missed, of, random):
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


def test_what_is_long_over_is_forgotten():
    window = MissWindow(10)
    for job in range(0, 100_000, 5):
        window.add(job)
        window.add(max(0, job - 100))   # late, and in no order
    assert window.worst == 2
    assert len(window._jobs) < 3 * (window.of + window.ORDER)
