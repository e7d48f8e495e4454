# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Intake by events: the middleware calls, and nothing is asked again for each wake-up.

Subscriptions, services and clients go through rclpy's native EventsExecutor (see ``native``).
The others can not, or crash it, and get threads of their own: timers; guard conditions, actions
and other waitables, if there are any; QoS events, if there are any.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
import threading
import time
from typing import Any

from mddag_executor.live.entities import EMPTY, EntitySet, Receiver, snapshot
from mddag_executor.live.native import NodeStandIn
from mddag_executor.live.waitset import PATIENCE, stop_at_exit, WaitSetIntake
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.task import Future

SPIN_SEC = 3600.0
"""The native executor spins for that long at a time: in rclpy 7.1.5 it does not for ever."""

PROBE_SEC = 2.0


class _OpenContext:
    """
    Stand in for the context of a native executor.

    That one asks whether it is ok in its updates, and forgets all entities if not. The real one
    would answer under a lock, which a shutdown holds while it waits for others; and its end is
    noticed here anyway.
    """

    def ok(self) -> bool:
        """Return True."""
        return True


class _NativeThread:
    """
    A thread in which a native EventsExecutor spins, made anew for each start.

    It installs no signal handler; rclpy's own, where it is installed, ends its spin on SIGINT and
    SIGTERM. So the context is looked at whenever a spin ends.
    """

    def __init__(
        self, context: Context, receiver: Receiver, entities: EntitySet,
        on_shutdown: Callable[[], None],
    ) -> None:
        self._context = context
        self._receiver = receiver
        self._on_shutdown = on_shutdown
        self._native: Any = _rclpy.EventsExecutor(_OpenContext())
        self._node = NodeStandIn(receiver, self._native.wake)
        self._node.wanted = entities
        self._native.add_node(self._node)
        self._lock = threading.Lock()
        self._stopping = False
        self._future: Any = None
        self._thread = threading.Thread(
            target=self._run, name='mddag-intake-events', daemon=True)
        self._thread.start()

    def update(self, entities: EntitySet) -> None:
        """Set what to look after; it comes into force soon."""
        self._node.wanted = entities
        self._native.wake()

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
        if self._thread is threading.current_thread():
            return False
        self._thread.join()
        return True

    def _run(self) -> None:
        failures = 0
        ended = False
        try:
            while not ended:
                with self._lock:
                    if self._stopping:
                        break
                    future = self._future = Future()  # type: ignore[no-untyped-call]
                try:
                    self._native.spin_until_future_complete(future, SPIN_SEC)
                    failures = 0
                except ExternalShutdownException:
                    pass
                except Exception as error:
                    # A take failed. What was announced with it will not be announced again.
                    failures += 1
                    self._receiver.on_intake_error(error)
                    self._node.drain()
                    if failures > PATIENCE:
                        time.sleep(min(0.1, 0.001 * failures))
                ended = not self._context.ok()
        finally:
            with self._lock:
                self._future = None
            self._native.shutdown()
            self._node.close()
        if ended and not self._stopping:
            self._on_shutdown()


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
        self._latest = EMPTY
        self._running = False
        self._native: _NativeThread | None = None
        self._ending: _NativeThread | None = None
        self._parts = {
            'timers': self._part('timers', 'timer'),
            'waitables': self._part('waitables', 'waitable', 'guard'),
            'qos': self._part('qos', 'event'),
        }
        self._started: set[str] = set()
        context.on_shutdown(self.wake)

    def _part(self, name: str, *kinds: str) -> WaitSetIntake:
        return WaitSetIntake(self._context, self._receiver, (), kinds, name=name)

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
                entities = snapshot(entities, self._latest)
            if entities is self._latest:
                return
            self._latest = entities
            if self._native is not None:
                self._native.update(entities)
            for part in self._parts.values():
                part.update(entities)
            if self._running:
                self._start_parts()

    def _start_parts(self) -> None:
        """Start the threads that have something to do, and have not had until now."""
        latest = self._latest
        for name, needed in (
            ('timers', latest.timers),
            ('waitables', latest.waitables or latest.guards),
            ('qos', latest.events),
        ):
            if needed and name not in self._started:
                self._started.add(name)
                self._parts[name].start()

    def wake(self) -> None:
        """Have all threads look around: whether the context has ended; from any thread."""
        native = self._native
        if native is not None:
            native.wake()
        for part in self._parts.values():
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
            if self._ending is not None and not self._ending.join():
                raise RuntimeError('the intake ends only after what it hands over now')
            self._running = True
            stop_at_exit(self)
            self._native = _NativeThread(
                self._context, self._receiver, self._latest, self._context_ended)
            self._start_parts()

    def stop(self) -> None:
        """
        End the threads and let go of all entities; from any thread, and in any state.

        What is ready by then stays where it is. Called by a receiver from one of the intake's
        threads, it returns without waiting for that thread, which ends after that call.
        """
        with self._lock:
            self._running = False
            native, self._native = self._native, None
            self._ending = native
            started, self._started = self._started, set()
        if native is not None:
            native.stop()
        for name in started:
            self._parts[name].stop()

    def _context_ended(self) -> None:
        """Let the other threads notice too that a signal has ended the context."""
        for part in self._parts.values():
            part.wake()
        if self._on_shutdown is not None:
            self._on_shutdown()


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
    native = _rclpy.EventsExecutor(_OpenContext())
    future: Any = Future()  # type: ignore[no-untyped-call]
    node = _Probe(future)
    native.add_node(node)
    native.wake()
    native.spin_until_future_complete(future, PROBE_SEC)
    native.shutdown()
    node.executor = None
    return bool(future.done())
