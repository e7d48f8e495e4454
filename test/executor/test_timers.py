# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Timers whose due time changes while the executor waits, and what is due before it spins."""

import os
import select
import threading
import time
from types import SimpleNamespace

from builtin_interfaces.msg import Time as TimeMessage
from hypothesis import given
from hypothesis import strategies as st
from mddag_executor import clocks, open_recording
from mddag_executor.core import NEVER
from mddag_executor.executor import due
from mddag_executor.executor.agenda import Agenda, CLEAN_EVERY
from mddag_executor.executor.listeners import TimerFd
from mddag_executor.executor.timers import TimerEntity, TimerQueue
from mddag_executor.report.live_runs import live_lines
from msg_graph import loads
import pytest
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import Header

from ..conftest import examples
from .conftest import is_idle, matched, Spinning, wait_for
from .declared import graph
from .inside import at_once_of, engine_of, pool_of, registry_of

MS = 1_000_000
RCLError = rclpy_implementation.RCLError


def waits_for_no_timer(executor):
    """Tell whether the executor knows of all timers, and none is to become due."""
    with pool_of(executor).lock:
        return pool_of(executor).is_current and pool_of(executor).agenda.next == NEVER


class Appointed:
    """An appointment that notes when it has come due."""

    def __init__(self, come):
        self.entry = None
        self.come_due = lambda: come.append(self)


@examples(100)
@given(st.lists(st.tuples(
    st.sampled_from(('set', 'set', 'cancel', 'handle')), st.integers(0, 4), st.integers(0, 30),
    st.integers(0, 9)), max_size=60))
def test_each_appointment_comes_due_once_in_order_and_what_was_changed_leaves_nothing(steps):
    agenda, come, expected, now = Agenda(), [], {}, 0
    several = [Appointed(come) for _ in range(5)]
    for what, which, time_, more in steps:
        one = several[which]
        if what == 'set':
            agenda.set(one, now + time_, now + time_ + more)
            expected[one] = now + time_, now + time_ + more
        elif what == 'cancel':
            agenda.cancel(one)
            expected.pop(one, None)
        else:
            now += time_
            come.clear()
            agenda.handle(lambda now=now: now)
            for each in come:
                at = expected.pop(each)[0]
                assert at <= now and at <= min((each[0] for each in expected.values()), default=at)
        assert agenda.next == min((each[0] for each in expected.values()), default=NEVER)
        assert agenda.latest == min((each[1] for each in expected.values()), default=NEVER)
        assert len(agenda) < 2 * len(expected) + 8 + CLEAN_EVERY


def test_what_is_set_while_appointments_come_due_is_not_due_yet():
    agenda, come = Agenda(), []
    first, second = Appointed(come), Appointed(come)
    first.come_due = lambda: (come.append(first), agenda.set(second, 0, 0))
    agenda.set(first, 1, 1)
    agenda.handle(lambda: 2)
    assert come == [first] and agenda.next == 0
    agenda.handle(lambda: 2)
    assert come == [first, second] and agenda.next == NEVER


def test_an_appointment_that_was_cancelled_does_not_put_off_the_next_one():
    agenda, come = Agenda(), []
    several = [Appointed(come) for _ in range(3)]
    for at, each in enumerate(several):
        agenda.set(each, at, at)
    agenda.cancel(several[1])
    agenda.handle(lambda: 10)
    assert come == [several[0], several[2]] and agenda.next == agenda.latest == NEVER


class FakeTimer:
    """A timer for which this says what rcl would say."""

    simulated, waiting, entry, period_of_allowance = False, (), None, -1

    def __init__(self, due, period):
        self.due, self._period, self.last_period = due, period, period
        self.next, self.asked = due, 0

    def is_eager(self):
        return False

    def period(self):
        return self._period

    def until(self):
        return self.next - time.monotonic_ns()

    def next_due(self):
        self.asked += 1
        return self.next

    def call(self):
        self.next += self._period
        return 'work'


def test_a_timer_that_was_set_to_an_earlier_time_is_released_then():
    """It is due already when this is found, for instance after a step of its clock."""
    queue = TimerQueue(Agenda(), print, print, print)
    timer = FakeTimer(time.monotonic_ns() - 5 * MS, 1000 * MS)
    timer.next -= 50 * MS
    due = timer.next
    assert queue._fire(timer) == ('work', due, 0, 1000 * MS)


