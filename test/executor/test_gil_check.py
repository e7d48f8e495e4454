# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Whether a thread computes or waits for anything but the GIL: real threads, also under load."""

from contextlib import contextmanager
import ctypes
from itertools import count
import os
import queue
import select
import socket
import subprocess
import sys
import threading
import time

from mddag_executor.executor import gil, gil_check
from mddag_executor.executor.gil import GilHabit, Measurement, short_switch_interval
from mddag_executor.executor.gil_check import CHECK_NS, GilCheck, LAST_CHECK_NS, waits_for_else
import pytest

from .conftest import shown, wait_for

MS = 1_000_000
keeps_gil = ctypes.PyDLL(None)


@contextmanager
def threads(*functions):
    """Run functions in threads, each with an event that ends it; yield the threads."""
    ends = threading.Event()
    found = [threading.Thread(target=each, args=(ends,), daemon=True) for each in functions]
    for each in found:
        each.start()
    try:
        with short_switch_interval():
            yield found
    finally:
        ends.set()
        for each in found:
            each.join(30.0)


def computes(ends):
    """Compute in Python, and never wait for anything but the GIL."""
    is_set = ends.is_set
    while not is_set():
        sum(range(100))


@contextmanager
def load(processes):
    """Let other processes keep the CPUs busy."""
    found = [subprocess.Popen([sys.executable, '-Sc', 'while True: pass'])
             for _ in range(processes)]
    try:
        yield
    finally:
        for each in found:
            each.kill()
            each.wait()


@shown
@pytest.mark.parametrize('processes', [0, 4])
def test_a_thread_that_waits_for_the_gil_is_never_taken_for_one_that_waits(processes):
    """However many want it, and however busy the CPUs are."""
    with load(processes), threads(*[computes] * 3) as found:
        seen = set()
        for _ in range(50):
            time.sleep(0)  # another one may have it
            keeps_gil.usleep(200)  # none of them has it
            seen |= {waits_for_else(each.native_id) for each in found}
    assert seen == {False}


def of_lock():
    """Wait for a lock; return how, and what ends it."""
    lock = threading.Lock()
    lock.acquire()
    return lock.acquire, lock.release


def of_timeout():
    """Wait for an event, but not for ever."""
    event = threading.Event()
    return lambda: event.wait(600.0), event.set


def of_queue():
    """Wait for an item."""
    items = queue.Queue()
    return items.get, lambda: items.put(1)


def of_socket():
    """Wait for bytes."""
    mine, other = socket.socketpair()
    return lambda: (mine.recv(1), mine.close()), lambda: (other.send(b'.'), other.close())


def of_select():
    """Wait for events of a descriptor."""
    reads, writes = os.pipe()
    return (lambda: (select.select([reads], [], []), os.close(reads)),
            lambda: (os.write(writes, b'.'), os.close(writes)))


def of_process():
    """Wait for the end of a process."""
    process = subprocess.Popen([sys.executable, '-Sc', 'input()'], stdin=subprocess.PIPE)
    return process.wait, process.stdin.close


@pytest.mark.parametrize(
    'kind', [of_lock, of_timeout, of_queue, of_socket, of_select, of_process])
def test_a_thread_that_waits_for_anything_else_does(kind):
    """Also while others compute."""
    waits, end = kind()
    with threads(computes, computes, lambda _: waits()) as (*_, waiting):
        try:
            assert wait_for(lambda: waits_for_else(waiting.native_id))
            for _ in range(100):
                assert waits_for_else(waiting.native_id)
        finally:
            end()


def answers(thread, number=50, step_us=200):
    """Check a thread several times."""
    check, found = GilCheck(), []
    for _ in range(number):
        found.append(check.waits(thread.ident, thread.native_id, time.monotonic_ns()))
        keeps_gil.usleep(step_us)
        time.sleep(0)
    return found


def test_what_is_more_urgent_is_not_kept_waiting_by_the_checks_of_before():
    """And between two checks is never more than the longest interval."""
    me, check, subject = threading.current_thread(), GilCheck(), object()
    check.begin(subject, 0, LAST_CHECK_NS, LAST_CHECK_NS)
    later = check.at
    check.begin(subject, 0, CHECK_NS, CHECK_NS)
    assert check.at == CHECK_NS < later
    check.begin(subject, 0, LAST_CHECK_NS, LAST_CHECK_NS)
    assert check.at == CHECK_NS
    gaps = []
    for _ in range(10):
        now = check.at
        check.waits(me.ident, me.native_id, now)
        gaps.append(check.at - now)
    assert gaps == sorted(gaps) and gaps[-1] == LAST_CHECK_NS


