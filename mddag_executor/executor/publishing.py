# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Wraps methods of rclpy, so that the executor knows when a program calls them.

Theory of operation
-------------------
``Publisher.publish``, ``Client.call``, ``Subscription.set_content_filter``, the trigger of guard
conditions, and the methods of handles that send requests are wrapped once for the process, when
the first executor is made.

1.  *A callback in* ``Client.call`` lends its worker to a spare thread (``workers``).
2.  *A publication on a trigger topic* is noted, so that its messages find their job
    (``attribution``).  Other messages on the topics of declared callbacks are counted, because the
    middleware numbers them as well.
3.  *Delivery within the process.*  A middleware that delivers within a process does so inside
    ``publish``: the message can be taken when that returns.  The publishing thread takes the
    message itself instead of waking a worker.  If a thread waits for events, the descriptors of
    this process's subscriptions on the topic are switched off while it publishes.  Then it takes
    the announced messages, and switches the descriptors on again.  Other publishers have no
    effect: any other arrival wakes a worker.
4.  A thread that publishes while it owns the engine's lock (a signal handler can) leaves the
    message to a worker.
5.  *A new content filter* makes rmw_fastrtps replace the subscription's reader, which loses the
    listener (rclpy from 7.1.8 on).  So the listener is set again.
6.  *A triggered guard condition* is announced like a message, because rcl has no listener for it.
    The method of its handle is wrapped, which also those call that have no ``GuardCondition``.
7.  *A request* that a callback with a deadline sends is noted: it inherits (``sent_requests``).
8.  *Code that a callback has started* publishes on its behalf (``starters``).  Other messages on
    the topics of declared callbacks belong to no job, and are counted (``outside``).

