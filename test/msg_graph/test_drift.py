# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Where a system and its declaration disagree, and which entity is which declared callback."""

from hypothesis import given
from hypothesis import strategies as st
from msg_graph import loads
from msg_graph.binding import Binder, entities_of, Entity, entity_name, is_period, meant
from msg_graph.drift import drift, Observed, Releases
import pytest

from .helpers import graph

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


def observed(jobs=50, period=10 * MS):
    """Return what a system does that is just as declared, for ``jobs`` jobs of the timer."""
    ys = jobs // 2
    counts = {'/a:t': jobs, '/a:y': ys, '/b:m': jobs, '/b:s': 2 * jobs, '/b:e': jobs, '/b:w': ys}
    return Observed(
        duration_ns=jobs * period,
        releases={'/a:t': Releases(jobs, 7, 7 + (jobs - 1) * period),
                  '/a:y': Releases(ys, 3, 3 + (ys - 1) * 2 * period)},
        got=dict(counts), ran=dict(counts),
        publishes={'/a:t': {'/x', '/rosout'}, '/a:y': {'/y'}, '/b:m': {'/z'}})


def kinds(found):
    return [(each.kind, each.callback) for each in found]


@given(jobs=st.integers(0, 400))
def test_nothing_is_said_of_what_is_as_declared(jobs):
    assert drift(TASKS, observed(jobs)) == []


def test_a_topic_that_is_not_declared():
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
def test_the_rate_of_a_source(factor, said):
    seen = observed()
    seen.releases['/a:t'] = Releases(50, 0, round(49 * 10 * MS * factor))
    found = drift(TASKS, seen)
    assert kinds(found) == ([('rate', '/a:t')] if said else [])
    if said:
        assert (found[0].declared, found[0].observed) == (10 * MS, round(10 * MS * factor))
        assert found[0].text.endswith('ms, and 10ms is declared')


@pytest.mark.parametrize(('got', 'said'), [(60, False), (62, True), (39, False), (38, True)])
def test_the_rate_of_messages(got, said):
    seen = observed()
    seen.got['/b:m'] = got
    found = drift(TASKS, seen)
    assert kinds(found) == ([('rate', '/b:m')] if said else [])
    if said:
        assert found[0].text == f'/b:m got {got} messages, and by the declaration 50 were due'


def test_few_messages_prove_nothing():
    seen = observed(jobs=9)
    seen.got['/b:m'] = 3
    assert drift(TASKS, seen) == []


def test_what_an_overload_skips_and_drops_is_no_difference():
    seen = observed()
    seen.ran['/a:t'] = seen.got['/b:m'] = 20     # of 50 releases
    seen.ran['/b:m'], seen.ran['/b:s'] = 1, 20
    seen.got['/b:e'] = seen.ran['/b:e'] = 0
    assert drift(TASKS, seen) == []
    seen.ran['/b:m'] = 15
    assert kinds(drift(TASKS, seen)) == [('never ran', '/b:e')]
    seen.got['/b:e'] = 15       # all were dropped
    assert drift(TASKS, seen) == []


def test_a_callback_that_never_ran_is_the_reason_for_those_after_it():
    seen = observed()
    for key in ('/b:m', '/b:s', '/b:e'):
        seen.ran[key] = seen.got[key] = 0
    assert kinds(drift(TASKS, seen)) == [('never ran', '/b:m')]
    seen.ran['/b:m'] = seen.got['/b:m'] = 50
    assert kinds(drift(TASKS, seen)) == [('never ran', '/b:s'), ('never ran', '/b:e')]


def test_a_sync_that_never_got_one_of_its_topics():
    seen = observed()
    seen.came = {'/b:s': {'/x', '/z'}}
    assert drift(TASKS, seen) == []
    seen.came = {'/b:s': {'/x'}}
    seen.undeclared = [Entity('/c', 'subscription', '/x'), Entity('/b', 'subscription', '/zz')]
    found, = drift(TASKS, seen)
    assert (found.kind, found.callback, found.topic) == ('never ran', '/b:s', '/z')
    assert found.text == (
        "/b:s never got a message of /z in 0.500 s: did you mean the topic '/zz'?")


def test_a_sync_publishes_once_for_all_messages_of_a_job():
    """Two publishers of one topic make three legs of two topics."""
    task_set = loads("""\
mddag: 1
nodes:
  - node: /a
    callbacks:
      - {name: t, timer: 10ms, publishes: [/i]}
      - {name: one, subscription: /i, publishes: [/x]}
      - {name: two, subscription: /i, publishes: [/x]}
      - {name: three, subscription: /i, publishes: [/y]}
      - {name: s, sync: [/x, /y], publishes: [/z]}
      - {name: e, subscription: /z, deadline: 9ms}
""")
    ran = {callback.key: 50 for callback in task_set.callbacks} | {'/a:s': 150}
    seen = Observed(500 * MS, {'/a:t': Releases(50, 0, 490 * MS)}, ran, ran)
    assert drift(task_set, seen) == []


def test_a_short_run_says_nothing_of_what_never_ran():
    seen = Observed(duration_ns=24 * MS)
    assert drift(TASKS, seen) == []
    seen.duration_ns = 25 * MS
    assert kinds(drift(TASKS, seen)) == [('never ran', '/a:t')]
    seen.duration_ns = 45 * MS
    assert kinds(drift(TASKS, seen)) == [('never ran', '/a:t'), ('never ran', '/a:y')]


