# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Callbacks that hold the GIL: one at a time, most urgent first, and never a deadlock."""

from functools import partial
import hashlib
import os
import random
import sys
import threading
import time
from types import SimpleNamespace

from mddag_executor.executor import lending as lending_module
from mddag_executor.executor import pausing, publishing
from mddag_executor.executor.compat import function_of_task
from mddag_executor.executor.gil import GilHabit
from mddag_executor.executor.pausing import can_pause
from mddag_executor.executor.work import current, Work
from msg_graph import loads
import pytest
from rclpy.action import ActionServer
from rclpy.callback_groups import ReentrantCallbackGroup
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from .conftest import is_idle, matched, shown, Spinning, wait_for
from .declared import Declared, graph
from .inside import engine_of, functions_of_tasks, pool_of, registry_of, replace_method

MS = 1_000_000


def compute(ms):
    """Take so much CPU, in Python."""
    end = time.thread_time_ns() + int(ms * MS)
    while time.thread_time_ns() < end:
        pass


def declare(*callbacks):
    """Declare callbacks of one node: name, and keys in YAML."""
    return graph(node='\n'.join(f'name: {name}, dag: {name}, {keys}' for name, keys in callbacks))


@shown
@pytest.mark.parametrize('holds, most', [('true', 1), ('false', 4)])
def test_as_many_run_at_once_as_the_declaration_says(make_executor, make_node, holds, most):
    """And the interpreter switches between them sooner, as long as the executor spins."""
    gate = threading.Barrier(most)
    running, at_once, intervals = [], [], set()

    def body():
        running.append(1)
        at_once.append(len(running))
        gate.wait(20.0)  # passes only when all parties are there
        compute(5)
        intervals.add(sys.getswitchinterval())
        running.pop()

    text = declare(*((
        name, f'subscription: /{name}, period: 100s, deadline: 50s, holds_interpreter: {holds}')
        for name in 'abcd'))
    nodes = Declared(make_node, text, dict.fromkeys('abcd', body))
    publishers = [make_node('p').create_publisher(Header, f'/{name}', 10) for name in 'abcd']
    before = sys.getswitchinterval()
    with Spinning(make_executor(loads(text), nodes=nodes.nodes.values())):
        matched(*publishers)
        for publisher in publishers:
            publisher.publish(Header())
        assert wait_for(lambda: len(at_once) == 4 and not running, 20.0)
    assert max(at_once) == most
    assert [*intervals] == [pytest.approx(0.001)] and sys.getswitchinterval() == before


def test_what_is_learnt_of_callbacks(make_executor, make_node):
    """Who computes, and what each needs when nothing disturbs it."""
    node, bell, ran = make_node(), threading.Event(), []
    group = ReentrantCallbackGroup()

    def lends():
        compute(6)
        with executor.lend():
            bell.wait(0.02)
        ran.append('d')

    for name, body in zip('abcd', (
            lambda: time.sleep(0.02), lambda: compute(20), lambda: None, lends)):
        node.create_timer(0.1, lambda name=name, body=body: (body(), ran.append(name)), group)
    executor = make_executor(loads(declare(*(
        (name, 'timer: 100ms, deadline: 1s') for name in 'abcd'))), nodes=[node])

    def found(key):
        counts = executor.statistics()['callbacks']
        return [counts.get(f'/node:{name}', {}).get(key) for name in 'ab']

    with Spinning(executor):
        assert wait_for(lambda: all(ran.count(name) > 12 for name in 'abcd'), 30.0)
        assert wait_for(lambda: found('holds_interpreter') == [False, True], 20.0)
        sleeping, computing = found('interpreter_share')
    sleeps, computes, empty, lent = engine_of(executor).scheduler.state.mean[:4]
    # without the time in which it paused for a more urgent one, and checked that
    assert sleeps >= 20 * MS and computes >= 10 * MS
    assert empty < 20 * MS and 3 * MS < lent < 20 * MS
    # on a busy machine it is not known how much it would have computed without the others
    assert computing is None or computing > 0.5
    assert sleeping is None or sleeping < 0.5


def test_a_trial_of_a_callback_is_measured_exactly():
    """Else it is inconclusive on a busy machine, as those before it were that led to it."""
    habit = GilHabit()
    for _ in range(10):
        habit.took(1 * MS, 20 * MS)
        habit.learn(20 * MS, 1 * MS, 0)
    assert habit.is_known and not habit.computes and not habit.is_doubtful
    while not habit.holds:  # until there is a trial
        habit.took(9 * MS, 20 * MS)
        habit.learn(20 * MS, 9 * MS, 4 * MS)
        assert habit.is_doubtful
    habit.took(1 * MS, 20 * MS)
    habit.learn(20 * MS, 1 * MS, 0)
    assert not (habit.holds or habit.is_doubtful)


