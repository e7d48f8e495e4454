# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Which sinks are overdue, and when that is known: against a list of all of them."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.core.deadlines import Deadlines
from mddag_executor.core.state import OPEN, SINK_OVERDUE
from mddag_executor.core.tables import NEVER

from .live_helpers import live, run_one
from .task_sets import declaration

US = 1_000
SINKS = declaration([
    {'node': '/n', 'name': 's', 'timer': '100us', 'publishes': ['/s'], 'dag': 'd'},
    {'node': '/n', 'name': 'x', 'subscription': '/s', 'deadline': '30us'},
    {'node': '/n', 'name': 'y', 'subscription': '/s', 'deadline': '70us'},
    {'node': '/n', 'name': 'z', 'subscription': '/s', 'deadline': '70us'},
    {'node': '/n', 'name': 'o', 'timer': '100us', 'deadline': '10us', 'dag': 'other'},
])
steps = st.lists(st.one_of(
    st.tuples(st.just('release'), st.integers(0, 1), st.integers(0, 40)),
    st.tuples(st.just('complete'), st.integers(0, 30), st.integers(1, 3)),
    st.tuples(st.just('expire'), st.integers(0, 30), st.just(0)),
    st.tuples(st.just('judge'), st.just(0), st.just(0)),
), max_size=60)


@given(steps, st.lists(st.integers(0, 25), min_size=60, max_size=60))
def test_each_overdue_sink_is_found_once_and_in_time(steps, gaps) -> None:
    scheduler = live(SINKS)
    tables, state = scheduler.tables, scheduler.state
    deadlines = Deadlines(tables, state)
    jobs: list[tuple[int, int, int]] = []
    open_sinks: dict[tuple[int, int, int], int] = {}  # DAG, job, vertex -> deadline
    overdue: list[tuple[int, int, int]] = []
    now = 0
    for (what, which, more), gap in zip(steps, gaps):
        now += gap * US
        if what == 'release':
            # some releases are known late, and out of order
            index, release = len(jobs), now - more * US
            slot = scheduler.release(which, index, release, now)
            deadlines.watch(slot)
            jobs.append((which, index, slot))
            first, last = tables.first_sink[which:which + 2]
            for vertex in tables.sinks[first:last]:
                open_sinks[which, index, vertex] = release + tables.sink_deadline[vertex]
        elif what in ('complete', 'expire') and jobs:
            dag, index, slot = jobs[which % len(jobs)]
            vertex = tables.first_vertex[dag] + (more if dag == 0 else 0)
            if state.job_state[slot] != OPEN or state.job_index[slot] != index:
                continue
            if what == 'expire':
                scheduler.expire(slot, now)
                open_sinks = {key: d for key, d in open_sinks.items() if key[:2] != (dag, index)}
            elif (dag, index, vertex) in open_sinks:
                run_one(scheduler, scheduler.execution(slot, vertex), now)
                del open_sinks[dag, index, vertex]
        else:
            expected = sorted(key for key, d in open_sinks.items()
                              if d < now and key not in overdue)
            assert (deadlines.next < now) >= bool(expected)
            scheduler.decisions()
            deadlines.judge(now)
            found = scheduler.decisions()
            assert {decision[0] for decision in found} <= {SINK_OVERDUE}
            assert sorted((dag, job, vertex) for _, dag, vertex, job, _, _ in found) == expected
            overdue += expected
            later = [d for d in open_sinks.values() if d >= now]
            assert now <= deadlines.next <= min(later, default=NEVER)


def test_what_is_at_its_deadline_is_not_overdue() -> None:
    scheduler = live(SINKS)
    deadlines = Deadlines(scheduler.tables, scheduler.state)
    deadlines.watch(scheduler.release(1, 0, 0, 0))
    assert deadlines.next == 10 * US
    deadlines.judge(10 * US)
    assert scheduler.decisions() == []
    deadlines.judge(10 * US + 1)
    assert [decision[0] for decision in scheduler.decisions()] == [SINK_OVERDUE]
    assert deadlines.next == NEVER