@shown
@pytest.mark.parametrize('processes', [0, 4])
def test_a_callback_that_computes_keeps_the_gil(processes):
    with load(processes), threads(*[computes] * 3) as (thread, *_):
        assert not any(answers(thread))


def test_the_second_check_finds_that_a_callback_waits():
    waits, end = of_lock()
    with threads(lambda _: waits()) as (thread,):
        assert wait_for(lambda: waits_for_else(thread.native_id))
        assert answers(thread, 3, 0) == [False, True, True]
        end()


def test_a_callback_that_polls_waits():
    def polls(ends):
        while not ends.wait(0.005):
            pass

    with threads(polls) as (thread,):
        assert wait_for(lambda: any(answers(thread, 10)))


def test_a_callback_that_has_computed_between_two_checks_does_not_wait():
    """Though both found it waiting for something else."""
    gate, leaves = threading.Semaphore(0), []

    def computes_at_times(_):
        while gate.acquire() and not leaves:
            end = time.thread_time_ns() + 5 * MS
            while time.thread_time_ns() < end:
                pass

    with threads(computes_at_times) as (thread,):
        def used():
            return gil_check.cpu_ns(thread.ident)

        def waits_at(now):
            assert wait_for(lambda: waits_for_else(thread.native_id))
            return check.waits(thread.ident, thread.native_id, now)

        check = GilCheck()
        assert not waits_at(0)
        before = used()
        gate.release()
        assert wait_for(lambda: used() >= before + 5 * MS)
        assert not waits_at(100 * MS)
        assert waits_at(101 * MS)
        gate.release()
        assert wait_for(lambda: used() >= before + 10 * MS)
        assert waits_at(100_000 * MS)  # that is hardly anything
        leaves.append(1)
        gate.release()


def test_without_proc_the_time_that_a_thread_has_computed_decides(kernel_that_hides_threads):
    """A thread that gets no CPU counts as waiting: two callbacks may share, none hangs."""
    assert gil_check._gil_address() == 0
    waits, end = of_lock()
    with threads(lambda _: waits()) as (thread,):
        assert wait_for(lambda: any(answers(thread, 3)))
        end()
    me = threading.current_thread()
    check, found = GilCheck(), []
    for _ in range(3):
        found.append(check.waits(me.ident, me.native_id, time.thread_time_ns()))
        before = time.thread_time_ns()
        while time.thread_time_ns() < before + MS:
            pass
    assert found == [False, False, False]


def test_a_child_process_has_the_address_of_its_parent():
    """A fork copies the interpreter to the same addresses."""
    program = """
import os, sys
from mddag_executor.executor.gil_check import _gil_address, GIL_BYTES
before = _gil_address()
child = os.fork()
if not child:
    os._exit(not before or abs(_gil_address.__wrapped__() - before) >= GIL_BYTES)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    assert subprocess.run([sys.executable, '-c', program], timeout=120).returncode == 0


def computes_a_bit_and_sleeps():
    for _ in range(10):
        sum(range(10_000))
        time.sleep(0.005)


def computes_for_20_ms():
    end = time.thread_time() + 0.02
    while time.thread_time() < end:
        pass


@pytest.mark.skipif(
    gil_check.cpu_wait_ns() is None, reason='this kernel does not show how long threads wait')
@pytest.mark.parametrize('processes', [0, 4])
@pytest.mark.parametrize(
    'body, holds', [(computes_a_bit_and_sleeps, 0), (computes_for_20_ms, 1)])
def test_preemptions_do_not_hide_whether_a_callback_holds_the_gil(
        monkeypatch, processes, body, holds):
    """A callback that sleeps for long is always preempted on a busy machine."""
    monkeypatch.setattr(gil, 'times_preempted', count().__next__)
    habit = GilHabit()
    with load(processes):
        for _ in range(3):
            measurement = Measurement(habit)
            body()
            measurement.end()
    assert (habit.is_known, habit.holds) == (True, holds)
    assert 0 <= habit.share <= 1


def test_a_thread_that_waited_for_a_cpu_all_the_time_has_computed_in_the_rest(monkeypatch):
    """The kernel counts that a little earlier or later than the times around it are read."""
    monkeypatch.setattr(gil, 'cpu_wait_ns', count(0, 1_000_000 * MS).__next__)
    habit = GilHabit()
    Measurement(habit).end()
    assert (habit.is_known, habit.holds, habit.share) == (True, 1, 1.0)