# --- what arrives next to a callback that computes for long --------------------------------------

COMPUTING = declare(*(
    (name, f'subscription: /{name}, period: 1s, deadline: {deadline}, holds_interpreter: true')
    for name, deadline in (('long', '60s'), ('urgent', '10ms'), ('patient', '120s'))))


class Computing:
    """
    Three callbacks, one of which computes for long.

    :ivar ran: what has happened, in order.
    :ivar meanwhile: called, while the long one computes, until it returns true.
    :ivar urgent: called by the urgent one.
    :ivar takes: for how many ms the long one computes before that.
    """

    def __init__(self, make_executor, make_node):
        self.ran = []
        self.begun = threading.Event()
        self.meanwhile = lambda: True
        self.urgent = lambda: None
        self.takes = 60
        nodes = Declared(make_node, COMPUTING, {
            'long': self._long, 'urgent': lambda: (self.urgent(), self.ran.append('urgent')),
            'patient': lambda: self.ran.append('patient')})
        # messages for callbacks with longer deadlines may stay in the middleware
        self.executor = make_executor(
            loads(COMPUTING), nodes=nodes.nodes.values(), default_deadline='60s')
        other = make_node('publishes')
        self.publishers = {
            name: other.create_publisher(Header, f'/{name}', 10) for name in nodes.ran}
        matched(*self.publishers.values())

    def publish(self, name):
        self.publishers[name].publish(Header())

    @property
    def habit(self):
        """Return what is known about how long the long one takes."""
        return next(each.habit for each in registry_of(self.executor).by_id.values()
                    if each.callback is not None and each.callback.name == 'long')

    def _long(self):
        self.ran.append('begins')
        self.begun.set()
        compute(self.takes)
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


@shown
def test_arrivals_with_an_earlier_deadline_overtake_and_others_wait(computing):
    """
    The long one does not wait for an urgent one, however long it usually takes.

    A patient one never begins before the long one has ended. As no thread is woken for it, it may
    only be taken then; so it must not be overlooked.
    """
    for _ in range(3):
        assert computing.order('patient') == ['begins', 'ends', 'patient']
    computing.meanwhile = lambda: 'urgent' in computing.ran
    for names in (('patient', 'urgent'), ('urgent', 'patient')):
        assert computing.order(*names) == ['begins', 'urgent', 'ends', 'patient']
    computing.habit.mean_ns = 20_000 * MS
    assert computing.order('urgent') == ['begins', 'urgent', 'ends']
    assert computing.executor.statistics()['dropped'] == {}


@pytest.mark.parametrize('computing', ['elsewhere'], indirect=True)
def test_no_thread_waits_for_events_while_a_callback_computes(computing):
    waiting = []
    computing.meanwhile = lambda: waiting.append(pool_of(computing.executor).polling) or (
        len(waiting) > 20)
    assert computing.order('patient') == ['begins', 'ends', 'patient']
    assert not any(waiting)


@shown
def test_no_thread_looks_all_the_time_because_something_less_urgent_waits(computing, monkeypatch):
    """Nothing may overtake then, though the callback takes longer than usual."""
    pool, looks, steps = pool_of(computing.executor), [], [time.monotonic()]
    look = pool._look
    replace_method(monkeypatch, pool, '_look', lambda: (looks.append(1), look()))

    def meanwhile():
        steps.append(time.monotonic())
        return len(steps) > 200

    computing.meanwhile = meanwhile
    computing.habit.mean_ns = 5 * MS
    assert computing.order('patient') == ['begins', 'ends', 'patient']
    # at most one a millisecond; if they are set to times that are over, it is four
    assert len(looks) < 30 + (steps[-1] - steps[0]) / 0.0006


