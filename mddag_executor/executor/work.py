# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The unit of work: one execution of a callback, which a user-defined callback group may refuse.

Theory of operation
-------------------
The core implements rclpy's two kinds of callback groups.  A mutually exclusive group is also
notified of each execution, and may refuse it: other executors may run callbacks of it, for example
because a node was moved while its callback ran.  Any other group is asked, as by rclpy's
executors: ``can_execute`` and ``beginning_execution`` before a callback, and ``ending_execution``
after it.  This is user code, which may wait for a lock.  So the worker that is to run the callback
asks, without the engine's lock.

Each entity of such a group is a group of one in the core (rule 4).  Its execution leaves that
group as soon as it may run.  So the group is asked about an entity's messages one at a time, in
their order.  A refused execution of either kind waits; the group is asked again after each
callback that ends, and every few milliseconds during a spin.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
import threading
import types
from typing import Any, Protocol

from mddag_executor.core import NEVER
from mddag_executor.executor.attribution import Origin
from mddag_executor.executor.compat import cancel_running
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.interrupts import runs_callbacks
from mddag_executor.executor.starters import set_starter, Starter, starter_outside
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.exceptions import InvalidHandle


class Runner(Protocol):
    """The thread that runs a callback: see ``workers.WorkerThread``."""

    work: Work | None
    is_copy: bool
    pool: Any
    engine: Any

    @property
    def job(self) -> tuple[str, int, int] | None:
        """Return DAG, index and release of its job."""

    def publishes(self, publisher: Any, state: Any, msg: Any, of: Work | None = None) -> None:
        """Note that the callback publishes; ``of``: on behalf of this execution."""

    def lend(self, waits_for: str = '') -> AbstractContextManager[Any]:
        """Lend the worker while entered."""

    def is_short(self) -> bool:
        """Return whether the callback is short."""


class _Current(threading.local):
    running: Runner | None = None


current = _Current()
"""For the calling thread: ``running``, a ``Runner`` while a callback runs in it."""


def starter_here() -> Starter | None:
    """Return the starter of what the calling thread starts; None: it works for no job."""
    running = current.running
    if running is None:
        return starter_outside()
    return None if running.work is None else starter_of(running.work, running.pool)


def starter_of(work: Work, pool: Any) -> Starter | None:
    """Return the starter of what an execution starts that runs in a pool; None: it has no job."""
    if work.origin is not None or work.answers is not None:
        return Starter(work, pool)
    return work.starter


def new_steps(coroutine: Any) -> Any:
    """Return the steps of a coroutine that the calling thread's callback has returned."""
    from mddag_executor.executor.coroutines import Steps  # with asyncio, when it is needed
    running = current.running
    steps = Steps(coroutine, None if running is None else running.pool.loops())
    set_starter(steps.get_context(), starter_here())
    return steps


def is_cancelled(error: BaseException) -> bool:
    """Return whether it is the exception that ends a cancelled coroutine."""
    return type(error).__name__ == 'CancelledError' and type(error).__module__ == (
        'asyncio.exceptions')


class Destroyed(Exception):
    """
    The entity was destroyed after its execution had become ready: it must not run.

    :cvar reason: why the execution is dropped.
    """

    reason = 'destroyed'


class Withdrawn(Destroyed):
    """The program does not want the execution any more: it has cancelled or reset the timer."""

    reason = 'withdrawn'


