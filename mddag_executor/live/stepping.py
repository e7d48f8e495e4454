# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
One callback at a time: ``spin_once``.

It uses no thread at all: one wait set over everything hands over what is ready, and the calling
thread runs the one callback that the core puts first.
"""

from __future__ import annotations

from collections.abc import Callable
import threading
import time

from mddag_executor.live.compat import is_called_by_spin, RCL_ERRORS
from mddag_executor.live.entries import AtOnce
from mddag_executor.live.intake.waitset import ALL_KINDS, WaitSetIntake
from mddag_executor.live.pool import Pool
from mddag_executor.live.receiver import Receiver
from mddag_executor.live.upkeep import Upkeep
from rclpy.executors import TimeoutObject
from rclpy.task import Future


def deadline_of(timeout_sec: float | None) -> float | None:
    """
    Return the monotonic time at which a time-out is over; None for never.

    :param timeout_sec: seconds; None or negative: for ever.
    :raises TypeError: when it is no number.
    """
    if timeout_sec is None or timeout_sec < 0:
        return None
    return time.monotonic() + timeout_sec


class Stepping(Upkeep):
    """The part of the executor that runs one callback in the calling thread."""

    _pool: Pool
    _receiver: Receiver
    _spinning: threading.Lock

    def _check_context(self) -> None:
        raise NotImplementedError

    def _raise_error(self) -> None:
        raise NotImplementedError

    def _look_after(self) -> None:
        raise NotImplementedError

    def _submit_tasks(self) -> None:
        raise NotImplementedError

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """
        Wait for one callback and run it in the calling thread.

        Called by ``rclpy.spin``, which would otherwise run one callback at a time, it does what
        ``spin`` does.

        :param timeout_sec: seconds to wait; None or negative: for ever; 0: do not wait.
        """
        if timeout_sec is None and is_called_by_spin():
            self.spin()
            return
        self._spin_once(timeout_sec, lambda: False)

    def spin_once_until_future_complete(
        self, future: Future, timeout_sec: float | TimeoutObject | None = None
    ) -> None:
        """Wait for one callback, or until a future is done, and run it."""
        seconds = timeout_sec.timeout if isinstance(timeout_sec, TimeoutObject) else timeout_sec
        future.add_done_callback(AtOnce(self.wake))
        self._spin_once(seconds, lambda: future.done() or future.cancelled())

    def _spin_once(self, timeout_sec: float | None, done: Callable[[], bool]) -> None:
        deadline = deadline_of(timeout_sec)
        if not self._spinning.acquire(blocking=False):
            raise RuntimeError('Executor is already spinning')
        try:
            while not self.is_ending():
                self._check_context()
                self._look_after()
                if self._one_step(deadline, done) or done():
                    return
                if deadline is not None and time.monotonic() >= deadline:
                    return
        except RCL_ERRORS:
            self._check_context()
            raise
        finally:
            self._spinning.release()

    def _one_step(self, deadline: float | None, done: Callable[[], bool]) -> bool:
        """Take in what is ready, waiting where nothing is; run one callback if there is one."""
        self._raise_error()
        if self._inline is None:
            self._inline = WaitSetIntake(
                self.context, self._receiver, self.guards(), ALL_KINDS)
            self._changed = True
        self._refresh()
        self._pool.resume_polled()
        self._inline.poll(0.0)
        self._submit_tasks()
        if not self._pool.run_one():
            if done():  # what it woke up for has just been polled away
                return False
            left = None if deadline is None else max(0.0, deadline - time.monotonic())
            self._inline.poll(left)
            self._refresh()
            self._submit_tasks()
            if not self._pool.run_one():
                self._raise_error()
                return False
        self._raise_error()
        return True

    def halt(self) -> None:
        """Start nothing more, since the interpreter ends; see ``wait_halted``."""
        self.begin_end()
        self._pool.pause()
        self.wake()

    def wait_halted(self, seconds: float) -> None:
        """Wait until what runs has ended and nobody spins, at most for a time."""
        end = time.monotonic() + seconds
        self._pool.close(seconds)
        # Not by taking the lock: a thread that steps once more meanwhile would get an exception.
        while self._spinning.locked() and time.monotonic() < end:
            time.sleep(0.001)