def test_a_new_timer_is_noticed_while_a_callback_computes(make_executor, make_node):
    """Though no thread waits for events, and nothing else may come that is urgent."""
    ran, ends = [], []

    def long():
        node.create_timer(0.01, lambda: ran.append(1), ReentrantCallbackGroup())
        end = time.monotonic() + 15.0
        while not ran and time.monotonic() < end:
            compute(1)
        ends.append(len(ran))

    text = graph(node="""
        name: long, subscription: /long, period: 1s, deadline: 60s, holds_interpreter: true
        name: urgent, timer: 10ms, deadline: 10ms""")
    node = make_node()
    node.create_subscription(
        Header, '/long', lambda message: long(), 10, callback_group=ReentrantCallbackGroup())
    publisher = make_node('publishes').create_publisher(Header, '/long', 10)
    with Spinning(make_executor(loads(text), nodes=[node], default_deadline='60s')):
        matched(publisher)
        publisher.publish(Header())
        assert wait_for(lambda: ends, 20.0)
    assert ends[0]


def test_what_a_thread_asks_for_starts_though_a_callback_that_usually_computes_waits(
        make_executor, make_node):
    """A parked thread checks that callback: nothing else would wake one."""
    node, begun, done = make_node(), threading.Event(), threading.Event()
    waits = []

    def callback():
        if waits:
            begun.set()
            waits.append(done.wait(20.0))

    def task():
        done.set()

    guard = node.create_guard_condition(callback)
    executor = make_executor(num_workers=2, nodes=[node], default_deadline='1000s')
    with Spinning(executor):
        assert wait_for(executor.create_task(task).done)
        done.clear()
        guard.trigger()
        assert wait_for(lambda: any(each.ran for each in registry_of(executor).by_id.values()))
        for entity in (*functions_of_tasks(executor), *registry_of(executor).by_id.values()):
            entity.habit, entity.wall_ns = GilHabit(True), 100 * MS
        waits.append(None)
        guard.trigger()
        assert begun.wait(20.0)
        executor.create_task(task)
        assert wait_for(lambda: len(waits) == 2, 25.0)
    assert waits[1]


def test_what_has_come_meanwhile_is_known_before_the_next_one_is_chosen(
        make_executor, make_node, monkeypatch):
    """Though no thread waits for events, and messages of other processes are in their sockets."""
    monkeypatch.setattr(publishing, 'replace_delivery', lambda *args: None)
    ran, begun, go_on = [], [threading.Event() for _ in 'ab'], [threading.Event() for _ in 'ab']

    def wait(number):
        ran.append('ab'[number])
        begun[number].set()
        assert go_on[number].wait(15.0)
        time.sleep(0.002)   # so it is not short

    text = declare(*((name, f'subscription: /{name}, period: 1s, deadline: {deadline}')
                     for name, deadline in zip('abcd', ('1s', '10s', '50s', '1s'))))
    nodes = Declared(make_node, text, {
        'a': partial(wait, 0), 'b': partial(wait, 1),
        'c': lambda: ran.append('patient'), 'd': lambda: ran.append('urgent')})
    other = make_node('publishes')
    publishers = [other.create_publisher(Header, f'/{name}', 10) for name in 'abcd']
    with Spinning(make_executor(loads(text), num_workers=1, nodes=nodes.nodes.values())):
        matched(*publishers)
        publishers[0].publish(Header())
        assert begun[0].wait(15.0)
        for publisher in publishers[1:3]:
            publisher.publish(Header())
        go_on[0].set()
        assert begun[1].wait(15.0)
        publishers[3].publish(Header())
        go_on[1].set()
        assert wait_for(lambda: len(ran) == 4)
    assert ran == ['a', 'b', 'urgent', 'patient']


def test_a_callback_that_waits_starts_at_once_while_another_one_computes(
        make_executor, make_node, monkeypatch):
    """A thread waits for its messages then, though nothing that comes is urgent."""
    monkeypatch.setattr(publishing, 'replace_delivery', lambda *args: None)
    ran, begun = [], threading.Event()

    def long():
        begun.set()
        end = time.monotonic() + 15.0
        while 'waits' not in ran and time.monotonic() < end:
            compute(1)
        ran.append('long')

    text = declare(*(
        (name, f'subscription: /{name}, period: 1s, deadline: 1000s{holds}')
        for name, holds in (('long', ', holds_interpreter: true'), ('waits', ''))))
    nodes = Declared(make_node, text, {
        'long': long, 'waits': lambda: (time.sleep(0.01), ran.append('waits'))})
    publishers = [make_node('p').create_publisher(Header, topic, 10)
                  for topic in ('/long', '/waits')]
    executor = make_executor(
        loads(text), nodes=nodes.nodes.values(), default_deadline='1000s')
    with Spinning(executor):
        matched(*publishers)
        for entity in registry_of(executor).by_id.values():
            if entity.topic == '/waits':
                entity.habit = GilHabit(False)  # as if it had been learnt
        for count, publisher in enumerate(reversed(publishers), 1):
            publisher.publish(Header())     # so it is known how long each takes
            assert wait_for(lambda n=count: len(ran) == n and is_idle(executor))
        for entity in registry_of(executor).by_id.values():
            entity.wall_ns = 100 * MS
        ran.clear()
        begun.clear()
        publishers[0].publish(Header())
        assert begun.wait(15.0)
        publishers[1].publish(Header())
        assert wait_for(lambda: len(ran) == 2, 20.0)
    assert ran == ['waits', 'long']


