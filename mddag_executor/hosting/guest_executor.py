# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The executors of hosted programs: the host's executor runs their nodes, and they wait.

The executor that a program makes gets a new class, derived from its former class, with the methods
of ``GuestExecutor`` instead of rclpy's.  So it does not matter when a program imports rclpy's
classes, and overridden methods stay.  ``node.executor`` is this executor even when the host's
executor runs the node.

What a program's own executor promises stays true.  All of its callbacks and tasks are an *outer
group* of the core (``core.rules``, rule 4), which is open while the executor spins: for one
callback at a time if its own executor has one thread, for n if it has n.  ``spin_once`` opens it
until one callback has started.  The executor of ``rclpy.spin`` has only the nodes that are spun at
the time, so there each node has a group.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from functools import cache
import threading
import time
from typing import Any, Protocol

from mddag_executor.executor.compat import alive, is_called_by_spin, joins_threads
from mddag_executor.executor.interrupts import interruptible_sleep, InterruptsDeferred
from mddag_executor.executor.outer_groups import outer_here
from mddag_executor.executor.tasks import watched
from mddag_executor.hosting.change import Change
from mddag_executor.hosting.guest import Guest
from rclpy.executors import Executor, ExternalShutdownException, MultiThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node

_STEP_S = 0.01
"""A step of unknown callbacks ends after this time."""
_START_S = 0.1
"""How long a callback that is ready may take to start in a ``spin_once`` that does not wait."""
_POLL_S = 0.0005
_UNBOUNDED = 1 << 30
_MOST_ERRORS = 100
"""At most this many exceptions are kept for the next spin: the program does not handle them."""


class HostOfExecutors(Protocol):
    """What the executors of programs need of their host; see ``host.Host``."""

    executor: Any

    def is_ending(self) -> bool:
        """Return whether the run is to end."""

    def is_over(self, guest: Guest | None) -> bool:
        """Return whether the run or the program has ended."""

    def wait(
        self, changed: Change, until: Callable[[], bool], timeout_s: float | None,
        guest: Guest | None,
    ) -> None:
        """Wait until a condition is true, the run or the program ends, or the timeout is over."""

    def raise_interrupt(self, guest: Guest | None) -> None:
        """Raise KeyboardInterrupt if a SIGINT has interrupted the main of the calling thread."""

    def note_interrupt(self) -> None:
        """Note a KeyboardInterrupt in the main thread."""

    def itself(self, node: Any) -> Any:
        """Return the node behind an object that only passes on to one."""

    def adopt(self, node: Node, guest: Guest | None) -> None:
        """Add a program's node to the executor."""

    def release(self, node: Node, guest: Guest | None) -> None:
        """Remove a program's node from the executor."""

    def group_of(self, owner: Any, is_single: bool) -> Any:
        """Return the outer group of an executor's callbacks, or a node's; None: none."""

    def put(self, node: Node, group: Any) -> None:
        """Let the callbacks of a node belong to an outer group."""

    def note_group(self, group: Any, executor: Any) -> None:
        """Note whose spin has opened an outer group."""

    def note_waiting(self, groups: Iterable[Any]) -> None:
        """Count how long callbacks have waited for others in outer groups."""