The methods are unchanged outside of callbacks of this executor, on topics that no callback is
declared to publish and that have no subscription of an executor here.
"""

from __future__ import annotations

from functools import partial
import threading
from typing import Any
import weakref

from mddag_executor.executor import starters
from mddag_executor.executor.attribution import (
    NO_ORIGIN,
    Origin,
    Publication,
    PublisherState,
    Topic,
)
from mddag_executor.executor.compat import (
    ACTION_REQUESTS,
    CLIENT_HANDLE,
    goal_of,
    GUARD_HANDLE,
    SERVER_HANDLE,
    SERVICE_CLIENT_HANDLE,
    service_name,
)
from mddag_executor.executor.interrupts import runs_callbacks
from mddag_executor.executor.listeners import announce_trigger
from mddag_executor.executor.request_ids import id_of_client
from mddag_executor.executor.sent_requests import Heritage
from mddag_executor.executor.starters import starter_outside
from mddag_executor.executor.work import current, Runner, starter_here
from rclpy.client import Client
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription


class LocalDelivery:
    """
    The subscriptions on one topic that publishing threads of this process take from.

    :param sources: the subscriptions (``sources.SubscriptionEntity``).
    :param pool: the ``WorkerPool``.
    """

    __slots__ = ('sources', 'pool', '_is_muted')

    def __init__(self, sources: tuple[Any, ...], pool: Any) -> None:
        self.sources = sources
        self.pool = pool
        self._is_muted = False

    def mute(self) -> None:
        """Pause announcements, as a thread waits for them."""
        try:
            self.pool.loop.mute(self.sources)
        finally:
            self._is_muted = True  # last: a thread that ends it meanwhile may be too early

    def listen_again(self, subscription: Any) -> None:
        """Announce a subscription again after the middleware has replaced its reader."""
        for source in self.sources:
            if source.rclpy_object is subscription:
                source.listen_again()

    def collect_published(self, publication: Publication | None, of: Any) -> None:
        """
        Collect the arrivals announced since a publication began, and resume announcements.

        :param of: the pool that runs the execution that has published; None: it was none of ours.
        """
        pool = self.pool
        if of is not pool:
            publication = None  # of another executor, with other jobs
        if not pool.is_inside():
            with pool.lock:
                pool.tick()
                posted = False
                for source in self.sources:
                    posted |= source.collect_published(publication)
                if posted:
                    pool.wake_for_more()
        if self._is_muted:
            self._is_muted = False
            pool.loop.unmute(self.sources)


_STATE = '_mddag_publisher_state'
_deliveries: dict[str, tuple[LocalDelivery, ...]] = {}
# by topic: the pools of executors with a callback that is declared to publish it
_watching: dict[str, tuple[weakref.ref[Any], ...]] = {}
_lock = threading.RLock()  # a finalizer may come anywhere
_installed = False


class Deliveries:
    """
    The subscriptions of an executor that publishing threads of this process take from.

    :param pool: the ``WorkerPool``.
    """

    def __init__(self, pool: Any) -> None:
        self._pool = pool
        self._by_topic: dict[str, LocalDelivery] = {}

    def add(self, source: Any) -> None:
        """Let publishing threads take from a subscription."""
        before = self._by_topic.get(source.label)
        self._set(source.label, (*(before.sources if before else ()), source))

    def remove(self, source: Any) -> None:
        """End ``add``; does nothing for other subscriptions."""
        before = self._by_topic.get(source.label)
        if before is not None and source in before.sources:
            self._set(
                source.label, tuple(each for each in before.sources if each is not source))

    def _set(self, topic: str, sources: tuple[Any, ...]) -> None:
        new = LocalDelivery(sources, self._pool) if sources else None
        replace_delivery(topic, self._by_topic.pop(topic, None), new)
        if new is not None:
            self._by_topic[topic] = new


def replace_delivery(topic: str, old: LocalDelivery | None, new: LocalDelivery | None) -> None:
    """Replace the ``LocalDelivery`` of publishing threads on a topic; None: there is none."""
    with _lock:
        several = [each for each in _deliveries.get(topic, ()) if each is not old]
        if new is not None:
            several.append(new)
        if several:
            _deliveries[topic] = tuple(several)
        else:
            _deliveries.pop(topic, None)


def watch(pool: Any) -> None:
    """Notice all messages on the topics that the declared callbacks of an executor publish."""
    reference = weakref.ref(pool)
    with _lock:
        for topic in pool.engine.attribution.topics:
            _watching[topic] = (*_watching.get(topic, ()), reference)


def unwatch(pool: Any) -> None:
    """End ``watch`` for a pool, and for pools that have been destroyed."""
    with _lock:
        for topic, several in list(_watching.items()):
            rest = tuple(each for each in several if each() not in (None, pool))
            if rest:
                _watching[topic] = rest
            else:
                del _watching[topic]


def state_of(publisher: Any) -> PublisherState:
    """Return the state of a publisher, which begins with the first use."""
    state: PublisherState = publisher.__dict__.setdefault(
        _STATE, PublisherState(publisher.topic_name))
    return state


def _send(
    original: Any, publisher: Any, msg: Any, state: PublisherState, running: Runner
) -> Publication | None:
    """Publish in a callback; return the publication if it was on a trigger topic."""
    engine, work = running.engine, running.work
    topic = engine.attribution.topics.get(state.topic)
    origin = None if work is None else work.origin or work.answers
    if topic is None or origin is not None:
        running.publishes(publisher, state, msg)
    else:
        claim = None if work is None or work.starter is None else (
            work.starter.claim(state.topic, msg, running.pool))
        if claim is not None:
            running.publishes(publisher, state, msg, claim.work)
            return _send_counted(original, publisher, msg, state, engine, topic, claim.origin)
        running.publishes(publisher, state, msg)
        if work is None or work.entity.callback is None:
            _note_outside(
                running.pool, publisher, state, '' if work is None else work.entity.name)
    if topic is None:
        _send_unnoted(original, publisher, msg, state)
        return None
    if work is not None and work.entity.awaiting is not None:
        engine.answers.note_published(work, state.topic, msg)
        origin = work.origin or work.answers
    return _send_counted(original, publisher, msg, state, engine, topic, origin or NO_ORIGIN)


def _send_counted(
    original: Any, publisher: Any, msg: Any, state: PublisherState, engine: Any = None,
    topic: Topic | None = None, origin: Origin = NO_ORIGIN,
) -> Publication | None:
    """
    Publish with a publisher of which the messages are counted.

    :param engine: notes the publication on a trigger topic; None: it is not noted.
    :return: the publication, if it was noted.
    """
    with state.lock:
        state.count += 1
        state.is_tracked = True
        try:
            if engine is None:
                original(publisher, msg)
                return None
            publication: Publication = engine.attribution.publish(
                original, publisher, msg, state, topic, origin)
            return publication
        except BaseException:
            state.count -= 1  # the middleware has not counted it
            raise


def _send_unnoted(original: Any, publisher: Any, msg: Any, state: PublisherState) -> None:
    """Publish a message that belongs to no job; it is counted if later ones may belong to one."""
    if state.is_tracked or state.topic in _watching:
        _send_counted(original, publisher, msg, state)
    else:
        original(publisher, msg)


def _send_outside(
    original: Any, publisher: Any, msg: Any, state: PublisherState
) -> tuple[Publication | None, Any]:
    """
    Publish outside of callbacks.

    :return: the publication if it is on behalf of an execution, and the pool that runs this.
    """
    watching = _watching.get(state.topic)
    starter = None if watching is None else starter_outside()
    claim = None if starter is None else starter.claim(state.topic, msg)
    for reference in watching or ():
        pool = reference()
        if pool is not None and (claim is None or claim.pool is pool):
            if pool.engine.notes_publications:
                pool.engine.publishes(
                    None if claim is None else claim.work, publisher, state, msg,
                    pool.clock.now(), threading.get_native_id(), claim is not None)
            if claim is None:
                _note_outside(pool, publisher, state, '')
    if claim is None:
        _send_unnoted(original, publisher, msg, state)
        return None, None
    claim.work.entity.publishes.add(state.topic)
    engine = claim.pool.engine
    return _send_counted(
        original, publisher, msg, state, engine, engine.attribution.topics[state.topic],
        claim.origin), claim.pool


def _note_outside(pool: Any, publisher: Any, state: PublisherState, by: str) -> None:
    outside = pool.outside
    if outside is not None:
        outside.note(publisher, state, by, pool.running and pool.engine.is_judging)


def publish_as_executor(publisher: Publisher, msg: Any) -> None:
    """Publish a message of the executor itself, which belongs to no callback of the thread."""
    before, current.running = current.running, None
    try:
        publisher.publish(msg)
    finally:
        current.running = before


def _heritage() -> tuple[Any, Heritage | None]:
    """Return the engine of the calling callback, and what its requests inherit, if anything."""
    running = current.running
    work = None if running is None else running.work
    if running is None or work is None:
        return None, None
    return running.engine, running.engine.heritage(work)


def _wrap_action(kind: str) -> None:
    """Wrap the methods that send a kind of requests to actions, and the responses."""
    ask = getattr(CLIENT_HANDLE, f'send_{kind}_request')
    answer = getattr(SERVER_HANDLE, f'send_{kind}_response')

    def send_request(self: Any, request: Any) -> Any:
        engine, heritage = _heritage()
        if heritage is None:
            return ask(self, request)
        return engine.sent_requests.send_to_action(
            partial(ask, self, request), kind, goal_of(request), self, heritage)

    def send_response(self: Any, header: Any, response: Any) -> None:
        answer(self, header, response)
        engine, heritage = _heritage()
        if heritage is not None:
            engine.sent_requests.receive_responses()

    send_request.__doc__, send_response.__doc__ = ask.__doc__, answer.__doc__
    setattr(CLIENT_HANDLE, f'send_{kind}_request', send_request)
    setattr(SERVER_HANDLE, f'send_{kind}_response', send_response)


def install() -> None:
    """Wrap rclpy's methods; further calls change nothing."""
    global _installed
    with _lock:
        if _installed:
            return
        _installed = True
    starters.install(starter_here)
    send = Publisher.publish
    call = Client.call
    set_filter = getattr(Subscription, 'set_content_filter', None)
    trigger = GUARD_HANDLE.trigger_guard_condition
    ask = SERVICE_CLIENT_HANDLE.send_request

    def publish(self: Any, msg: Any) -> None:
        state = self.__dict__.get(_STATE) or state_of(self)
        running = current.running
        deliveries = _deliveries.get(state.topic)
        if deliveries is None:
            if running is not None:
                _send(send, self, msg, state, running)
            else:
                _send_outside(send, self, msg, state)
            return
        publication, pool = None, None if running is None else running.pool
        try:  # an interrupt at any place must not leave the descriptors switched off
            for delivery in deliveries:
                if delivery.pool.polling:
                    delivery.mute()
            if running is not None:
                publication = _send(send, self, msg, state, running)
            else:
                publication, pool = _send_outside(send, self, msg, state)
        finally:
            for delivery in deliveries:
                delivery.collect_published(publication, pool)

    @runs_callbacks
    def call_and_wait(self: Any, request: Any, *args: Any, **kwargs: Any) -> Any:
        running = current.running
        if running is None:
            return call(self, request, *args, **kwargs)
        with running.lend(f'service {service_name(self)}'):
            return call(self, request, *args, **kwargs)

    def send_request(self: Any, request: Any) -> Any:
        engine, heritage = _heritage()
        known = None if heritage is None else id_of_client(self)
        if heritage is None or known is None:
            return ask(self, request)
        return engine.sent_requests.send(
            partial(ask, self, request), *known, self, heritage)

    def set_content_filter(self: Any, *args: Any, **kwargs: Any) -> None:
        set_filter(self, *args, **kwargs)  # type: ignore[misc]
        for delivery in _deliveries.get(self.topic_name, ()):
            delivery.listen_again(self)

    def trigger_and_announce(self: Any) -> None:
        trigger(self)
        announce_trigger(self.pointer)

    publish.__doc__ = send.__doc__
    call_and_wait.__doc__ = call.__doc__
    Publisher.publish = publish  # type: ignore[method-assign]
    Client.call = call_and_wait  # type: ignore[method-assign]
    trigger_and_announce.__doc__ = trigger.__doc__
    GUARD_HANDLE.trigger_guard_condition = trigger_and_announce
    send_request.__doc__ = ask.__doc__
    SERVICE_CLIENT_HANDLE.send_request = send_request
    for kind in ACTION_REQUESTS:
        _wrap_action(kind)
    if set_filter is not None:
        set_content_filter.__doc__ = set_filter.__doc__
        Subscription.set_content_filter = set_content_filter  # type: ignore[attr-defined]