def test_the_period_of_a_timer_may_change():
    """Rcl is asked once when it is due next, and it may stay unnoticed for as long as before."""
    agenda = Agenda()
    queue = TimerQueue(agenda, print, print, print)
    queue.allowance = lambda timer, period: period // 4
    begin = time.monotonic_ns()
    timer = FakeTimer(begin + 1000 * MS, 1000 * MS)
    for period, asked in ((1000, 0), (8000, 1), (8000, 1), (8000, 1)):
        timer._period = period * MS
        queue._fire(timer)
        assert timer.asked == asked
        assert agenda.latest - agenda.next == period * MS // 4


def test_an_appointment_that_fails_leaves_the_times_of_the_others():
    agenda, come = Agenda(), []
    failing, other = Appointed(come), Appointed(come)
    failing.come_due = lambda: 1 // 0
    agenda.set(failing, 1, 1)
    agenda.set(other, 5, 6)
    with pytest.raises(ZeroDivisionError):
        agenda.handle(lambda: 2)
    assert (agenda.next, agenda.latest) == (5, 6)


def test_the_deadline_of_a_job_that_was_in_time_wakes_no_thread(make_executor, make_node):
    node, ran = make_node('n'), []
    node.create_subscription(Header, '/go', ran.append, 10)
    go = node.create_publisher(Header, '/go', 10)
    executor = make_executor(loads(graph(
        n='name: on, subscription: /go, dag: once, period: 600s, deadline: 300s')), nodes=[node])
    with Spinning(executor):
        assert wait_for(lambda: waits_for_no_timer(executor))
        matched(go)
        go.publish(Header())
        assert wait_for(lambda: ran)
        assert wait_for(lambda: executor.statistics()['dags']['once']['ends']['completed'])
        assert wait_for(lambda: pool_of(executor).polling and waits_for_no_timer(executor))


def test_after_a_short_callback_that_is_rare_no_thread_looks(
        make_executor, make_node, monkeypatch):
    """A parked thread was to look in case that it would have taken long."""
    monkeypatch.setattr('mddag_executor.executor.engine.NET_NS', 600_000 * MS)
    node, was_set = make_node(), []
    executor = make_executor(nodes=[node])
    pool = pool_of(executor)
    node.create_subscription(
        Header, '/go', lambda _: was_set.append(pool.parking.watch.at < NEVER), 10)
    go = node.create_publisher(Header, '/go', 10)

    def publish():
        ran = len(was_set)
        go.publish(Header())
        assert wait_for(lambda: len(was_set) > ran)
        assert wait_for(lambda: pool.polling and pool.loop.timer.at > 0)
        time.sleep(0.01)
        return was_set[-1]

    with Spinning(executor):
        matched(go)
        assert wait_for(publish)
        go.publish(Header())
        assert wait_for(lambda: pool.polling and pool.parking.watch.at == NEVER)


def test_a_timer_that_becomes_due_while_a_busy_thread_looks_runs(make_executor, make_node):
    """The thread takes the event of the timerfd, so it has to know the time after that."""
    node, ran, ticks, delays = make_node(), [], [], []
    executor = make_executor(nodes=[node])
    loop = pool_of(executor).loop
    poll, timer = loop.poll, loop.timer

    def compute():
        while time.monotonic_ns() < timer.at - 3_000_000 < NEVER // 2:
            pass
        ran.append(1)

    def poll_late():
        due = timer.at
        if ran and not delays and due - time.monotonic_ns() < 50_000_000:
            delays.append(max(0, due + 1_000_000 - time.monotonic_ns()) / 1e9)
            time.sleep(delays[0])
        return poll()

    loop.poll = poll_late
    guard = node.create_guard_condition(compute)
    node.create_timer(0.1, lambda: ticks.append(1))
    with Spinning(executor):
        assert wait_for(lambda: len(ticks) == 2)
        time.sleep(max(0, timer.at - 10_000_000 - time.monotonic_ns()) / 1e9 % 0.1)
        guard.trigger()
        assert wait_for(lambda: ran)
        before = len(ticks)
        assert wait_for(lambda: len(ticks) > before + 3)


def test_a_timer_that_was_cancelled_runs_when_it_is_reset(make_executor, make_node, spinning):
    node, ran = make_node(), []
    timer = node.create_timer(0.01, lambda: ran.append(1), autostart=False)
    executor = make_executor(nodes=[node])
    with spinning(executor):
        for _ in range(5):
            assert wait_for(lambda: waits_for_no_timer(executor))
            count = len(ran)
            timer.reset()
            assert wait_for(lambda n=count: len(ran) >= n + 2)
            timer.cancel()