class GuestExecutor:
    """
    The methods of an executor of a hosted program.

    :ivar guest: the program; None when a callback has made the executor.
    :ivar is_global: whether it is the executor of ``rclpy.spin``, which removes a node after each
        use.
    :ivar has_spun: whether its nodes run, also those that are added later.
    :ivar is_pool: whether its callbacks are in no outer group.
    """

    host: HostOfExecutors
    guest: Guest | None
    is_global = False
    _changed: Change
    _lock: threading.Lock
    _errors: deque[BaseException]
    has_spun = is_pool = False
    _is_stopped = False
    # Pieces of callbacks that have ended, and those among them that were in no group.  They are
    # counted because several threads may step at once, and each must see the same end.
    _n_ended = _n_free_ended = 0
    _seen: threading.local  # ``n_free_ended`` when the last spin of this thread ended
    _n_stepping = _n_spinning = 0

    @property
    def is_spinning(self) -> bool:
        """Return whether a thread spins (rclpy from 7.1.9 on)."""
        return self._n_spinning > 0

    def spin(self) -> None:
        """Let the nodes run, and wait for the end."""
        self._wait(lambda: False, None)

    def spin_once(self, timeout_sec: Any = None) -> None:
        """Let the nodes run until a callback has run."""
        if timeout_sec is None and is_called_by_spin():
            self.spin()
        else:
            self._step(lambda: False, timeout_sec)

    def spin_until_future_complete(self, future: Any, timeout_sec: Any = None) -> None:
        """Let the nodes run, and wait for a future."""
        with watched(future, self.wake_waiting):
            self._wait(_is_done(future), timeout_sec)

    def spin_once_until_future_complete(self, future: Any, timeout_sec: Any = None) -> None:
        """Do the same as ``spin_once``, or wait until a future is done."""
        with watched(future, self.wake_waiting):
            self._step(_is_done(future), timeout_sec)

    def _step(self, until: Callable[[], bool], timeout_sec: Any) -> None:
        if self.guest is None and self.is_global:  # for rclpy.spin_once in a callback
            timeout_sec = _STEP_S
        if self.guest is not None and self.host.is_over(self.guest):
            self.host.raise_interrupt(self.guest)
            raise ExternalShutdownException()
        self._wait(until, timeout_sec, is_step=True)

    def _wait(self, until: Callable[[], bool], timeout_sec: Any, is_step: bool = False) -> None:
        error: BaseException | None = None
        try:
            with InterruptsDeferred():
                let_run = self._let_step if is_step else self._let_run
                error = let_run(until, timeout_sec)
        except KeyboardInterrupt as interrupt:
            self.host.note_interrupt()
            if error is not None:  # the next spin raises it
                self._errors.appendleft(error)
            error = interrupt
        if isinstance(error, KeyboardInterrupt):
            self._await_callbacks()
        if error is not None:
            raise error

    def _let_step(self, until: Callable[[], bool], timeout_sec: Any) -> BaseException | None:
        """Let the nodes run until a callback has run, or a condition is true; see ``_let_run``."""
        with self._lock:
            self._n_stepping += 1
        groups = self._groups()
        seen = self._n_ended
        # What is in no group (a concurrent callback), or handled at once (a response), also runs
        # between two spins: it ends this step.
        seen_free = getattr(self._seen, 'n_free_ended', 0)
        own = outer_here()

        def has_ended() -> bool:  # a callback that runs in a spin of another one is none of ours
            return (self._n_ended > seen or self._n_free_ended > seen_free) and all(
                group.n_nested <= (group.number == own) for group in groups)

        try:
            return self._let_run(lambda: has_ended() or until(), timeout_sec, is_step=True)
        finally:
            with self._lock:
                self._n_stepping -= 1

    def _let_run(
        self, until: Callable[[], bool], timeout_sec: Any, is_step: bool = False
    ) -> BaseException | None:
        """Let the nodes run until a condition is true; return what a callback has raised."""
        self.has_spun = True
        self._adopt(Executor.get_nodes(self))  # type: ignore[arg-type]
        raised: list[BaseException] = []

        def is_over() -> bool:
            if not raised and self._errors:  # each error comes out of one spin
                raised.append(self._errors.popleft())
            if not raised:
                self.host.raise_interrupt(self.guest)
            return bool(raised) or self._is_stopped or until()

        timeout_s = getattr(timeout_sec, 'timeout', timeout_sec)
        if timeout_s is not None:
            timeout_s = min(timeout_s, threading.TIMEOUT_MAX)
        with self._lock:
            self._n_spinning += 1
        # a callback that spins is in one of the groups: the host lets others of that run
        groups = [group for group in self._groups() if group.number != outer_here()]
        is_interrupted = True
        try:
            may_start = self._open(groups, is_step)
            if may_start and timeout_s is not None and 0 <= timeout_s < _START_S:
                timeout_s = _START_S
            self.host.wait(self._changed, is_over, timeout_s, self.guest)
            is_interrupted = False
        finally:
            with self._lock:
                self._n_spinning -= 1
            if not self._n_spinning:
                self._close(groups, is_interrupted)
            self._seen.n_free_ended = self._n_free_ended
        return raised[0] if raised else None

    def _groups(self) -> list[Any]:
        """Return the outer groups that a spin opens."""
        owners: list[Any] = [self]
        if self.is_global:
            owners = Executor.get_nodes(self)  # type: ignore[arg-type]
        groups = [self._group_of(owner) for owner in owners]
        return [group for group in groups if group is not None]

    def _group_of(self, owner: Any) -> Any:
        """Return the outer group of this executor, or of one of its nodes; None: none."""
        return None if self.is_pool else self.host.group_of(owner, _limit(self) == 1)

    def _open(self, groups: list[Any], is_step: bool) -> bool:
        """Let callbacks run; return whether one may start in a step that opens the groups."""
        limit = _limit(self)
        may_start = False
        for group in groups:
            self.host.note_group(group, self)
            may_start |= group.open(limit, is_step and limit == 1)
        return is_step and may_start

    def _close(self, groups: list[Any], is_interrupted: bool) -> None:
        """
        Let no more callbacks run; in a single thread, the running one would end before.

        :param is_interrupted: a signal ends the spin, so the next one ends this.
        """
        is_single = _limit(self) == 1
        for group in groups:
            group.open(0)
        pause = interruptible_sleep if is_interrupted else time.sleep
        for group in groups:
            while is_single and group.n_running() and not self.host.is_over(self.guest):
                pause(_POLL_S)
        self.host.note_waiting(groups)

    def _await_callbacks(self) -> None:
        """Wait until the callbacks that run have finished, if an interrupt ends the run."""
        while self.host.is_ending():
            try:
                self.host.wait(self._changed, lambda: False, None, self.guest)
                return
            except KeyboardInterrupt:  # it also interrupts the callbacks
                self.host.note_interrupt()

    def _adopt(self, nodes: list[Node]) -> None:
        nodes = [node for node in nodes if alive(node)]     # the program may have destroyed others
        for node in nodes:
            owner = node if self.is_global else self
            self.host.put(node, self._group_of(owner))
            self.host.adopt(node, self.guest)
        if nodes and self.guest is not None:
            self.guest.is_complete = True

    def wake_waiting(self) -> None:
        """Let waiting threads check their conditions again."""
        self._changed.notify()

    def callback_ended(self, error: BaseException | None, outer: int) -> bool:
        """Note that a callback has ended; return whether a spin raises its error."""
        if error is None:
            self._n_ended += 1
            self._n_free_ended += outer < 0
            if self._n_stepping:
                self.wake_waiting()
            return False
        guest = self.guest
        if guest is None or guest.returned or self.host.is_over(guest) or (
                len(self._errors) >= _MOST_ERRORS):
            return False
        self._errors.append(error)
        self.wake_waiting()
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
        """Create a task of the host's executor, in the group of this one."""
        for group in self._groups()[:1]:
            return group.create_task(callback, *args, **kwargs)
        return self.host.executor.create_task(callback, *args, **kwargs)

    def wake(self) -> None:
        """Let the host's executor note that entities of a node have changed."""
        if self.host.executor is not None:
            self.host.executor.wake()

    def shutdown(
        self, timeout_sec: float | None = None, *, wait_for_threads: bool | None = None
    ) -> bool:
        """
        Remove all nodes and end all spins.

        :param wait_for_threads: whether to wait for the callbacks that run; None: if the program's
            own executor would (Kilted's ``MultiThreadedExecutor``).
        """
        self._is_stopped = True
        self.wake_waiting()
        if wait_for_threads is None:
            wait_for_threads = joins_threads(type(self))
        if wait_for_threads and self.has_spun:
            own = outer_here()
            for group in self._groups():
                while group.number != own and group.n_running() and (
                        not self.host.is_over(self.guest)):
                    time.sleep(_POLL_S)
        for node in Executor.get_nodes(self):  # type: ignore[arg-type]
            self.remove_node(node)
        return bool(Executor.shutdown(self, timeout_sec))  # type: ignore[arg-type]


