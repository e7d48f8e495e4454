# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
One run of an executor, from the start of its nodes to a clean end.

Theory of operation
-------------------
The executor spins in a separate thread.  The thread that made the ``Session`` only waits, so
Python delivers signals to it at once, whatever the executor does.  Everything that can end a run
(time, a signal, an exception of a callback, the end of the programs) calls ``stop``.

``stop`` notes the end and releases a lock on which ``wait`` sleeps.  A ``threading.Event`` would
be wrong.  A signal handler runs in the waiting thread, between any two of its steps, even while
that thread owns the event's inner lock; ``set`` would then wait for that lock for ever.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
import math
import threading
import time

from mddag_executor.child import Tick
from mddag_executor.errors import MddagError
from mddag_executor.text import counted
from rclpy.executors import Executor, ExternalShutdownException

END_TIMEOUT_S = 30.0
"""How long running callbacks may take to end, and then programs."""
MATCH_TIMEOUT_S = 30.0


class SessionError(MddagError):
    """A run that cannot begin."""


class Session:
    """
    Spins an executor in a thread; a context manager.

    :param executor: any rclpy executor, with or without nodes.
    :param spin: spins it; by default ``executor.spin``.
    :param on_end: called when its end begins.
    :ivar error: the exception that has ended the run.
    :ivar clean: whether all callbacks have ended; one that does not is left running.
    :ivar stopped: whether the run is to end.
    """

    def __init__(
        self, executor: Executor, spin: Callable[[], None] | None = None,
        on_end: Callable[[], None] | None = None,
    ) -> None:
        self.executor = executor
        self.error: BaseException | None = None
        self.clean = True
        self.stopped = self._ended = False
        self._on_end = on_end or (lambda: None)
        self._is_hurried = False
        self._end_by = math.inf
        self._bell = threading.Lock()
        self._bell.acquire()
        self._spin = spin or executor.spin
        self._thread = threading.Thread(target=self._run, name='mddag-spin', daemon=True)

    def __enter__(self) -> Session:
        self._thread.start()
        return self

    def __exit__(self, *args: object) -> None:
        self.end()

    def _run(self) -> None:
        try:
            self._spin()
        except ExternalShutdownException:
            pass  # the context was shut down: that also ends a run
        except BaseException as error:
            self.error = error
        finally:
            self.stop()

    def stop(self) -> None:
        """End the run, even from a signal handler."""
        self.stopped = True
        with suppress(RuntimeError):  # it is released already
            self._bell.release()

    def hurry(self) -> None:
        """Wait no longer for callbacks that still run at the end, even from a signal handler."""
        self._is_hurried = True

    def is_patient(self) -> bool:
        """Return whether what runs at the end may still take its time."""
        return not self._is_hurried and time.monotonic() < self._end_by

    def wait(self, seconds: float | None, tick: Tick | None = None) -> bool:
        """Wait, for ever with None; return whether the run is to end."""
        begin = now = time.monotonic()
        end = math.inf if seconds is None else begin + seconds
        while now < end and not self.stopped:
            self._bell.acquire(True, min(0.5, end - now))
            now = time.monotonic()
            if tick is not None and not self.stopped:
                tick(now - begin)
        return self.stopped

    def wait_until_matched(
        self, unmatched: Callable[[], list[str]], patience_s: float = MATCH_TIMEOUT_S
    ) -> None:
        """
        Wait until publishers and subscriptions have discovered each other, or the run is to end.

        :param unmatched: returns the topics on which they have not.
        :param patience_s: how long to wait for progress.
        :raises SessionError: when there is no progress in that time.
        """
        fewest = math.inf
        end = 0.0
        while topics := unmatched():
            if len(topics) < fewest:
                fewest, end = len(topics), time.monotonic() + patience_s
            if self.wait(0.02):
                return
            if time.monotonic() > end:
                raise SessionError(
                    f'{topics[0]}: publishers and subscriptions have not discovered each other '
                    f'within {patience_s:.0f} s ({counted(len(topics), "topic")} in all): check '
                    'ROS_DOMAIN_ID and the network')

    def end(self) -> None:
        """Shut the executor down, once."""
        self.stop()
        if self._ended:
            return
        self._ended = True
        self._on_end()
        self._end_by = time.monotonic() + END_TIMEOUT_S
        finish = getattr(self.executor, 'finish_callbacks', None)
        if finish is not None and self._thread.is_alive() and not finish(self.is_patient):
            self.executor.shutdown(0.0)
            self._abandon()
            return
        # In steps: a signal may shorten the wait meanwhile.
        while self.executor.shutdown(0.1) is False:
            if not self.is_patient():
                self._abandon()
                return
        while self._thread.is_alive() and self.is_patient():
            self._thread.join(0.1)
        self._thread.join(0.2)
        self.clean = not self._thread.is_alive()

    def _abandon(self) -> None:
        """Leave callbacks running that have not ended."""
        self.clean = False
        abandon = getattr(self.executor, 'abandon_callbacks', None)
        if abandon is not None:
            abandon()
