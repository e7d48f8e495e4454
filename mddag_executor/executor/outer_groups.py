# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The groups of callbacks that a host of programs opens and closes (``core.rules``, rule 4)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TYPE_CHECKING
import weakref

from mddag_executor.executor.work import current

if TYPE_CHECKING:
    from mddag_executor.executor.workers import WorkerPool


def outer_here() -> int:
    """Return the outer group of the calling callback, and so of its tasks; -1: none."""
    running = current.running
    work = None if running is None else running.work
    return -1 if work is None else work.entity.outer


class OuterGroup:
    """
    The callbacks of a program's executor, of which a limited number may run at a time.

    It is also what runs the done callbacks of its clients' futures.  It exists as long as the one
    who made it, a node or an unfinished task refers to it; then its number is used again.

    :param create_task_in: the executor's method that makes tasks of a group.
    :param is_single: whether at most one of them runs at a time whenever it is open.
    :ivar number: in the core.
    :ivar n_nested: how many of its callbacks wait in a call, or spin an executor themselves.
    """

    def __init__(
        self, pool: WorkerPool, create_task_in: weakref.WeakMethod[Callable[..., Any]],
        is_single: bool,
    ) -> None:
        self._pool = pool
        self._create_task_in = create_task_in
        self.is_single = is_single
        with pool.lock:
            while pool.freed_outer_groups:
                pool.engine.outer.free(pool.freed_outer_groups.popleft())
            self.number = pool.engine.outer.new()
        pool.outer_groups[self.number] = self
        # Any thread may call the finalizer, even one that owns the lock.
        weakref.finalize(self, pool.freed_outer_groups.append, self.number).atexit = False
        self.n_nested = 0
        # what ``open`` has set
        self._limit, self._once = 0, False

    def open(self, limit: int, once: bool = False) -> bool:
        """
        Let this many callbacks run at a time, or none.

        :param once: only until the next one starts.
        :return: whether one may start now.
        """
        with self._pool.lock:
            self._limit, self._once = limit, once
            return self._apply()

    def _apply(self) -> bool:
        """Tell the core; return whether a callback may start now.  The caller holds the lock."""
        pool = self._pool
        now = pool.tick()
        limit, once = self._limit, self._once
        if self.n_nested:
            limit, once = max(1, limit), False
        may_start = pool.engine.outer.open(self.number, limit, now, once)
        if limit:
            pool.wake_for_more()
        return may_start

    def n_running(self) -> int:
        """Return how many callbacks run, including those that wait in a call or in a spin."""
        with self._pool.lock:
            return self._pool.n_running_of(self.number)

    @contextmanager
    def nested(self) -> Iterator[None]:
        """Let others run while a callback waits in a call or a spin of its own."""
        with self._pool.lock:
            if self._once:  # it is what this was open for
                self._limit, self._once = 0, False
            self.n_nested += 1
            self._apply()
        try:
            yield
        finally:
            with self._pool.lock:
                self.n_nested -= 1
                self._apply()

    def take_wait_ns(self) -> int:
        """Return how long callbacks have waited for others of the group since the last call."""
        with self._pool.lock:
            return self._pool.engine.outer.read_wait(self.number)

    def create_task(self, callback: Any, *args: Any, **kwargs: Any) -> Any:
        """Run a function or coroutine as one of the group."""
        create_task_in = self._create_task_in()
        if create_task_in is None:
            raise RuntimeError('the executor has been destroyed')
        return create_task_in(self.number, callback, *args, **kwargs)
