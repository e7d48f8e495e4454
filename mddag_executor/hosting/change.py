# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the spins of programs wait for, in a way that signals may interrupt."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
import threading
import time

from mddag_executor.executor.interrupts import wait_for_permit


class Change:
    """
    Lets threads wait until another thread notifies them of a change.

    A ``threading.Condition`` has a lock.  A handler of a signal that interrupts a thread which has
    the lock could not notify, and an exception of the handler could leave the lock acquired.
    """

    def __init__(self) -> None:
        self._permits: set[threading.Lock] = set()  # one for each thread that waits

    def notify(self) -> None:
        """Let all threads that wait check their conditions again; from any thread or handler."""
        for permit in list(self._permits):
            with suppress(RuntimeError):  # it has been notified already
                permit.release()

    def wait_for(self, is_over: Callable[[], bool], timeout_s: float | None) -> None:
        """Wait until a function returns True, or the timeout is over; None: there is none."""
        end = None if timeout_s is None else time.monotonic() + timeout_s
        permit = threading.Lock()
        permit.acquire()
        self._permits.add(permit)
        try:
            while not is_over():
                left = None if end is None else end - time.monotonic()
                if left is not None and left <= 0:
                    break
                wait_for_permit(permit, left)
        finally:
            self._permits.discard(permit)
