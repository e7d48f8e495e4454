# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Which misses stops explain."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.core.stops import KEEP_MISSES, KEEP_STOPS, Stops


def test_a_miss_is_counted_whether_it_is_known_before_or_after_the_stop() -> None:
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
def test_the_order_in_which_they_become_known_does_not_matter(found, misses, random) -> None:
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


def test_what_is_kept_is_bounded_and_the_counts_are_whole() -> None:
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
