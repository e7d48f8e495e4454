# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the tests of the intakes share: a recording receiver, and ways to wait for things."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
import itertools
import os
import threading
import time
from typing import Any

from mddag_executor.live.intake.entities import snapshot
from mddag_executor.live.intake.events import EventsIntake
from mddag_executor.live.intake.waitset import WaitSetIntake
from mddag_executor.live.work import Work
from rclpy.context import Context
from rclpy.node import Node
from rclpy.waitable import NumberOfEntities, Waitable
import std_msgs.msg

INTAKES = ('events', 'waitset', 'poll')
THREADED = ('events', 'waitset')
MS = 1_000_000

_numbers = itertools.count()


def nothing(*_: Any) -> None:
    pass


def look_after(intake: Any, *nodes: Node) -> None:
    intake.update(snapshot(nodes))


def start(intake: Any, *nodes: Node) -> None:
    look_after(intake, *nodes)
    intake.start()


class Recorder:
    """A receiver that keeps what it gets; ``react`` holds functions to call with it as well."""

    def __init__(self) -> None:
        self.executor = None
        self.rounds: list[int] = []
        self.timers: list[tuple[Any, int]] = []
        self.missed: list[tuple[Any, int, int]] = []
        self.messages: list[tuple[Any, Any, dict[str, Any]]] = []
        self.requests: list[tuple[Any, Any]] = []
        self.guards: list[Any] = []
        self.waitables: list[tuple[Any, Any]] = []
        self.errors: list[BaseException] = []
        self.react: dict[str, Callable[..., None]] = {}

    def _reaction(self, kind: str, *what: Any) -> None:
        reaction = self.react.get(kind)
        if reaction is not None:
            reaction(*what)

    def take(self, work: Work) -> None:
        self.take_in((work,))

    def take_in(self, arrivals: Sequence[Work]) -> None:
        self.rounds.append(len(arrivals))
        for arrival in arrivals:
            self._arrived(arrival)

    def _arrived(self, arrival: Work) -> None:
        entity, function, args = arrival.rclpy_entity, arrival.function, arrival.args
        then, info, due, missed = arrival.then, arrival.info, arrival.due, arrival.missed
        if due is not None:
            self.timers.append((entity, due))
            if missed:
                self.missed.append((entity, due, missed))
            self._reaction('timer', entity, due)
        elif info is not None:
            self.messages.append((entity, args[0], info))
            self._reaction('message', entity, args[0], info)
        elif then is not None:
            self.requests.append((entity, args[0]))
            self._reaction('request', entity, args[0], then)
        elif args:
            self.waitables.append((entity, args[0]))
            self._reaction('waitable', entity, function, args[0])
        else:
            self.guards.append(entity)
            self._reaction('guard', entity)

    def on_intake_error(self, error: BaseException) -> None:
        self.errors.append(error)

    def dues(self, timer: Any) -> list[int]:
        """Return the due times that this timer was handed over with."""
        return [due for t, due in self.timers if t is timer]

    def texts(self, subscription: Any) -> list[str]:
        """Return the data of this subscription's messages."""
        return [m.data for s, m, _ in self.messages if s is subscription]


class PollingIntake:
    """A ``WaitSetIntake`` that a thread polls, with the methods of the others."""

    def __init__(self, context: Context, receiver: Recorder) -> None:
        self._intake = WaitSetIntake(context, receiver)
        self._context = context
        self._thread: threading.Thread | None = None
        self._stopping = False
        self._error: Exception | None = None
        self.update = self._intake.update
        self.wake = self._intake.wake

    def start(self) -> None:
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name='polling')
        self._thread.start()

    def _run(self) -> None:
        try:
            while not self._stopping and self._context.ok():
                self._intake.poll(None)
        except Exception as error:  # else the test would only wait in vain
            self._error = error

    def stop(self) -> None:
        self._stopping = True
        self._intake.wake()
        if self._thread is not None:
            self._thread.join(5.0)
            assert not self._thread.is_alive()
            self._thread = None
        assert self._error is None, self._error


def make_intake(kind: str, context: Context, receiver: Recorder) -> Any:
    """Return an intake of this kind of INTAKES."""
    if kind == 'events':
        return EventsIntake(context, receiver)
    if kind == 'waitset':
        return WaitSetIntake(context, receiver)
    return PollingIntake(context, receiver)


def make_node(context: Context, **options: Any) -> Node:
    """Return a node with a name of its own."""
    return Node(f'node_{next(_numbers)}', context=context, **options)


def topic() -> str:
    """Return a name that no other test has used."""
    return f'/name_{os.getpid()}_{next(_numbers)}'


def text(data: str) -> std_msgs.msg.String:
    return std_msgs.msg.String(data=data)


def wait_for(condition: Callable[[], Any], seconds: float = 5.0) -> Any:
    """Return the first true value of a condition, or its last one after some time."""
    end = time.monotonic() + seconds
    while True:
        value = condition()
        if value or time.monotonic() > end:
            return value
        time.sleep(0.002)


def intake_threads() -> list[threading.Thread]:
    """Return the threads of all intakes."""
    return [t for t in threading.enumerate() if t.name.startswith('mddag-intake')]


def cpu_ns(threads: Iterable[threading.Thread]) -> int:
    """Return the CPU time that these threads have had."""
    return sum(
        time.clock_gettime_ns(time.pthread_getcpuclockid(t.ident))
        for t in threads if t.ident is not None)


def matched(publisher: Any, count: int = 1) -> bool:
    """Wait until a publisher has found its subscriptions."""
    return bool(wait_for(lambda: publisher.get_subscription_count() >= count))


def on_grid(dues: list[int], period: int) -> bool:
    """Return whether due times are points of one exact phase grid, and never go back."""
    steps = [b - a for a, b in zip(dues, dues[1:])]
    return all(step > 0 and step % period == 0 for step in steps)


class Pulse(Waitable):
    """A waitable of one's own, made of a guard condition."""

    def __init__(self, node: Node, group: Any) -> None:
        super().__init__(group)  # type: ignore[no-untyped-call]
        self.guard = node.create_guard_condition(lambda: None)
        node._guards.remove(self.guard)
        self._index: int | None = None
        self.order: list[str] = []

    def __enter__(self) -> None:
        self.guard.handle.__enter__()

    def __exit__(self, *_: Any) -> None:
        self.guard.handle.__exit__(None, None, None)

    def is_ready(self, wait_set: Any) -> bool:
        ready = bool(wait_set.is_ready('guard_condition', self._index))
        if ready:
            self.order.append('ready')
        return ready

    def take_data(self) -> int:
        self.order.append('take')
        return len(self.order)

    async def execute(self, taken_data: int) -> None:
        pass

    def get_num_entities(self) -> NumberOfEntities:
        return NumberOfEntities(num_gcs=1)

    def add_to_wait_set(self, wait_set: Any) -> None:
        self._index = wait_set.add_guard_condition(self.guard.handle)
