# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Executions that have not ended: of callbacks that hang, or still run when the run ends.

Theory of operation
-------------------
1.  An execution is recorded when it ends.  So one that never ends is noted separately: when the
    run ends, and, as the process may be killed before, each ``LONG_NS`` that it has run.
2.  The note says where the execution is: the line of the user's code that its thread runs or its
    coroutine has reached, and the service that it waits for.
3.  A suspended coroutine has not ended either: it may wait for a future that is never done.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import PurePath
import sys
from types import FrameType
from typing import Any, NamedTuple, Protocol

from mddag_executor.clocks import TraceClock
from mddag_executor.core import NEVER
from mddag_executor.executor.compat import requested_service
from mddag_executor.executor.work import Work

LONG_NS = 1_000_000_000
"""An execution that has run for so long is noted before it ends."""
_NOT_OF_USER = {*sys.stdlib_module_names, 'mddag_executor', 'rclpy'} - {'__main__'}


class Thread(Protocol):
    """A thread that runs callbacks: see ``threads.WorkerThread``."""

    work: Work | None
    vtid: int
    ident: int
    is_out: bool
    waits_for: str

    @property
    def since(self) -> int:
        """Return when the running execution began, on the trace's clock; 0: none runs."""


class Engine(Protocol):
    """The engine, as notes need it: see ``engine.Engine``."""

    def begun(self) -> list[Work]:
        """Return the coroutines that have begun, and are suspended or wait to go on."""

    def note_unfinished(self, several: Iterable[Unfinished], now: int) -> None:
        """Record executions that have not ended."""


class Pool(Protocol):
    """The worker pool, as notes need it: see ``workers.WorkerPool``."""

    clock: TraceClock

    @property
    def engine(self) -> Engine:
        """Return the engine."""

    def threads(self) -> Sequence[Thread]:
        """Return the threads that run callbacks."""


class Unfinished(NamedTuple):
    """
    An execution that has not ended.

    :ivar vtid: its thread; 0: none, as it is suspended.
    :ivar worker: its worker; -1: none.
    :ivar since: when it, or its suspension, began, on the trace's clock.
    :ivar where: where it is and what it waits for; empty if unknown.
    """

    work: Work
    vtid: int
    worker: int
    since: int
    where: str


def unfinished(pool: Pool, until: int = NEVER) -> list[Unfinished]:
    """Return the executions that run or are suspended, and did so at a time; from any thread."""
    return [*_running(pool, until), *_suspended(pool, until)]


def _running(pool: Pool, until: int) -> Iterator[Unfinished]:
    for thread in pool.threads():
        since, work = thread.since, thread.work
        if work is None or not 0 < since <= until or work.entity.is_own:
            continue
        found = Unfinished(work, thread.vtid, -1 if thread.is_out else work.worker, since,
                           _where_running(thread))
        if thread.since == since:  # else it has ended meanwhile
            yield found


def _suspended(pool: Pool, until: int) -> Iterator[Unfinished]:
    for work in pool.engine.begun():
        since, steps = work.suspended_ns, work.coroutine
        if 0 < since <= until and not work.entity.is_own and steps is not None:
            yield Unfinished(work, 0, -1, since, _where_suspended(steps))


class LongRuns:
    """Records executions that have run for ``LONG_NS``, again and again, until they end."""

    def __init__(self, pool: Pool) -> None:
        self._pool = pool
        self._noted_at = 0

    def note(self) -> None:
        """Record them if the last time is ``LONG_NS`` ago; called regularly, by one thread."""
        now = self._pool.clock.now()
        if now - self._noted_at >= LONG_NS:
            self._noted_at = now
            self._pool.engine.note_unfinished(unfinished(self._pool, now - LONG_NS), now)


# --- where it is ---------------------------------------------------------------------------------

def _where_running(thread: Thread) -> str:
    frame = sys._current_frames().get(thread.ident)
    while frame is not None and not _is_of_user(frame):
        frame = frame.f_back
    return _said(frame, thread.waits_for)


def _where_suspended(steps: Any) -> str:
    inner: Any = steps.get_coro()
    frame: FrameType | None = None
    while inner is not None:    # down the chain of awaits
        at = getattr(inner, 'cr_frame', None)
        if at is not None and _is_of_user(at):
            frame = at
        inner = getattr(inner, 'cr_await', None)
    service = requested_service(steps.waits_for)
    return _said(frame, f'service {service}' if service else 'a future')


def _is_of_user(frame: FrameType) -> bool:
    module = str(frame.f_globals.get('__name__', ''))
    return module.partition('.')[0] not in _NOT_OF_USER


def _said(frame: FrameType | None, waits_for: str) -> str:
    at = '' if frame is None else (
        f'at {PurePath(frame.f_code.co_filename).name}:{frame.f_lineno}')
    return ', '.join(each for each in (at, waits_for and f'waits for {waits_for}') if each)