@pytest.mark.skipif(not can_pause(), reason='this Python has no sys.monitoring')
def test_a_callback_pauses_while_a_more_urgent_one_computes(computing):
    steps, still, paused = [0], [], []

    def step():
        steps[0] += 1
        paused.append(current.running.work.paused_ns)
        return 'urgent' in computing.ran

    def urgent():
        """Compute until the other one has made no step for 20 ms; it has if they share."""
        end = time.monotonic() + 15.0
        while not still and time.monotonic() < end:
            before = steps[0]
            compute(20)
            if steps[0] == before:
                still.append(before)

    computing.meanwhile, computing.urgent, computing.takes = step, urgent, 0
    assert computing.order('urgent') == ['begins', 'urgent', 'ends']
    assert still and steps[0] > still[0]  # it went on then
    assert paused[0] == 0 and paused[-1] >= 20 * MS  # it does not count as holding the GIL


@pytest.mark.skipif(not can_pause(), reason='this Python has no sys.monitoring')
def test_a_callback_pauses_no_longer_when_the_more_urgent_one_waits_for_a_response(
        computing, monkeypatch):
    """At once: it does not have to find that out itself."""
    monkeypatch.setattr(pausing, 'CHECK_S', 3600.0)
    steps, has_gone_on = [0], []

    def step():
        steps[0] += 1
        return 'urgent' in computing.ran

    def urgent():
        before, end = -1, time.monotonic() + 15.0
        while before != steps[0] and time.monotonic() < end:    # until it pauses
            before = steps[0]
            compute(20)
        with computing.executor.lend():
            has_gone_on.append(wait_for(lambda: steps[0] > before))

    computing.meanwhile, computing.urgent, computing.takes = step, urgent, 0
    assert computing.order('urgent') == ['begins', 'urgent', 'ends']
    assert has_gone_on == [True]


@pytest.mark.parametrize('is_held_by', ['user', 'library'])
def test_a_callback_that_owns_a_lock_does_not_pause_for_ever(computing, is_held_by):
    lock = threading.Lock()

    def meanwhile():
        with lock:
            if is_held_by == 'user':
                compute(1)
            else:
                sorted(range(100), key=lambda _: compute(0.01) or 0)
        return 'urgent' in computing.ran

    def urgent():
        for _ in range(20):
            with lock:
                compute(0.1)

    computing.meanwhile, computing.urgent, computing.takes = meanwhile, urgent, 0
    for _ in range(3):
        assert computing.order('urgent') == ['begins', 'urgent', 'ends']


def test_a_callback_that_owns_a_lock_goes_on_for_one_that_polls_for_it(computing):
    """To poll takes CPU time, but not so much as to compute."""
    lock, tries, got = threading.Lock(), threading.Event(), []

    def meanwhile():
        with lock:
            while not tries.is_set():
                compute(1)
        return 'urgent' in computing.ran

    def urgent():
        tries.set()
        end = time.monotonic() + 10.0
        while not got and time.monotonic() < end:
            if lock.acquire(timeout=0.001):
                got.append(1)
                lock.release()

    computing.meanwhile, computing.urgent, computing.takes = meanwhile, urgent, 0
    assert computing.order('urgent') == ['begins', 'urgent', 'ends']
    assert got


def code_of(path):
    """Return new code in a file: equal to other new code of the same file."""
    found = {}
    exec(compile('import sys\ndef function():\n    return sys._getframe()\n', path, 'exec'), found)
    return found['function']


@pytest.mark.skipif(not can_pause(), reason='this Python has no sys.monitoring')
def test_equal_code_is_told_apart():
    """Each is instrumented while a pause needs it, and not after that."""
    monitor, several = pausing._monitor, [code_of('/tmp/user.py').__code__ for _ in range(2)]
    pauses = [SimpleNamespace(ident=-1 - i) for i in range(2)]
    assert several[0] == several[1]

    def events():
        return [bool(sys.monitoring.get_local_events(monitor._tool, code)) for code in several]

    for pause, code in zip(pauses, several):
        monitor.begin(pause, [code])
    assert events() == [True, True]
    monitor.end(pauses[0], several[:1])
    assert events() == [False, True]
    monitor.end(pauses[1], several[1:])
    assert events() == [False, False] and not monitor._users


