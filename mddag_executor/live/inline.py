# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Messages between callbacks of one process are taken by the thread that publishes them.

Theory of operation
-------------------
A middleware that delivers within a process does so inside of ``publish``: when it returns, the
message is there to be taken.  Who has just published may then as well take it, with warm caches;
to wake an intake thread for it costs two switches of threads and a fight for the interpreter
lock.  So a subscription all of whose publishers belong to this executor's nodes is *direct*: the
intake does not look after it, and each ``publish`` of one of these publishers takes from it.

Nothing may get lost or wait by that:

1.  Who publishes from elsewhere is counted by the middleware: the subscription is direct only
    while it has exactly as many publishers as these nodes have with a compatible QoS.  They are
    counted again every ``LOOK_S``.
2.  A message that is not there when ``publish`` returns (the middleware delivers in a thread of
    its own, or filters) shows that the assumption is wrong here: the intake takes over for good.
3.  Whoever starts to look after a subscription, the intake or this one, first takes what is there
    already.
4.  The main thread takes nothing: a signal's handler may publish in it, while it holds the lock of
    a subscription or of the engine.  The thread that counts publishers takes for it, at once.
5.  Each publication takes at least once, after its message has arrived, so as often as messages
    arrive, whichever of several threads gets which.  One lock for each subscription keeps the
    messages in order.

6.  Whatever happened, every ``TAKE_EVERY`` looks all that has arrived is taken.  So a publisher
    from elsewhere that has just come is served ``LOOK_S`` later at the most, one that has come and
    gone within that time a second later; sooner where one of these nodes publishes on its topic.
    (More often would cost too much: a look at a hundred subscriptions takes half a millisecond.)

Why not the middleware's event "matched"?  rclpy's native executor crashes when it is notified of
an event whose waitable is just being removed (it lets go of Python objects without the interpreter
lock), and publishers come and go just when nodes are destroyed.  In a wait set such an event wakes
for every message.

Subscriptions with durability other than volatile get messages from the past at some later time,
so they are not direct; nor are those on which time depends: a callback that sets the time is not
to run what waits for it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import replace
import threading
import time
from typing import Any

from mddag_executor.live.alarm import Bell
from mddag_executor.live.compat import keeps_time, RCL_ERRORS
from mddag_executor.live.hooks import install, publisher_state
from mddag_executor.live.intake.arrivals import Receiver
from mddag_executor.live.intake.entities import alive, EntitySet
from mddag_executor.live.intake.sources import MOST_AT_ONCE, SubscriptionSource
from mddag_executor.live.jobs import PublisherState
from mddag_executor.live.work import Work
from rclpy.exceptions import InvalidHandle
from rclpy.qos import DurabilityPolicy, qos_check_compatible, QoSCompatibility
from rclpy.subscription import Subscription

LOOK_S = 0.2
"""How often to count publishers anew."""
TAKE_EVERY = 5
"""So many times less often, all that has arrived is taken."""


class Direct:
    """A subscription that publishers of the process may take from."""

    __slots__ = ('subscription', 'publishers', 'refused', 'lock', '_newest', '_source')

    def __init__(self, subscription: Subscription, receiver: Receiver) -> None:
        self.subscription = subscription
        # how many there are, all of these nodes
        self.publishers = 0
        # whether a message was not there that was published
        self.refused = False
        self.lock = threading.Lock()
        self._newest = 0
        self._source = SubscriptionSource(subscription, receiver)

    def changed(self) -> bool:
        """Return whether there are more or fewer publishers than when they were counted."""
        try:
            return bool(self.subscription.get_publisher_count() != self.publishers)
        except InvalidHandle:
            return False  # destroyed: its node notifies the executor

    def take(self, begin: int, arrivals: list[Work]) -> bool:
        """
        Take what is there, at least up to a message that was just published.

        :param begin: system time (ns) before that was published; 0: take what there is.
        :param arrivals: gets what was taken.
        :return: False when that message was not there, for the first time.
        """
        source = self._source
        try:  # without entering the handle, which takes as long as a tenth of all this
            for _ in range(MOST_AT_ONCE):
                taken = source.take_next()
                if taken is None:
                    break
                stamp: int = taken[1]['source_timestamp']
                if stamp > self._newest:
                    self._newest = stamp
                arrivals.append(source.arrival(taken))
                if stamp >= begin > 0:
                    break
        except RCL_ERRORS:
            if alive(self.subscription):
                raise
            return True  # destroyed
        if self._newest >= begin or self.refused:
            return True
        self.refused = True
        return False


