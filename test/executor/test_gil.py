# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Callbacks that hold the GIL: one at a time, most urgent first, and never a deadlock."""

import sys
import threading
import time

from mddag_executor.executor import publishing
import msg_graph
import pytest
from rclpy.callback_groups import ReentrantCallbackGroup
from std_msgs.msg import Header

from .conftest import Spinning, wait_for
from .declared import Declared

MS = 1_000_000


def compute(ms):
    """Take so much CPU, in Python."""
    end = time.thread_time_ns() + int(ms * MS)
    while time.thread_time_ns() < end:
        pass


@pytest.mark.parametrize('holds, most', [('true', 1), ('false', 4)])
def test_as_many_run_at_once_as_the_declaration_says(make_executor, make_node, holds, most):
    node, gate = make_node('publishes'), threading.Barrier(most)
    running, at_once = list[int](), list[int]()

    def body():
        running.append(1)
        at_once.append(len(running))
        gate.wait(20.0)  # passes only when so many are there
        compute(5)
        running.pop()

    text = 'mddag: 1\nnodes:\n  - node: /node\n    callbacks:\n' + ''.join(
        f'      - {{name: {name}, subscription: /{name}, dag: {name}, period: 100ms, '
        f'deadline: 50ms, holds_interpreter: {holds}}}\n' for name in 'abcd')
    nodes = Declared(make_node, text, dict.fromkeys('abcd', body))
    publishers = [node.create_publisher(Header, f'/{name}', 10) for name in 'abcd']
    executor = make_executor(msg_graph.loads(text), nodes=nodes.nodes.values())
    with Spinning(executor):
        assert wait_for(lambda: all(each.get_subscription_count() for each in publishers))
        for publisher in publishers:
            publisher.publish(Header())
        assert wait_for(lambda: len(at_once) == 4 and not running, 20.0)
    assert max(at_once) == most


def test_a_long_callback_does_not_hold_up_a_more_urgent_one(make_executor, make_node):
    """
    A camera computes until the 1 kHz callback has run thrice meanwhile, so it must let it.

    Its deadline is far: once it were late it would be the more urgent one.
    """
    node, ticks, seen = make_node(), [], []
    group = ReentrantCallbackGroup()
    node.create_timer(0.001, lambda: ticks.append(None), callback_group=group)

    def capture():
        before, end = len(ticks), time.monotonic() + 50.0
        while len(ticks) < before + 3 and len(seen) < 3 and time.monotonic() < end:  # computes
            pass
        seen.append(len(ticks) - before)

    node.create_timer(0.1, capture, callback_group=group)
    executor = make_executor(msg_graph.loads(
        'mddag: 1\nnodes:\n  - node: /node\n    callbacks:\n'
        '      - {name: step, timer: 1ms, dag: step, deadline: 1ms, holds_interpreter: true}\n'
        '      - {name: capture, timer: 100ms, dag: camera, deadline: 60s, '
        'holds_interpreter: true}\n',
        'g.yaml'), nodes=[node])
    with Spinning(executor):
        assert wait_for(lambda: len(seen) >= 3, 160.0)
    assert min(seen[:3]) >= 3


def test_who_computes_is_learnt_and_shown(make_executor, make_node):
    node, ran = make_node(), []
    node.create_timer(0.01, lambda: (compute(3), ran.append('computes')))
    node.create_timer(0.011, lambda: (time.sleep(0.003), ran.append('sleeps')),
                      callback_group=ReentrantCallbackGroup())
    executor = make_executor(nodes=[node])

    def found():
        return {name: (count['holds_interpreter'], count['interpreter_share'])
                for name, count in executor.statistics()['callbacks'].items()
                if count['kind'] == 'timer'}

    with Spinning(executor):
        assert wait_for(lambda: [holds for holds, _ in found().values()] == [True, False], 20.0)
        ran.clear()
        assert wait_for(lambda: ran.count('sleeps') > 10 and ran.count('computes') > 10, 20.0)
        (_, computing), (_, sleeping) = found().values()
    # on a busy machine it is not known how much it would have computed without the others
    assert computing is None or computing > 0.5
    assert sleeping is None or sleeping < 0.5


def test_what_a_callback_needs_when_nothing_disturbs_it(make_executor, make_node):
    node, bell, ran = make_node(), threading.Event(), []
    group = ReentrantCallbackGroup()

    def lends():
        with executor.lend():
            bell.wait(0.02)
        ran.append('d')

    for name, body in zip('abcd', (
            lambda: time.sleep(0.02), lambda: compute(20), lambda: None, lends)):
        node.create_timer(0.1, lambda name=name, body=body: (body(), ran.append(name)), group)
    executor = make_executor(msg_graph.loads('mddag: 1\nnodes:\n  - node: /node\n    callbacks:\n'
        + ''.join(f'      - {{name: {name}, timer: 100ms, dag: {name}, deadline: 1s}}\n'
                  for name in 'abcd'), 'g.yaml'), nodes=[node])
    with Spinning(executor):
        assert wait_for(lambda: all(ran.count(name) > 12 for name in 'abcd'), 30.0)
    sleeps, computes, empty, lent = executor._engine.scheduler.state.mean[:4]
    assert sleeps >= 20 * MS and computes >= 20 * MS
    assert empty < 20 * MS and lent < 20 * MS


