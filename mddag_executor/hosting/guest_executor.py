# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The executors of hosted programs: the host's executor runs their nodes, and they wait.

The executor that a program makes gets a new class, derived from its former class, with the methods
of ``GuestExecutor`` instead of rclpy's.  So it does not matter when a program imports rclpy's
classes, and overridden methods stay.  ``node.executor`` is this executor even when the host's
executor runs the node.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import cache
import threading
from typing import Any, TYPE_CHECKING

from mddag_executor.executor.compat import is_called_by_spin
from mddag_executor.executor.tasks import watched
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.node import Node

if TYPE_CHECKING:
    from mddag_executor.hosting.host import Guest, Host

_MOST_TURNS = 10
"""At most this many callbacks, the usual queue depth, are remembered for ``spin_once``."""
_STEP_S = 0.01
"""A step of unknown callbacks ends after this time."""
_MOST_ERRORS = 100
"""At most this many exceptions are kept for the next spin: the program does not handle them."""


class GuestExecutor:
    """
    The methods of an executor of a hosted program.

    :ivar guest: the program; None when a callback has made the executor.
    :ivar is_global: whether it is the executor of ``rclpy.spin``, which removes a node after each
        use.
    :ivar has_spun: whether its nodes run, also those that are added later.
    """

    host: Host
    guest: Guest | None
    is_global = False
    _changed: threading.Condition
    _errors: deque[BaseException]
    has_spun = False
    _is_stopped = False
    _turns = 0  # callbacks that have run since the last spin
    _n_stepping = _n_spinning = 0

    @property
    def is_spinning(self) -> bool:
        """Return whether a thread spins (rclpy from 7.1.9 on)."""
        return self._n_spinning > 0

    def spin(self) -> None:
        """Let the nodes run, and wait for the end."""
        self._wait(lambda: False, None)
        self._turns = 0

    def spin_once(self, timeout_sec: Any = None) -> None:
        """Let the nodes run, and wait until a callback has run since the last call."""
        if timeout_sec is None and is_called_by_spin():
            self.spin()
        else:
            self._step(lambda: False, timeout_sec)

    def spin_until_future_complete(self, future: Any, timeout_sec: Any = None) -> None:
        """Let the nodes run, and wait for a future."""
        with watched(future, self.wake_waiting):
            self._wait(_is_done(future), timeout_sec)
        self._turns = 0

    def spin_once_until_future_complete(self, future: Any, timeout_sec: Any = None) -> None:
        """Do the same as ``spin_once``, or wait until a future is done."""
        with watched(future, self.wake_waiting):
            self._step(_is_done(future), timeout_sec)

    def _step(self, until: Callable[[], bool], timeout_sec: Any) -> None:
        if self.guest is None and self.is_global:  # for rclpy.spin_once in a callback
            timeout_sec = _STEP_S
        if self.guest is not None and self.host.is_over(self.guest):
            raise ExternalShutdownException()
        with self._changed:
            self._n_stepping += 1
        try:
            self._wait(lambda: self._turns > 0 or until(), timeout_sec)
        finally:
            with self._changed:
                self._n_stepping -= 1
                self._turns = max(0, self._turns - 1)

    def _wait(self, until: Callable[[], bool], timeout_sec: Any) -> None:
        self.has_spun = True
        self._adopt(Executor.get_nodes(self))  # type: ignore[arg-type]
        raised: list[BaseException] = []

        def is_over() -> bool:
            if not raised:  # each error comes out of one spin
                if self._errors:
                    raised.append(self._errors.popleft())
                elif self.host.take_interrupt(self.guest):
                    raised.append(KeyboardInterrupt())
            return bool(raised) or self._is_stopped or until()

        timeout_s = getattr(timeout_sec, 'timeout', timeout_sec)
        if timeout_s is not None:
            timeout_s = min(timeout_s, threading.TIMEOUT_MAX)
        with self._changed:
            self._n_spinning += 1
        try:
            self.host.wait(self._changed, is_over, timeout_s, self.guest)
        except KeyboardInterrupt as error:
            self.host.note_interrupt()
            raised = [error]
        finally:
            with self._changed:
                self._n_spinning -= 1
        if raised:
            if isinstance(raised[0], KeyboardInterrupt):
                self._await_callbacks()
            raise raised[0]

    def _await_callbacks(self) -> None:
        """Wait until the callbacks that run have finished, if an interrupt ends the run."""
        while self.host.is_ending():
            try:
                self.host.wait(self._changed, lambda: False, None, self.guest)
                return
            except KeyboardInterrupt:  # it also interrupts the callbacks
                self.host.note_interrupt()

    def _adopt(self, nodes: list[Node]) -> None:
        for node in nodes:
            self.host.adopt(node, self.guest)
        if nodes and self.guest is not None:
            self.guest.is_complete = True

    def wake_waiting(self) -> None:
        """Let waiting threads check their conditions again."""
        with self._changed:
            self._changed.notify_all()

    def callback_ended(self, error: BaseException | None) -> bool:
        """Note that a callback has ended; return whether a spin raises its error."""
        if error is None and self._turns >= _MOST_TURNS:
            return False
        guest = self.guest
        with self._changed:
            if error is None:
                self._turns += 1
                if self._n_stepping:
                    self._changed.notify_all()
                return False
            if guest is None or guest.returned or self.host.is_over(guest) or (
                    len(self._errors) >= _MOST_ERRORS):
                return False
            self._errors.append(error)
            self._changed.notify_all()
            return True

    def add_node(self, node: Node) -> bool:
        """Add a node; once this executor has spun, it runs at once."""
        node = self.host.itself(node)
        if self.guest is None and self.is_global and isinstance(node.executor, GuestExecutor):
            return False  # rclpy.spin_once in a callback: the node stays with its program
        added: bool = Executor.add_node(self, node)  # type: ignore[arg-type]
        if added and self.has_spun:
            self._adopt([node])
        return added

    def remove_node(self, node: Node) -> None:
        """Remove a node."""
        node = self.host.itself(node)
        Executor.remove_node(self, node)  # type: ignore[arg-type]
        if self.has_spun and not self.is_global:
            self.host.release(node, self.guest)

    def create_task(self, callback: Any, *args: Any, **kwargs: Any) -> Any:
        """Create a task of the host's executor."""
        return self.host.executor.create_task(callback, *args, **kwargs)

    def wake(self) -> None:
        """Let the host's executor note that entities of a node have changed."""
        if self.host.executor is not None:
            self.host.executor.wake()

    def shutdown(self, timeout_sec: float | None = None, **more: Any) -> bool:
        """Remove all nodes and end all spins."""
        self._is_stopped = True
        self.wake_waiting()
        for node in Executor.get_nodes(self):  # type: ignore[arg-type]
            self.remove_node(node)
        return bool(Executor.shutdown(self, timeout_sec))  # type: ignore[arg-type]


def _is_done(future: Any) -> Callable[[], bool]:
    return lambda: bool(future.done() or future.cancelled())


def make_guest(executor: Any, host: Host, guest: Guest | None) -> None:
    """Make a ``GuestExecutor`` of an executor."""
    executor.__class__ = _guest_class(executor.__class__)
    executor.host, executor.guest = host, guest
    executor._changed, executor._errors = threading.Condition(), deque()


@cache
def _guest_class(kind: type[Executor]) -> type[Any]:
    """Derive a class with the methods of this module instead of those of rclpy."""
    methods = {
        name: method for name, method in vars(GuestExecutor).items() if callable(method) and (
            getattr(kind, name, method).__module__.partition('.')[0]
            in ('rclpy', 'mddag_executor'))}
    methods['is_spinning'] = GuestExecutor.is_spinning
    return type(kind.__name__, (kind, GuestExecutor), methods)
