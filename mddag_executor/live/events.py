# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Intake by events: the middleware calls, and nothing is asked again for each wake-up.

Subscriptions, services and clients go through one native EventsExecutor of rclpy, QoS events
through another (see ``native``). What cannot, or crashes it, gets threads of its own: timers;
guard conditions, actions and other waitables. A thread is started when there is something for it.

A native executor cannot be repaired, and not even be disposed of, when the middleware refuses an
entity half way. Should that happen, it is left lying, and a wait set takes over.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
import threading
import time
from typing import Any

from mddag_executor.live.direct import DirectTakes
from mddag_executor.live.endings import call_at_shutdown, is_over, join, SecondLooks, stop_at_exit
from mddag_executor.live.entities import EMPTY, EntitySet, Receiver, snapshot
from mddag_executor.live.native import NodeStandIn
from mddag_executor.live.waitset import PATIENCE, WaitSetIntake
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.task import Future

SPIN_SEC = 3600.0
"""The native executor spins for that long at a time: in rclpy 7.1.5 it does not for ever."""

PROBE_SEC = 2.0

_PARTS = {
    'events': ('subscriptions', 'services', 'clients'),
    'qos': ('events',),
    'timers': ('timers',),
    'waitables': ('waitables', 'guards'),
}
_NATIVE = ('events', 'qos')
_SINGULAR = {
    'subscriptions': 'subscription', 'services': 'service', 'clients': 'client',
    'events': 'event', 'timers': 'timer', 'waitables': 'waitable', 'guards': 'guard'}


class _OpenContext:
    """
    Stand in for the context of a native executor.

    That one asks whether it is ok in its updates, and forgets all entities if not. The real one
    would answer under a lock, which a shutdown holds while it waits for others; and its end is
    noticed here anyway.
    """

    def __init__(self, handle: Any) -> None:
        self.handle = handle

    def ok(self) -> bool:
        """Return True."""
        return True


_left_lying: list[Any] = []


