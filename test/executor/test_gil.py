# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Callbacks that compute in Python: one at a time, most urgent first, and never a deadlock."""

from __future__ import annotations

import sys
import threading
import time
from types import SimpleNamespace
from typing import Any

from mddag_executor.executor.interpreter import Habit, Interpreter
import msg_graph
import pytest
from rclpy.callback_groups import ReentrantCallbackGroup
from std_msgs.msg import Header

from .conftest import Spinning, wait_for

NAMES = ('a', 'b', 'c', 'd')
MS = 1_000_000


def graph(holds: str, deadlines: tuple[int, ...] = (50, 50, 50, 50)) -> msg_graph.TaskSet:
    """Declare a subscription for each name; ``holds`` is what they say of the interpreter."""
    return msg_graph.loads('mddag: 1\nnodes:\n  - node: /node\n    callbacks:\n' + ''.join(
        f'      - {{name: {name}, subscription: /{name}, dag: {name}, period: 100ms, '
        f'deadline: {deadline}ms, holds_interpreter: {holds}}}\n'
        for name, deadline in zip(NAMES, deadlines)), 'g.yaml')


def compute(ms: float) -> None:
    """Take so much CPU, in Python."""
    end = time.thread_time_ns() + int(ms * MS)
    while time.thread_time_ns() < end:
        pass


class Bodies:
    """Callbacks that note when they run; one for each name."""

    def __init__(self, node: Any, body: Any) -> None:
        self.ran: list[str] = []
        self.at_once = 0
        self._running = 0
        self._lock = threading.Lock()
        self._body = body
        group = ReentrantCallbackGroup()
        self.publishers = {name: node.create_publisher(Header, f'/{name}', 100) for name in NAMES}
        for name in NAMES:
            node.create_subscription(
                Header, f'/{name}', lambda message, name=name: self._run(name), 100,
                callback_group=group)

    def _run(self, name: str) -> None:
        with self._lock:
            self._running += 1
            self.at_once = max(self.at_once, self._running)
            self.ran.append(name)
        self._body(name)
        with self._lock:
            self._running -= 1

    def publish(self, *names: str) -> None:
        for name in names:
            self.publishers[name].publish(Header())


@pytest.mark.parametrize('holds, at_once', [('true', 1), ('false', 4)])
def test_as_many_run_at_once_as_the_declaration_says(make_executor, make_node, holds, at_once):
    node = make_node()
    gate = threading.Barrier(4) if at_once == 4 else None

    def body(name: str) -> None:
        if gate is not None:
            gate.wait(20.0)  # passes only when all four are there
        compute(5)

    bodies = Bodies(node, body)
    executor = make_executor(graph(holds))
    executor.add_node(node)
    with Spinning(executor):
        bodies.publish(*NAMES)
        assert wait_for(lambda: len(bodies.ran) == 4, 20.0)
    assert bodies.at_once == 1 if at_once == 1 else bodies.at_once >= at_once


def test_what_is_held_back_runs_in_the_order_of_deadlines(make_executor, make_node):
    node = make_node()
    begun, go_on = threading.Event(), threading.Event()

    def body(name: str) -> None:
        if name == 'a' and not begun.is_set():
            begun.set()
            while not go_on.is_set():  # computes
                pass

    bodies = Bodies(node, body)
    executor = make_executor(graph('true', (5_000, 60_000, 20_000, 40_000)))
    executor.add_node(node)
    with Spinning(executor):
        bodies.publish('a')
        assert begun.wait(5.0)
        bodies.publish('b', 'd', 'c')
        assert wait_for(lambda: executor.statistics()['queue'] == 3)
        go_on.set()
        assert wait_for(lambda: len(bodies.ran) == 4)
    assert bodies.ran == ['a', 'c', 'd', 'b']