def _is_done(future: Any) -> Callable[[], bool]:
    return lambda: bool(future.done() or future.cancelled())


def _limit(executor: Any) -> int:
    """Return how many callbacks at a time a program's own executor would run."""
    kind = type(executor).__mro__[1]  # without the methods of this module
    if _is_replaced(kind, 'spin_once'):
        if issubclass(kind, MultiThreadedExecutor):
            return int(executor._executor._max_workers)
        if kind.__module__.partition('.')[0] != 'mddag_executor':
            return 1
    return _UNBOUNDED  # its threads are its own


def make_guest(executor: Any, host: HostOfExecutors, guest: Guest | None) -> None:
    """Make a ``GuestExecutor`` of an executor."""
    executor.__class__ = _guest_class(executor.__class__)
    executor.host, executor.guest = host, guest
    executor._changed, executor._lock, executor._errors = Change(), threading.Lock(), deque()
    executor._seen = threading.local()


def _is_replaced(kind: type[Executor], name: str) -> bool:
    """Return whether a method is rclpy's or this package's, not the program's own."""
    method = getattr(kind, name, None)
    return method is None or method.__module__.partition('.')[0] in ('rclpy', 'mddag_executor')


def _with_warning(kind: type[Executor]) -> Callable[..., None]:
    """Return the ``spin_once`` of a program's own class, which says what it does."""
    def spin_once(executor: Any, *args: Any, **more: Any) -> None:
        if not executor.has_warned:
            executor.has_warned = True
            get_logger('mddag_executor').warning(
                f'{kind.__module__}.{kind.__qualname__} has a spin_once of its own: callbacks '
                'that it runs are neither ordered, recorded nor judged: let it call that of rclpy')
        kind.spin_once(executor, *args, **more)

    return spin_once


@cache
def _guest_class(kind: type[Executor]) -> type[Any]:
    """Derive a class with the methods of this module instead of those of rclpy."""
    methods = {
        name: method for name, method in vars(GuestExecutor).items()
        if callable(method) and _is_replaced(kind, name)}
    methods['is_spinning'] = GuestExecutor.is_spinning
    methods['has_warned'] = False
    if 'spin_once' not in methods:
        methods['spin_once'] = _with_warning(kind)
    return type(kind.__name__, (kind, GuestExecutor), methods)
