# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""An executor gives back its threads and descriptors, even if it is not shut down."""

import gc
import os
import resource
import signal
import sys
import threading
from types import SimpleNamespace
import weakref

from mddag_executor import MultiDeadlineExecutor
from mddag_executor.executor import forks, settings
from mddag_executor.executor.at_once import SignalPipe
from mddag_executor.executor.compat import RCLError
from mddag_executor.executor.ending import Ending
from mddag_executor.executor.session import Session
import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import Header

from .conftest import patience, Spinning, wait_for
from .inside import pool_of, replace_method

LIMIT = resource.RLIMIT_NOFILE


def used():
    """Return how many threads and descriptors there are."""
    return threading.active_count(), len(os.listdir('/proc/self/fd'))


def busy_node(context):
    """Return a node with a timer and a subscription that run."""
    node = Node('busy', context=context, start_parameter_services=False, enable_rosout=False)
    publisher = node.create_publisher(Header, '/topic', 10)
    node.heard = []
    node.create_subscription(Header, '/topic', node.heard.append, 10)
    node.create_timer(0.002, lambda: publisher.publish(Header()))
    return node


def run(executor, node):
    before, calls = len(node.heard), 0
    while len(node.heard) < before + 3:
        calls += 1
        if calls % 2:
            executor.spin_until_future_complete(Future(), 0.05)
        else:
            executor.spin_once(0.05)


# --- it is not shut down -------------------------------------------------------------------------


@pytest.mark.parametrize('has_spun', [False, True])
@pytest.mark.parametrize('is_in_cycle', [False, True])
def test_an_executor_that_is_dropped_is_freed(ros_context, tmp_path, has_spun, is_in_cycle):
    """Its trace is complete then.  In a cycle, it takes the garbage collector."""
    node = busy_node(ros_context)
    if has_spun:  # what the middleware opens at first
        with MultiDeadlineExecutor(context=ros_context) as first:
            first.add_node(node)
            run(first, node)
    before = used()
    executor = MultiDeadlineExecutor(
        context=ros_context, trace=tmp_path / 'run.mcap', diagnostics_period='50ms',
        on_deadline_miss=print)
    executor.add_node(node)
    if has_spun:
        run(executor, node)
    if is_in_cycle:
        node.executor_of_its_own = executor
    reference = weakref.ref(executor)
    del executor, node
    if is_in_cycle:
        gc.collect()
    assert reference() is None
    assert wait_for(lambda: used()[0] == before[0] and used()[1] <= before[1])
    assert wait_for(lambda: (tmp_path / 'run.mcap').read_bytes().endswith(b'\x89MCAP0\r\n'))


def test_objects_that_were_frozen_are_collected_once_the_run_has_ended(ros_context):
    """Else nodes in reference cycles would remain, with what the middleware keeps for them."""
    node = busy_node(ros_context)
    node.itself = node
    reference = weakref.ref(node)
    with MultiDeadlineExecutor(context=ros_context, freeze_gc=True) as executor:
        executor.add_node(node)
        run(executor, node)
        assert gc.get_freeze_count()
        executor.remove_node(node)
    del node
    gc.collect()
    assert reference() is None


def test_a_dropped_executor_is_freed_after_a_callback_that_still_runs(ros_context):
    node, go_on, begun = busy_node(ros_context), threading.Event(), threading.Event()
    before = threading.active_count()
    executor = MultiDeadlineExecutor(context=ros_context)
    executor.add_node(node)
    executor.create_task(lambda: begun.set() or go_on.wait(30.0))
    while not begun.is_set():
        executor.spin_until_future_complete(Future(), 0.01)
    executor.remove_node(node)
    del executor
    assert wait_for(lambda: threading.active_count() <= before + 2), threading.enumerate()
    go_on.set()
    assert wait_for(lambda: threading.active_count() == before)


def test_threads_end_while_a_callback_that_is_abandoned_still_runs(make_executor, make_node):
    """The descriptors are closed only when no thread waits for one of them any more."""
    for _ in range(5):
        abandon_a_callback(make_executor(num_workers=64, nodes=[make_node()]))


def abandon_a_callback(executor):
    """End a run while one of its callbacks waits; all other threads end, then the rest."""
    before, begun, let_go = threading.active_count(), threading.Event(), threading.Event()
    executor.create_task(lambda: (begun.set(), let_go.wait()))
    session = Session(executor)
    with session:
        assert begun.wait(15)
        session.hurry()
    assert not session.clean
    assert wait_for(lambda: threading.active_count() == before + 1)
    let_go.set()
    assert wait_for(lambda: threading.active_count() == before)
    assert wait_for(lambda: pool_of(executor).loop._epoll.closed)


