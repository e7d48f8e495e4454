# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A thread's place in the pool, and what the hooks ask of it.

``current.running`` is the seat whose callback runs in the calling thread, or None.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
import threading
from time import monotonic_ns
from typing import Any, TYPE_CHECKING

from mddag_executor.clocks import TraceClock
from mddag_executor.core import NEVER
from mddag_executor.live.engine import Engine
from mddag_executor.live.jobs import NO_ORIGIN, PublisherState
from mddag_executor.live.thread_clock import Reading, ThreadClock
from mddag_executor.trace.groups import PUBLICATION

if TYPE_CHECKING:
    from mddag_executor.live.work import Work


class _Current(threading.local):
    running: Seat | None = None
    intake: Seat | None = None


current = _Current()
"""
Of the calling thread: ``running``, the seat whose callback runs in it, and ``intake``, the seat on
which an intake's thread may run what it takes; None where there is none.
"""


class Seat:
    """
    A thread that runs callbacks, and what it runs.

    :ivar engine: whose executions it runs.
    :ivar worker: the worker that it is; -1: none at present.
    :ivar work: the execution that it runs, or is to run when it is woken.
    :ivar thread: its thread where that is one of the pool's own.
    :ivar waits: whether its callback waits for a service, and has lent its worker.
    :ivar published: when the callback that runs published first (monotonic ns); 0: not yet.
    :ivar refused: whether a callback group has not let something run in it.
    :ivar relieved: whether another thread does what it, an intake's, would do otherwise.
    """

    __slots__ = (
        'worker', 'wake', 'work', 'ended', 'thread', 'vtid', 'cpu_clock', 'waits', 'relieved',
        'reading', 'began_ns', 'others_before', 'engine', '_clock', '_lend', 'published',
        'refused')

    def __init__(
        self, engine: Engine, clock: TraceClock, worker: int,
        lend: Callable[[Seat], AbstractContextManager[None]],
    ) -> None:
        self.worker = worker
        self.wake = threading.Lock()
        self.wake.acquire()
        self.work: Work | None = None
        self.ended = False
        self.thread: threading.Thread | None = None
        self.vtid = 0
        self.waits = False
        self.relieved = False
        # for ``interpreter``: the CPU clock of its thread, and what that and those of the others
        # read when its execution began, where it is measured; when that was, on the trace's clock
        self.cpu_clock: ThreadClock | None = None
        self.reading: Reading | None = None
        self.began_ns = NEVER
        self.others_before = 0
        self.engine = engine
        self._clock = clock
        self._lend = lend
        self.published = 0
        self.refused = False

    def publish(
        self, send: Any, publisher: Any, msg: Any, state: PublisherState, begin: int
    ) -> None:
        """Publish on behalf of the callback that runs; the caller holds the publisher's lock."""
        work, engine = self.work, self.engine
        assert work is not None
        if engine.record is not None:
            engine.record(
                PUBLICATION, self._clock.now(), self.vtid, id(publisher), id(msg))
        if state.topic not in work.entity.publishes:
            work.entity.publishes.add(state.topic)
        engine.jobs.publish(send, publisher, msg, state, work.origin or NO_ORIGIN, begin)
        if not self.published:
            self.published = monotonic_ns()

    def lend(self) -> AbstractContextManager[None]:
        """Lend its worker while entered: the callback waits for a service."""
        return self._lend(self)

    @property
    def job(self) -> tuple[str, int, int] | None:
        """Return DAG, index and release of the job whose callback runs; None for no job."""
        if self.work is None or self.work.origin is None:
            return None
        return (self.engine.dag_names[self.work.origin.dag], self.work.origin.job,
                self.engine.release_of(self.work))
