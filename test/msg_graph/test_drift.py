# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Where a system and its declaration disagree, and which entity is which declared callback."""

from hypothesis import given
from hypothesis import strategies as st
from msg_graph import loads
from msg_graph.binding import Binder, entities_of, Entity, entity_name, suggest_entity
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
        messages=dict(counts), executions=dict(counts),
        publishes={'/a:t': {'/x', '/rosout'}, '/a:y': {'/y'}, '/b:m': {'/z'}})


@given(jobs=st.integers(0, 400))
def test_nothing_is_said_of_what_is_as_declared(jobs):
    assert drift(TASKS, observed(jobs)) == []


def released(factor):
    return {'releases': {'/a:t': Releases(50, 0, round(49 * 10 * MS * factor))}}


def never_ran(*names):
    return {'executions': dict.fromkeys(names, 0), 'messages': dict.fromkeys(names, 0)}


NO_E = "/b:e never ran in the 0.500 s after the first release: did you mean the topic '/zz'?"
SKIPPED = {'/a:t': 20, '/b:m': 15, '/b:s': 20, '/b:e': 0}       # of 50 releases


WHEN_NEEDED = "if it is made, reset or cancelled when needed, declare 'sporadic: true'"


@pytest.mark.parametrize(('changes', 'texts'), [
    ({'publishes': {'/b:w': {
        '/q\x1b', '/p', '/parameter_events', '/mddag/jobs_1f/p0', '/diagnostics'}}},
     ['/b:w publishes /p, which it does not declare',
      '/b:w publishes /q\\x1b, which it does not declare']),
    ({'periods': {'/a:t': 10 * MS}}, []), ({'periods': {'/a:t': 10_010_000}}, []),
    ({'periods': {'/a:t': 11 * MS}},
     ['the timer of /a:t has a period of 11ms, and 10ms is declared']),
    (released(0.81), []), (released(1.19), []),
    (released(0), ['/a:t was released 50 times at the same time, and every 10ms is declared']),
    (released(0.79), ['/a:t was released every 7.9ms, and 10ms is declared']),
    (released(1.21), [f'/a:t was released every 12.1ms, and 10ms is declared: {WHEN_NEEDED}']),
    ({'messages': {'/b:m': 39}}, []), ({'messages': {'/b:m': 60}}, []),
    *(({'messages': {'/b:m': got}}, [
        f'/b:m got {got} messages, and by the declaration 50 were due' + (
            f": if /a:t published /x in {got} of 50 runs, declare 'may_publish: [/x]'"
            if got < 50 else '')])
      for got in (38, 62)),
    # Messages that were published and did not arrive say nothing about the declaration.
    ({'messages': {'/b:m': 20}, 'published': {('/a:t', '/x'): 40}}, []),
    ({'messages': {'/b:m': 20}, 'published': {('/a:t', '/x'): 30}}, [
        '/b:m got 20 messages, and by the declaration 50 were due: if /a:t published /x in 30 of '
        "50 runs, declare 'may_publish: [/x]'"]),
    # Of consecutive callbacks the first that never ran is the reason.
    (never_ran('/b:m', '/b:s', '/b:e'), ['/b:m never ran in the 0.500 s after the first release']),
    (never_ran('/b:s', '/b:e'), [NO_E.replace('e', 's', 1), NO_E]),
    # Releases and messages that an overload skips and drops are not drift.
    ({'executions': SKIPPED | {'/b:m': 1}, 'messages': {'/b:m': 20, '/b:e': 0}}, []),
    ({'executions': SKIPPED, 'messages': {'/b:m': 20, '/b:e': 0}}, [NO_E]),
    ({'executions': SKIPPED, 'messages': {'/b:m': 20, '/b:e': 15}}, []),
    ({'topics_received': {'/b:s': {'/x', '/z'}}}, []),
    ({'topics_received': {'/b:s': {'/x'}}},
     ["/b:s never got a message of /z in the 0.500 s after the first release: did you mean the "
      "topic '/zz'?"]),
])
def test_each_difference(changes, texts):
    seen = observed()
    seen.undeclared = [Entity('/c', 'subscription', '/x'), Entity('/b', 'subscription', '/zz')]
    for name, change in changes.items():
        getattr(seen, name).update(change)
    assert [each.text for each in drift(TASKS, seen)] == texts