@pytest.mark.parametrize('has_spun', [False, True])
def test_the_end_of_its_context_frees_an_executor_that_does_not_spin(has_spun, no_thread_leak):
    """As in fixtures of tests that initialise rclpy and shut it down again."""
    executors, counts, before = [], [], threading.active_count()
    for _ in range(4):
        context = Context()
        rclpy.init(context=context)
        node = busy_node(context)
        executor = MultiDeadlineExecutor(context=context)
        executors.append(executor)  # it is not dropped
        executor.add_node(node)
        if has_spun:
            run(executor, node)
        node.destroy_node()
        rclpy.shutdown(context=context)
        assert wait_for(lambda: threading.active_count() == before)
        if has_spun:
            assert wait_for(lambda: pool_of(executors[-1]).loop._bell < 0)
            counts.append(used())
    assert len(set(counts)) == has_spun
    for executor in executors:
        executor.statistics()
        with pytest.raises(ExternalShutdownException):
            executor.spin_once(0.1)
        assert executor.shutdown(5.0) and executor.is_gone()


# --- ends at bad times ---------------------------------------------------------------------------


def test_shutdown_in_a_handler_that_interrupts_the_executor_itself(ros_context):
    """The workers wait for the lock that this thread owns, so it cannot wait for them."""
    executor = MultiDeadlineExecutor(context=ros_context)
    node = busy_node(ros_context)
    executor.add_node(node)
    with Spinning(executor) as spinning:
        assert wait_for(lambda: len(node.heard) >= 3)
        with pool_of(executor).lock:
            assert not executor.shutdown()
        spinning.join()
        assert executor.is_gone() and pool_of(executor).loop._bell < 0


@pytest.mark.parametrize('step', ['_judge_and_close', '_close_descriptors'])
def test_a_shutdown_that_is_interrupted_leaves_nothing(ros_context, monkeypatch, step):
    """The interrupt comes out of it when nothing is left half done."""
    node = busy_node(ros_context)
    with MultiDeadlineExecutor(context=ros_context) as first:  # what the middleware opens first
        first.add_node(node)
        run(first, node)
    before = used()
    executor = MultiDeadlineExecutor(context=ros_context)
    executor.add_node(node)
    run(executor, node)
    do_step = getattr(Ending, step)

    def interrupted(ending):
        signal.raise_signal(signal.SIGINT)
        do_step(ending)

    with monkeypatch.context() as patch:
        patch.setattr(Ending, step, interrupted)
        with pytest.raises(KeyboardInterrupt):
            executor.shutdown()
    assert executor.shutdown()
    assert wait_for(lambda: used() == before)
    node.destroy_node()


def test_an_interrupt_at_the_end_of_a_spin_leaves_an_executor_that_can_be_shut_down(monkeypatch):
    context = Context()
    rclpy.init(context=context)
    executor = MultiDeadlineExecutor(context=context)

    def interrupted(timeout):
        monkeypatch.undo()
        raise KeyboardInterrupt

    replace_method(monkeypatch, pool_of(executor), 'close', interrupted)
    executor.create_task(rclpy.shutdown, context=context)
    with pytest.raises(KeyboardInterrupt):
        executor.spin()
    assert not executor.is_spinning
    assert executor.shutdown(5.0) and pool_of(executor).loop._bell < 0
    executor.spin_once(0.0)


def test_an_interrupt_of_a_pause_does_not_keep_the_workers_awake(make_executor, monkeypatch):
    executor = make_executor()
    wait = pool_of(executor)._all_left.wait

    def interrupted(timeout):
        monkeypatch.setattr(pool_of(executor)._all_left, 'wait', wait)
        raise KeyboardInterrupt

    monkeypatch.setattr(pool_of(executor)._all_left, 'wait', interrupted)
    with pytest.raises(KeyboardInterrupt):
        executor.spin_until_future_complete(Future(), 0.05)
    executor.spin_until_future_complete(executor.create_task(lambda: None), patience(5.0))


# --- limits of the system ------------------------------------------------------------------------


@pytest.mark.parametrize('left', range(6))
def test_a_thread_that_cannot_be_started_is_started_by_the_next_spin(
        make_executor, make_node, monkeypatch, left):
    """With three workers, a wait-set thread, one for misses and one for diagnostics."""
    node, ran, start = make_node(), [], threading.Thread.start
    node.create_timer(0.002, lambda: ran.append(1))
    executor = make_executor(
        num_workers=3, nodes=[node], diagnostics_period='50ms', on_deadline_miss=print)
    started = []

    def limited(thread):
        if len(started) == left:
            raise RuntimeError("can't start new thread")
        started.append(thread)
        start(thread)

    with monkeypatch.context() as limit:
        limit.setattr(threading.Thread, 'start', limited)
        with pytest.raises(RuntimeError, match='new thread'):
            executor.spin_until_future_complete(Future(), patience(5.0))
    before = len(ran)
    with Spinning(executor):
        assert wait_for(lambda: len(ran) >= before + 3)
        names = {thread.name for thread in threading.enumerate()}
        assert names >= {'mddag-diagnostics', 'mddag-wait-set', 'mddag-deadline-misses'}
        assert len(pool_of(executor)._threads) == 3