def test_a_long_callback_does_not_hold_up_a_more_urgent_one(make_executor, make_node):
    """
    A camera computes until the 1 kHz callback has run thrice meanwhile, so it must let it.

    Its deadline is far: once it were late it would be the more urgent one.
    """
    node, ticks, seen = make_node(), [], []
    group = ReentrantCallbackGroup()
    node.create_timer(0.001, lambda: ticks.append(None), callback_group=group)

    def capture() -> None:
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
        'g.yaml'))
    executor.add_node(node)
    with Spinning(executor):
        assert wait_for(lambda: len(seen) >= 3, 160.0)
    assert min(seen[:3]) >= 3


def test_one_that_waits_for_another_gives_the_interpreter_back(make_executor, make_node):
    """Declared as computing, but it waits for one that is held back: no deadlock."""
    node = make_node()
    done, waited = threading.Event(), []

    def body(name: str) -> None:
        if name == 'a':
            compute(3)
            waited.append(done.wait(20.0))
        else:
            done.set()

    bodies = Bodies(node, body)
    executor = make_executor(graph('true'))
    executor.add_node(node)
    with Spinning(executor):
        bodies.publish('a')
        assert wait_for(lambda: bodies.ran == ['a'])
        bodies.publish('b')
        assert wait_for(lambda: waited, 20.0)
    assert waited == [True]


def test_who_computes_is_learnt_and_shown(make_executor, make_node):
    node, ran = make_node(), []
    node.create_timer(0.01, lambda: (compute(3), ran.append('computes')))
    node.create_timer(0.011, lambda: (time.sleep(0.003), ran.append('sleeps')),
                      callback_group=ReentrantCallbackGroup())
    executor = make_executor()
    executor.add_node(node)

    def holds(period: str) -> list[bool]:
        return [count['holds_interpreter'] for name, count in executor.statistics()[
            'callbacks'].items() if count['kind'] == 'timer' and count['ran'] and period in name]

    with Spinning(executor):
        assert wait_for(lambda: any(holds('')), 20.0)
        ran.clear()
        assert wait_for(lambda: ran.count('sleeps') > 10 and ran.count('computes') > 10, 20.0)
        found = executor.statistics()['callbacks']
    assert not all(count['holds_interpreter'] for count in found.values())
    shares = [count['interpreter_share'] for count in found.values()]
    assert any(share is not None and share > 0.5 for share in shares)


def test_the_switch_interval_is_given_back(make_executor, make_node):
    node, seen = make_node(), []
    node.create_timer(0.001, lambda: seen.append(sys.getswitchinterval()))
    executor = make_executor()
    executor.add_node(node)
    before = sys.getswitchinterval()
    with Spinning(executor):
        assert wait_for(lambda: seen)
    assert seen[0] == pytest.approx(0.001) and sys.getswitchinterval() == before


def test_nothing_is_left_when_it_ends(make_executor, make_node):
    node = make_node()
    bodies = Bodies(node, lambda name: compute(5))
    executor = make_executor(graph('true'))
    executor.add_node(node)
    with Spinning(executor):
        bodies.publish(*NAMES, *NAMES)
        assert wait_for(lambda: len(bodies.ran) == 8, 20.0)
    assert 'mddag-overseer' not in [thread.name for thread in threading.enumerate()]


def learnt(
    *executions: tuple[float, float, float], habit: Habit | None = None, waited: int = 0,
) -> int:
    """
    Return whether a callback holds the interpreter after these executions.

    Each is its duration, its CPU time and that of the process, in ms; ``waited`` is how long its
    thread waited for a CPU.
    """
    habit = habit or Habit()
    for execution in executions:
        habit.runs += 1
        if habit.runs < habit.due or not habit.is_to_be_measured():
            continue
        duration, computed, process_computed = (int(ms * MS) for ms in execution)
        beside = process_computed - computed
        habit.ran(duration, (0, 0), (computed, waited * MS), beside)
    return habit.holds


