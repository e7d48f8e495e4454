# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""With ``MDDAG_DEBUG=1`` a broken invariant of the engine is found at once."""

from __future__ import annotations

from collections.abc import Callable
import os
import threading
from typing import Any

from mddag_executor.core import NEVER
from mddag_executor.core.state import N_HOLDING, N_IDLE, N_STALE, WAITING
from mddag_executor.executor.debugging import CheckedLock, engine_lock, InvariantError
from mddag_executor.executor.engine import Engine
from mddag_executor.executor.entity import Entity, SUBSCRIPTION
from mddag_executor.executor.gil import GilHabit
from mddag_executor.executor.work import Work
from msg_graph import loads
import pytest

from .conftest import Spinning, wait_for

GRAPH = """
mddag: 1
nodes:
  - node: /n
    callbacks: [{name: tick, timer: 10ms, deadline: 10ms}]
"""


def busy_engine() -> Engine:
    """
    Return an engine in which something of each kind is under way.

    One of group 0 runs and two wait for it; one holds the GIL and two are held back; one is
    suspended; a message and a job of a DAG are ready; and one entry is stale.
    """
    engine = Engine(
        loads(GRAPH), 4, 'rad', default_deadline=10 ** 9, max_active_jobs=64, expire_after=NEVER)

    def entity(group: int = -1, holds: bool = False, depth: int = 0) -> Entity:
        found = Entity('waitable', None, '/n', None, group, depth, '/t')
        found.kind = SUBSCRIPTION
        found.habit = GilHabit(holds)
        return found

    def ready(which: Entity, count: int) -> None:
        for _ in range(count):
            engine.ready(Work(which, print), 0)

    ready(entity(engine.scheduler.new_group()), 3)
    ready(entity(holds=True), 3)
    suspended = entity()
    ready(suspended, 1)
    running = []
    while (work := engine.dispatch(0, 0)) is not None:
        running.append(work)
    work = next(each for each in running if each.entity is suspended)
    engine.suspended(work, 0, 0, 0, work.worker)
    ready(entity(depth=1), 1)
    gone = entity()
    ready(gone, 2)
    engine.remove(gone, 0)
    source = Entity('waitable', None, '/n', None, -1, 2, '')
    source.source = 0
    engine.timer_due(Work(source, print), 0, 0)
    engine.validate()
    return engine


def count(engine: Engine, column: int) -> None:
    engine._state.scalars[column] += 1


def running(engine: Engine) -> int:
    """Return an execution of the group that runs."""
    return engine._state.group_owner[0]


def set_state(engine: Engine, x: int, state: int) -> None:
    engine._state.x_state[x] = state


BREAKS: dict[str, tuple[str, Callable[[Engine], Any]]] = {
    'lost': ('in no queue', lambda e: e._state.held_back.pop()),
    'wrong group': ('waits for group', lambda e: e._state.x_group.__setitem__(
        e._state.group_heap[0][0][4], -1)),
    'stale': ('are stale', lambda e: count(e, N_STALE)),
    'idle workers': ('are idle', lambda e: count(e, N_IDLE)),
    'holders counted': ('hold the interpreter', lambda e: count(e, N_HOLDING)),
    'worker': ('runs execution', lambda e: set_state(e, running(e), WAITING)),
    'owner': ('nothing brings', lambda e: e._state.group_owner.__setitem__(0, -1)),
    'active': ('counted are', lambda e: e._state.job_active.__setitem__(0, 9)),
    'open jobs': ('jobs of DAG 0 are open', lambda e: e._state.n_open.__setitem__(0, 0)),
    'deadline': ('next deadline', lambda e: setattr(e.deadlines, 'next', 5)),
}


@pytest.mark.parametrize('broken', BREAKS)
def test_each_broken_invariant_is_found(broken):
    engine = busy_engine()
    text, break_it = BREAKS[broken]
    break_it(engine)
    with pytest.raises(InvariantError, match=text):
        engine.validate()


def test_what_a_section_raises_is_not_hidden():
    def fail() -> None:
        raise AssertionError('not called')

    lock = CheckedLock(fail, lambda: 0)
    with pytest.raises(ZeroDivisionError):
        with lock:
            raise ZeroDivisionError
    assert not lock._is_owned()


def test_without_the_variable_there_is_a_plain_lock(monkeypatch):
    assert os.environ['MDDAG_DEBUG'] == 'engine'  # in all tests
    for value in ('0', ''):
        monkeypatch.setenv('MDDAG_DEBUG', value)
        assert type(engine_lock(print, int)) is type(threading.RLock())


def test_a_broken_invariant_ends_the_spin(make_executor, make_node):
    node, ticks = make_node(), []
    node.create_timer(0.01, lambda: ticks.append(None))
    executor = make_executor(nodes=[node])
    with Spinning(executor) as spinning:
        assert wait_for(lambda: ticks)
        count(executor._engine, N_STALE)
        spinning.join()
        executor._engine._state.scalars[N_STALE] -= 1
    assert isinstance(spinning.error, InvariantError)