def test_a_result_has_what_its_text_says():
    seen = observed()
    seen.releases |= released(2)['releases']
    seen.messages['/b:w'], seen.topics_received = 3, {'/b:s': {'/x'}}
    assert [tuple(each.result().values())[:5] for each in drift(TASKS, seen)] == [
        ('rate', '/a:t', None, 10 * MS, 20 * MS), ('rate', '/b:w', None, 25, 3)]
    del seen.releases['/a:t']
    found = drift(TASKS, seen)[0].result()
    assert tuple(found.values())[:5] == ('never ran', '/b:s', '/z', None, 0)


def test_few_messages_and_short_runs_prove_nothing():
    seen = observed(jobs=9)
    seen.messages['/b:m'] = 3
    assert drift(TASKS, seen) == []
    for ms, never_ran in ((24, []), (25, ['/a:t']), (45, ['/a:t', '/a:y'])):
        found = drift(TASKS, Observed(duration_ns=ms * MS))
        assert [each.callback for each in found] == never_ran


def test_a_source_that_stopped_is_named_although_its_results_were_in_time():
    seen = observed()
    seen.end_ns = 1_480 * MS
    assert drift(TASKS, seen) == []
    seen.end_ns = 1_500 * MS
    assert [(each.kind, each.text) for each in drift(TASKS, seen)] == [
        ('stopped', f'/a:{name} was not released any more in the last {silent} s, and every '
         f'{period} is declared{more}')
        for name, silent, period, more in (
            ('t', '1.010', '10ms', f': {WHEN_NEEDED}'), ('y', '1.020', '20ms', ''))]
    for key in ('once', 'sporadic'):
        rare = loads(TASKS.text.replace('period: 20ms', 'period: 20ms, sporadic: true').replace(
            'timer: 10ms', f'timer: 10ms, {key}: true'))
        assert [each.kind for each in drift(rare, seen)] == []


@pytest.mark.parametrize(('key', 'what', 'then'), [
    ('/a:t', 'the timer', WHEN_NEEDED), ('/b:e', 'the subscription', 'results that need it'),
    ('/b:s', 'a subscription', 'results that need it')])
def test_a_callback_that_was_destroyed_is_named(key, what, then):
    """Its messages need not be missing in any count."""
    seen = observed()
    seen.gone = {key: 1_000 * MS}
    assert drift(TASKS, seen) == []
    seen.gone = {key: 1_001 * MS}
    (found,) = drift(TASKS, seen)
    assert (found.kind, found.callback) == ('stopped', key)
    assert found.text.startswith(f'{what} of {key} was destroyed 1.001 s before the end')
    assert then in found.text
    seen.executions[key] = seen.messages[key] = 0   # in a part of a recording, after that
    assert [each for each in drift(TASKS, seen) if each.callback == key] == [found]


def test_of_publishers_only_those_that_always_publish_are_expected_to():
    tasks = loads("""\
mddag: 1
nodes:
  - node: /a
    callbacks:
      - {name: always, timer: 100ms, publishes: [/d], dag: always}
      - {name: sometimes, timer: 10ms, may_publish: [/d], dag: sometimes}
  - node: /b
    callbacks: [{name: keep, subscription: /d, deadline: none}]
""")
    ran = {'/a:always': 20, '/a:sometimes': 200}

    def texts(got):
        return [each.text for each in drift(tasks, Observed(
            duration_ns=2_000 * MS, messages={'/b:keep': got},
            executions={**ran, '/b:keep': got}))]

    assert texts(21) == texts(120) == texts(220) == []
    assert texts(5) == [
        '/b:keep got 5 messages, and by the declaration 20 were due: if /a:always published /d in '
        "5 of 20 runs, declare 'may_publish: [/d]'"]
    assert texts(400) == ['/b:keep got 400 messages, and by the declaration 220 were due']


