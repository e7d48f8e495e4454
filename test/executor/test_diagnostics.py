# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

import threading
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from mddag_executor.core import Tables, Tally
from mddag_executor.core.state import SINK_EXPIRED, SINK_IN_TIME, SINK_LATE
from mddag_executor.errors import UsageError
from mddag_executor.executor.diagnostics import DagWatch, ERROR, OK, STALE, WARN
from mddag_executor.executor.settings import diagnostics_period_ns, Thresholds
from msg_graph import loads
import pytest

from .conftest import Spinning, wait_for
from .test_deadlines import CHAIN, Chain

SECOND = 1_000_000_000


# --- the verdicts, without ROS -------------------------------------------------------------------


class Watched:
    """A DAG of one sink whose results are made up; each ``after`` is one period."""

    def __init__(self, **thresholds: Any) -> None:
        task_set = loads(CHAIN)
        tables = Tables.build(task_set)
        self.tally = Tally(task_set, tables)
        self.sink = next(v for v in tables.sinks if tables.sink_deadline[v] == 50_000_000)
        self.job = 0
        self.in_stops = [0]
        self.now = SECOND
        self.watch = DagWatch(
            self.tally, task_set.dags[0], Thresholds(**thresholds), SECOND, self.in_stops)

    def after(self, in_time: int = 0, late: int = 0, expired: int = 0) -> Any:
        for kind, count, response in (
            (SINK_IN_TIME, in_time, 20_000_000), (SINK_LATE, late, 60_000_000),
            (SINK_EXPIRED, expired, -1),
        ):
            for _ in range(count):
                self.tally.released(0)
                deadline = 50_000_000
                self.tally.add([(kind, 0, self.sink, self.job, deadline, response)])
                self.job += 1
        self.now += SECOND
        return self.watch.status(self.now)


def test_levels_follow_the_share_of_misses_in_the_window():
    watched = Watched(window=3)
    assert watched.after().level == STALE
    assert watched.after(in_time=50).level == OK
    watched.in_stops[0] = 1
    status = watched.after(in_time=49, late=1)
    assert (status.level, status.message) == (
        WARN, '1 of 100 results missed their deadlines, 1 as the machine stood still')
    assert status.values['margin_min_ms'] == '-10.000'
    assert status.values[f'margin_ms {watched.tally.vertex_name(watched.sink)}'] == '-10.000'
    assert status.values['window_missed_ratio'] == '0.0100'
    status = watched.after(in_time=20, expired=30)
    assert (status.level, status.values['expired']) == (ERROR, '30')
    assert watched.after(in_time=50).level == ERROR
    assert watched.after(in_time=50).level == ERROR
    assert watched.after(in_time=50).level == OK  # the window has moved on


def test_a_source_that_stops_is_stale_until_it_goes_on():
    watched = Watched()
    assert watched.after(in_time=50).level == OK
    status = watched.after()
    assert (status.level, status.message) == (STALE, 'nothing has been released for 1.0 s')
    assert watched.after().message == 'nothing has been released for 2.0 s'
    assert watched.after(in_time=50).level == OK


def test_response_times_are_those_of_the_last_period():
    watched = Watched()
    values = watched.after(in_time=98, late=2).values
    assert values['response_p50_ms'] == '20.000'
    assert values['response_max_ms'] == values['response_p99_ms'] == '60.000'
    assert values['deadline_used_max'] == '1.20'
    assert watched.after(in_time=10).values['response_max_ms'] == '20.000'
    assert 'response_max_ms' not in watched.after().values


@pytest.mark.parametrize('wrong', [
    {'warn_ratio': 0.0}, {'warn_ratio': 1.5}, {'error_ratio': -1.0}, {'error_ratio': float('nan')},
    {'warn_burst': 0}, {'window': 0}, {'stale_periods': 0}])
def test_thresholds_that_make_no_sense(wrong: dict[str, Any]):
    with pytest.raises(UsageError, match=next(iter(wrong))):
        Thresholds(**wrong)


def test_the_period():
    assert diagnostics_period_ns(None) is diagnostics_period_ns(0) is None
    assert diagnostics_period_ns('1s') == diagnostics_period_ns(SECOND) == SECOND
    for short in (1, '1ms'):
        with pytest.raises(UsageError, match='too short'):
            diagnostics_period_ns(short)


# --- published -----------------------------------------------------------------------------------


