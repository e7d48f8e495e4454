# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""One CPU for the threads that hold the interpreter lock."""

from __future__ import annotations

from collections.abc import Iterator
import os
import threading
import time
from typing import Any

from mddag_executor.errors import UsageError
from mddag_executor.live.entries import Entry, TASK, Work
from mddag_executor.live.gathering import Gathering, LIGHT_FROM, LIGHT_NS, LOOK_S, SAMPLE
import pytest
from rclpy.node import Node

from .conftest import Spinning, wait_for

CPUS = os.sched_getaffinity(0)
several = pytest.mark.skipif(len(CPUS) < 2, reason='there is one CPU only')


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
    policy = os.sched_getscheduler(0)
    yield
    os.sched_setaffinity(0, CPUS)
    os.sched_setscheduler(0, policy, os.sched_param(0))


def run(gathering: Gathering, entry: Entry, cpu_ns: int = 0) -> set[int]:
    """Return where a callback may run."""
    seen: list[set[int]] = []

    def callback() -> None:
        seen.append(os.sched_getaffinity(0))
        end = time.thread_time_ns() + cpu_ns
        while time.thread_time_ns() < end:
            pass

    gathering.step(Work(entry, callback, ()))
    entry.ran += 1
    return seen[0]


def task() -> Entry:
    return Entry(TASK, None, '', None, -1, 0, 'task')


def test_a_thread_that_joins_is_at_home_and_not_preempted() -> None:
    gathering = Gathering()
    gathering.join()
    assert os.sched_getaffinity(0) == {gathering.home}
    assert os.sched_getscheduler(0) == os.SCHED_BATCH


@several
def test_a_callback_roams_until_it_has_been_light_often_enough() -> None:
    gathering, entry = Gathering(), task()
    gathering.join()
    for _ in range(LIGHT_FROM):
        assert run(gathering, entry) == CPUS
        assert os.sched_getaffinity(0) == {gathering.home}
    assert run(gathering, entry) == {gathering.home}


@several
def test_a_callback_that_takes_much_cpu_roams() -> None:
    gathering, entry = Gathering(), task()
    gathering.join()
    for _ in range(LIGHT_FROM):
        run(gathering, entry)
    where = [run(gathering, entry, 2 * LIGHT_NS) for _ in range(SAMPLE + 1)]
    assert where[0] == {gathering.home}  # nobody knew
    assert where[-1] == CPUS
    assert os.sched_getaffinity(0) == {gathering.home}


@several
def test_a_callback_that_raises_brings_its_thread_home() -> None:
    gathering = Gathering()
    gathering.join()
    with pytest.raises(ZeroDivisionError):
        gathering.step(Work(task(), lambda: 1 / 0, ()))
    assert os.sched_getaffinity(0) == {gathering.home}


class Machine:
    """CPU times as a test says; of this thread none."""

    def __init__(self) -> None:
        self.busy = dict.fromkeys(CPUS, 0)
        self.mine = 1

    def gathering(self) -> Gathering:
        """Return one that this thread has joined, and that has looked once."""
        gathering = Gathering(
            cpu_times=lambda: dict(self.busy), thread_cpu_time=lambda _: self.mine)
        gathering.join()
        self.pass_second(gathering)
        return gathering

    def pass_second(self, gathering: Gathering) -> None:
        gathering._looked -= LOOK_S
        gathering.look()


@several
def test_the_home_moves_from_where_others_are() -> None:
    machine = Machine()
    gathering = machine.gathering()
    first = gathering.home
    machine.busy[first] += 900_000_000
    machine.pass_second(gathering)
    assert gathering.home != first
    assert os.sched_getaffinity(0) == {gathering.home}


@several
def test_it_does_not_move_from_its_own_work_nor_to_a_cpu_as_busy() -> None:
    machine = Machine()
    gathering = machine.gathering()
    first = gathering.home
    machine.busy[first] += 900_000_000
    machine.mine += 900_000_000
    machine.pass_second(gathering)
    assert gathering.home == first
    for cpu in CPUS:
        machine.busy[cpu] += 900_000_000
    machine.pass_second(gathering)
    assert gathering.home == first


def test_a_thread_that_has_ended_is_forgotten() -> None:
    gathering = Gathering()
    thread = threading.Thread(target=gathering.join)
    thread.start()
    thread.join()

    def forgotten() -> bool:
        gathering._looked -= LOOK_S
        gathering.look()
        return not gathering._threads

    assert wait_for(forgotten)


def test_where_there_is_no_affinity_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, 'sched_setaffinity')
    with pytest.raises(UsageError, match='one_cpu'):
        Gathering()
    monkeypatch.undo()


def test_workers_and_intake_share_a_cpu(make_executor: Any, make_node: Any) -> None:
    executor = make_executor(num_workers=2, one_cpu=True)
    node: Node = make_node()
    executor.add_node(node)
    calls: list[set[int]] = []
    timer = node.create_timer(0.01, lambda: calls.append(os.sched_getaffinity(0)))

    def homes() -> set[frozenset[int]]:
        return {
            frozenset(os.sched_getaffinity(t.native_id)) for t in threading.enumerate()
            if t.name.startswith(('mddag-worker', 'mddag-intake')) and t.native_id}

    with Spinning(executor):
        assert wait_for(lambda: len(calls) > LIGHT_FROM)
        timer.cancel()
        assert wait_for(lambda: len(homes()) == 1)
    assert calls[0] == CPUS
    assert os.sched_getaffinity(0) == CPUS  # this thread is none of the executor's