class Delivery:
    """
    Takes from some subscriptions what was published for them.

    :param on_miss: called when a message is not there that was published.
    :param defer: has another thread call ``deliver`` with a begin; it waits for no lock.
    """

    __slots__ = ('_directs', '_receiver', '_on_miss', '_defer')

    def __init__(
        self, directs: Iterable[Direct], receiver: Receiver, on_miss: Callable[[], None],
        defer: Callable[[Delivery, int], None],
    ) -> None:
        self._directs = sorted(directs, key=id)  # so no two threads wait for each other's locks
        self._receiver = receiver
        self._on_miss = on_miss
        self._defer = defer

    def published(self, begin: int) -> None:
        """Deliver what was just published, in the calling thread unless it is the main one."""
        if threading.get_ident() == threading.main_thread().ident:
            self._defer(self, begin)
        else:
            self.deliver(begin)

    def deliver(self, begin: int) -> None:
        """Take what is there (see ``Direct.take``), and hand it over in one piece."""
        arrivals: list[Work] = []
        missed = False
        for direct in self._directs:
            direct.lock.acquire()
        try:
            for direct in self._directs:
                missed |= not direct.take(begin, arrivals)
            if len(arrivals) == 1:
                self._receiver.take(arrivals[0])
            elif arrivals:
                self._receiver.take_in(arrivals)
        except Exception as error:
            self._receiver.on_intake_error(error)
        finally:
            for direct in self._directs:
                direct.lock.release()
        if missed:
            self._on_miss()


