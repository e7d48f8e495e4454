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
    (``attribution``).  Those outside of callbacks are counted, because the middleware numbers them
    as well.
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

The methods are unchanged outside of callbacks of this executor, on topics without a subscription
of an executor here.
"""

from __future__ import annotations

from functools import partial
import threading
from typing import Any

from mddag_executor.executor.attribution import NO_ORIGIN, Publication, PublisherState
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
from mddag_executor.executor.work import current, Runner
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

    def collect_published(
        self, publication: Publication | None, running: Runner | None
    ) -> None:
        """
        Collect the arrivals announced since a publication began, and resume announcements.

        :param running: what runs the callback that has published; None: it was none of ours.
        """
        pool = self.pool
        if running is None or running.pool is not pool:
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
_lock = threading.Lock()
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


def state_of(publisher: Any) -> PublisherState:
    """Return the state of a publisher, which begins with the first use."""
    state: PublisherState = publisher.__dict__.setdefault(
        _STATE, PublisherState(publisher.topic_name))
    return state


def _send(
    original: Any, publisher: Any, msg: Any, state: PublisherState, running: Runner | None
) -> Publication | None:
    """Publish; return the publication if a callback published on a trigger topic."""
    topic = None
    if running is not None:
        running.publishes(publisher, state, msg)
        topic = running.engine.attribution.topics.get(state.topic)
    if running is not None and topic is None and not state.is_tracked:
        original(publisher, msg)
        return None
    with state.lock:
        state.count += 1
        try:
            if running is None or topic is None:
                original(publisher, msg)
                return None
            state.is_tracked = True
            work = running.work
            if work is not None and work.entity.awaiting is not None:
                running.engine.answers.note_published(work, state.topic, msg)
            origin = None if work is None else work.origin or work.answers
            publication: Publication = running.engine.attribution.publish(
                original, publisher, msg, state, topic, origin or NO_ORIGIN)
            return publication
        except BaseException:
            state.count -= 1  # the middleware has not counted it
            raise


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
            if running is None and not state.is_tracked:
                send(self, msg)
            else:
                _send(send, self, msg, state, running)
            return
        publication = None
        try:  # an interrupt at any place must not leave the descriptors switched off
            for delivery in deliveries:
                if delivery.pool.polling:
                    delivery.mute()
            publication = _send(send, self, msg, state, running)
        finally:
            for delivery in deliveries:
                delivery.collect_published(publication, running)

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
