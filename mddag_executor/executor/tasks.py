# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Tasks of the executor: futures that know whether their exception is handled.

Theory of operation
-------------------
The exception of a task comes out of the spin, as with rclpy's executors, unless it is handled: the
task was awaited, or got a done callback, before it failed (it is *observed*).  A spin that waits
for a task (``spin_until_future_complete``) does not observe it: it raises the exception itself.

With several workers a task may fail before the callback that created it reaches its ``await`` or
``result()``.  So the exception of such a task is kept while that callback runs and a reference
to the task exists.  If the exception is fetched meanwhile, it is handled.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
import inspect
from typing import Any, TYPE_CHECKING
import weakref

from mddag_executor.executor.bounds import REMEMBERED
from mddag_executor.executor.compat import (
    BareTask,
    forget_task_frames,
    function_of_task,
    name_of_task,
    QuickCallback,
)
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.starters import set_starter
from mddag_executor.executor.work import current, starter_here, TaskWork, Work
from rclpy.task import Future

if TYPE_CHECKING:
    from mddag_executor.executor.coroutines import Loops
    from mddag_executor.executor.recorder import Recorder

CHECK_S = 0.05
"""How often to check whether a callback still runs that has created a failed task."""


class ObservedTask(BareTask):
    """
    A task that knows whether it is observed, so that its exception is handled.

    :ivar maker: the execution whose callback has created it, or None.
    :ivar report_to: receives a kept exception that was not handled.
    :ivar spins: how many spins wait for its end.
    :ivar outer_group: the one that it belongs to, which exists as long as the task.
    """

    outer_group: Any = None

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.observed = False
        running = current.running
        self.maker: Work | None = None if running is None else running.work
        self.report_to: Callable[[BaseException], None] | None = None
        self.spins = 0
        self._claims = [None]
        super().__init__(*args, **kwargs)  # type: ignore[no-untyped-call]

    def __del__(self) -> None:
        """Report a kept exception: it cannot be handled any more."""
        if self.report_to is not None:
            self.report()
        super().__del__()  # type: ignore[no-untyped-call]

    def unclaimed(self) -> BaseException | None:
        """Return the exception if it is not handled."""
        return None if self.observed else self.unfetched()

    def claim(self) -> BaseException | None:
        """Return the exception if it is not handled, to one caller only, which raises it."""
        error = self.unclaimed()
        try:
            if error is not None:
                self._claims.pop()  # one thread succeeds
        except IndexError:
            return None
        self.mark_fetched()
        return error

    def is_expected(self) -> bool:
        """Return whether its maker still runs, or a spin waits for it: they may handle it."""
        return self.spins > 0 or self.maker is not None and self.maker.x >= 0

    def report(self) -> None:
        """Report a kept exception, unless it has been handled."""
        report, self.report_to = self.report_to, None
        error = None if report is None else self.claim()
        if error is not None and report is not None:
            report(error)

    def add_done_callback(self, callback: Callable[[Future], None]) -> None:
        """Add a callback for the end of the task."""
        self.observed = True
        super().add_done_callback(callback)  # type: ignore[no-untyped-call]


class Unclaimed:
    """
    The exceptions of tasks that are not handled yet.

    :param fail: receives those that remain unhandled.
    :param ring: called when there is a task to ``check``.
    """

    def __init__(
        self, fail: Callable[[BaseException], None], ring: Callable[[], None] = lambda: None
    ) -> None:
        self._fail = fail
        self._ring = ring
        # weak references, so that an unreferenced task is destroyed and reports its exception
        self._tasks: deque[weakref.ref[ObservedTask]] = deque()

    def ended(self, task: ObservedTask) -> None:
        """Note that a task has ended; raise its exception if that cannot be handled."""
        error = task.unclaimed()
        if error is None:
            task.maker = None
            return
        if not task.is_expected():
            error = task.claim()
            if error is not None:
                raise error
            return
        forget_task_frames(error)  # else the task refers to itself
        task.report_to = self._fail
        self._tasks.append(weakref.ref(task))
        self._ring()

    def rest_s(self) -> float | None:
        """Return the seconds until the next ``check``; None: there are no tasks."""
        return CHECK_S if self._tasks else None

    def check(self) -> None:
        """Report the exceptions of tasks whose makers have ended."""
        for _ in range(len(self._tasks)):
            reference = self._tasks.popleft()
            task = reference()
            if task is None or task.unclaimed() is None:
                continue
            if task.is_expected():
                self._tasks.append(reference)
            else:
                task.report()