class Listener:
    """Keeps the newest status by name, from an executor of its own."""

    def __init__(self, make_node: Any, make_executor: Any) -> None:
        self.statuses: dict[str, Any] = {}
        self.stamps: list[float] = []
        self.node = make_node('listener')
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_array, 10)
        self.executor = make_executor()
        self.executor.add_node(self.node)

    def _on_array(self, message: Any) -> None:
        self.stamps.append(message.header.stamp.sec + message.header.stamp.nanosec / 1e9)
        self.statuses = {status.name: status for status in message.status}

    def level(self, name: str) -> Any:
        return self.statuses[name].level if name in self.statuses else None


def values(status: Any) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


def test_statuses_are_published_from_ok_to_stale(make_executor, make_node):
    listener = Listener(make_node, make_executor)
    slow = [0.0]
    chain = Chain(make_node, {'early': lambda: time.sleep(slow[0])})
    executor = make_executor(
        loads(CHAIN), diagnostics_period='100ms', thresholds=Thresholds(window=2, name='robot'))
    names = [n for n, _ in make_node('look').get_node_names_and_namespaces()]
    assert not any('diagnostics' in name for name in names)  # not before it spins
    with Spinning(listener.executor), Spinning(executor):
        chain.start(executor)
        assert wait_for(lambda: listener.level('robot: chain') == DiagnosticStatus.OK)
        assert set(listener.statuses) == {'robot: chain', 'robot: workers'}
        status = listener.statuses['robot: chain']
        assert status.message.endswith('results in time')
        assert values(status)['period_ms'] == '20.000'
        assert status.hardware_id == listener.statuses['robot: workers'].hardware_id != ''
        assert float(values(listener.statuses['robot: workers'])['callbacks_per_s']) > 20
        slow[0] = 0.012
        assert wait_for(lambda: listener.level('robot: chain') == DiagnosticStatus.ERROR)
        slow[0] = 0.0
        assert wait_for(lambda: listener.level('robot: chain') == DiagnosticStatus.OK)
        chain.timer.cancel()
        assert wait_for(lambda: listener.level('robot: chain') == DiagnosticStatus.STALE)
        chain.timer.reset()
        assert wait_for(lambda: listener.level('robot: chain') == DiagnosticStatus.OK)
        assert abs(listener.stamps[-1] - time.time()) < 5
        assert set(executor.get_nodes()) == set(chain.nodes.values())


def test_only_dags_that_have_a_callback_here_have_a_status(make_executor, make_node):
    text = CHAIN + """
  - node: /elsewhere
    callbacks: [{name: tick, timer: 20ms, dag: other, deadline: 10ms}]
"""
    chain = Chain(make_node)
    executor = make_executor(loads(text), diagnostics_period='50ms')
    with Spinning(executor):
        chain.start(executor)
        assert wait_for(lambda: len(chain.jobs['last']) >= 2)
        names = [status.name for status in executor._diagnostics.statuses()]
    assert names == ['mddag: chain', 'mddag: workers']


def test_drops_are_a_warning_of_the_pool(make_executor, make_node):
    from std_msgs.msg import Header
    node = make_node()
    publisher = node.create_publisher(Header, '/a', 100)
    node.create_subscription(Header, '/a', lambda message: time.sleep(0.02), 1)
    executor = make_executor(num_workers=1, diagnostics_period='1000s', nodes=[node])
    with Spinning(executor):
        assert wait_for(lambda: publisher.get_subscription_count() == 1)
        assert executor._diagnostics.statuses()[-1].level == OK
        for _ in range(20):
            publisher.publish(Header())
            time.sleep(0.003)
        status = executor._diagnostics.statuses()[-1]
        assert (status.name, status.level) == ('mddag: workers', WARN)
        assert f'{status.values["dropped"]} dropped' in status.message
        assert wait_for(lambda: executor._diagnostics.statuses()[-1].level == OK)


def test_a_shutdown_of_the_context_ends_it_quietly(make_executor, make_node, ros_context, capfd):
    executor = make_executor(diagnostics_period='20ms')
    executor.add_node(make_node())
    spinning = Spinning(executor)
    spinning._thread.start()
    assert wait_for(lambda: executor._diagnostics._thread is not None)
    time.sleep(0.1)
    ros_context.try_shutdown()
    spinning.join()
    assert wait_for(lambda: not executor._diagnostics._thread.is_alive())
    assert 'diagnostics' not in capfd.readouterr().err


def test_a_shutdown_while_its_thread_is_started(make_executor, monkeypatch):
    start, begun = threading.Thread.start, threading.Event()

    def late(thread: threading.Thread) -> None:
        if thread.name == 'mddag-diagnostics':
            begun.set()
            time.sleep(0.2)
        start(thread)

    monkeypatch.setattr(threading.Thread, 'start', late)
    with Spinning(make_executor(loads(CHAIN), diagnostics_period='20ms')) as spinning:
        assert begun.wait(5.0)
    assert spinning.error is None