class _NativeThread:
    """
    A thread in which a native EventsExecutor spins, made anew for each start.

    It installs no signal handler; rclpy's own, where it is installed, ends its spin on SIGINT and
    SIGTERM. So the context is looked at whenever a spin ends, and some more times soon after.

    :param on_end: called at the end of the thread, unless by ``stop``, with whether the context
        has ended; if not, the native executor has failed.
    """

    def __init__(
        self, name: str, kinds: Iterable[str], context: Context, receiver: Receiver,
        entities: EntitySet, on_end: Callable[[bool], None],
    ) -> None:
        self._context = context
        self._receiver = receiver
        self._on_end = on_end
        self._native: Any = _rclpy.EventsExecutor(_OpenContext(context.handle))
        self._node = NodeStandIn(kinds, receiver, self._native.wake)
        self._node.wanted = entities
        self._native.add_node(self._node)
        self._lock = threading.Lock()
        self._stopping = False
        self._future: Any = None
        self._thread = threading.Thread(
            target=self._run, name=f'mddag-intake-{name}', daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def update(self, entities: EntitySet) -> None:
        """Set what to look after; it comes into force soon."""
        self._node.wanted = entities
        self._native.wake()

    def settled(self) -> bool:
        """Return whether what was set by ``update`` has come into force."""
        return self._node.settled() or not self._thread.is_alive()

    def wake(self) -> None:
        """Have the thread look at its context soon."""
        with self._lock:
            if self._future is not None:
                self._future.set_result(None)

    def stop(self) -> None:
        """End the thread and let go of all entities."""
        with self._lock:
            self._stopping = True
            if self._future is not None:
                self._future.set_result(None)
        self.join()

    def join(self) -> bool:
        """Wait for the end of the thread; False when this is the thread itself."""
        join(self._thread)
        return self._thread is not threading.current_thread()

    def _run(self) -> None:
        ended = broken = False
        failures = 0
        looks = SecondLooks()
        try:
            while not ended and not broken:
                with self._lock:
                    if self._stopping:
                        break
                    future = self._future = Future()
                try:
                    if looks.at is None:
                        self._native.spin_until_future_complete(future, SPIN_SEC)
                        looks.begin()  # a signal, or a wake
                    else:
                        self._native.spin_until_future_complete(future, looks.seconds())
                        looks.due()
                    failures = 0
                except ExternalShutdownException:
                    pass
                except InvalidHandle as error:
                    broken = not self._node.survives(error)
                    if broken:
                        self._receiver.on_intake_error(error)
                except Exception as error:
                    failures += 1
                    self._receiver.on_intake_error(error)
                    broken = not self._node.survives(error)
                    if not broken:
                        # A take failed. What was announced with it is announced no more.
                        self._node.drain()
                    if failures > PATIENCE:
                        time.sleep(min(0.1, 0.001 * failures))
                ended = is_over(self._context)
        finally:
            with self._lock:
                self._future = None
            if broken:
                _left_lying.append((self._native, self._node))
                self._node.withdraw()
            else:
                self._native.shutdown()
                self._node.close()
        if (ended or broken) and not self._stopping:
            self._on_end(ended)


class EventsIntake:
    """
    Hands over what becomes ready, from threads of its own.

    :param context: the context of all nodes.
    :param receiver: whom to hand over to.
    :param guards: for the same signature as ``WaitSetIntake``; not waited for, since no thread
        of this intake needs to be told more than by ``update``, ``wake`` and ``stop``.
    :param on_shutdown: called in a thread of the intake when that ends because the context has
        ended, also by a signal.
    """

    _available: bool | None = None

    def __init__(
        self,
        context: Context,
        receiver: Receiver,
        guards: Iterable[GuardCondition] = (),
        *,
        on_shutdown: Callable[[], None] | None = None,
    ) -> None:
        self._context = context
        self._receiver = receiver
        self._on_shutdown = on_shutdown
        self._lock = threading.RLock()
        self._given = EMPTY
        self._latest = EMPTY
        self._direct = DirectTakes(receiver, self._choose_again, partial(is_over, context))
        self._running = False
        self._parts: dict[str, Any] = {}
        self._ending: list[Any] = []
        self._refused: set[str] = set()
        call_at_shutdown(context, self.wake)

    @classmethod
    def available(cls) -> bool:
        """
        Return whether this rclpy has a native EventsExecutor, and it does dispatch.

        It needs no context, is found out once, and takes about a millisecond where it works.
        """
        if EventsIntake._available is None:
            try:
                EventsIntake._available = _probe()
            except Exception:
                EventsIntake._available = False
        return EventsIntake._available

    def update(self, entities: EntitySet | Iterable[Node]) -> None:
        """
        Set what to wait for; from any thread. It comes into force at once.

        :param entities: a snapshot, or the nodes to take one of. Nothing is done when nothing
            has changed.
        """
        with self._lock:
            if not isinstance(entities, EntitySet):
                entities = snapshot(entities, self._given)
            self._given = entities
            self._choose()

    def _choose(self) -> None:
        """Share what is given out among the publishers and the threads."""
        entities = self._direct.choose(self._given) if self._running else self._given
        if entities is not self._latest:
            self._latest = entities
            for part in list(self._parts.values()):
                part.update(entities)
            if self._running:
                self._start_parts()
        self._direct.settle()

    def _choose_again(self) -> None:
        with self._lock:
            if self._running:
                self._choose()

    def _start_parts(self) -> None:
        """Start the threads that have something to do, and have not had until now."""
        for name, kinds in _PARTS.items():
            # The first one always: it is whom signals wake.
            needed = name == 'events' or any(getattr(self._latest, kind) for kind in kinds)
            if not needed or name in self._parts:
                continue
            if name in _NATIVE and name not in self._refused:
                part = self._parts[name] = _NativeThread(
                    name, kinds, self._context, self._receiver, self._latest,
                    partial(self._native_ended, name))
                part.start()
            else:
                self._start_wait_set(name, [_SINGULAR[kind] for kind in kinds])

    def _start_wait_set(self, name: str, kinds: Iterable[str]) -> None:
        part = self._parts[name] = WaitSetIntake(
            self._context, self._receiver, (), kinds, name=name)
        part.update(self._latest)
        part.start()

    def _native_ended(self, name: str, context_ended: bool) -> None:
        """React in a native executor's thread to its end."""
        if context_ended:
            self.wake()  # a signal has ended the context, which the others do not notice
            if self._on_shutdown is not None:
                self._on_shutdown()
            return
        with self._lock:
            self._refused.add(name)
            if self._parts.pop(name, None) is not None and self._running:
                self._start_parts()

    def settled(self) -> bool:
        """Return whether what was set by ``update`` has come into force everywhere."""
        return all(part.settled() for part in list(self._parts.values()))

    def wake(self) -> None:
        """Have all threads look around: whether the context has ended; from any thread."""
        for part in list(self._parts.values()):
            part.wake()

    def start(self) -> None:
        """
        Hand over from threads of the intake's own until ``stop``.

        :raises RuntimeError: when it runs already.
        """
        with self._lock:
            if self._running:
                raise RuntimeError('the intake runs already')
            # One native executor's end would undo what the next one has told the middleware.
            for part in self._ending:
                if not part.join():
                    raise RuntimeError('the intake ends only after what it hands over now')
            self._ending = []
            self._running = True
            stop_at_exit(self)
            self._choose()
            self._start_parts()

    def stop(self) -> None:
        """
        End the threads and let go of all entities; from any thread, and in any state.

        What is ready by then stays where it is. Called by a receiver from one of the intake's
        threads, it returns without waiting for that thread, which ends after that call.
        """
        with self._lock:
            self._running = False
            looker = self._direct.stop()
            parts, self._parts = self._parts, {}
            self._ending = [part for part in parts.values() if isinstance(part, _NativeThread)]
        for part in parts.values():
            part.stop()
            if isinstance(part, WaitSetIntake):
                part.update(EMPTY)
        if looker is not None:
            join(looker)


class _Probe:
    """A node without entities that completes a future when it is asked for them."""

    executor: Any = None
    timers = clients = services = waitables = guards = ()  # type: Any

    def __init__(self, future: Any) -> None:
        self._future = future

    @property
    def subscriptions(self) -> tuple[()]:
        """Note that the native executor is at work."""
        self._future.set_result(None)
        return ()


def _probe() -> bool:
    native = _rclpy.EventsExecutor(_OpenContext(None))
    future: Any = Future()
    node = _Probe(future)
    native.add_node(node)
    native.wake()
    native.spin_until_future_complete(future, PROBE_SEC)
    native.shutdown()
    node.executor = None
    return bool(future.done())
