# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Intake by events: the middleware calls, and nothing is asked again for each wake-up.

Subscriptions, services and clients go through a native EventsExecutor of rclpy. What it cannot
take, or what crashes it, gets wait sets in threads of their own: timers; and guard conditions,
actions, QoS events and other waitables. A thread is started when there is something for it.

A native executor cannot be repaired when the middleware refuses an entity half way. Should that
happen, a wait set takes over.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
import threading
import time
from typing import Any

from mddag_executor.live.compat.events_executor import is_available, NativeExecutor
from mddag_executor.live.inline import InlineDelivery
from mddag_executor.live.intake.arrivals import Receiver
from mddag_executor.live.intake.entities import EMPTY, EntitySet
from mddag_executor.live.intake.sources import sources
from mddag_executor.live.intake.waitset import PATIENCE, QOS_EVENTS, WaitSetIntake
from mddag_executor.live.shutdown import (
    call_at_shutdown,
    ContextChecks,
    is_over,
    join,
    stop_at_exit,
)
from rclpy.context import Context
from rclpy.guard_condition import GuardCondition
from rclpy.task import Future

_NATIVE = 'events'
_RELIEF = 'relief'
_PARTS = {
    _NATIVE: ('subscriptions', 'services', 'clients'),
    'timers': ('timers',),
    'waitables': ('waitables', 'guards', *QOS_EVENTS),
}
SPIN_S = 3600.0
PATIENCE_S = 2.0


class _NativeThread:
    """
    A thread in which a native EventsExecutor spins, made anew for each start.

    A signal ends the native executor's spin. So the context is looked at whenever a spin ends, and
    some more times soon after.

    :param on_end: called at the end of the thread, unless by ``stop``, with whether the context
        has ended; if not, the native executor has failed.
    :param serve_here: entered in the thread; the receiver may then run callbacks in it.
    """

    def __init__(
        self, name: str, context: Context, receiver: Receiver, on_end: Callable[[bool], None],
        serve_here: Callable[[], AbstractContextManager[None]],
    ) -> None:
        self._serve_here = serve_here
        self._context = context
        self._receiver = receiver
        self._on_end = on_end
        self._native = NativeExecutor(context, receiver.on_intake_error)
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
        self._native.show(tuple(sources(entities, _PARTS[_NATIVE], self._receiver)))
        self._native.wake()

    def settled(self) -> bool:
        """Return whether what was set by ``update`` has come into force."""
        return self._native.settled() or not self._thread.is_alive()

    def wake(self) -> None:
        """Have the thread look at its context soon."""
        with self._lock:
            if self._future is not None:
                self._future.set_result(None)

    def stop(self) -> None:
        """End the thread and release all entities; after a while, leave it to end by itself."""
        with self._lock:
            self._stopping = True
        self.wake()
        join(self._thread, PATIENCE_S)  # a callback may run in it that does not end

    def _run(self) -> None:
        with self._serve_here():
            self._spin()

    def _spin(self) -> None:
        ended = broken = False
        failures = 0
        looks = ContextChecks()
        try:
            while not ended and not broken:
                with self._lock:
                    if self._stopping:
                        break
                    future = self._future = Future()
                waiting = looks.at is not None
                try:
                    broken = not self._native.spin(future, looks.seconds() if waiting else SPIN_S)
                    failures = 0
                except Exception as error:
                    failures += 1
                    self._receiver.on_intake_error(error)
                    if failures > PATIENCE:
                        time.sleep(min(0.1, 0.001 * failures))
                else:
                    if waiting:
                        looks.due()
                    else:
                        looks.begin()  # a signal, or a wake
                ended = is_over(self._context)
        finally:
            with self._lock:
                self._future = None
            if broken:
                self._native.abandon()
            else:
                self._native.close()
        if (ended or broken) and not self._stopping:
            self._on_end(ended)


