# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Misses are known when they happen, and what `on_deadline_miss` does never disturbs the executor.

`make stress` runs the latter for MISS_STRESS_SECONDS (20) each.
"""

from collections import Counter
import os
import random
import sys
import threading
import time

from diagnostic_msgs.msg import DiagnosticArray
from mddag_executor.core.tally import total
from mddag_executor.replay import replay
from mddag_executor.trace import read_events
from msg_graph import loads
import pytest
from rclpy.callback_groups import ReentrantCallbackGroup
from std_msgs.msg import Header
from std_srvs.srv import Empty

from .conftest import Spinning, wait_for
from .declared import Declared

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
        self.misses = []
        self.group = ReentrantCallbackGroup()
        self._node = node
        self._then = getattr(self, f'_{does}', None) or (lambda: time.sleep(float(does) / 1e3))
        self._publisher = node.create_publisher(Header, '/alarm', 10)
        self.heard = []
        node.create_subscription(
            Header, '/alarm', self.heard.append, 10, callback_group=self.group)
        self._client = node.create_client(Empty, '/stop', callback_group=self.group)
        self.served = []
        node.create_service(Empty, '/stop', self._serve, callback_group=self.group)

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

    def _log(self):
        self._node.get_logger().warning('a deadline was missed')

    def _publish(self):
        self._publisher.publish(Header())

    def _call(self):
        future = self._client.call_async(Empty.Request())
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        done.wait(0.2)  # at the end nothing answers any more


class SpinningOn(Spinning):
    """Spins again after an exception of the handler."""

    def _run(self):
        while self.error is None and not self.executor._is_shutdown:
            try:
                self.executor.spin()
            except (Wrong, SystemExit):
                pass
            except BaseException as error:
                self.error = error


@pytest.mark.parametrize(('does', 'workers'), [
    ('0', 7), ('1', 1), ('50', 2), ('raise', 1), ('exit', 7), ('log', 2), ('publish', 1),
    ('call', 1), ('call', 7)])
def test_the_executor_runs_on_whatever_the_handler_does(make_executor, make_node, does, workers):
    node = make_node('late')
    handler = Handler(does, node)
    ran = Counter[int]()
    for i, period in enumerate(PERIODS_MS):
        node.create_timer(period / 1e3, lambda i=i: ran.update((i,)), handler.group)
    executor = make_executor(
        loads(LATE), num_workers=workers, on_deadline_miss=handler, nodes=[node])
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
ONCE = """
mddag: 1
nodes:
  - node: /source
    callbacks: [{name: begin, subscription: /start, period: 60s, publishes: [/a], dag: once}]
  - node: /sink
    callbacks:
      - {name: end, subscription: /a, deadline: 20ms}
