# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What is ready and does not run: messages of full queues, and all of destroyed entities.

Theory of operation
-------------------
A queue holds as many messages as its QoS says; of more than that the oldest go, and are counted.

What no DAG declares runs in the order of becoming ready, so that nobody starves.  For that the
turn is the callback's and not the message's: where a queue overflows all the time, none of its
messages ever waits long, and it would have its turn after everybody who has waited longer; for
ever, where there are always some.  So the next message takes the place of the one that goes.
"""

from __future__ import annotations

import threading

from mddag_executor.core import Scheduler
from mddag_executor.live.entries import Entry, Work
from mddag_executor.live.verdicts import NO_ORIGIN, Verdicts


class Dropping:
    """The part of the dispatcher that drops executions."""

    lock: threading.Lock
    scheduler: Scheduler
    undeclared: int
    verdicts: Verdicts
    _work: dict[int, Work]

    def tick(self) -> int:
        """Return the core's time now; the caller holds the lock."""
        raise NotImplementedError

    def decided(self, now: int) -> None:
        """Carry out what the core has decided since the last call."""
        raise NotImplementedError

    def _start_undeclared(self, entry: Entry, work: Work, now: int) -> None:
        raise NotImplementedError

    def _note_ready(self, entry: Entry, work: Work, x: int, now: int) -> None:
        raise NotImplementedError

    def _drop_oldest(self, entry: Entry, now: int) -> None:
        """Keep QoS: the oldest waiting message of a full queue goes."""
        self._drop(entry, next(iter(entry.waiting)), 'qos_depth', now)
        self.decided(now)

    def _replace_oldest(self, entry: Entry, work: Work, now: int) -> None:
        """Keep QoS for a callback that no DAG declares: whose turn it is stays as it was."""
        places = iter(entry.waiting)
        first, second = next(places), next(places, -1)
        gone = self._work[first]
        if second < 0:
            gone.x = -1
            self.undeclared += 1
            self.verdicts.note_drop(entry, NO_ORIGIN, 'qos_depth', now)
            self._note_ready(entry, work, first, now)
            return
        heir = self._work[second]
        self._work[first], self._work[second] = heir, gone
        heir.x, gone.x = first, second
        self._drop(entry, second, 'qos_depth', now)
        self.decided(now)
        self._start_undeclared(entry, work, now)

    def _drop(self, entry: Entry, x: int, reason: str, now: int) -> None:
        del entry.waiting[x]
        work = self._work.pop(x)
        work.x = -1
        self.scheduler.drop(x, now)
        self.verdicts.note_drop(entry, work.origin or NO_ORIGIN, reason, now)

    def remove(self, entry: Entry) -> None:
        """Forget a destroyed entity: what waits of it never runs."""
        with self.lock:
            entry.removed = True
            now = self.tick()
            for x in list(entry.waiting):
                self._drop(entry, x, 'destroyed', now)
            self.decided(now)
