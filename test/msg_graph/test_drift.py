# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The rules about where a system and its declaration disagree."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from msg_graph import loads
from msg_graph.drift import Drift, drift, Observed, Releases
import pytest

MS = 1_000_000
TASKS = loads("""\
mddag: 1
nodes:
  - node: /a
    callbacks:
      - {name: t, timer: 10ms, publishes: [/x]}
      - {name: y, subscription: /in, period: 20ms, publishes: [/y], dag: y}
  - node: /b
    callbacks:
      - {name: m, subscription: /x, publishes: [/z]}
      - {name: s, sync: [/x, /z], deadline: 5ms}
      - {name: e, subscription: /z, deadline: 5ms}
      - {name: w, subscription: /y, deadline: 5ms}
""")


def observed(jobs: int = 50, period: int = 10 * MS) -> Observed:
    """Return what a system does that is just as declared, for ``jobs`` jobs of the timer."""
    ys = jobs // 2
    counts = {'/a:t': jobs, '/a:y': ys, '/b:m': jobs, '/b:s': 2 * jobs, '/b:e': jobs, '/b:w': ys}
    return Observed(
        duration_ns=jobs * period,
        releases={'/a:t': Releases(jobs, 7, 7 + (jobs - 1) * period),
                  '/a:y': Releases(ys, 3, 3 + (ys - 1) * 2 * period)},
        got=dict(counts), ran=dict(counts),
        publishes={'/a:t': {'/x', '/rosout'}, '/a:y': {'/y'}, '/b:m': {'/z'}})


def kinds(found: list[Drift]) -> list[tuple[str, str]]:
    return [(each.kind, each.callback) for each in found]


@given(jobs=st.integers(0, 400))
def test_nothing_is_said_of_what_is_as_declared(jobs: int) -> None:
    assert drift(TASKS, observed(jobs)) == []


def test_a_topic_that_is_not_declared() -> None:
    seen = observed()
    seen.publishes['/b:w'] = {'/q\x1b', '/p', '/parameter_events'}
    found = drift(TASKS, seen)
    assert [(each.kind, each.topic) for each in found] == [
        ('publishes', '/p'), ('publishes', '/q\x1b')]
    assert [each.text for each in found] == [
        '/b:w publishes /p, which it does not declare',
        '/b:w publishes /q\\x1b, which it does not declare']


@pytest.mark.parametrize(('factor', 'said'), [
    (1.19, False), (1.21, True), (0.81, False), (0.79, True)])
def test_the_rate_of_a_source(factor: float, said: bool) -> None:
    seen = observed()
    seen.releases['/a:t'] = Releases(50, 0, round(49 * 10 * MS * factor))
    found = drift(TASKS, seen)
    assert kinds(found) == ([('rate', '/a:t')] if said else [])
    if said:
        assert (found[0].declared, found[0].observed) == (10 * MS, round(10 * MS * factor))
        assert found[0].text.endswith('ms, and 10ms is declared')


@pytest.mark.parametrize(('got', 'said'), [(60, False), (62, True), (39, False), (38, True)])
def test_the_rate_of_messages(got: int, said: bool) -> None:
    seen = observed()
    seen.got['/b:m'] = got
    found = drift(TASKS, seen)
    assert kinds(found) == ([('rate', '/b:m')] if said else [])
    if said:
        assert found[0].text == f'/b:m got {got} messages, and by the declaration 50 were due'


def test_a_callback_that_never_ran_is_the_reason_for_those_after_it() -> None:
    seen = observed()
    for key in ('/b:m', '/b:s', '/b:e'):
        seen.ran[key] = seen.got[key] = 0
    assert kinds(drift(TASKS, seen)) == [('never ran', '/b:m')]
    seen.ran['/b:m'] = seen.got['/b:m'] = 50
    assert kinds(drift(TASKS, seen)) == [('never ran', '/b:s'), ('never ran', '/b:e')]


def test_a_short_run_says_nothing_of_what_never_ran() -> None:
    seen = Observed(duration_ns=24 * MS)
    assert drift(TASKS, seen) == []
    seen.duration_ns = 25 * MS
    assert kinds(drift(TASKS, seen)) == [('never ran', '/a:t')]
    seen.duration_ns = 45 * MS
    assert kinds(drift(TASKS, seen)) == [('never ran', '/a:t'), ('never ran', '/a:y')]


def test_what_may_run_in_another_process() -> None:
    text = TASKS.text.replace('dag: y}', 'dag: y, release_from: header_stamp}')
    seen = observed()
    seen.ran['/b:w'] = seen.got['/b:w'] = seen.ran['/b:e'] = seen.got['/b:e'] = 0
    seen.nodes = {'/a'}
    assert kinds(drift(loads(text), seen)) == [('never ran', '/b:e')]
    seen.nodes = {'/a', '/b'}
    assert kinds(drift(loads(text), seen)) == [('never ran', '/b:e'), ('never ran', '/b:w')]