@pytest.mark.parametrize('suffix, may_pause', [('', False), ('_message_converter', True)])
def test_callbacks_pause_in_packages_whose_names_begin_like_those_kept_out(suffix, may_pause):
    for package in pausing._KEPT_OUT:
        function = code_of(os.path.join(package.rstrip(os.sep) + suffix, 'module.py'))
        assert (function.__code__ in pausing._own_code(function())) is may_pause


class PausedHere:
    """The calling thread as one that is to pause; the pool raises an interrupt meanwhile."""

    def __init__(self, is_inside):
        self.calls = []
        self.ident, self.paused_ns = threading.get_ident(), 0
        self.pool = self.pauses = self
        self.measurement = SimpleNamespace(
            pause=partial(self.calls.append, 'pause'), resume=partial(self.calls.append, 'resume'))
        self.is_inside = lambda: is_inside

    def check(self, _):
        raise KeyboardInterrupt


@pytest.mark.skipif(not can_pause(), reason='this Python has no sys.monitoring')
def test_an_interrupted_pause_ends():
    thread = PausedHere(is_inside=False)
    kept = []
    with pytest.raises(KeyboardInterrupt):  # in one line: else it would pause at the next one
        (kept.append(pausing.Pause(thread)), kept[0].pause_here())
    kept[0].pause_here()    # in a handler of a signal, for instance
    assert thread.calls == ['pause', 'resume'] and thread.paused_ns > 0


@pytest.mark.skipif(not can_pause(), reason='this Python has no sys.monitoring')
def test_a_thread_that_owns_the_lock_of_the_engine_does_not_pause():
    """The finalizers of a user's objects may run there."""
    thread = PausedHere(is_inside=True)
    pause = pausing.Pause(thread)
    pause.pause_here()
    pause.end()
    assert thread.calls == []


class Overtaken:
    """A pool with executions that were overtaken; ``calls`` has what is done to them."""

    def __init__(self, overtaken):
        self.calls, self.lock, self.offset, self.now = [], threading.Lock(), 0, 7
        self.thread_of = lambda work: SimpleNamespace(ident=0, vtid=0)
        self.tick = lambda: self.now
        self.engine = SimpleNamespace(
            interpreter=SimpleNamespace(holder='urgent', overtaken=overtaken),
            stop_holding=lambda work: self.calls.append(f'{work} gives way'))
        self.pauses = pausing.Pauses(self)
        for name in ('first', 'second'):
            self.pauses.paused[Work(None, print)] = SimpleNamespace(
                since=3, end=partial(self.calls.append, f'{name} goes on'))

    def wake_for_more(self):
        self.calls.append('another thread is woken')


def test_those_that_are_still_overtaken_stay_paused():
    pool = Overtaken([])
    first, second = pool.pauses.paused
    pool.engine.interpreter.overtaken.append(first)
    pool.pauses.end()
    assert pool.calls == ['second goes on'] and [*pool.pauses.paused] == [first]
    assert (first.paused_ns, second.paused_ns) == (0, 4)


def test_others_may_start_as_well_when_the_urgent_one_waits_for_a_paused_one():
    pool = Overtaken([])
    pool.pauses.check(SimpleNamespace(subject='urgent', waits=lambda *_: True))
    assert pool.calls == [
        'urgent gives way', 'first goes on', 'second goes on', 'another thread is woken']


def test_a_paused_callback_checks_the_one_that_is_the_most_urgent_now():
    """Not that of before, whose times are others."""
    pool = Overtaken([])
    pool.pauses.check(SimpleNamespace(
        subject='earlier', begin=lambda *args: pool.calls.append(args[:2]),
        waits=lambda *_: False))
    assert pool.calls == [('urgent', 7)]


# --- callbacks that lend their workers, and go on ------------------------------------------------