def test_a_timer_that_is_reset_before_it_is_due_never_runs_and_costs_no_memory(
        make_executor, make_node):
    """A watchdog."""
    node, barked, resets = make_node(), [], []
    watchdog = node.create_timer(60.0, lambda: barked.append(1))

    def feed():
        for _ in range(20):
            watchdog.reset()
        resets.append(1)

    node.create_timer(0.001, feed)
    executor = make_executor(nodes=[node])
    with Spinning(executor):
        assert wait_for(lambda: len(resets) >= 50)
        assert len(pool_of(executor).agenda) < 50
    assert not barked


@pytest.mark.parametrize('cancels', [False, True], ids=['reset', 'cancelled'])
@pytest.mark.parametrize('until', ['its turn', 'it is due again'])
def test_a_timer_that_is_reset_while_its_callback_waits_is_withdrawn(
        make_executor, make_node, tmp_path, until, cancels):
    """A watchdog is due while another callback runs, which feeds it: it barks a period later."""
    node, barked, fed, path = make_node(), [], [], tmp_path / 'run.mcap'
    watchdog = node.create_timer(
        0.05, lambda: barked.append(time.monotonic()), autostart=False)

    def work():
        watchdog.reset()
        (known,) = registry_of(executor).of_kind(TimerEntity)
        assert wait_for(lambda: known.waiting)
        if cancels:
            watchdog.cancel()
        watchdog.reset()
        fed.append(time.monotonic())
        assert until == 'its turn' or wait_for(lambda: known.dropped)

    node.create_guard_condition(work).trigger()
    executor = make_executor(nodes=[node], trace=str(path))
    with Spinning(executor):
        assert wait_for(lambda: len(barked) >= 2)
    assert barked[0] - fed[0] > 0.049
    recording = open_recording(path)
    assert [recording.names.drop_reasons[each] for each in recording.drops['reason']] == [
        'withdrawn']
    assert ['timer' in recording.callback_name(each) for each in recording.drops['callback']] == [
        True]


@pytest.mark.parametrize('sleeps', [False, True], ids=['timer', 'rate'])
def test_a_timer_that_left_while_its_arrival_was_handled_is_not_asked_again(
        make_executor, make_node, sleeps):
    """Else two executors would advance it, and one of them would drop what is due."""
    node = make_node()
    kept = node.create_rate(1.0) if sleeps else node.create_timer(1.0, print)
    executor, other = make_executor(nodes=[node]), make_executor()
    executor._upkeep.refresh()
    place = executor._at_once if sleeps else pool_of(executor)
    (source,) = place.timers._timers.values()
    arrived = list(place.loop.sources(place.loop.wait(0)))
    assert source in arrived and place.agenda.next < NEVER
    other.add_node(node)
    for each in arrived:
        each.collect()
    assert place.agenda.next == NEVER
    del kept


def test_a_timer_without_a_period_that_has_left_is_not_asked_again(make_executor, make_node):
    """Though an execution of it still starts."""
    node = make_node()
    node.create_timer(0.0, print)
    executor = make_executor(nodes=[node])
    executor._upkeep.refresh()
    pool = pool_of(executor)
    (source,) = pool.timers._timers.values()
    for _ in range(2):
        assert source.entry
        assert wait_for(lambda: pool.agenda.next <= time.monotonic_ns())
        with pool.lock:
            pool.agenda.handle(time.monotonic_ns)
    assert source.waiting and not source.entry
    executor.remove_node(node)
    with pool.lock:
        assert pool.engine.step(0, pool.tick()).work.entity is source
    assert not source.entry


def test_an_error_of_rcl_ends_the_spin_unless_its_timer_is_cancelled(
        make_executor, make_node, monkeypatch):
    def fails(queue, source):
        if source.rclpy_object is cancelled:
            cancelled.cancel()
        failed.append(source)
        raise RCLError('it fails')

    monkeypatch.setattr(TimerQueue, '_fire', fails)
    node, failed = make_node(), []
    cancelled = node.create_timer(0.001, print)
    with Spinning(make_executor(nodes=[node]), raises=RCLError) as spinning:
        assert wait_for(lambda: failed)
        assert not wait_for(lambda: spinning.error, 0.05)
        node.create_timer(0.001, print)
        spinning.join()
    assert len(failed) == 2