def test_a_sync_publishes_once_for_all_messages_of_a_job():
    """Two publishers of one topic make three legs of two topics."""
    task_set = graph("""
- node: /a
  callbacks:
    - {name: t, timer: 10ms, publishes: [/i]}
    - {name: one, subscription: /i, publishes: [/x]}
    - {name: two, subscription: /i, publishes: [/x]}
    - {name: three, subscription: /i, publishes: [/y]}
    - {name: s, sync: [/x, /y], publishes: [/z]}
    - {name: e, subscription: /z, deadline: 9ms}
""")
    runs = {callback.key: 50 for callback in task_set.callbacks} | {'/a:s': 150}
    seen = Observed(500 * MS, {'/a:t': Releases(50, 0, 490 * MS)}, runs, runs)
    assert drift(task_set, seen) == []


def test_what_may_run_in_another_process():
    text = TASKS.text.replace('dag: y}', 'dag: y, release_from: header_stamp}')
    seen = observed()
    for key in ('/b:w', '/b:e'):
        seen.executions[key] = seen.messages[key] = 0
    for seen.nodes, never_ran in (({'/a'}, ['/b:e']), ({'/a', '/b'}, ['/b:e', '/b:w'])):
        assert [each.callback for each in drift(loads(text), seen)] == never_ran


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


@pytest.mark.parametrize(('entity', 'keys'), [      # alike ones in order, periods rounded
    (Entity('/a', 'subscription', '/x'), ['/a:s0', '/a:j0', '/a:s1', None]),
    (Entity('/a', 'subscription', '/y'), ['/a:j0', None]),
    (Entity('/a', 'service', '/ask'), ['/a:q', None]),
    (Entity('/b', 'subscription', '/x'), ['/b:s', None]),
    (Entity('/a', 'timer', '', 10_000_000), ['/a:t0', '/a:t1', None]),
    (Entity('/a', 'timer', '', 9_999_999), ['/a:t0', '/a:t1', None]),
    (Entity('/a', 'timer', '', 20_000_000), ['/a:t2', None]),
    (Entity('/b', 'timer', '', 33_333_333), ['/b:t', None]),
    (Entity('/b', 'timer', '', 33_300_000), ['/b:t', None]),
    (Entity('/b', 'timer', '', 33_400_000), [None])])
def test_entities_are_bound_to_callbacks(entity, keys):
    binder = Binder(BOUND)
    bound = [binder.bind(entity) for _ in keys]
    assert [callback and callback.key for callback in bound] == keys


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


@pytest.mark.parametrize(('callback', 'seen', 'meaning'), [
    ('/b:s', Entity('/robot/b', 'subscription', '/robot/x'), "the node '/robot/b'"),
    ('/b:s', Entity('/b', 'subscription', '/robot/x'), "the topic '/robot/x'"),
    ('/a:q', Entity('/a', 'service', '/a/ask'), "the service '/a/ask'"),
    ('/a:j0', Entity('/robot/a', 'subscription', '/robot/y'), "the node '/robot/a'"),
    ('/b:t', Entity('/b', 'timer', '', 50_000_000), 'its timer of 50ms'),
    ('/b:t', Entity('/robot/b', 'timer', '', 33_333_333), "the node '/robot/b'"),
    ('/b:t', Entity('/robot/b', 'timer', '', 50_000_000), None),
    ('/b:s', Entity('/bb', 'subscription', '/x'), "the node '/bb'"),
    ('/b:s', Entity('/bb', 'subscription', '/y'), None),
    ('/b:s', Entity('/b', 'subscription', '/xx'), "the topic '/xx'"),
    ('/b:s', Entity('/b', 'subscription', '/other_topic'), None),
    ('/b:s', Entity('/robot/b', 'service', '/x'), None),
])
def test_a_namespace_more_or_another_period_is_probably_meant(callback, seen, meaning):
    others = [Entity('/other', seen.kind, '/z', 1000), seen]
    found = suggest_entity(BOUND.callback(callback), others)
    assert found == (meaning and f'did you mean {meaning}?')


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
