# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What sources see of the worker pool, and the pool of the executor.

The pool (``workers``) collects from the sources, and they report to it; the executor makes the
pool, which reports changes to it.  Each knows the one above it by a protocol, so that imports
point one way.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Protocol

from mddag_executor.clocks import TraceClock
from mddag_executor.executor.engine import Engine
from mddag_executor.executor.loop import EventLoop
from mddag_executor.executor.stamps import StampedReleases
from mddag_executor.executor.work import Work


class Announced(Protocol):
    """Messages of other processes, whose jobs are announced."""

    def receive(self, work: Work, info: dict[str, Any], now: int) -> None:
        """Handle a message that may be of another process."""


class Timers(Protocol):
    """Timers by due time, to a timer: see ``timers.TimerQueue``."""

    def add(self, source: Any) -> None:
        """Add a timer."""

    def remove(self, source: Any) -> None:
        """Remove a timer."""

    def ask(self, source: Any) -> None:
        """Ask rcl when a timer is due next."""

    def fire(self, source: Any) -> None:
        """Call a timer whose time has come, if rcl reports it due."""

    def follow(self, clock: Any, ask: Callable[[], None]) -> None:
        """Call a function after each jump of a clock, under the lock."""

    def follow_no_more(self, clock: Any, ask: Callable[[], None]) -> None:
        """End ``follow``."""


class Hall(Protocol):
    """
    The worker pool, to a source: see ``workers.WorkerPool``.

    :ivar unlocked_calls: functions to call when the calling thread does not own the lock.
    :ivar outer_groups: the executors for done callbacks of outer groups, by their numbers.
    """

    engine: Engine
    clock: TraceClock
    stamped_releases: StampedReleases
    loop: EventLoop
    announcements: Announced | None
    fail: Callable[[BaseException], None]
    running: bool
    now: int
    lock: Any
    context: Any
    unlocked_calls: deque[Callable[[], None]]
    outer_groups: dict[int, Any]

    @property
    def timers(self) -> Timers:
        """Return its timers."""

    @property
    def executor(self) -> Spinner | None:
        """Return the executor; None: it has been destroyed."""

    def is_inside(self) -> bool:
        """Return whether the calling thread owns the lock."""

    def report(self, event: Callable[..., None], *args: Any) -> None:
        """Report an event, which gets the time."""

    def tick(self) -> int:
        """Return the engine's time now."""

    def post(self, several: list[Work]) -> None:
        """Make undeclared executions ready."""

    def call_at(self, at: int, function: Callable[[], None]) -> None:
        """Let a worker thread call a function at a time (monotonic ns), without the lock."""


class Spinner(Protocol):
    """The executor, to its pool."""

    @property
    def context(self) -> Any:
        """Return its context."""

    def wake(self) -> None:
        """Note that entities have changed."""

    def serve_meanwhile(self) -> AbstractContextManager[None]:
        """Let other threads do all work while a callback waits."""
