# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Matching entities with declared callbacks."""

from __future__ import annotations

from msg_graph.binding import Binder, entities_of, Entity, entity_name, is_period, meant
import pytest

from .helpers import graph

TASKS = graph("""
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


def key(callback: object) -> str | None:
    return None if callback is None else callback.key  # type: ignore[attr-defined, no-any-return]


def test_alike_ones_are_handed_out_in_order() -> None:
    binder = Binder(TASKS)
    assert [key(binder.bind(Entity('/a', 'subscription', '/x'))) for _ in range(4)] == [
        '/a:s0', '/a:j0', '/a:s1', None]
    assert [key(binder.bind(Entity('/a', 'timer', '', 10_000_000))) for _ in range(3)] == [
        '/a:t0', '/a:t1', None]
    assert key(binder.bind(Entity('/a', 'timer', '', 20_000_000))) == '/a:t2'
    assert [key(binder.bind(Entity('/a', 'service', '/ask'))) for _ in range(2)] == ['/a:q', None]
    assert key(binder.bind(Entity('/b', 'subscription', '/x'))) == '/b:s'


def test_a_sync_is_bound_by_each_leg() -> None:
    binder = Binder(TASKS)
    assert key(binder.bind(Entity('/a', 'subscription', '/y'))) == '/a:j0'
    assert binder.bind(Entity('/a', 'subscription', '/y')) is None
    binder.bind(Entity('/a', 'subscription', '/x'))
    assert key(binder.bind(Entity('/a', 'subscription', '/x'))) == '/a:j0'


def test_periods_may_be_rounded() -> None:
    binder = Binder(TASKS)
    assert key(binder.bind(Entity('/b', 'timer', '', 33_333_333))) == '/b:t'
    assert is_period(33_333_333, 33_300_000) and is_period(16_666_666, 16_700_000)
    assert not is_period(33_333_333, 33_000_000)
    binder = Binder(TASKS)
    assert binder.bind(Entity('/b', 'timer', '', 33_400_000)) is None
    assert key(binder.bind(Entity('/a', 'timer', '', 9_999_999))) == '/a:t0'


def test_every_callback_can_be_bound_once() -> None:
    binder = Binder(TASKS)
    assert binder.unbound() == list(TASKS.callbacks)
    for callback in reversed(TASKS.callbacks):
        for entity in entities_of(callback):
            assert binder.bind(entity) is not None
    assert binder.unbound() == []
    binder.release(TASKS.callback('/a:j0'), '/y')
    assert [callback.key for callback in binder.unbound()] == ['/a:j0']
    assert binder.bind(Entity('/a', 'subscription', '/y')) is not None
    for callback in TASKS.callbacks:
        for entity in entities_of(callback):
            assert binder.bind(entity) is None


@pytest.mark.parametrize(('callback', 'seen', 'question'), [
    ('/b:s', Entity('/robot/b', 'subscription', '/robot/x'), "did you mean the node '/robot/b'?"),
    ('/b:s', Entity('/robot/b', 'subscription', '/x'), "did you mean the node '/robot/b'?"),
    ('/b:s', Entity('/b', 'subscription', '/robot/x'), "did you mean the topic '/robot/x'?"),
    ('/a:q', Entity('/a', 'service', '/a/ask'), "did you mean the service '/a/ask'?"),
    ('/a:j0', Entity('/robot/a', 'subscription', '/robot/y'), "did you mean the node '/robot/a'?"),
    ('/b:t', Entity('/b', 'timer', '', 50_000_000), 'did you mean its timer of 50ms?'),
    ('/b:t', Entity('/robot/b', 'timer', '', 33_333_333), "did you mean the node '/robot/b'?"),
    ('/b:t', Entity('/robot/b', 'timer', '', 50_000_000), None),
    ('/b:s', Entity('/bb', 'subscription', '/x'), "did you mean the node '/bb'?"),
    ('/b:s', Entity('/xyz', 'subscription', '/x'), "did you mean the node '/xyz'?"),
    ('/b:s', Entity('/bb', 'subscription', '/y'), None),
    ('/b:s', Entity('/b', 'subscription', '/xx'), "did you mean the topic '/xx'?"),
    ('/b:s', Entity('/b', 'subscription', '/other_topic'), None),
    ('/b:t', Entity('/bb', 'timer', '', 33_333_333), "did you mean the node '/bb'?"),
    ('/b:t', Entity('/bb', 'timer', '', 50_000_000), None),
    ('/b:s', Entity('/robot/b', 'subscription', '/y'), None),
    ('/b:s', Entity('/robot/b', 'service', '/x'), None),
])
def test_a_namespace_more_or_another_period_is_probably_meant(
        callback: str, seen: Entity, question: str | None) -> None:
    assert meant(TASKS.callback(callback), [Entity('/other', seen.kind, '/z', 1000), seen]) \
        == question


@pytest.mark.parametrize(('symbol', 'name'), [
    ('robot.camera.Camera.on_image', '/n: on_image (timer 1s)'),
    ('__main__.main.<locals>.tick', '/n: tick (timer 1s)'),
    ('robot.camera.<lambda>', '/n: <lambda> (timer 1s)'),
    ('void ns::on_timer(int, char const*)', '/n: on_timer (timer 1s)'),
    ('std::_Bind<void (Ping::*(Ping*))()>', '/n: timer 1s'),
    ('', '/n: timer 1s'),
])
def test_undeclared_ones_are_called_by_node_and_function(symbol: str, name: str) -> None:
    assert entity_name('/n', symbol, 'timer 1s') == name
