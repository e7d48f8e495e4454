# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Callbacks that wait inside ``Client.call``: they lend their workers, and rejoin.

Theory of operation
-------------------
1.  *Lending.*  A callback that waits inside ``Client.call`` returns its worker to the core.  If
    there are fewer other threads than workers, a thread is made first.  If it cannot be made, the
    others do the work; without any, ``Client.call`` raises the error, since no thread would handle
    the answer.  At most ``MOST`` callbacks lend at the same time; further ones keep their workers.
2.  *Rejoining.*  When the callback has its answer, its execution waits in the core like any other
    one, and its thread waits for its *permit*.  The thread that dispatches the execution gives the
    worker to that thread, releases the permit, and chooses again.
3.  *Going on without a worker.*  All workers may run callbacks that wait for this one, for example
    for a lock that it owns.  So it goes on without a worker if all running callbacks wait for
    something (``GilCheck``) at two checks in a row, and no callback has ended between the two.
    Other threads of the program may compute meanwhile: they need no worker.  A callback also goes
    on without a worker when a spin ends, and in ``spin_once``, where only one callback runs.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from time import monotonic_ns
from typing import Any, Protocol

from mddag_executor.executor.bounds import ALONE_NS, MOST, REJOIN_NS
from mddag_executor.executor.engine import Engine, Step
from mddag_executor.executor.gil_check import GilCheck
from mddag_executor.executor.hall import Spinner
from mddag_executor.executor.pausing import Pauses
from mddag_executor.executor.threads import ThreadState, WorkerThread
from mddag_executor.executor.work import Work


class Pool(Protocol):
    """The worker pool, as lending sees it: see ``workers.WorkerPool``."""

    engine: Engine
    pauses: Pauses
    lock: Any
    running: bool
    offset: int
    now: int
    last_end: int

    @property
    def executor(self) -> Spinner | None:
        """Return the executor; None: it has been destroyed."""

    @property
    def polling(self) -> int:
        """Return how many threads wait for events."""

    def tick(self) -> int:
        """Return the engine's time now."""

    def running_threads(self) -> list[WorkerThread]:
        """Return the threads whose callbacks run with a worker."""

    def become(self, me: WorkerThread, state: ThreadState) -> None:
        """Change the state of a thread."""

    def need_threads(self, n_out: int) -> None:
        """Make a thread if there are fewer than workers, without the ``n_out`` that are lent."""

    def call(self) -> None:
        """Wake a thread."""

    def wake_for(self, now: int) -> None:
        """Wake a thread if it may start an execution."""

    def wake_for_more(self) -> None:
        """Wake a thread if an idle worker may start an execution."""


class Lending:
    """
    The callbacks without a worker; methods with ``the lock`` need the engine's.

    :ivar n_lent: how many times a worker was lent.
    :ivar n_out: how many callbacks have lent their workers now.
    :ivar rejoining: the threads of executions that wait to go on; needs the lock.
    """

    def __init__(self, pool: Pool) -> None:
        self._pool = pool
        self.n_lent = 0
        self.n_out = 0
        self.rejoining: dict[Work, WorkerThread] = {}

    @contextmanager
    def lend(self, me: WorkerThread, waits_for: str = '') -> Iterator[None]:
        """
        Lend the worker of a running callback to other threads.

        :param waits_for: what the callback waits for, in words.
        """
        pool = self._pool
        lends = False
        if me.work is not None and me.work.coroutine is not None:
            me.work.coroutine.let_others()
        with pool.lock:
            if not me.is_out and me.work is not None and self.n_out < MOST:
                if me.thread is not None and pool.running:
                    pool.need_threads(self.n_out + 1)
                lends = me.has_lent = me.is_out = True
                self.n_out += 1
                self.n_lent += 1
                pool.tick()
                pool.become(me, ThreadState.OUT)
                pool.engine.lend(me.work)
                pool.pauses.end()
                if pool.polling:
                    pool.wake_for_more()
                else:
                    pool.call()
        measurement = me.measurement if lends else None
        if measurement is not None:
            measurement.pause()
        before = me.waits, me.waits_for
        me.waits, me.waits_for = True, waits_for
        try:
            executor = pool.executor if me.thread is None else None
            with nullcontext() if executor is None else executor.serve_meanwhile():
                yield
        finally:
            me.waits, me.waits_for = before
            if lends and me.thread is not None:
                self._rejoin(me)
            if measurement is not None:
                measurement.resume()

    def _rejoin(self, me: WorkerThread) -> None:
        """Wait until the callback of the calling thread, which has lent its worker, may go on."""
        pool = self._pool
        engine = pool.engine
        work: Any = me.work
        with pool.lock:
            now = pool.tick()
            if not pool.running:
                return
            is_first = engine.rejoin(work, now)
            self.rejoining[work] = me
            # another thread chooses callbacks that wait already, as this one cannot run them
            if is_first:
                step = engine.step(me.worker, now)
                if step.work is not None:
                    self.hand_over(step)
            if pool.polling:
                pool.wake_for(now)
            else:
                pool.call()
        checks: dict[WorkerThread, GilCheck] = {}
        seen = -1, False
        while not me.permit.acquire(timeout=REJOIN_NS / 1e9):
            with pool.lock:
                before, seen = seen, (pool.last_end, self._all_wait(checks))
                if work in self.rejoining and engine.waits_for_place(work) and (
                        pool.now - now < ALONE_NS):
                    pool.tick()     # it is not to overlap with the one that has its place
                elif work in self.rejoining and seen == (before[0], True):
                    self._go_on_without(work)
        me.wait_for_pause()

    def _all_wait(self, checks: dict[WorkerThread, GilCheck]) -> bool:
        """Return whether all running callbacks have waited since the last call."""
        now = monotonic_ns()
        answers = [checks.setdefault(each, GilCheck()).waits(each.ident, each.vtid, now)
                   for each in self._pool.running_threads()]
        return all(answers)

    def hand_over(self, step: Step) -> None:
        """Let an execution go on that was dispatched again; the caller holds the lock."""
        work: Any = step.work
        pool, thread = self._pool, self.rejoining.pop(work)
        pool.become(thread, ThreadState.RUNNING)
        thread.worker = work.worker
        self.is_back(thread)
        if step.overtaken:
            pool.pauses.begin(step.overtaken, thread)
        thread.permit.release()

    def is_back(self, thread: WorkerThread) -> None:
        """Note that a thread has a worker again, or its callback has ended; needs the lock."""
        self.n_out -= thread.is_out
        thread.is_out = False

    def _go_on_without(self, work: Work) -> None:
        """Let an execution go on without a worker; the caller holds the lock."""
        self._pool.engine.go_on_without(work)
        thread = self.rejoining.pop(work)
        self._pool.become(thread, ThreadState.RUNNING)
        thread.permit.release()

    def let_go_on(self) -> None:
        """
        Let the executions go on that wait for their workers; the caller holds the lock.

        Of an outer group they go on one after the other.
        """
        for work in list(self.rejoining):
            if not self._pool.engine.waits_for_place(work):
                self._go_on_without(work)
