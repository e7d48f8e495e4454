# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The unit of work: one execution of a callback."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
import threading
import types
from typing import Any, Protocol

from mddag_executor.executor.compat import awaited
from mddag_executor.executor.entity import Entity, TIMER
from mddag_executor.executor.jobs import Origin
from rclpy.exceptions import InvalidHandle


class RunningThread(Protocol):
    """A thread in which a callback runs, as far as rclpy's wrapped methods need it."""

    work: Work | None
    engine: Any
    pool: Any
    published: int

    def publishes(self, publisher: Any, msg: Any, topic: str) -> None:
        """Note that the callback publishes."""

    def is_brief(self) -> bool:
        """Return whether a callback runs in it that probably ends soon."""

    def lend(self) -> AbstractContextManager[None]:
        """Lend its worker while entered: the callback waits."""

    @property
    def job(self) -> tuple[str, int, int] | None:
        """Return DAG, index and release of the job whose callback runs; None for no job."""


class _Current(threading.local):
    running: RunningThread | None = None


current = _Current()
"""Of the calling thread: ``running``, the thread's own object while a callback runs in it."""


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
    One execution of a callback: what to call, for which job, and where it is.

    :ivar entity: what the executor keeps for the timer, subscription, service, …
    :ivar function: what is to be called for it, with ``args``.
    :ivar then: what is to be called with its result, or None: a service's response is sent so.
    :ivar x: the execution in the core; -1 before it is ready and after it has ended.
    :ivar origin: the vertex and job that it executes; None if no DAG declares it.
    :ivar worker: the worker that runs it, or has run it last.
    :ivar must_check: whether the entity may be destroyed, or its timer cancelled, by now.
    :ivar ready_ns: when it became ready, on the trace's clock.
    :ivar cpu_ns: how long it has computed.
    :ivar yields: how many times in a row its coroutine has yielded without awaiting a future.
    """

    __slots__ = (
        'entity', 'function', 'args', 'then', 'x', 'coroutine', 'origin', 'worker',
        'must_check', 'ready_ns', 'cpu_ns', 'yields')

    def __init__(
        self, entity: Entity, function: Callable[..., Any], args: tuple[Any, ...] = (),
        then: Callable[[Any], Any] | None = None,
    ) -> None:
        self.entity = entity
        self.function = function
        self.args = args
        self.then = then
        self.coroutine: Any = None
        self.origin: Origin | None = None
        self.x = self.worker = -1
        self.must_check = True
        self.ready_ns = self.cpu_ns = self.yields = 0

    def step(self) -> Any:
        """
        Run, or go on running; return None when it has finished, else what it waits for.

        :raises Destroyed: where it must not run any more.
        :raises BaseException: whatever the callback raises.
        """
        if self.coroutine is None:
            if self.must_check:
                self._check()
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

    def _check(self) -> None:
        entity = self.entity
        if entity.handle is None:
            return
        try:
            with entity.handle:
                # One more may have become due before it was cancelled in its callback.
                if entity.kind == TIMER and entity.rclpy.is_canceled():
                    raise Destroyed
        except InvalidHandle:
            raise Destroyed from None


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
