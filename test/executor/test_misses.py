# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Misses are known when they happen, and what `on_deadline_miss` does never disturbs the executor.

`make stress` runs the latter for MISS_STRESS_SECONDS (20) each.
"""

from collections import Counter
from contextlib import suppress
import os
import re
import sys
import threading
import time
from types import SimpleNamespace

from diagnostic_msgs.msg import DiagnosticArray
from mddag_executor import replay
from mddag_executor.core.tally import total
from mddag_executor.executor import misses
from mddag_executor.executor.threads import RUNS
from msg_graph import loads
import pytest
from rclpy.callback_groups import ReentrantCallbackGroup
from std_msgs.msg import Header
from std_srvs.srv import Empty

from .conftest import matched, Spinning, wait_for
from .declared import Declared, graph
from .inside import pool_of

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

    def __init__(self, does, node):
        self.misses, self.heard, self.served = [], [], []
        self.group = ReentrantCallbackGroup()
        publisher = node.create_publisher(Header, '/alarm', 10)
        self._publish = lambda: publisher.publish(Header())
        node.create_subscription(
            Header, '/alarm', self.heard.append, 10, callback_group=self.group)
        self._client = node.create_client(Empty, '/stop', callback_group=self.group)
        node.create_service(Empty, '/stop', self._serve, callback_group=self.group)
        self._log = lambda: node.get_logger().warning('a deadline was missed')
        self._then = getattr(self, f'_{does}', lambda: time.sleep(float(does) / 1e3))

    def __call__(self, miss):
        self.misses.append(miss)
        self._then()

    def _serve(self, request, response):
        self.served.append(1)
        return response

    def _raise(self):
        raise Wrong

    def _exit(self):
        sys.exit('a deadline was missed')

    def _call(self):
        done = threading.Event()
        self._client.call_async(Empty.Request()).add_done_callback(lambda _: done.set())
        done.wait(0.2)  # at the end nothing answers any more


class SpinningOn(Spinning):
    """Spins again after an exception of the handler."""

    def _spin(self):
        while not self.executor._is_shutdown:
            with suppress(Wrong, SystemExit):
                self.executor.spin()


@pytest.mark.parametrize(('does', 'workers'), [
    ('0', 7), ('50', 2), ('raise', 1), ('exit', 7), ('log', 2), ('publish', 1), ('call', 1),
    ('call', 7)])
def test_the_executor_runs_on_whatever_the_handler_does(make_executor, make_node, does, workers):
    node = make_node('late')
    handler = Handler(does, node)
    ran = Counter[int]()
    for i, period in enumerate(PERIODS_MS):
        node.create_timer(period / 1e3, lambda i=i: ran.update((i,)), handler.group)
    executor = make_executor(
        loads(LATE), num_workers=workers, on_deadline_miss=handler, nodes=[node])
    with SpinningOn(executor):
        end = time.monotonic() + SECONDS
        assert wait_for(lambda: len(handler.misses) >= 5 and time.monotonic() >= end
                        and min(ran[i] for i in range(len(PERIODS_MS))) >= 20
                        and (does != 'publish' or handler.heard)
                        and (does != 'call' or handler.served), SECONDS + 15.0), ran
    statistics = executor.statistics()
    counts = statistics['callbacks']
    assert all(each['ready'] == each['ran'] + each['dropped'] + each['waiting']
               for each in counts.values())
    assert total(statistics['dags']).missed == (
        len(handler.misses) + statistics['unreported_misses'])
    assert len({(m.vertex, m.job) for m in handler.misses}) == len(handler.misses)


def test_callbacks_run_while_the_handler_hangs_and_what_does_not_fit_is_counted(
        make_executor, make_node, capfd):
    """The only worker is free for them, and memory is bounded."""
    go_on, misses = threading.Event(), []

    def hang(miss):
        misses.append(miss)
        go_on.wait(60.0)

    node = make_node('late')
    for period in PERIODS_MS:
        node.create_timer(period / 1e3, lambda: None)
    executor = make_executor(loads(LATE), num_workers=1, on_deadline_miss=hang, nodes=[node])
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


# --- when a miss is known ------------------------------------------------------------------------

#: Nothing but `/start` starts a job, so nothing else makes a miss known.
ONCE = graph(
    source='name: begin, subscription: /start, period: 60s, publishes: [/a], dag: once',
    sink='name: end, subscription: /a, deadline: 20ms')


def test_a_result_that_never_comes_is_a_miss_at_its_deadline(make_executor, make_node):
    """Though nothing runs then: the node of the sink is not there."""
    nodes, misses = Declared(make_node, ONCE), []
    start = make_node('other').create_publisher(Header, '/start', 10)
    with Spinning(make_executor(
            loads(ONCE), on_deadline_miss=misses.append, nodes=[nodes.nodes['source']])):
        matched(start)
        start.publish(Header())
        assert wait_for(lambda: misses)
    assert [(miss.kind, miss.vertex, miss.completed_ns) for miss in misses] == [
        ('overdue', '/sink:end', None)]


@pytest.mark.parametrize('has_ended', [False, True])
def test_a_callback_that_has_ended_is_no_miss_before_its_thread_could_say_so(
        make_executor, make_node, has_ended):
    """Another thread owns the executor's lock when it ends, and still after the deadline."""
    text = ONCE.replace('20ms', '100s')
    misses, began, may_end = [], threading.Event(), threading.Event()

    def end():
        began.set()
        may_end.wait(60.0)

    nodes = Declared(make_node, text, {'end': end})
    start = make_node('other').create_publisher(Header, '/start', 10)
    executor = make_executor(
        loads(text), on_deadline_miss=misses.append, nodes=nodes.nodes.values())
    pool = pool_of(executor)
    with Spinning(executor):
        matched(start)
        assert wait_for(nodes.connected)
        start.publish(Header())
        assert began.wait(60.0)
        # the end of the source, which is of the same job, has been reported
        assert wait_for(lambda: not any(
            each.work is not None and each.work.entity.name == '/source:begin'
            for each in pool.threads()))
        try:
            with pool.lock:
                # others may run undeclared callbacks
                thread, = (each for each in pool.threads() if each.work is not None
                           and each.work.entity.name == '/sink:end')
                if has_ended:
                    may_end.set()
                    assert wait_for(lambda: thread.outcome is not RUNS)
                pool.due.overdue.update()   # as a thread does before it waits
                pool.now += 10 ** 12        # the deadline is over
                pool.due.overdue.come_due()
                assert pool.engine.verdicts.missed == (not has_ended)
        finally:
            may_end.set()
        assert wait_for(lambda: executor.statistics()['dags']['once']['ends']['completed'] == 1)
    assert [miss.kind for miss in misses] == ['overdue'] * (not has_ended)


