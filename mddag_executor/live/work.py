# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The unit of work: one execution of a callback."""

from __future__ import annotations

from collections.abc import Callable
import types
from typing import Any

from mddag_executor.live.compat import awaited
from mddag_executor.live.entity import Entity, TIMER
from mddag_executor.live.jobs import Origin
from rclpy.exceptions import InvalidHandle


class QuickCallback:
    """
    A future's done callback that takes no time, and never fails.

    A future hands its callbacks to its executor as tasks; this one is called at once instead.
    """

    __slots__ = ('_function',)

    def __init__(self, function: Callable[[], Any]) -> None:
        self._function = function

    def __call__(self, _: Any = None) -> None:
        """Call the function."""
        self._function()


class Destroyed(Exception):
    """
    The entity was destroyed after its execution had become ready: it must not run.

    Or it is a timer that was cancelled.
    """


class Work:
    """
    One execution of a callback: what to call, for which job, and where it stands.

    The intake makes it of what has been taken: that is no longer in the middleware.

    :ivar rclpy_entity: the timer, subscription, service, guard condition or waitable.
    :ivar function: what is to be called for it, with ``args``.
    :ivar then: what is to be called with its result, or None: a service's response is sent so.
    :ivar info: of a message: what the middleware says of it, with its stamps.
    :ivar due: of a timer: its nominal due time, ns on the scale of ``time.monotonic_ns``, a point
        of the timer's exact phase grid; with simulated time active, when it was noticed. After
        an overrun it is when the first of the missed periods was due.
    :ivar missed: so many periods after that one are skipped, as rcl does it.
    :ivar entity: what the executor keeps for the entity.
    :ivar x: the execution in the core; -1 before it is ready and after it has ended.
    :ivar origin: the vertex and job that it executes; None where no DAG declares it.
    :ivar worker: where it runs, or has run last.
    :ivar is_known: whether the executor would know if the entity were destroyed.
    :ivar ready_ns: when it became ready, on the trace's clock.
    :ivar cpu_ns: what it has computed, while a trace is recorded.
    """

    __slots__ = (
        'rclpy_entity', 'function', 'args', 'then', 'info', 'due', 'missed', 'entity', 'x',
        'coroutine', 'origin', 'worker', 'is_known', 'ready_ns', 'cpu_ns')

    def __init__(
        self, rclpy_entity: Any, function: Callable[..., Any], args: tuple[Any, ...] = (),
        then: Callable[[Any], Any] | None = None, info: dict[str, Any] | None = None,
        due: int | None = None, missed: int = 0, entity: Entity | None = None,
    ) -> None:
        self.rclpy_entity = rclpy_entity
        self.function = function
        self.args = args
        self.then = then
        self.info = info
        self.due = due
        self.missed = missed
        self.entity: Entity = entity  # type: ignore[assignment]  # else the receiver sets it
        self.coroutine: Any = None
        self.origin: Origin | None = None
        self.x = self.worker = -1
        self.is_known = False
        self.ready_ns = self.cpu_ns = 0

    def step(self) -> Any:
        """
        Run, or go on running; return None when it has finished, else what it waits for.

        :raises Destroyed: where it must not run any more.
        :raises BaseException: whatever the callback raises.
        """
        if self.coroutine is None:
            handle = self.entity.handle
            if handle is not None and not (self.is_known and self.entity.kind != TIMER):
                try:
                    with handle:
                        # One more may have become due before it was cancelled in its callback.
                        if self.entity.kind == TIMER and self.entity.rclpy.is_canceled():
                            raise Destroyed
                except InvalidHandle:
                    raise Destroyed from None
            result = self.function(*self.args)
            if type(result) is not types.CoroutineType:
                if self.then is not None:
                    self.then(result)
                return None
            self.coroutine = result
        try:
            yielded = self.coroutine.send(None)
        except StopIteration as stop:
            if self.then is not None:
                self.then(stop.value)
            return None
        return yielded if yielded is not None else awaited(self.coroutine)

    def close(self) -> None:
        """Close what will never run on."""
        if self.coroutine is not None:
            self.coroutine.close()


def _nothing() -> None:
    pass


class TaskWork(Work):
    """An execution of an rclpy ``Task``; exceptions are the task's."""

    __slots__ = ()

    def step(self) -> Any:
        """Run the task once; return None when it is done."""
        task: Any = self.function
        task.waits_for = None
        task()
        if task.done() or task.cancelled():
            self.function = _nothing  # whoever else holds on to the task does so: see ``tasks``
            if self.then is not None:
                self.then(task)
            del task
            return None
        return awaited(self.coroutine) if task.waits_for is None else task.waits_for