def test_too_many_open_files_leave_nothing_behind(
        ros_context, request, monkeypatch, tmp_path):
    """Whichever descriptor the constructor cannot open."""
    MultiDeadlineExecutor(context=ros_context).shutdown()
    unraisable, limits, errors = [], resource.getrlimit(LIMIT), 0
    monkeypatch.setattr(sys, 'unraisablehook', unraisable.append)
    gc.collect()
    highest, fillers = max(map(int, os.listdir('/proc/self/fd'))), [os.open(os.devnull, 0)]

    def fill_gaps():
        """Let no number of a descriptor be free that is less than another one's."""
        while fillers[-1] <= highest:
            fillers.append(os.open(os.devnull, 0))

    fill_gaps()
    request.addfinalizer(lambda: [os.close(each) for each in fillers])
    before = used()
    for more in range(40):
        fillers.append(os.open(os.devnull, 0))
        fill_gaps()     # of what earlier tests have left, and has ended by now
        os.close(fillers.pop())
        resource.setrlimit(LIMIT, (before[1] + more, limits[1]))
        try:
            executor = MultiDeadlineExecutor(
                context=ros_context, trace=tmp_path / 'run.mcap', overwrite=True)
        except Exception as error:  # the trace's own; too many open files
            assert 'open files' in str(error).lower(), (more, error)
            errors += 1
            assert not (tmp_path / 'run.mcap').exists()
        else:
            executor.shutdown()
            break
        finally:
            resource.setrlimit(LIMIT, limits)
    assert errors >= 8
    del executor
    gc.collect()
    assert wait_for(lambda: used()[0] <= before[0] and used()[1] <= before[1])
    assert unraisable == []


def test_a_context_that_ends_meanwhile_leaves_nothing_behind(monkeypatch, tmp_path):
    """No trace either, for which the next executor would need `overwrite`."""
    check = settings.check_context

    def end(context):
        check(context)
        context.shutdown()

    monkeypatch.setattr(settings, 'check_context', end)
    before = []
    for _ in range(3):
        context = Context()
        context.init()
        with pytest.raises(RCLError, match='context is not valid'):
            MultiDeadlineExecutor(
                context=context, trace=tmp_path / 'run.mcap', diagnostics_period='1s')
        assert not (tmp_path / 'run.mcap').exists()
        del context
        gc.collect()
        before.append(used())
    assert wait_for(lambda: used()[0] <= before[0][0] and used()[1] <= before[0][1])


# --- copies of the process, and signals ----------------------------------------------------------

@pytest.mark.parametrize(('outcome', 'expected', 'text'), [
    (SystemExit(), 0, ''), (SystemExit(3), 3, ''), (SystemExit('why'), 1, 'why'),
    (KeyError('raised'), 1, 'raised'), (None, 1, 'os._exit')])
def test_the_status_of_a_copy_is_that_of_its_callback(monkeypatch, outcome, expected, text):
    """What it has printed is not lost."""
    written, flushed, ended = [], [], []

    def stream(name):
        return SimpleNamespace(write=written.append, flush=lambda: flushed.append(name))

    monkeypatch.setattr(forks, 'os', SimpleNamespace(_exit=ended.append))
    monkeypatch.setattr(forks, 'sys', SimpleNamespace(
        stdout=stream('stdout'), stderr=stream('stderr')))
    monkeypatch.setattr(forks.traceback, 'print_exception', lambda error: written.append(
        str(error)))
    forks.end_copy(SimpleNamespace(entity=SimpleNamespace(label='/a')), outcome)
    assert ended == [expected] and flushed == ['stdout', 'stderr']
    assert text in ''.join(written) and bool(text) == bool(written)


def test_the_signals_of_another_loop_stay_its_own():
    """That of asyncio, for instance, which waits for them in the main thread."""
    pipe, (reads, writes) = SignalPipe(), os.pipe2(os.O_NONBLOCK)
    before = signal.set_wakeup_fd(writes)
    try:
        with pipe.watch():
            assert signal.set_wakeup_fd(writes) == writes
        assert signal.set_wakeup_fd(-1) == writes
        with pipe.watch():
            found = signal.set_wakeup_fd(-1)
            assert found >= 0 and signal.set_wakeup_fd(found) == -1
        assert signal.set_wakeup_fd(-1) == -1
    finally:
        signal.set_wakeup_fd(before)
        pipe.close()
        os.close(reads)
        os.close(writes)
