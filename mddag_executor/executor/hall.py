# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What sources see of the worker pool, and the pool of the executor.

The pool (``workers``) collects from the sources, and they report to it; the executor makes the
pool, which tells it about changes.  Each knows the one above it by a protocol, so that imports
point one way.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Protocol

from mddag_executor.clocks import TraceClock
from mddag_executor.executor.engine import Engine
from mddag_executor.executor.loop import EventLoop
from mddag_executor.executor.work import Work


class Announced(Protocol):
    """Messages of other processes, whose jobs are announced."""

    def take(self, work: Work, info: dict[str, Any], now: int) -> None:
        """Handle a message that may be of another process."""


class Hall(Protocol):
    """The worker pool, to a source: see ``workers.WorkerPool``."""

    engine: Engine
    clock: TraceClock
    loop: EventLoop
    announcements: Announced | None
    fail: Callable[[BaseException], None]
    now: int

    def tick(self) -> int:
        """Return the engine's time now."""


class Spinner(Protocol):
    """The executor, to its pool."""

    @property
    def context(self) -> Any:
        """Return its context."""

    def wake(self) -> None:
        """Note that entities have changed."""

    def serve_meanwhile(self) -> AbstractContextManager[None]:
        """Let other threads do all work while a callback waits."""