def test_a_callback_that_hangs_is_a_miss_once(make_executor, make_node, tmp_path, capfd):
    """A miss is known everywhere at its deadline; the later end decides the verdict."""
    misses, reported, go_on = [], [], threading.Event()
    nodes = Declared(make_node, ONCE, {'end': lambda: go_on.wait(60.0)})
    other = make_node('other')
    start = other.create_publisher(Header, '/start', 10)

    def diagnosed(message):
        for status in message.status:
            if status.name == 'mddag: once':
                values = {each.key: each.value for each in status.values}
                reported.append((values['missed'], values['late']))

    other.create_subscription(DiagnosticArray, '/diagnostics', diagnosed, 10)
    trace = str(tmp_path / 'run.mcap')
    executor = make_executor(
        loads(ONCE), on_deadline_miss=misses.append, trace=trace, diagnostics_period='50ms',
        nodes=[*nodes.nodes.values(), other])

    def sink():
        return executor.statistics()['dags']['once']['sinks']['/sink:end']

    with Spinning(executor):
        matched(start)
        assert wait_for(nodes.connected)
        start.publish(Header())
        assert wait_for(lambda: misses)
        assert wait_for(lambda: '1 deadline missed: /sink:end, 20 ms, job 0 of once'
                        in capfd.readouterr().err)
        assert wait_for(lambda: reported and reported[-1] == ('1', '1')), reported[-1:]
        assert (sink()['late'], sink()['overdue'], sink()['completed']) == (1, 1, 0)
        first = executor.statistics()['first_miss']
        go_on.set()
        assert wait_for(lambda: executor.statistics()['dags']['once']['ends']['late'] == 1)
    miss, = misses
    assert (miss.kind, miss.vertex, miss.job, miss.completed_ns) == (
        'overdue', '/sink:end', 0, None)
    assert miss.deadline_ns - miss.release_ns == 20_000_000
    assert first == {'dag': 'once', 'vertex': '/sink:end', 'job': 0,
                     'deadline_ns': miss.deadline_ns, 'completed_ns': None}
    assert (sink()['late'], sink()['overdue'], sink()['completed']) == (1, 0, 1)
    dag = replay(trace).result()['dags']['once']
    assert dag['ends'] == executor.statistics()['dags']['once']['ends']
    assert (dag['sinks']['/sink:end']['late'], dag['sinks']['/sink:end']['overdue']) == (1, 0)