def test_the_switch_interval_is_given_back(make_executor, make_node):
    node, seen = make_node(), []
    node.create_timer(0.001, lambda: seen.append(sys.getswitchinterval()))
    executor = make_executor(nodes=[node])
    before = sys.getswitchinterval()
    with Spinning(executor):
        assert wait_for(lambda: seen)
    assert seen[0] == pytest.approx(0.001) and sys.getswitchinterval() == before


# --- what arrives next to a callback that computes for long --------------------------------------

COMPUTING = """
mddag: 1
nodes:
  - node: /node
    callbacks:
      - {name: long, subscription: /long, dag: long, period: 1s, deadline: 60s,
         holds_interpreter: true}
      - {name: urgent, subscription: /urgent, dag: urgent, period: 1s, deadline: 10ms,
         holds_interpreter: true}
      - {name: patient, subscription: /patient, dag: patient, period: 1s, deadline: 120s,
         holds_interpreter: true}
"""


class Computing:
    """
    Three callbacks, one of which computes for long.

    :ivar ran: what has happened, in order.
    :ivar meanwhile: called, while the long one computes, until it returns true.
    """

    def __init__(self, make_executor, make_node):
        self.ran = []
        self.begun = threading.Event()
        self.meanwhile = lambda: True
        nodes = Declared(make_node, COMPUTING, {
            'long': self._long, 'urgent': lambda: self.ran.append('urgent'),
            'patient': lambda: self.ran.append('patient')})
        self.executor = make_executor(
            msg_graph.loads(COMPUTING, 'g.yaml'), nodes=nodes.nodes.values())
        other = make_node('publishes')
        self.publishers = {
            name: other.create_publisher(Header, f'/{name}', 10) for name in nodes.ran}
        assert wait_for(lambda: all(
            p.get_subscription_count() == 1 for p in self.publishers.values()))

    def publish(self, name):
        self.publishers[name].publish(Header())

    @property
    def habit(self):
        """Return what is known about how long the long one takes."""
        return next(each.habit for each in self.executor._registry.by_id.values()
                    if each.callback is not None and each.callback.name == 'long')

    def _long(self):
        self.ran.append('begins')
        self.begun.set()
        compute(60)
        end = time.monotonic() + 15.0
        while not self.meanwhile() and time.monotonic() < end:
            compute(1)
        self.ran.append('ends')

    def order(self, *names):
        """Publish some while the long one computes; return the order of all."""
        self.ran.clear()
        self.begun.clear()
        self.publish('long')
        assert self.begun.wait(15.0)
        for name in names:
            self.publish(name)
        assert wait_for(lambda: len(self.ran) == 2 + len(names)), self.ran
        return self.ran.copy()


@pytest.fixture(params=['here', 'elsewhere'])
def computing(request, make_executor, make_node, monkeypatch):
    """Give these callbacks; messages come from threads of this process, or as from elsewhere."""
    if request.param == 'elsewhere':
        monkeypatch.setattr(publishing, 'replace_delivery', lambda *args: None)
    found = Computing(make_executor, make_node)
    with Spinning(found.executor):
        for name in found.publishers:  # so it is known how long each takes
            found.publish(name)
        assert wait_for(lambda: len(found.ran) == 4), found.ran
        yield found


def test_it_does_so_at_once(computing):
    """The long one does not wait for it, however long it usually takes."""
    computing.meanwhile = lambda: 'urgent' in computing.ran
    computing.habit.mean_ns = 20_000 * MS
    assert computing.order('urgent') == ['begins', 'urgent', 'ends']


def test_an_arrival_with_a_later_deadline_is_collected_after_a_long_callback(computing):
    """
    Its callback never begins before the long one has ended.

    As no thread is woken for it, it may only be taken then; so it must not be overlooked.
    """
    for _ in range(3):
        assert computing.order('patient') == ['begins', 'ends', 'patient']
    assert computing.executor.statistics()['dropped'] == {}


def test_of_two_arrivals_during_a_long_callback_one_overtakes(computing):
    computing.meanwhile = lambda: 'urgent' in computing.ran
    for names in (('patient', 'urgent'), ('urgent', 'patient')):
        assert computing.order(*names) == ['begins', 'urgent', 'ends', 'patient']


@pytest.mark.parametrize('computing', ['elsewhere'], indirect=True)
def test_an_urgent_arrival_is_not_left_in_the_middleware(computing):
    for _ in range(20):  # on a busy machine it may be late
        computing.habit.mean_ns = 50 * MS
        order = computing.order('urgent')
        if order[-1] == 'ends':
            break
    assert order == ['begins', 'urgent', 'ends']


@pytest.mark.parametrize('computing', ['elsewhere'], indirect=True)
def test_what_cannot_start_is_left_in_the_middleware(computing):
    """While the long one computes for as long as usual, no thread wakes for the patient one."""
    queued = []

    def meanwhile():
        queued.append(computing.executor.statistics()['queue'])
        return True

    computing.meanwhile = meanwhile
    for _ in range(20):  # on a busy machine it may take longer than usual
        computing.habit.mean_ns = 50 * MS
        assert computing.order('patient') == ['begins', 'ends', 'patient']
        if queued[-1] == 0:
            break
    assert queued[-1] == 0
