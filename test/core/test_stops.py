# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Which misses fall into stops."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.core.stops import KEEP_MISSES, KEEP_STOPS, Stops


def test_a_miss_is_counted_whether_it_is_known_before_or_after_the_stop() -> None:
    stops = Stops()
    stops.missed(0, 99)       # over before
    stops.missed(50, 100)     # its deadline passes as the stop begins
    stops.stopped(100, 400)
    stops.missed(120, 130)    # all of it within
    stops.missed(400, 900)    # released as it ends
    stops.missed(401, 900)
    stops.stopped(1000, 1100)
    stops.missed(90, 5000)    # both: once
    assert stops.result() == {
        'count': 2, 'total_ns': 400, 'misses': 4,
        'latest': [{'begin_ns': 100, 'end_ns': 400}, {'begin_ns': 1000, 'end_ns': 1100}]}


spans = st.tuples(st.integers(0, 60), st.integers(0, 20)).map(lambda s: (s[0], s[0] + s[1]))


@given(st.lists(spans, max_size=5), st.lists(spans, max_size=10), st.randoms())
def test_the_order_in_which_they_become_known_does_not_matter(found, misses, random) -> None:
    events = [('stopped', *each) for each in found] + [('missed', *each) for each in misses]
    random.shuffle(events)
    stops = Stops()
    for name, begin, end in events:
        getattr(stops, name)(begin, end)
    assert stops.result()['misses'] == sum(
        any(begin <= deadline and release <= end for begin, end in found)
        for release, deadline in misses)


def test_what_is_kept_is_bounded_and_the_counts_are_whole() -> None:
    stops = Stops()
    for i in range(3 * KEEP_MISSES):
        stops.missed(1000 * i, 1000 * i + 1)
        stops.stopped(1000 * i + 500, 1000 * i + 510)
    for _ in range(3 * KEEP_MISSES):
        stops.missed(-10, -5)
    result = stops.result()
    assert (result['count'], result['total_ns']) == (3 * KEEP_MISSES, 30 * KEEP_MISSES)
    assert len(result['latest']) == KEEP_STOPS
    assert len(stops._elsewhere) == KEEP_MISSES