class Lending:
    """
    A callback that lends its worker until ``bell`` is set, and others that run until ``leave`` is.

    :ivar ran: the names of those that have begun, and what the lending one does after that.
    :ivar then: called when it goes on.
    """

    def then(self):
        """Do nothing more."""

    def __init__(self, make_executor, make_node, workers, **callbacks):
        self.ran = []
        self.bell, self.leave = threading.Event(), threading.Event()
        text = declare(*((
            name, f'subscription: /{name}, period: 1s, deadline: {deadline}, '
            'holds_interpreter: true') for name, deadline in callbacks.items()))
        nodes = Declared(make_node, text, {name: partial(self._run, name) for name in callbacks})
        self.executor = make_executor(
            loads(text), num_workers=workers, nodes=nodes.nodes.values())
        other = make_node('publishes')
        self._publishers = {
            name: other.create_publisher(Header, f'/{name}', 10) for name in callbacks}
        matched(*self._publishers.values())

    def start(self, name):
        """Let a callback begin."""
        self._publishers[name].publish(Header())
        assert wait_for(lambda: name in self.ran), self.ran

    def wait_in_queue(self, *names):
        """Let some become ready, after what waits."""
        before = self.executor.statistics()['queue']
        for name in names:
            self._publishers[name].publish(Header())
        assert wait_for(lambda: self.executor.statistics()['queue'] == before + len(names))

    def go_on(self):
        """Let the lending one go on, if it may."""
        before = self.executor.statistics()['queue']
        self.bell.set()
        assert wait_for(
            lambda: self.executor.statistics()['queue'] > before or 'goes on' in self.ran)

    def _run(self, name):
        self.ran.append(name)
        if name == 'lends':
            with self.executor.lend():
                assert self.bell.wait(15.0)
            self.ran.append('goes on')
            self.then()
            self.ran.append('ends')
        elif name == 'blocks':
            self.compute()
        elif 'waits' in name:
            assert self.leave.wait(15.0)

    def compute(self):
        """Compute until ``leave`` is set."""
        while not self.leave.is_set():
            compute(1)


@pytest.mark.parametrize('workers', [1, 7])
def test_a_callback_that_has_lent_its_worker_goes_on_in_order(make_executor, make_node, workers):
    """It needs a worker and the interpreter again: what is more urgent goes before it."""
    lending = Lending(
        make_executor, make_node, workers, lends='50s', blocks='40s', urgent='45s', patient='60s')
    with Spinning(lending.executor):
        lending.start('lends')
        lending.start('blocks')
        lending.go_on()
        lending.wait_in_queue('patient', 'urgent')
        assert lending.ran == ['lends', 'blocks']
        lending.leave.set()
        assert wait_for(lambda: len(lending.ran) == 6)
    assert lending.ran == ['lends', 'blocks', 'urgent', 'goes on', 'ends', 'patient']


def test_others_wait_for_a_callback_that_goes_on(make_executor, make_node):
    """It holds the interpreter as it did before."""
    lending = Lending(make_executor, make_node, 7, lends='50s', patient='60s')
    lending.then = lending.compute
    with Spinning(lending.executor):
        lending.start('lends')
        lending.go_on()
        assert wait_for(lambda: 'goes on' in lending.ran)
        lending.wait_in_queue('patient')
        lending.leave.set()
        assert wait_for(lambda: len(lending.ran) == 4)
    assert lending.ran == ['lends', 'goes on', 'ends', 'patient']


def test_a_callback_that_has_lent_its_worker_is_not_short(make_executor, make_node):
    """What waits need not wait for its end."""
    lending, is_short = Lending(make_executor, make_node, 2, lends='50s'), []

    def begins():
        current.running.work.entity.wall_ns = 0
        is_short.append(current.running.is_short())
        with lending.executor.lend():
            is_short.append(current.running.is_short())
        is_short.append(current.running.is_short())

    with Spinning(lending.executor):
        task = lending.executor.create_task(begins)
        assert wait_for(task.done)
    assert is_short == [True, False, True]


@pytest.mark.skipif(not can_pause(), reason='this Python has no sys.monitoring')
def test_a_callback_pauses_for_a_more_urgent_one_that_goes_on(make_executor, make_node):
    lending = Lending(make_executor, make_node, 7, lends='1s', blocks='60s')
    steps, still = [0], []

    def step():
        while not lending.leave.is_set():
            steps[0] += 1
            compute(1)

    def then():
        end = time.monotonic() + 10.0
        while not still and time.monotonic() < end:
            before = steps[0]
            compute(20)
            if steps[0] == before:
                still.append(before)
        lending.leave.set()

    lending.compute, lending.then = step, then
    with Spinning(lending.executor):
        lending.start('lends')
        lending.start('blocks')
        lending.go_on()
        assert wait_for(lambda: is_idle(lending.executor))
    assert still