"""


class Once:
    """The nodes of ONCE; ``go`` starts a job, whose callbacks do what they are given."""

    def __init__(self, make_node, begin, end):
        self.nodes = [make_node('source'), make_node('sink')]
        self.group = ReentrantCallbackGroup()
        self._go = make_node('go').create_publisher(Header, '/start', 10)
        self.publisher = self.nodes[0].create_publisher(Header, '/a', 10)
        for node, topic, body in zip(self.nodes, ('/start', '/a'), (begin, end)):
            node.create_subscription(
                Header, topic, lambda _, body=body: body(), 10, callback_group=self.group)

    def go(self):
        assert wait_for(lambda: self._go.get_subscription_count() == 1
                        and self.publisher.get_subscription_count() == 1)
        self._go.publish(Header())


def judged(dags):
    """Return the verdicts of a result, with the longest response times."""
    keys = ('completed', 'late', 'overdue', 'expired', 'failed', 'aborted')
    return {name: (dag['jobs'], dag['ends'], {
        sink: ([counts[key] for key in keys], (counts['response_ns'] or {}).get('max'))
        for sink, counts in dag['sinks'].items()}) for name, dag in dags.items()}


def test_a_result_that_never_comes_is_a_miss_at_its_deadline(make_executor, make_node, capfd):
    misses = []
    once = Once(make_node, lambda: None, lambda: None)
    executor = make_executor(loads(ONCE), on_deadline_miss=misses.append, nodes=once.nodes)
    with Spinning(executor):
        once.go()
        assert wait_for(lambda: misses)
        assert wait_for(lambda: '1 deadline missed: /sink:end, 20 ms, job 0 of once'
                        in capfd.readouterr().err)
        statistics = executor.statistics()
    miss, = misses
    assert (miss.kind, miss.vertex, miss.job, miss.completed_ns) == (
        'overdue', '/sink:end', 0, None)
    assert miss.deadline_ns - miss.release_ns == 20_000_000
    sink = statistics['dags']['once']['sinks']['/sink:end']
    assert (sink['late'], sink['overdue'], sink['completed']) == (1, 1, 0)
    assert statistics['first_miss'] == {
        'dag': 'once', 'vertex': '/sink:end', 'job': 0, 'deadline_ns': miss.deadline_ns,
        'completed_ns': None}


def test_a_callback_that_hangs_is_a_miss_once(make_executor, make_node, tmp_path):
    """Known while it hangs, to all who ask; what comes of it later is its verdict."""
    misses = []
    go_on = threading.Event()
    once = Once(make_node, lambda: once.publisher.publish(Header()), lambda: go_on.wait(60.0))
    reported = []

    def diagnosed(message):
        for status in message.status:
            if status.name == 'mddag: once':
                reported.append({each.key: each.value for each in status.values})

    once.nodes[0].create_subscription(
        DiagnosticArray, '/diagnostics', diagnosed, 10, callback_group=once.group)
    trace = str(tmp_path / 'run.mcap')
    executor = make_executor(
        loads(ONCE), on_deadline_miss=misses.append, trace=trace, diagnostics_period='50ms',
        nodes=once.nodes)
    with Spinning(executor):
        once.go()
        assert wait_for(lambda: misses)
        assert wait_for(lambda: reported and (reported[-1]['missed'], reported[-1]['late']) == (
            '1', '1')), reported[-1:]
        go_on.set()
        assert wait_for(lambda: executor.statistics()['dags']['once']['ends']['late'] == 1)
    assert [miss.kind for miss in misses] == ['overdue']
    dags = executor.statistics()['dags']
    sink = dags['once']['sinks']['/sink:end']
    assert (sink['late'], sink['overdue'], sink['completed']) == (1, 0, 1)
    assert judged(replay(trace).result()['dags']) == judged(dags)


MANY = """
mddag: 1
nodes:
  - node: /many
    callbacks:
      - {name: tick, timer: 5ms, publishes: [/many], dag: many}
      - {name: soon, subscription: /many, deadline: 4ms}
      - {name: later, subscription: /many, deadline: 6ms}
"""


def test_what_was_reported_is_what_a_replay_judges(make_executor, make_node, tmp_path):
    """Callbacks end just before and after their deadlines."""
    generator = random.Random(1)
    misses = []
    nodes = Declared(make_node, MANY, dict.fromkeys(
        ('soon', 'later'), lambda: time.sleep(generator.uniform(0.0, 0.008))))
    trace = str(tmp_path / 'run.mcap')
    executor = make_executor(loads(MANY), on_deadline_miss=misses.append, trace=trace)
    with Spinning(executor):
        nodes.start(executor)
        assert wait_for(lambda: executor.statistics()['dags']['many']['jobs'] >= 200)
    statistics = executor.statistics()
    reported = [(miss.vertex, miss.job) for miss in misses]
    assert len(set(reported)) == len(reported) == total(statistics['dags']).missed > 20
    names = ['/many:tick', '/many:soon', '/many:later']
    assert sorted(reported) == sorted(
        (names[event['vertex']], event['job']) for event in read_events(trace)
        if event['_name'] == 'mddag:deadline')
    replayed = replay(trace)
    assert replayed.warnings == []
    assert judged(replayed.result()['dags']) == judged(statistics['dags'])
