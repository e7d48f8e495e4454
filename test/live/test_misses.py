# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What `on_deadline_miss` does, however long it takes, never disturbs the executor.

`make stress` runs the same for MISS_STRESS_SECONDS (20) each.
"""

from __future__ import annotations

from collections import Counter
import os
import sys
import threading
import time
from typing import Any

from mddag_executor import DeadlineMiss, MultiDeadlineExecutor
from mddag_executor.core.tally import total
from msg_graph import loads
import pytest
from rclpy.callback_groups import ReentrantCallbackGroup
from std_msgs.msg import Header
from std_srvs.srv import Empty

from .conftest import Spinning, wait_for

SECONDS = float(os.environ.get('MISS_STRESS_SECONDS', 0))
PERIODS_MS = (3, 5, 7)
#: Each result is late.
LATE = 'mddag: 1\nnodes:\n  - node: /late\n    callbacks:\n' + ''.join(
    f'      - {{name: t{i}, timer: {period}ms, dag: d{i}, deadline: 1us}}\n'
    for i, period in enumerate(PERIODS_MS))


class Wrong(Exception):
    """What a handler of these tests raises."""


class Handler:
    """Takes note of each miss, then does one of the things that users do."""

    def __init__(self, does: str, node: Any) -> None:
        self.misses: list[DeadlineMiss] = []
        self.group = ReentrantCallbackGroup()
        self._node = node
        self._then = getattr(self, f'_{does}', None) or (lambda: time.sleep(float(does) / 1e3))
        self._publisher = node.create_publisher(Header, '/alarm', 10)
        self.heard: list[Header] = []
        node.create_subscription(
            Header, '/alarm', self.heard.append, 10, callback_group=self.group)
        self._client = node.create_client(Empty, '/stop', callback_group=self.group)
        self.served: list[int] = []
        node.create_service(Empty, '/stop', self._serve, callback_group=self.group)

    def __call__(self, miss: DeadlineMiss) -> None:
        self.misses.append(miss)
        self._then()

    def _serve(self, request: Any, response: Any) -> Any:
        self.served.append(1)
        return response

    def _raise(self) -> None:
        raise Wrong

    def _exit(self) -> None:
        sys.exit('a deadline was missed')

    def _log(self) -> None:
        self._node.get_logger().warning('a deadline was missed')

    def _publish(self) -> None:
        self._publisher.publish(Header())

    def _call(self) -> None:
        future = self._client.call_async(Empty.Request())
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        done.wait(0.2)  # at the end nobody answers any more


class SpinningOn(Spinning):
    """Spins again after an exception of the handler."""

    def _run(self) -> None:
        while self.error is None and not self.executor._is_shutdown:
            try:
                self.executor.spin()
            except (Wrong, SystemExit):
                pass
            except BaseException as error:
                self.error = error


@pytest.mark.parametrize('workers', [1, 2, 7])
@pytest.mark.parametrize(
    'does', ['0', '0.1', '1', '3', '10', '50', 'raise', 'exit', 'log', 'publish', 'call'])
def test_the_executor_runs_on_whatever_the_handler_does(
        ros_context, make_node, does: str, workers: int) -> None:
    node = make_node('late')
    handler = Handler(does, node)
    ran = Counter[int]()
    for i, period in enumerate(PERIODS_MS):
        node.create_timer(period / 1e3, lambda i=i: ran.update((i,)), handler.group)
    executor = MultiDeadlineExecutor(
        loads(LATE), num_workers=workers, on_deadline_miss=handler, context=ros_context)
    executor.add_node(node)
    with SpinningOn(executor) as spinning:
        end = time.monotonic() + SECONDS
        assert wait_for(lambda: len(handler.misses) >= 5 and time.monotonic() >= end
                        and min(ran[i] for i in range(len(PERIODS_MS))) >= 20
                        and (does != 'publish' or handler.heard)
                        and (does != 'call' or handler.served), SECONDS + 15.0), ran
        assert executor.shutdown(10.0)
        spinning.join()
    assert spinning.error is None
    statistics = executor.statistics()
    counts = statistics['callbacks']
    assert all(each['ready'] == each['ran'] + each['dropped'] + each['waiting']
               for each in counts.values())
    assert total(statistics['dags']).missed == (
        len(handler.misses) + statistics['unreported_misses'])
    assert len({(m.vertex, m.job) for m in handler.misses}) == len(handler.misses)


def test_callbacks_run_while_the_handler_hangs_and_what_does_not_fit_is_counted(
        ros_context, make_node, capfd) -> None:
    """The only worker is free for them, and memory is bounded."""
    go_on, misses = threading.Event(), []

    def hang(miss: DeadlineMiss) -> None:
        misses.append(miss)
        go_on.wait(60.0)

    node = make_node('late')
    for period in PERIODS_MS:
        node.create_timer(period / 1e3, lambda: None)
    executor = MultiDeadlineExecutor(
        loads(LATE), num_workers=1, on_deadline_miss=hang, context=ros_context)
    executor.add_node(node)
    with Spinning(executor):
        assert wait_for(lambda: executor.statistics()['unreported_misses'] >= 10)
        assert len(misses) == 1
        go_on.set()
        assert wait_for(lambda: len(misses) > 50)
    statistics = executor.statistics()
    unreported = statistics['unreported_misses']
    assert total(statistics['dags']).missed == len(misses) + unreported
    warned = [line for line in capfd.readouterr().err.splitlines() if 'not reported' in line]
    assert sum(int(line.split('on_deadline_miss: ')[1].split()[0]) for line in warned) == (
        unreported), warned


def test_the_handler_may_end_the_executor(ros_context, make_node) -> None:
    ended: list[bool] = []
    node = make_node('late')
    node.create_timer(PERIODS_MS[0] / 1e3, lambda: None)
    executor = MultiDeadlineExecutor(
        loads(LATE), on_deadline_miss=lambda miss: ended.append(executor.shutdown()),
        context=ros_context)
    executor.add_node(node)
    executor.spin()
    assert wait_for(lambda: ended)
    assert all(ended)