@pytest.mark.skipif(not can_pause(), reason='this Python has no sys.monitoring')
def test_a_callback_that_goes_on_waits_until_the_less_urgent_one_pauses(
        make_executor, make_node, monkeypatch):
    """That one may be in C code, which computes without the GIL."""
    monkeypatch.setattr(pausing, 'PAUSES_BY_S', 20.0)
    lending = Lending(make_executor, make_node, 7, lends='1s', blocks='60s')
    in_c, found, data = [], [], bytes(50_000_000)

    def hash_data():
        while not lending.leave.is_set():   # it pauses at the beginning of a line only
            lending.last = (in_c.append(1), hashlib.sha256(data), in_c.clear())

    def then():
        found.append(in_c.copy())
        lending.leave.set()

    lending.compute, lending.then = hash_data, then
    with Spinning(lending.executor):
        lending.start('lends')
        lending.start('blocks')
        assert wait_for(lambda: in_c)
        lending.bell.set()
        assert wait_for(lambda: found and is_idle(lending.executor))
    assert found == [[]]


def test_a_callback_that_goes_on_at_once_wakes_no_other_thread(
        make_executor, make_node, monkeypatch):
    """Nothing else waits, so it gets its worker back itself."""
    executor, wakes = make_executor(num_workers=2), []
    pool = pool_of(executor)
    wake = pool.loop.wake

    def lends():
        with executor.lend():
            assert wait_for(lambda: pool.polling)
            monkeypatch.setattr(pool.loop, 'wake', lambda: (wakes.append(1), wake()))
        monkeypatch.setattr(pool.loop, 'wake', wake)

    with Spinning(executor):
        assert wait_for(executor.create_task(lends).done)
    assert not wakes


def test_a_callback_waits_for_its_worker_while_others_end(
        make_executor, make_node, monkeypatch):
    """Then they do not wait for it, even if each of them is found to wait."""
    monkeypatch.setattr(lending_module, 'REJOIN_NS', MS)
    lending = Lending(make_executor, make_node, 1, lends='50s', waits='40s')
    pool, checks = pool_of(lending.executor), []

    def all_wait(_):
        checks.append(list(lending.ran))
        if len(checks) < 20:
            pool.last_end += 1
        return True

    monkeypatch.setattr(pool.lending, '_all_wait', all_wait)
    with Spinning(lending.executor):
        lending.start('lends')
        lending.start('waits')
        lending.bell.set()
        assert wait_for(lambda: 'ends' in lending.ran)
        lending.leave.set()
    assert len(checks) > 20 and lending.ran == ['lends', 'waits', 'goes on', 'ends']


@shown
@pytest.mark.parametrize('is_async', [False, True])
def test_a_task_holds_the_gil_if_its_function_does(make_executor, make_node, is_async):
    """That is learnt of each function: tasks that wait do not change it."""
    lending, is_long = Lending(make_executor, make_node, 7, patient='120s'), threading.Event()
    executor = lending.executor

    def computes():
        compute(5)
        if is_long.is_set():
            lending.ran.append('task')
            lending.compute()

    async def computes_later():
        computes()

    function = computes_later if is_async else computes
    habit = executor._task_entities.of(function, ()).habit
    with Spinning(executor):
        for _ in range(200):
            tasks = executor.create_task(function), executor.create_task(time.sleep, 0.005)
            # they are measured after they are done
            assert wait_for(lambda tasks=tasks: all(task.done() for task in tasks)
                            and is_idle(executor))
            if habit.is_known and habit.holds:
                break
        is_long.set()
        executor.create_task(function)
        assert wait_for(lambda: lending.ran == ['task'])
        lending.wait_in_queue('patient')
        assert not wait_for(lambda: 'patient' in lending.ran, 0.1)  # nor soon
        lending.leave.set()
        assert wait_for(lambda: lending.ran == ['task', 'patient'])


def test_goals_of_an_action_are_told_apart_by_their_callback():
    """A server runs them all by one method of its own."""
    servers = [ActionServer._execute_goal.__get__(each) for each in (object(), object())]

    def one(goal):
        pass

    async def other(goal):
        pass

    found = [function_of_task(server, (callback, object()))
             for server in servers for callback in (one, partial(other), one)]
    assert found == [one.__code__, other.__code__, one.__code__] * 2
    assert function_of_task([].append, ()) != function_of_task([].remove, ())