@pytest.mark.parametrize(
    'kind', [ClockType.STEADY_TIME, ClockType.SYSTEM_TIME, ClockType.ROS_TIME])
def test_timers_of_each_clock_run(make_executor, make_node, kind):
    node, ran = make_node(), []
    node.create_timer(0.01, lambda: ran.append(1), clock=Clock(clock_type=kind))
    with Spinning(make_executor(nodes=[node])):
        assert wait_for(lambda: len(ran) >= 5)


# --- simulated time ------------------------------------------------------------------------------


def test_a_timer_runs_by_simulated_time_and_by_nothing_else(make_executor, make_node):
    """Its node may turn to the system's time and back."""
    node = make_node('simulated', parameter_overrides=[Parameter('use_sim_time', value=True)])
    publisher = make_node('clock').create_publisher(
        ClockMessage, '/clock', QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    clock, executor, ran = node.get_clock(), make_executor(nodes=[node]), []

    def set_clock(ms):
        """Publish the time until the node has it, and all that is due then is done."""
        matched(publisher)
        message = ClockMessage(clock=TimeMessage(sec=ms // 1000, nanosec=ms % 1000 * MS))
        assert wait_for(lambda: publisher.publish(message) or wait_for(
            lambda: clock.now().nanoseconds == ms * MS, 0.1))
        is_quiet()

    def is_quiet():
        assert wait_for(executor.create_task(lambda: None).done)
        assert wait_for(lambda: pool_of(executor).is_current and is_idle(executor))

    with Spinning(executor):
        set_clock(100_000)
        node.create_timer(1.0, lambda: ran.append(clock.now().nanoseconds))
        brief = node.create_timer(1.0, print)
        is_quiet()
        node.destroy_timer(brief)   # the other one still runs
        is_quiet()
        for second in range(101, 106):
            set_clock(second * 1000 - 1)
            assert len(ran) == second - 101
            set_clock(second * 1000)
            assert wait_for(lambda n=second: len(ran) == n - 100)
        assert ran == [second * 10**9 for second in range(101, 106)]

        node.set_parameters([Parameter('use_sim_time', value=False)])
        assert wait_for(lambda: len(ran) >= 6)
        node.set_parameters([Parameter('use_sim_time', value=True)])
        set_clock(3_700_000)
        count = len(ran)
        set_clock(3_701_000)
        assert wait_for(lambda: len(ran) > count)


@pytest.mark.parametrize('simulated', [False, True])
def test_a_timer_without_a_period_stops_no_other_timer(make_executor, make_node, simulated):
    """It is always due, also while simulated time stands still; it waits once at most."""
    wall, ran, go_on = make_node('wall'), [], threading.Event()
    node = make_node('node', parameter_overrides=[Parameter('use_sim_time', value=simulated)])
    publisher = make_node('clock').create_publisher(
        ClockMessage, '/clock', QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    always, often = [], []

    def run():
        always.append(1)
        if len(always) >= 10:
            go_on.wait()

    timer = node.create_timer(0.0, run)
    wall.create_timer(0.01, lambda: ran.append(1))
    wall.create_timer(0.0, lambda: often.append(1), clock=Clock())
    executor = make_executor(nodes=[node, wall])
    with Spinning(executor):
        matched(publisher, count=int(simulated))
        publisher.publish(ClockMessage(clock=TimeMessage(sec=10)))
        assert wait_for(lambda: len(always) == 10)
        before = len(ran), len(often)
        assert wait_for(lambda: len(ran) >= before[0] + 5 and len(often) > before[1] + 5)
        entity = next(each for each in registry_of(executor).of_kind(TimerEntity)
                      if each.rclpy_object is timer)
        assert wait_for(lambda: (entity.ready, entity.skipped) == (11, 0))
        go_on.set()
        assert wait_for(lambda: len(always) >= 20)


def test_any_time_can_be_set_and_never_is_none():
    """Also one before the boot of the machine; the system call knows none."""
    timer = TimerFd()
    try:
        for at, is_due in ((-1, True), (NEVER, False), (-10**30, True), (0, True), (10**30, False),
                           (time.monotonic_ns() + 10**12, False), (1, True)):
            timer.arm(at)
            assert timer.at == at
            assert bool(select.select([timer.fd], [], [], 0)[0]) is is_due
    finally:
        timer.close()
    timer.arm(1)  # as an executor that has ended may do
    timer.arm(NEVER)


def test_a_time_that_the_kernel_does_not_accept_is_an_error():
    timer = TimerFd()
    file = os.open(os.devnull, os.O_RDONLY)
    try:
        os.dup2(file, timer.fd)
        with pytest.raises(OSError, match='timerfd_settime'):
            timer.arm(1)
    finally:
        os.close(file)
        timer.close()


# --- what is due or arrives before it is noticed -------------------------------------------------

GRAPH = graph(
    node="""
        name: tick, timer: 10ms, dag: ticks, deadline: 10s
        name: heard, subscription: /topic, period: 10ms, release_from: STAMP, deadline: 1s""")


class Released:
    """A node with a topic, and an executor whose releases are noted by DAG."""

    def __init__(self, make_executor, make_node, stamp='source_timestamp', tick=None):
        self.node = make_node()
        self.publisher = self.node.create_publisher(Header, '/topic', 10)
        self.got = []
        self.subscription = self.node.create_subscription(
            Header, '/topic', lambda message, info: self.got.append(info['source_timestamp']), 10)
        matched(self.publisher)
        if tick is not None:
            self.node.create_timer(0.01, tick)
        self.executor = make_executor(
            loads(GRAPH.replace('STAMP', stamp)), num_workers=1, nodes=[self.node])
        self.releases = []
        engine_of(self.executor).verdicts.on_release = (
            lambda dag, release: self.releases.append(release))

    def publish(self):
        now = self.node.get_clock().now()
        self.publisher.publish(Header(stamp=now.to_msg()))
        return now.nanoseconds


def test_periods_before_the_spin_are_no_jobs_and_no_misses(make_executor, make_node):
    """Those during a long callback of the only worker are skipped jobs."""
    ran = []

    def tick():
        ran.append(1)
        if len(ran) == 3:
            time.sleep(0.15)

    released = Released(make_executor, make_node, tick=tick)
    time.sleep(0.3)
    begin = released.executor._trace_clock.now()
    with Spinning(released.executor):
        assert wait_for(lambda: len(ran) > 5)
    periods = (released.executor._trace_clock.now() - begin) / 1e7
    first, last = min(released.releases), max(released.releases)
    assert first >= begin
    statistics = released.executor.statistics()
    skipped = statistics['callbacks']['/node:tick']['skipped']
    assert 10 <= skipped and skipped + len(ran) <= periods + 2
    assert statistics['dags']['ticks']['jobs'] >= round((last - first) / 1e7) + 1


@pytest.mark.parametrize('declared', [False, True])
def test_a_release_is_the_due_time_even_if_that_was_after_the_turn_began(
        make_executor, make_node, declared, tmp_path):
    """A thread may lose its processor between its wake-up and the next timer."""
    node, first, second = make_node(), [], []

    def one():
        first.append(1)

    def two():
        second.append(1)

    node.create_timer(0.01, one)
    time.sleep(0.005)
    node.create_timer(0.01, two)
    task_set = loads(graph(node="""
        name: one, timer: 10ms, dag: a, deadline: 10s
        name: two, timer: 10ms, dag: b, deadline: 10s"""))
    trace = str(tmp_path / 'trace.mcap')
    executor = make_executor(task_set if declared else None, nodes=[node], trace=trace)
    handle = pool_of(executor).due.handle
    pool_of(executor).due.handle = lambda *each: (time.sleep(0.012), handle(*each))
    with Spinning(executor):
        assert wait_for(lambda: len(first) >= 10 and len(second) >= 10)
    executor.shutdown(5.0)
    recording = open_recording(trace, None if declared else task_set)
    assert not any('due times' in each.text for each in recording.missing)
    for dag in range(2):
        each = recording.releases['release'][recording.releases['dag'] == dag].tolist()
        assert len(each) >= 10
        grid = each[len(each) // 2]
        # the first one is released when the executor begins to manage the timer
        assert all(min((at - grid) % (10 * MS), (grid - at) % (10 * MS)) < MS for at in each[1:])


@pytest.mark.parametrize('stamp', ['source_timestamp', 'header_stamp'])
def test_a_message_from_before_the_spin_is_released_when_it_begins(
        make_executor, make_node, stamp):
    """And a pause while a later one is taken does not move its release."""
    released = Released(make_executor, make_node, stamp)
    executor, got = released.executor, released.got
    released.publish()
    time.sleep(0.2)
    begin = executor._trace_clock.now()
    with Spinning(executor):
        assert wait_for(lambda: got and pool_of(executor).is_current)
        assert len(released.releases) == 1 and released.releases[0] >= begin
        source = registry_of(executor).by_id[id(released.subscription)]
        take = source._take
        source._take = lambda: (take(), time.sleep(0.1))[0]
        time.sleep(0.2)  # no release is before the spin
        sent = released.publish()
        assert wait_for(lambda: len(got) == 2)
    expected = got[1] if stamp == 'source_timestamp' else sent
    assert len(released.releases) == 2
    # the pause took 100 ms; the system clock may be set by a few ms meanwhile
    assert abs(released.releases[1] - executor._trace_clock.of_system(expected)) < 50 * MS


def test_a_declared_subscription_of_clock_is_the_nodes_own(make_executor, make_node):
    """Not the one that rclpy makes for simulated time."""
    node = make_node('node', parameter_overrides=[Parameter('use_sim_time', value=True)])
    got = []
    own = node.create_subscription(ClockMessage, '/clock', got.append, 10)
    publisher = make_node('clock').create_publisher(ClockMessage, '/clock', 10)
    executor = make_executor(loads(graph(
        node='name: on_clock, subscription: /clock, period: 1s, deadline: 1s')), nodes=[node])
    with Spinning(executor):
        matched(publisher, count=2)
        publisher.publish(ClockMessage(clock=TimeMessage(sec=7)))
        assert wait_for(lambda: got and node.get_clock().now().nanoseconds == 7_000 * MS)
        assert registry_of(executor).by_id[id(own)].name == '/node:on_clock'
        assert wait_for(lambda: executor.statistics()['callbacks']['/node:on_clock']['ran'] == 1)


def test_the_spinning_thread_changes_its_agenda_under_the_lock_only(make_executor, monkeypatch):
    """Another thread may set a timer just then, which must not be lost."""
    at_once, is_inside = at_once_of(make_executor()), []
    monkeypatch.setattr(at_once.agenda, 'handle', lambda clock: is_inside.append(
        at_once.pool.is_inside()))
    at_once.loop.timer.arm(1)
    at_once.handle([])
    assert is_inside == [True] and not at_once.pool.is_inside()


def test_the_spinning_thread_knows_whether_it_has_handled_anything(make_executor):
    """Else a ``spin_once`` that has handled a response once would return at once ever after."""
    at_once, ended = at_once_of(make_executor()), []
    at_once.pool.callback_ended = lambda *args: ended.append(args)
    entity = SimpleNamespace(rclpy_object='client', ready=0, ran=0)
    assert not at_once.handle([])
    at_once.count(entity)
    assert ended == [('client', None, -1)]  # who hosts the program knows it as well
    assert at_once.has_run and not at_once.handle([])


def test_a_step_of_the_system_clock_is_noticed(make_executor, make_node, tmp_path, monkeypatch):
    """It is one line in the log, below the table of a run, and of a replay; slewing is none."""
    path = tmp_path / 'run.mcap'
    ahead, ran, logged = [0], [], []

    class Time:
        monotonic_ns = staticmethod(time.monotonic_ns)

        @staticmethod
        def time_ns():
            return time.time_ns() + ahead[0]

    monkeypatch.setattr(clocks, 'time', Time)
    monkeypatch.setattr(due, 'get_logger', lambda _: SimpleNamespace(warning=logged.append))
    node = make_node()
    node.create_timer(0.01, lambda: ran.append(None), clock=Clock(
        clock_type=ClockType.STEADY_TIME))
    declared = loads(graph(node='name: tick, timer: 10ms, deadline: 9s'))
    executor = make_executor(declared, trace=str(path), nodes=[node])
    with Spinning(executor):
        for more in (1_000_000, 3_600_000_000_000, -2_000_000_000):
            n = len(ran)
            assert wait_for(lambda n=n: len(ran) > n + 30)
            ahead[0] += more
        assert wait_for(lambda: len(executor.statistics()['clock_steps']) == 2)
    found = executor.statistics()['clock_steps']
    assert [round(each['step_ns'] / 1e9) for each in found] == [3600, -2]
    lines = [line for line in live_lines({**executor.statistics(), 'measured': None})
             if 'system clock' in line]
    assert [line[:35] for line in lines] == [
        'the system clock was set forward by', 'the system clock was set back by 2.']
    assert [line for line in logged if 'clock' in line] == lines
    said, = [loss for loss in open_recording(path).missing if loss.kind == 'clock']
    assert (said.count, said.text) == (2, f'{path}: {lines[0]} (and 1 more)')