class EventsIntake:
    """
    Hands over what becomes ready, from threads of its own.

    :param context: the context of all nodes.
    :param receiver: whom to hand over to.
    :param guards: for the same signature as ``WaitSetIntake``; not waited for, since no thread
        of this intake needs to be notified otherwise than by ``update``, ``wake`` and ``stop``.
    :param on_shutdown: called in a thread of the intake when that ends because the context has
        ended, also by a signal.
    :param serve_here: entered in the thread that takes messages, requests and responses: the
        receiver may run callbacks in it.  See ``relieve``.
    """

    available = staticmethod(is_available)

    def __init__(
        self,
        context: Context,
        receiver: Receiver,
        guards: Iterable[GuardCondition] = (),
        *,
        on_shutdown: Callable[[], None] | None = None,
        serve_here: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        self._context = context
        self._receiver = receiver
        self._on_shutdown = on_shutdown
        self._serve_here = serve_here
        self._lock = threading.RLock()
        self._given = EMPTY
        self._latest = EMPTY
        self._inline = InlineDelivery(receiver, self._choose_again, partial(is_over, context))
        self._running = False
        self._refused = False
        self._parts: dict[str, _NativeThread | WaitSetIntake] = {}
        call_at_shutdown(context, self.wake)

    def update(self, entities: EntitySet) -> None:
        """Set what to wait for; from any thread. It comes into force soon."""
        with self._lock:
            self._given = entities
            self._choose()

    def _choose(self) -> None:
        """Share what is given out among the publishers and the threads."""
        entities = self._inline.choose(self._given) if self._running else self._given
        if entities is not self._latest:
            self._latest = entities
            for part in list(self._parts.values()):
                part.update(entities)
            if self._running:
                self._start_parts()
        self._inline.settle()

    def _choose_again(self) -> None:
        with self._lock:
            if self._running:
                self._choose()

    def _start_parts(self) -> None:
        """Start the threads that have something to do, and have not had until now."""
        for name, kinds in _PARTS.items():
            # The first one always: it is whom signals wake.
            needed = name == _NATIVE or any(getattr(self._latest, kind) for kind in kinds)
            if not needed or name in self._parts:
                continue
            part: _NativeThread | WaitSetIntake
            if name == _NATIVE and not self._refused:
                part = _NativeThread(
                    name, self._context, self._receiver, self._native_ended, self._serve_here)
            else:
                part = WaitSetIntake(self._context, self._receiver, (), kinds, name=name)
            self._parts[name] = part
            part.update(self._latest)
            part.start()

    def _native_ended(self, context_ended: bool) -> None:
        """React in the native executor's thread to its end."""
        if context_ended:
            self.wake()  # a signal has ended the context, which the others do not notice
            if self._on_shutdown is not None:
                self._on_shutdown()
            return
        with self._lock:
            self._refused = True
            if self._parts.pop(_NATIVE, None) is not None and self._running:
                self._start_parts()

    def relieve(self, relieved: bool) -> None:
        """
        Have a wait set look after messages, requests and responses, too, or no longer.

        To be called while the receiver keeps the thread that does so otherwise.
        """
        part: _NativeThread | WaitSetIntake | None = None
        with self._lock:
            if not relieved:
                part = self._parts.pop(_RELIEF, None)
            elif self._running and _RELIEF not in self._parts:
                part = self._parts[_RELIEF] = WaitSetIntake(
                    self._context, self._receiver, (), _PARTS[_NATIVE], name=_RELIEF)
                part.update(self._latest)
                part.start()
                return
        if part is not None:
            part.stop()
            part.update(EMPTY)

    def settled(self) -> bool:
        """Return whether what was set by ``update`` has come into force everywhere."""
        return all(part.settled() for part in list(self._parts.values()))

    def wake(self) -> None:
        """Have all threads look around: whether the context has ended; from any thread."""
        for part in list(self._parts.values()):
            part.wake()

    def start(self) -> None:
        """Hand over from threads of the intake's own until ``stop``: once."""
        with self._lock:
            self._running = True
            stop_at_exit(self)
            self._choose()
            self._start_parts()

    def stop(self) -> None:
        """
        End the threads and release all entities; from any thread, and in any state.

        What is ready by then stays where it is. Called by a receiver from one of the intake's
        threads, it returns without waiting for that thread, which ends after that call.
        """
        with self._lock:
            self._running = False
            looker = self._inline.stop()
            parts, self._parts = self._parts, {}
        for part in parts.values():
            part.stop()
            if isinstance(part, WaitSetIntake):
                part.update(EMPTY)
        if looker is not None:
            join(looker)
