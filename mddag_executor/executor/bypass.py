# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The bypass: short undeclared callbacks that run past the core while it has nothing else.

::

    a short undeclared callback becomes ready, and the core is empty
                │
                ▼        another one becomes ready, starts or ends
             ┌──────┐ ◀──────────┐
             │ OPEN │ ───────────┘
             └──────┘
                │  anything else: a declared callback; one that is long, answers a driven sync,
                │  decides itself when it runs, or belongs to a closed outer group; a second
                │  thread; an execution that lends its worker or is suspended
                ▼
             CLOSED: the running and the waiting ones are reported to the core, in their order

While it is open, the callbacks run one after the other in the order in which they became ready.
If a queue is full, its oldest execution is dropped, and the next one gets its place, as in the
core (``core.queues``).  The core would choose the same, so nothing but time depends on the bypass.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice
from typing import TYPE_CHECKING

from mddag_executor.executor.bounds import SHORT_CALLBACK_NS

if TYPE_CHECKING:
    from mddag_executor.executor.work import Work


class Bypass:
    """
    The executions that the core does not know of.

    Their ids (``Work.x``) are below -1 while they wait.

    :ivar is_open: whether short undeclared callbacks run past the core now.
    :ivar queue: those that wait, by their ids.
    :ivar running: the one that runs; None: there is none.
    """

    __slots__ = ('is_open', 'queue', 'running', '_running_since', '_next_id')

    def __init__(self) -> None:
        self.is_open = False
        self.queue: dict[int, Work] = {}
        self.running: Work | None = None
        self._running_since = 0
        self._next_id = -2

    @property
    def n_entered(self) -> int:
        """Return how many executions have waited here so far."""
        return -2 - self._next_id

    def enter(self, work: Work) -> None:
        """Let an execution wait."""
        x = work.x = self._next_id
        self._next_id = x - 1
        entity = work.entity
        entity.waiting[x] = None
        entity.ready += 1
        self.queue[x] = work

    def enter_full(self, work: Work) -> None:
        """Let an execution wait instead of the oldest one of its entity."""
        self.enter(work)
        queue, waiting = self.queue, work.entity.waiting
        first, second = islice(waiting, 2)
        oldest, successor = queue[first], queue.pop(second)
        del waiting[second]
        successor.place_ns = min(oldest.place_ns, oldest.ready_ns)
        queue[first] = successor
        successor.x = first
        oldest.x = -1

    def start(self, worker: int, now: int) -> Work | None:
        """Start the first one that waits; None: it is to start by way of the core."""
        queue = self.queue
        x = next(iter(queue))
        work = queue[x]
        entity = work.entity
        if self.running is not None or entity.wall_ns > SHORT_CALLBACK_NS or (
                entity.gate is not None):
            return None
        del queue[x]
        self.running = work
        self._running_since = now
        del entity.waiting[x]
        work.x = -1
        work.worker = worker
        return work

    def close(self) -> tuple[Work | None, int, Iterable[Work]]:
        """Return the running execution, since when it runs, and the waiting ones: none is left."""
        found = self.running, self._running_since, self.queue.values()
        self.is_open = False
        self.running = None
        self.queue = {}
        for work in found[2]:
            del work.entity.waiting[work.x]
        return found