@pytest.mark.parametrize('kernel', ['shows', 'hides'])
def test_workers_that_wait_for_a_callback_do_not_keep_it_waiting(
        make_executor, make_node, kernel, request):
    """It may own a lock: if all workers wait, it goes on without one, whatever else computes."""
    if kernel == 'hides':
        request.getfixturevalue('kernel_that_hides_threads')
    lending = Lending(make_executor, make_node, 2, lends='50s', waits='40s', other_waits='40s')
    lending.then = lending.leave.set
    of_program = threading.Thread(target=lending.compute)
    with Spinning(lending.executor):
        for name in ('lends', 'waits', 'other_waits'):
            lending.start(name)
        of_program.start()
        lending.bell.set()
        try:
            assert wait_for(lambda: is_idle(lending.executor))
        finally:
            lending.leave.set()
    of_program.join()
    assert lending.ran[3:] == ['goes on', 'ends']


def test_a_callback_that_has_lent_its_worker_ends_though_the_spin_does(
        spinning, make_executor, make_node):
    """It began in this spin, so it ends in it."""
    lending = Lending(make_executor, make_node, 1, lends='50s', blocks='40s')
    with spinning(lending.executor):
        lending.start('lends')
        lending.start('blocks')
        lending.go_on()
        threading.Timer(0.05, lending.leave.set).start()
    assert sorted(lending.ran) == ['blocks', 'ends', 'goes on', 'lends']


# --- at random -----------------------------------------------------------------------------------

NAMES = tuple('abcdef')
SEED = int(os.environ.get('FUZZ_SEED', '1'))
ROUNDS = int(os.environ.get('FUZZ_ROUNDS', '25'))
PATIENCE_S = 60.0


def scripts(seed):
    """Return what each does in a round; it waits only for those after it in the alphabet."""
    draw = random.Random(seed)
    found = {}
    for place, name in enumerate(NAMES):
        steps = [('set', place)]
        for _ in range(draw.randint(1, 4)):
            kind = draw.choice(('compute', 'sleep', 'call', 'wait', 'wait', 'lock'))
            if kind == 'wait' and place + 1 < len(NAMES):
                steps.append((kind, draw.randrange(place + 1, len(NAMES))))
            elif kind != 'wait':
                steps.append((kind, draw.choice((20, 300, 3000))))
        draw.shuffle(steps)
        found[name] = steps
    return found


def test_all_end_whatever_was_declared(make_executor, make_node):
    """
    They wait for one another, compute, sleep and call services, at random.

    They are declared to hold the interpreter, or not to, or nothing is said. FUZZ_ROUNDS is how
    many rounds are run, from FUZZ_SEED on.
    """
    draw = random.Random(SEED)
    text = declare(*((
        name, f'subscription: /{name}, period: 100ms, deadline: {draw.randint(5, 50)}ms'
        + draw.choice((', holds_interpreter: true', ', holds_interpreter: false', '')))
        for name in NAMES))
    other, group, lock = make_node('other'), ReentrantCallbackGroup(), threading.Lock()
    other.create_service(
        Trigger, '/serve', lambda request, response: response, callback_group=group)
    client = other.create_client(Trigger, '/serve', callback_group=group)
    publishers = {name: other.create_publisher(Header, f'/{name}', 10) for name in NAMES}
    done = {}

    def run(name):
        steps = []
        for kind, number in todo[name]:
            if kind == 'compute':
                compute(number / 1e3)
            elif kind == 'sleep':
                time.sleep(number / 1e6)
            elif kind == 'call':
                assert client.call(Trigger.Request()) is not None
            elif kind == 'wait':
                assert events[number].wait(PATIENCE_S)
            elif kind == 'lock':
                with lock:
                    time.sleep(number / 1e7)
            else:
                events[number].set()
            steps.append((kind, number))
        done[name] = steps

    nodes = Declared(make_node, text, {name: partial(run, name) for name in NAMES})
    with Spinning(make_executor(
            loads(text), num_workers=len(NAMES) + 1, nodes=[other, *nodes.nodes.values()])):
        matched(*publishers.values())
        assert client.wait_for_service(PATIENCE_S)
        for seed in range(SEED, SEED + ROUNDS):
            todo, events = scripts(seed), [threading.Event() for _ in NAMES]
            done.clear()
            for name in random.Random(seed).sample(NAMES, len(NAMES)):
                publishers[name].publish(Header())
            assert wait_for(lambda: len(done) == len(NAMES), PATIENCE_S), done
            assert done == todo
