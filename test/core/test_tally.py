# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Counts of the core's decisions, stops of the machine, and the worst window of a sink."""

from fractions import Fraction
import math

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.core import quantile, Scheduler, Tables
from mddag_executor.core.state import JOB_END, LATE
from mddag_executor.core.stops import KEEP_MISSES, KEEP_STOPS, Stops
from mddag_executor.core.tally import SinkTally
from mddag_executor.core.weakly_hard import MissWindow
from msg_graph import loads

from ..conftest import examples


def test_a_bounded_tally_keeps_the_extremes_and_the_last():
    sink = SinkTally(10, keep=3)
    for response in (1, 9, 4, 5, 6):
        sink.done(response, False)
    assert sink.result()['completed'] == 5
    assert sink.result()['response_ns'] == {'min': 1, 'median': 5, 'p99': 6, 'max': 9}


@examples(200)
@given(st.lists(st.integers(0, 1000), min_size=1, max_size=400).map(sorted),
       st.sampled_from([0, 50, 90, 95, 99, 100]))
def test_quantiles_are_nearest_ranks(ordered, percent):
    rank = max(1, math.ceil(Fraction(percent, 100) * len(ordered)))
    assert quantile(ordered, percent / 100) == ordered[rank - 1]


spans = st.tuples(st.integers(0, 60), st.integers(0, 20)).map(lambda s: (s[0], s[0] + s[1]))
late = st.tuples(spans, st.integers(1, 30)).map(lambda s: (*s[0], s[0][1] + s[1]))
never = spans.map(lambda s: (*s, -1))


# each begins after the previous one has ended
disjoint = st.lists(st.integers(0, 80), max_size=10).map(
    lambda times: [*zip(sorted(times)[::2], sorted(times)[1::2])])


@examples(300)
@given(disjoint, st.lists(late | never, max_size=10), st.randoms())
def test_misses_are_explained_in_whatever_order_they_and_stops_become_known(found, misses, random):
    events = [('stopped', *each) for each in found] + [('missed', *each) for each in misses]
    random.shuffle(events)
    ends = iter(sorted(found, key=lambda stop: stop[1]))    # a stop is known when it ends
    events = [('stopped', *next(ends)) if each[0] == 'stopped' else each for each in events]
    stops = Stops()
    for name, *times in events:
        getattr(stops, name)(*times)
    assert stops.result() == {
        'count': len(found), 'total_ns': sum(end - begin for begin, end in found),
        'misses': sum(
            any(begin <= release <= end if completed < 0 else
                completed - max(0, min(end, completed) - max(begin, release)) <= deadline
                for begin, end in found)
            for release, deadline, completed in misses),
        'latest': [{'begin_ns': begin, 'end_ns': end}
                   for name, begin, end, *_ in events if name == 'stopped']}


def test_what_is_kept_of_stops_is_bounded_and_the_counts_are_whole():
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
    stops.stopped(10 ** 9, 10 ** 9 + 1)
    assert not stops._unexplained  # no later stop explains them: they are not looked through again


def test_a_miss_is_not_compared_with_stops_before_its_release():
    """There may be many, and many misses, when the machine is too busy."""
    class Stop(int):
        asked = 0

        def __le__(self, other):
            Stop.asked += 1
            return int(self) <= other

        def __lt__(self, other):
            Stop.asked += 1
            return int(self) < other

    stops = Stops()
    for i in range(KEEP_STOPS):
        stops.stopped(Stop(1000 * i), Stop(1000 * i + 500))
    for completed in (-1, 10 ** 9):
        Stop.asked = 0
        assert not stops.missed(10 ** 6, 10 ** 6 + 1, completed)
        assert Stop.asked <= 1


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


def test_misses_long_over_are_forgotten():
    window = MissWindow(10)
    for job in range(0, 100_000, 5):
        window.add(job)
        window.add(max(0, job - 100))   # late, and in no order
    assert window.worst == 2
    assert len(window._jobs) < 3 * (window.of + window.ORDER)


def test_a_job_that_was_judged_at_the_end_of_the_run_has_ended_late():
    """Its result had completed in time, but that was reported after the end."""
    tables = Tables.build(loads("""
mddag: 1
nodes: [{node: /n, callbacks: [{name: tick, timer: 100ms, deadline: 50ms}]}]
"""))
    scheduler = Scheduler(tables, 1)
    slot = scheduler.release(0, 0, 0, 0)
    x = scheduler.source(slot)
    scheduler.ready(x, 0)
    assert scheduler.take(0, 0) == x
    deadline = tables.sink_deadline[0]
    scheduler.finish(deadline + 1)
    scheduler.complete(x, deadline)
    kind, *_, end, _ = scheduler.decisions()[-1]
    assert (kind, end) == (JOB_END, LATE)