class InlineDelivery:
    """
    Which subscriptions are taken from directly.

    Not thread-safe: the intake calls it under a lock of its own.

    :param on_change: called from any thread when it has to be chosen anew.
    :param over: whether the context has ended; then nothing is looked after.
    """

    def __init__(
        self, receiver: Receiver, on_change: Callable[[], None], over: Callable[[], bool]
    ) -> None:
        install()
        self._over = over
        self._receiver = receiver
        self._on_change = on_change
        self._known: dict[int, Direct] = {}
        self._refused: dict[int, Subscription] = {}
        self._states: dict[int, PublisherState] = {}
        self._chosen: frozenset[int] = frozenset()
        self._before: EntitySet | None = None
        self._left: EntitySet | None = None
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._bell = Bell()
        # what the main thread has published
        self._deferred: deque[tuple[Delivery, int]] = deque()

    def choose(self, entities: EntitySet) -> EntitySet:
        """
        Choose the direct subscriptions; return what is left for the intake to look after.

        Publishers begin to take at once.  The caller notifies the intake, then calls ``settle``.
        """
        publishers: dict[str, list[Any]] = {}
        for node in entities.nodes:
            for publisher in list(node.publishers):
                try:
                    publishers.setdefault(publisher.topic_name, []).append(publisher)
                except InvalidHandle:
                    continue  # destroyed meanwhile
        takes: dict[int, list[Direct]] = {}
        states: dict[int, PublisherState] = {}
        chosen: list[Direct] = []
        for subscription in entities.subscriptions:
            try:
                locals_ = publishers.get(subscription.topic_name)
                direct = self._direct(subscription) if locals_ else None
                if direct is None or locals_ is None:
                    continue
                matching = [p for p in locals_ if _compatible(p, subscription)]
                direct.publishers = subscription.get_publisher_count()
            except InvalidHandle:
                continue  # destroyed meanwhile
            if not matching or direct.publishers != len(matching):
                continue
            chosen.append(direct)
            for publisher in matching:
                takes.setdefault(id(publisher), []).append(direct)
                states[id(publisher)] = publisher_state(publisher)
        self._set_takes(takes, states)
        self._forget(entities)
        if self._thread is None:
            self._thread = threading.Thread(
                target=self._look_after, args=(self._stopping,), name='mddag-intake-inline',
                daemon=True)
            self._thread.start()
        return self._rest(entities, chosen)

    def _defer(self, delivery: Delivery, begin: int) -> None:
        self._deferred.append((delivery, begin))
        self._bell.ring()

    def _look_after(self, stopping: threading.Event) -> None:
        looks, next_look = 0, time.monotonic() + LOOK_S
        while True:
            self._bell.wait(max(0.0, next_look - time.monotonic()))
            if stopping.is_set() or self._over():
                self._bell.ring()  # for the next thread
                return
            while self._deferred:
                delivery, begin = self._deferred.popleft()
                delivery.deliver(begin)
            if time.monotonic() >= next_look:
                next_look = time.monotonic() + LOOK_S
                looks += 1
                if self._look(looks % TAKE_EVERY == 0):
                    self._on_change()

    def _look(self, take: bool) -> bool:
        """Return whether publishers have come or gone; take what has arrived, too, if asked to."""
        changed = False
        for key, direct in list(self._known.items()):
            if take and key in self._chosen:
                self._delivery([direct]).deliver(0)
            changed = changed or direct.changed()
        return changed

    def settle(self) -> None:
        """Take what has arrived before the publishers took."""
        for key in self._chosen:
            direct = self._known.get(key)
            if direct is not None:
                self._delivery([direct]).deliver(0)

    def _delivery(self, directs: list[Direct]) -> Delivery:
        return Delivery(directs, self._receiver, self._on_change, self._defer)

    def stop(self) -> threading.Thread | None:
        """
        Have publishers take no more; the intake has been stopped, or looks after all.

        :return: a thread that ends soon; to be joined without the intake's lock.
        """
        self._set_takes({}, {})
        self._stopping.set()
        self._bell.ring()
        self._deferred.clear()
        thread, self._thread = self._thread, None
        self._stopping = threading.Event()
        self._known = {}
        self._before = self._left = None
        return thread

    def _direct(self, subscription: Subscription) -> Direct | None:
        key = id(subscription)
        direct = self._known.get(key)
        if direct is not None and direct.refused:
            self._refused[key] = subscription
            del self._known[key]
        if self._refused.get(key) is subscription:
            return None
        if direct is None:
            if subscription.qos_profile.durability != DurabilityPolicy.VOLATILE:
                return None
            if keeps_time(subscription):
                return None
            direct = self._known[key] = Direct(subscription, self._receiver)
        return direct

    def _set_takes(
        self, takes: dict[int, list[Direct]], states: dict[int, PublisherState]
    ) -> None:
        for key, state in (*self._states.items(), *states.items()):
            mine = takes.get(key, []) if states.get(key) is state else []
            state.set_delivery(self, self._delivery(mine).published if mine else None)
        self._states = states

    def _forget(self, entities: EntitySet) -> None:
        """Let go of subscriptions that are there no more."""
        present = {id(s): s for s in entities.subscriptions}
        for key, direct in list(self._known.items()):
            if present.get(key) is not direct.subscription:
                del self._known[key]
        self._refused = {
            key: s for key, s in self._refused.items() if present.get(key) is s}

    def _rest(self, entities: EntitySet, chosen: list[Direct]) -> EntitySet:
        keys = frozenset(id(direct.subscription) for direct in chosen)
        if self._left is not None and entities is self._before and keys == self._chosen:
            return self._left
        self._before, self._chosen = entities, keys
        self._left = replace(
            entities, subscriptions=[s for s in entities.subscriptions if id(s) not in keys])
        return self._left


def _compatible(publisher: Any, subscription: Subscription) -> bool:
    found, _ = qos_check_compatible(publisher.qos_profile, subscription.qos_profile)
    return bool(found != QoSCompatibility.ERROR)