class Work:
    """
    One execution of a callback: its function, job, and state.

    :ivar entity: the executor's record of the timer, subscription, service, …
    :ivar function: the function to call for it, with ``args``.
    :ivar then: called with its result, or None: sends a service's response.
    :ivar x: the execution in the core; -1 before it is ready and after it has ended.
    :ivar origin: its vertex and job; None if it is undeclared.
    :ivar answers: of a driven sync, the vertex and job that it completes if it publishes; None
        before it starts, and for other callbacks.
    :ivar published: of a driven sync, the topics that it has published.
    :ivar sent: its publications on topics of ``PathWatch.topics``, with their times.
    :ivar heritage: what it inherits (see ``sent_requests``); None: nothing.
    :ivar starter: of a task: the execution on whose behalf it runs; None: none.
    :ivar worker: its current or last worker.
    :ivar ready_ns: when it became ready, on the trace's clock.
    :ivar place_ns: if it has the place of an older execution, which was dropped because the queue
        was full (see ``bypass``): when that one became ready; otherwise NEVER.
    :ivar due_ns: when its timer was due, on the trace's clock; 0: it is of no timer.
    :ivar n_resets: how many times its timer had been reset when it was due.
    :ivar was_reset: whether its timer was reset since it had been due before.
    :ivar cpu_ns: its CPU time.
    :ivar coroutine: its ``coroutines.Steps``, if it is one and has begun.
    :ivar paused_ns: for how long it has paused since it was dispatched.
    :ivar suspended_ns: when its coroutine was suspended last, on the trace's clock; 0: never.
    :ivar yields: how many times in a row its coroutine has yielded without awaiting a future.
    """

    # those that each execution uses: a default of the class is read nine times more slowly
    __slots__ = (
        'entity', 'function', 'args', 'then', 'x', 'worker', 'origin', 'coroutine', 'ready_ns',
        'paused_ns', 'was_reset', 'n_resets', '__dict__', '__weakref__')

    # most executions never set these
    answers: Origin | None = None
    heritage: tuple[int, int] | None = None
    starter: Starter | None = None
    published: frozenset[str] = frozenset()
    sent: tuple[tuple[str, int], ...] = ()
    due_ns = cpu_ns = yields = suspended_ns = 0
    place_ns = NEVER

    def __init__(
        self, entity: Entity, function: Callable[..., Any], args: tuple[Any, ...] = (),
        then: Callable[[Any], Any] | None = None,
    ) -> None:
        self.entity = entity
        self.function = function
        self.args = args
        self.then = then
        self.origin: Origin | None = None
        self.coroutine: Any = None
        self.x = self.worker = -1
        self.ready_ns = self.paused_ns = self.n_resets = 0
        self.was_reset = False

    @runs_callbacks
    def run(self, must_check: bool = True) -> Any:
        """
        Run, or continue; return None when it has finished, else what it waits for.

        :param must_check: the entity may be destroyed, or its timer cancelled or reset, by now.
        :raises Destroyed: if it must not run any more.
        :raises BaseException: the exception of the callback.
        """
        if self.coroutine is None:
            if must_check:
                self._check()
            result = self.function(*self.args)
            if type(result) is not types.CoroutineType:
                if self.then is not None:
                    self.then(result)
                return None
            self.coroutine = new_steps(result)
        steps = self.coroutine
        try:
            steps.send()
        except StopIteration as stop:
            if self.then is not None:
                self.then(stop.value)
            return None
        except BaseException as error:
            if not (is_cancelled(error) and steps.cancelling()):
                raise
            return None
        return steps.waits_for

    def _check(self) -> None:
        entity = self.entity
        if entity.handle is None:
            return
        try:
            with entity.handle:
                if entity.is_withdrawn(self):
                    raise Withdrawn
        except InvalidHandle:
            raise Destroyed from None


def _nothing() -> None:
    pass


class TaskWork(Work):
    """An execution of an rclpy ``Task``; exceptions are the task's."""

    @runs_callbacks
    def run(self, must_check: bool = True) -> Any:
        """Run the task once; return None when it is done."""
        task: Any = self.function
        try:
            task()
        except BaseException as error:
            if not is_cancelled(error):
                raise
            cancel_running(task)
        if task.done() or task.cancelled():
            self.function = _nothing  # other references to the task may remain: see ``tasks``
            if self.then is not None:
                self.then(task)
            del task
            return None
        return self.coroutine.waits_for


# --- callback groups of a user-defined class -----------------------------------------------------

_METHODS = ('can_execute', 'beginning_execution', 'ending_execution')


class Refused(Exception):
    """The callback group does not let a callback run now."""


def decides_itself(group: Any) -> bool:
    """Return whether a callback group is of neither of rclpy's kinds, or overrides one of them."""
    return not any(
        all(getattr(getattr(group, name), '__func__', None) is getattr(kind, name)
            for name in _METHODS)
        for kind in (MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup))


def run_in_group(
    group: Any, entity: Any, passed: Callable[[Work], None], work: Work, must_check: bool = True
) -> Any:
    """
    Run a step of an execution as ``Work.run`` does, or raise Refused.

    :param group: the user-defined callback group of rclpy's entity.
    :param passed: called before an execution runs.
    """
    if work.coroutine is None:
        if not (group.can_execute(entity) and group.beginning_execution(entity)):
            raise Refused
        passed(work)
    waits_for = None
    try:
        waits_for = work.run(must_check)
    finally:
        if waits_for is None:
            group.ending_execution(entity)
    return waits_for