def test_between_two_lines_of_the_log_a_miss_costs_nothing(monkeypatch, capfd):
    now = [100.0]
    monkeypatch.setattr(misses, 'time', SimpleNamespace(monotonic=lambda: now[0]))
    verdicts = SimpleNamespace(
        missed=0, gone=set(), last_missed=lambda: ('dag', 'sink', 7, 1_000_000))
    log = misses.MissLog(verdicts)
    assert not log.is_behind()
    for missed, at, is_behind in ((1, 100.0, True), (2, 101.0, False), (3, 109.9, False),
                                  (4, 110.0, True), (5, 119.0, False), (5, 120.0, True)):
        verdicts.missed, now[0] = missed, at
        verdicts.gone = {'sink'} if missed == 5 else set()
        assert log.is_behind() is is_behind
        if is_behind:
            log.write()
            log.write()
            assert not log.is_behind()
    assert [line[line.index(']: ') + 3:] for line in capfd.readouterr().err.splitlines()] == [
        '1 deadline missed: sink, 1 ms, job 7 of dag',
        '3 deadlines missed within 10 s, the last: sink, 1 ms, job 7 of dag',
        '1 deadline missed within 10 s: sink, 1 ms, job 7 of dag '
        '(its program destroyed it, or has ended)']


def test_misses_after_a_line_of_the_log_are_in_a_later_one(
        make_executor, make_node, monkeypatch, capfd):
    """Though nothing else happens until it may be written."""
    monkeypatch.setattr(misses, 'LOG_EVERY_S', 0.3)
    node, ran, logged = make_node('late'), [], []

    def late():
        time.sleep(0.002)
        ran.append(1)
        if len(ran) == 4:
            timer.cancel()

    timer = node.create_timer(0.01, late)
    executor = make_executor(loads(graph(
        late='name: t, timer: 10ms, dag: d, deadline: 1ms')), nodes=[node])

    def n_logged():
        logged.append(capfd.readouterr().err)
        return sum(map(int, re.findall(r'(\d+) deadlines? missed', ''.join(logged))))

    with Spinning(executor):
        assert wait_for(lambda: len(ran) == 4)
        assert wait_for(lambda: n_logged() == total(executor.statistics()['dags']).missed >= 4)


def test_a_miss_in_the_last_step_is_logged(make_executor, make_node, capfd):
    late = graph(late='name: t, timer: 50ms, dag: d, deadline: 20ms')
    node = make_node('late')
    executor = make_executor(loads(late), nodes=[node])
    node.create_timer(0.05, lambda: time.sleep(0.03))
    while not executor.statistics()['dags']['d']['sinks']['/late:t']['completed']:
        executor.spin_once(10.0)
    assert ': /late:t, 20 ms, job ' in capfd.readouterr().err
