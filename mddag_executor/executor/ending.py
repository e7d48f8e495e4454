# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The end of an executor: its run is judged, and its threads and descriptors are freed.

Theory of operation
-------------------
1.  ``shutdown`` ends the executor and waits for running callbacks.  So does a spin that ends with
    its context.
2.  An executor that is not shut down ends when its context ends while it does not spin, or when
    it is destroyed.  Neither can wait for a lock or a thread: a thread that owns any lock may be
    the one that collects garbage.  So the parked workers are only woken to end, and the last of
    them does the rest.
3.  Therefore nothing that a thread refers to may refer to the executor: threads would keep it
    alive.  They have its methods by ``weakly.weakly``.
4.  Objects that were exempted from garbage collection (``freeze_gc``) are collected again.  Else
    nodes in reference cycles would never be destroyed, even at the end of the interpreter: other
    processes would wait for them, and with Kilted the middleware's shared memory would stay.
"""

from __future__ import annotations

import gc
import os
import select
import sys
import threading
from typing import TYPE_CHECKING

from mddag_executor.executor.interrupts import InterruptsDeferred
from mddag_executor.executor.publishing import unwatch
from mddag_executor.executor.unfinished import unfinished

if TYPE_CHECKING:
    from mddag_executor.executor.announcements import Announcements
    from mddag_executor.executor.at_once import AtOnce, SignalPipe
    from mddag_executor.executor.diagnostics import Diagnostics
    from mddag_executor.executor.misses import MissNotifier
    from mddag_executor.executor.recorder import Recorder
    from mddag_executor.executor.silences import Silences
    from mddag_executor.executor.upkeep import Upkeep
    from mddag_executor.executor.waitables import WaitSetThread
    from mddag_executor.executor.workers import WorkerPool


class Ending:
    """
    Ends the parts of an executor, each once.

    :ivar is_asked: whether the executor has been asked to end.
    :ivar spin_once_epoll: the epoll of ``spin_once``, once there is one.
    """

    def __init__(
        self, pool: WorkerPool, at_once: AtOnce, signals: SignalPipe, recorder: Recorder | None,
        notifier: MissNotifier | None,
    ) -> None:
        self.is_asked = False
        self.spin_once_epoll: select.epoll | None = None
        self.wait_sets: WaitSetThread | None = None
        self.upkeep: Upkeep | None = None
        self.diagnostics: Diagnostics | None = None
        self.announcements: list[Announcements | Silences] = []
        self._pool = pool
        self._at_once = at_once
        self._signals = signals
        self._recorder = recorder
        self._notifier = notifier
        # reentrant: a signal handler may end the run in the thread that is ending it
        self._lock = threading.RLock()
        self._has_ended = False
        self._has_frozen = False
        self._pid = os.getpid()

    def freeze_objects(self) -> None:
        """Collect garbage, and exempt all objects from later collections until the run ends."""
        self._has_frozen = True
        gc.collect()
        gc.freeze()

    def end_run(self) -> None:
        """
        Judge open jobs and close the trace, once; a second thread waits for the first.

        An interrupt comes out of it at its end: a further ``shutdown`` would not do the rest.
        """
        with InterruptsDeferred(), self._lock:
            if not self._has_ended:
                self._has_ended = True
                self._judge_and_close()

    def _judge_and_close(self) -> None:
        if self._has_frozen:
            gc.unfreeze()
        for each in (self.diagnostics, self.wait_sets):
            if each is not None:
                each.stop()
        unwatch(self._pool)
        if self.upkeep is not None:
            self.upkeep.clear()
        for announcements in self.announcements:
            announcements.close()
        try:
            self._pool.end_coroutines()
        finally:
            self._judge()

    def _judge(self) -> None:
        pool = self._pool
        with pool.lock:
            now = pool.tick()
            end = min(now, pool.stopped_at or now)
            pool.engine.finish(now, end, unfinished(pool))
        if self._recorder is not None:
            self._recorder.close(now, end)

    def close(self) -> None:
        """Close the descriptors, once the run has ended and no thread uses them any more."""
        with self._lock:
            if self._has_ended and self.is_asked:
                self._pool.close_descriptors(self._close_descriptors)

    def _close_descriptors(self) -> None:
        if self.spin_once_epoll is not None:
            self.spin_once_epoll.close()
        self._pool.loop.close()
        self._at_once.loop.close()
        self._pool.parking.close()
        self._signals.close()

    def abandon(self) -> None:
        """
        End everything, soon and without waiting; no thread spins.

        If threads have been started, the last worker does it (rule 2).
        """
        if self._has_ended and self.is_asked or sys.is_finalizing():
            return
        self.is_asked = True
        if os.getpid() != self._pid:
            return self._close_descriptors()  # a forked child: the threads are the parent's
        self._pool.leave(self._end_all)

    def _end_all(self) -> None:
        self.end_run()
        if self._notifier is not None:
            self._notifier.stop()
        self.close()

    def undo(self) -> None:
        """Free everything again, as the executor could not be made."""
        self._has_ended = self.is_asked = True
        for announcements in self.announcements:
            announcements.close()
        self._close_descriptors()