def test_the_share_of_cpu_in_the_duration_decides():
    assert learnt() == 0
    assert learnt((10, 9.5, 9.6)) == 1
    assert learnt((10, 0.2, 0.3)) == 0
    assert learnt(*[(10, 9.5, 9.6)] * 3, *[(10, 0.2, 0.3)] * 20) == 0
    assert learnt(*[(10, 0.2, 0.3)] * 3, *[(10, 9.5, 9.6)] * 30) == 1
    assert learnt(*[(0.001, 0.001, 0.001)] * 20) == 0  # too short to matter


def test_two_that_fight_for_the_lock_are_both_found_out():
    assert learnt((20, 10, 20)) == 1
    assert learnt((70, 10, 70)) == 1
    assert learnt((20, 0.2, 15)) == 0  # sleeps while others compute


def test_who_sleeps_while_others_compute_is_not_thought_to_compute():
    beside_all_the_time = (1.4, 0.1, 2.9)  # one computes in Python, others without the lock
    habit = Habit()
    for _ in range(500):
        assert learnt(beside_all_the_time, habit=habit) == 0
    habit = Habit()
    assert learnt(*[(10, 0.6, 0.7)] * 20, habit=habit) == 0
    taken_for_one = sum(learnt((10, 0.6, 25), habit=habit) for _ in range(5000))
    assert 0 < taken_for_one < 50  # for one execution now and then, to find out


def test_who_computes_for_less_than_a_turn_is_seldom_interrupted():
    interrupted = (1.2, 0.1, 1.3)
    assert learnt(*[*[(0.1, 0.1, 0.1)] * 5, interrupted] * 100) == 1


def test_that_the_machine_stood_still_once_changes_nothing():
    habit = Habit()
    assert learnt(*[(10, 9.5, 9.6)] * 31, (1000, 9.5, 9.6), habit=habit) == 1
    for _ in range(50):
        assert learnt((10, 9.5, 9.6), habit=habit) == 1


def test_other_processes_do_not_count():
    assert learnt(*[(40, 9.5, 9.6)] * 20) == 0
    assert learnt(*[(40, 9.5, 9.6)] * 20, waited=29) == 1


def test_what_is_declared_is_not_learnt():
    assert learnt(*[(10, 0.2, 0.3)] * 20, habit=Habit(True)) == 1
    assert learnt(*[(10, 9.5, 9.6)] * 20, habit=Habit(False)) == 0


def test_who_mixes_numpy_and_python_keeps_nobody_from_the_interpreter():
    habit = Habit()
    assert learnt((10, 9.5, 9.6), habit=habit) == 1
    for _ in range(20):
        habit.was_released(False)
        habit.was_released(True)
    assert habit.holds == 0
    assert 0.3 < habit.share < 0.7
    for _ in range(3):
        habit.was_released(False)
    assert any(learnt((10, 9.5, 9.6), habit=habit) for _ in range(200))


def test_computing_with_the_lock_released_is_noticed_and_looked_at_again():
    habit = Habit()
    assert learnt((10, 9.5, 9.6), habit=habit) == 1
    for _ in range(20):
        habit.was_released(True)
    assert habit.holds == 0
    assert learnt((10, 9.5, 9.6), habit=habit) == 0
    assert any(learnt((10, 9.5, 9.6), habit=habit) for _ in range(200))
    habit.was_released(True)
    assert habit.holds == 0
    for _ in range(20):
        habit.was_released(False)
    assert any(learnt((10, 9.5, 9.6), habit=habit) for _ in range(20))


def test_the_alarm_that_rings_for_the_end_is_not_set_anew():
    engine: Any = SimpleNamespace(queues=(), has_waiting=False)
    interpreter = Interpreter(engine, threading.Lock(), [], lambda: None)
    interpreter._watch(3600 * 1000 * MS)
    ring = interpreter._alarm.ring

    def ring_and_look() -> None:
        ring()
        interpreter.look_after()

    interpreter._alarm.ring = ring_and_look  # type: ignore[method-assign]
    closing = threading.Thread(target=interpreter.close, daemon=True)
    closing.start()
    closing.join(60)
    assert not closing.is_alive()