def test_what_may_run_in_another_process():
    text = TASKS.text.replace('dag: y}', 'dag: y, release_from: header_stamp}')
    seen = observed()
    seen.ran['/b:w'] = seen.got['/b:w'] = seen.ran['/b:e'] = seen.got['/b:e'] = 0
    seen.nodes = {'/a'}
    assert kinds(drift(loads(text), seen)) == [('never ran', '/b:e')]
    seen.nodes = {'/a', '/b'}
    assert kinds(drift(loads(text), seen)) == [('never ran', '/b:e'), ('never ran', '/b:w')]


BOUND = graph("""
- node: /a
  callbacks:
    - {name: t0, timer: 10ms, publishes: [/x, /y], dag: t0}
    - {name: t1, timer: 10ms, deadline: 1ms, dag: t1}
    - {name: t2, timer: 20ms, deadline: 1ms, dag: t2}
    - {name: s0, subscription: /x, deadline: 1ms}
    - {name: j0, sync: [/x, /y], deadline: 1ms}
    - {name: s1, subscription: /x, deadline: 1ms}
    - {name: q, service: /ask, period: 1s, deadline: 1ms, dag: q}
- node: /b
  callbacks:
    - {name: s, subscription: /x, deadline: 1ms}
    - {name: t, timer: 33.333ms, deadline: 1ms}
""")


def key(callback):
    return None if callback is None else callback.key


def test_alike_ones_are_handed_out_in_order():
    binder = Binder(BOUND)
    assert [key(binder.bind(Entity('/a', 'subscription', '/x'))) for _ in range(4)] == [
        '/a:s0', '/a:j0', '/a:s1', None]
    assert [key(binder.bind(Entity('/a', 'timer', '', 10_000_000))) for _ in range(3)] == [
        '/a:t0', '/a:t1', None]
    assert key(binder.bind(Entity('/a', 'timer', '', 20_000_000))) == '/a:t2'
    assert [key(binder.bind(Entity('/a', 'service', '/ask'))) for _ in range(2)] == ['/a:q', None]
    assert key(binder.bind(Entity('/b', 'subscription', '/x'))) == '/b:s'


def test_a_sync_is_bound_by_each_leg():
    binder = Binder(BOUND)
    assert key(binder.bind(Entity('/a', 'subscription', '/y'))) == '/a:j0'
    assert binder.bind(Entity('/a', 'subscription', '/y')) is None
    binder.bind(Entity('/a', 'subscription', '/x'))
    assert key(binder.bind(Entity('/a', 'subscription', '/x'))) == '/a:j0'


def test_periods_may_be_rounded():
    binder = Binder(BOUND)
    assert key(binder.bind(Entity('/b', 'timer', '', 33_333_333))) == '/b:t'
    assert is_period(33_333_333, 33_300_000) and is_period(16_666_666, 16_700_000)
    assert not is_period(33_333_333, 33_000_000)
    binder = Binder(BOUND)
    assert binder.bind(Entity('/b', 'timer', '', 33_400_000)) is None
    assert key(binder.bind(Entity('/a', 'timer', '', 9_999_999))) == '/a:t0'


def test_every_callback_can_be_bound_once():
    binder = Binder(BOUND)
    assert binder.unbound() == list(BOUND.callbacks)
    for callback in reversed(BOUND.callbacks):
        for entity in entities_of(callback):
            assert binder.bind(entity) is not None
    assert binder.unbound() == []
    binder.release(BOUND.callback('/a:j0'), '/y')
    assert [callback.key for callback in binder.unbound()] == ['/a:j0']
    assert binder.bind(Entity('/a', 'subscription', '/y')) is not None
    for callback in BOUND.callbacks:
        for entity in entities_of(callback):
            assert binder.bind(entity) is None


@pytest.mark.parametrize(('callback', 'seen', 'question'), [
    ('/b:s', Entity('/robot/b', 'subscription', '/robot/x'), "did you mean the node '/robot/b'?"),
    ('/b:s', Entity('/b', 'subscription', '/robot/x'), "did you mean the topic '/robot/x'?"),
    ('/a:q', Entity('/a', 'service', '/a/ask'), "did you mean the service '/a/ask'?"),
    ('/a:j0', Entity('/robot/a', 'subscription', '/robot/y'), "did you mean the node '/robot/a'?"),
    ('/b:t', Entity('/b', 'timer', '', 50_000_000), 'did you mean its timer of 50ms?'),
    ('/b:t', Entity('/robot/b', 'timer', '', 33_333_333), "did you mean the node '/robot/b'?"),
    ('/b:t', Entity('/robot/b', 'timer', '', 50_000_000), None),
    ('/b:s', Entity('/bb', 'subscription', '/x'), "did you mean the node '/bb'?"),
    ('/b:s', Entity('/bb', 'subscription', '/y'), None),
    ('/b:s', Entity('/b', 'subscription', '/xx'), "did you mean the topic '/xx'?"),
    ('/b:s', Entity('/b', 'subscription', '/other_topic'), None),
    ('/b:s', Entity('/robot/b', 'service', '/x'), None),
])
def test_a_namespace_more_or_another_period_is_probably_meant(callback, seen, question):
    assert meant(BOUND.callback(callback), [Entity('/other', seen.kind, '/z', 1000), seen]) \
        == question


@pytest.mark.parametrize(('symbol', 'name'), [
    ('robot.camera.Camera.on_image', '/n: on_image (timer 1s)'),
    ('__main__.main.<locals>.tick', '/n: tick (timer 1s)'),
    ('robot.camera.<lambda>', '/n: <lambda> (timer 1s)'),
    ('void ns::on_timer(int, char const*)', '/n: on_timer (timer 1s)'),
    ('std::_Bind<void (Ping::*(Ping*))()>', '/n: timer 1s'),
    ('', '/n: timer 1s'),
])
def test_undeclared_ones_are_called_by_node_and_function(symbol, name):
    assert entity_name('/n', symbol, 'timer 1s') == name