@contextmanager
def watched(future: Future, notify: Callable[[], object]) -> Iterator[None]:
    """
    Call a function when a future is done while entered, for a spin that waits for it.

    If the future is a task that has failed, its exception is raised at the end, unless it is
    handled.
    """
    callback = QuickCallback(notify)
    task = future if isinstance(future, ObservedTask) else None
    if task is not None:
        task.spins += 1
    Future.add_done_callback(future, callback)  # not an observer
    try:
        yield
    finally:
        future.remove_done_callback(callback)
        if task is not None:
            task.spins -= 1
    error = None if task is None else task.claim()
    if error is not None:
        raise error


class TaskEntity(Entity):
    """A task: it belongs to no node, and nothing arrives at it."""

    kind = 'task'
    names_type = False

    __slots__ = ('_symbol',)

    def __init__(self, node: str = '', symbol: str = '') -> None:
        super().__init__(None, node)
        self._symbol = symbol

    @property
    def symbol(self) -> str:
        """Return module and name of its function."""
        return self._symbol


class TaskEntities:
    """
    The executor's records of tasks: one for each function, as each has its own GIL habit.

    :param recorder: records them in the trace; None: there is none.
    """

    def __init__(self, recorder: Recorder | None) -> None:
        self._recorder = recorder
        # of functions beyond the ``REMEMBERED`` first ones
        self._others = self._new(-1)
        self._entities: dict[object, TaskEntity] = {}

    def of(self, callback: Any, args: tuple[Any, ...], outer: int = -1) -> TaskEntity:
        """
        Return the record of a task's function; an action's goals have that of its callback.

        :param outer: its outer group in the core, or -1.
        """
        key = outer, function_of_task(callback, args)
        if key not in self._entities and len(self._entities) >= REMEMBERED:
            if outer < 0:
                return self._others
            key = outer, None
        found = self._entities.get(key)
        if found is None:
            name = ('', '') if key[1] is None else name_of_task(callback, args)
            found = self._entities[key] = self._new(outer, *name)
        return found

    def _new(self, outer: int, node: str = '', symbol: str = '') -> TaskEntity:
        entity = TaskEntity(node, symbol)
        entity.outer = outer
        if self._recorder is not None:
            self._recorder.entities((), [entity])
        return entity


def make_task(
    entity: Entity, executor: Any, resume: Callable[[TaskWork], None], unclaimed: Unclaimed,
    loops: Callable[[], Loops] | None, callback: Any, args: tuple[Any, ...],
    kwargs: dict[str, Any],
) -> tuple[ObservedTask, TaskWork]:
    """
    Make a task of a function, a coroutine function or a coroutine, and the work that runs it.

    :param resume: makes the work ready again; called when the task is cancelled.
    :param unclaimed: receives the task with its exception when it has ended.
    :param loops: returns the event loops of coroutines; None: there are none.
    """
    steps, starter = None, starter_here()
    if inspect.iscoroutinefunction(callback):
        callback, args, kwargs = callback(*args, **kwargs), (), {}
    if inspect.iscoroutine(callback):
        from mddag_executor.executor.coroutines import Steps  # with asyncio, when it is needed
        steps = Steps(callback, None if loops is None else loops())
        set_starter(steps.get_context(), starter)
        callback = steps.as_coroutine()
    task = ObservedTask(callback, args, kwargs, executor=executor)
    work = TaskWork(entity, task)
    work.coroutine, work.starter = steps, starter
    work.then = unclaimed.ended
    if steps is not None:
        Future.add_done_callback(task, QuickCallback(partial(resume, work)))  # not an observer
    return task, work
