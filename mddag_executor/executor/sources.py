# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Collect messages, requests and responses from entities, and make work of them.

The middleware writes to the descriptor of an entity at each arrival (``loop``); ``collect`` then
takes what has arrived.  Messages and requests are taken under the engine's lock, so they stay in
order whichever thread takes them.  This costs no parallelism, because rclpy keeps the GIL while it
takes.

Responses complete futures, and messages on ``/clock`` set simulated time.  The spinning thread
takes both, because callbacks may wait for them (``at_once``).  A response to a request that
inherits is also taken by the thread that has sent it (``sent_requests``).

Anything beyond a bound stays in the middleware: requests beyond ``SERVICE_DEPTH``, and messages
beyond ``MOST`` if the QoS profile keeps all.  These are collected when a waiting one starts
(``Entity.collect_more``).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from mddag_executor.executor import compat
from mddag_executor.executor.attribution import header_stamp, Publication
from mddag_executor.executor.bounds import MOST
from mddag_executor.executor.gaps import Gaps
from mddag_executor.executor.kinds import ListenerEntity, Rooms
from mddag_executor.executor.listeners import MANY, read_count, set_listener
from mddag_executor.executor.request_ids import name_of_service, sender_of
from mddag_executor.executor.work import Work
from msg_graph.binding import Entity as Declarable
from rclpy.qos import HistoryPolicy

_MOST_FOREIGN = 8
"""This many responses to other clients are expected before the first own one."""
_ONCE = range(1)
SERVICE_DEPTH = 10
"""How many requests wait in Python at most: the depth of rclpy's default profile for services."""


class ArrivalEntity(ListenerEntity):
    """
    An entity at which messages, requests or responses arrive.

    Its kind sets, before it listens, how one arrival is taken (``_take``; None: there is none).
    """

    __slots__ = ('_take',)

    _take: Callable[[], Any]
    hears_others = False
    """Whether arrivals may be for others, so that taking one gives None before the last one."""

    def collect(self, left: int = 0) -> None:
        """
        Collect the arrivals; the rest after ``MOST`` is announced again.

        :param left: how many at most; 0: those announced since the last call.
        """
        take = self._take
        try:
            if not left:
                left = read_count(self.fd) if self.is_counted else MANY
                if not left:
                    return  # another thread has collected it
            if self.removed:
                return  # another executor may have it now
            most = self.most_waiting
            misses = (left if left < MANY else _MOST_FOREIGN) if self.hears_others else 1
            for _ in _ONCE if left == 1 else range(min(left, MOST)):
                if most and most <= len(self.waiting):
                    self.collect_more = partial(self.collect, MANY)
                    return
                left -= 1
                taken = take()
                if taken is None:
                    misses -= 1
                    if not misses:
                        return
                    continue
                self.post(taken)
        except compat.RCL_ERRORS as error:
            if not compat.alive(self.rclpy_object):
                return
            self.rooms.pool.fail(error)
        except Exception as error:
            if self.fd < 0:
                return  # it was just removed
            self.rooms.pool.fail(error)
        if left:
            self.loop.announce(self, left)

    def post(self, taken: Any) -> None:
        """Handle an arrival."""
        raise NotImplementedError


class SubscriptionEntity(ArrivalEntity):
    """A subscription."""

    kind = 'subscription'
    list_name = 'subscriptions'
    is_known_to_caret = True

    __slots__ = ('_gaps', '_with_info', '_is_plain', '_is_successor')

    def describe(self) -> None:
        """Set label, depth and whatever else does not change."""
        self.topic = self.label = self.rclpy_object.topic_name
        qos = self.rclpy_object.qos_profile
        if qos.history == HistoryPolicy.KEEP_LAST:
            self.depth = qos.depth
        else:
            self.most_waiting = MOST
        self.declarable = Declarable(self.node, self.kind, self.topic)

    def may_come_from_outside(self) -> bool:
        """Return whether messages may come that declared callbacks of this process do not send."""
        return self.callback is None or self.source >= 0 or bool(self.remote_publishers)

    def listen(self, rooms: Rooms) -> None:
        """Let workers and publishing threads of this process collect messages."""
        subscription, pool = self.rclpy_object, rooms.pool
        if compat.is_of_wait_for_message(subscription):
            return
        self._take = compat.message_taker(subscription)
        self._gaps = Gaps(
            partial(rooms.publishers, subscription), partial(compat.publisher_count, subscription))
        self._with_info = compat.callback_type(subscription) is compat.WITH_INFO
        # of no job; or only of jobs that are known by the publication
        may_be_plain = pool.engine.record is None and not self.is_own
        self._is_plain = may_be_plain and self.callback is None
        self._is_successor = may_be_plain and self.source < 0 and bool(self.targets)
        self.listen_in(rooms, pool.loop)
        if self.is_counted:
            rooms.deliveries.add(self)

    def ignore(self) -> None:
        """End ``listen``."""
        if self.fd >= 0:
            self.rooms.deliveries.remove(self)
        super().ignore()

    def listen_again(self) -> None:
        """Set the listener again after the middleware has replaced the reader."""
        with self.handle:
            set_listener(self.kind, self.handle.pointer, self.fd)

    def record(self, say: Callable[..., None], node: int) -> None:
        """Record it with CARET's tracepoints."""
        handle = id(self.rclpy_object)
        say('rcl_subscription_init', handle, node, handle, self.label, self.depth)
        say('rclcpp_subscription_init', handle, handle)
        say('rclcpp_subscription_callback_added', handle, self.address)
        say('rclcpp_callback_register', self.address, self.symbol)

    def post(self, taken: Any, publication: Publication | None = None) -> None:
        """
        Report a message to the engine.

        :param publication: the one that has just sent it, if certain.
        """
        pool, gaps = self.rooms.pool, self._gaps
        number = taken[1].get('publication_sequence_number')
        if number == gaps.expected:
            gaps.expected = number + 1
        elif missing := gaps.missing(number):
            pool.engine.messages_lost(self, missing, pool.now)
        work = Work(self, self.rclpy_object.callback, taken if self._with_info else (taken[0],))
        if self._is_plain:
            pool.engine.ready(work, pool.now)
        elif publication is not None and self._is_successor:
            pool.engine.arrived(work, publication.origin, -1, -1, pool.now)
        else:
            self._post_known(work, taken[1], publication)

    def _post_known(
        self, work: Work, info: dict[str, Any], publication: Publication | None
    ) -> None:
        """Report a message that is recorded, or may belong to a job, or is the executor's own."""
        pool = self.rooms.pool
        engine = pool.engine
        if self.is_own:
            work.function(*work.args)
            return
        message, stamp = work.args[0], info['source_timestamp']
        now = pool.now
        if engine.record is not None or self.source >= 0 or self.remote_publishers:
            now = pool.tick()  # the message may have been sent after the turn began
        if engine.record is not None:
            engine.message_taken(
                self, message, stamp, info.get('publication_sequence_number'), now)
        if self.callback is None:
            engine.ready(work, now)
            return
        if self.awaits and publication is None and pool.announcements is not None:
            pool.announcements.receive(work, info, now)
            return
        origin = None
        release = header = -1
        if self.source >= 0:
            release, header = engine.attribution.release_of(
                engine.tables.dag_of[self.source], self.topic, message, stamp, now,
                pool.stamped_releases)
        elif self.targets:
            origin = publication.origin if publication is not None else engine.attribution.find(
                self.topic, stamp, info.get('publication_sequence_number'))
            if origin is None and self.remote_publishers:
                header = header_stamp(message)
                release = pool.stamped_releases.release(header, self.topic, now)
        engine.arrived(work, origin, release, header, now)

    def collect_published(self, publication: Publication | None) -> bool:
        """
        Collect the announced arrivals, right after a publication.

        If only the publication's message was announced, the message is known to be the
        publication's.  The caller holds the engine's lock.

        :return: whether there was any arrival.
        """
        announced = read_count(self.fd)
        if not announced:
            return False  # nothing was announced, or it was just removed
        if announced > 1 or self.most_waiting:
            self.collect(announced)
            return True
        try:
            taken = self._take()
        except compat.RCL_ERRORS:
            self.collect(MANY)  # finds out the reason
            return True
        if taken is None:
            return False
        if publication is not None:
            info = taken[1]
            sequence = info.get('publication_sequence_number')
            if not publication.covers(info['source_timestamp']) or (
                    sequence is not None and not publication.numbers.agree_at_once(
                        publication.sequence, sequence)):
                publication = None
        self.post(taken, publication)
        return True


class ClockEntity(SubscriptionEntity):
    """The subscription of a node to simulated time, which rclpy makes: no declaration means it."""

    at_once = True

    __slots__ = ()

    @classmethod
    def fits(cls, rclpy_object: Any) -> bool:
        """Return whether a subscription is of this kind."""
        return compat.keeps_time(rclpy_object)

    def describe(self) -> None:
        """Set label, depth and whatever else does not change."""
        super().describe()
        self.declarable = None

    def listen(self, rooms: Rooms) -> None:
        """Let the spinning thread collect messages."""
        self._take = compat.message_taker(self.rclpy_object)
        self.listen_in(rooms, rooms.at_once.loop)

    def ignore(self) -> None:
        """End ``listen``."""
        ListenerEntity.ignore(self)

    def post(self, taken: Any, publication: Publication | None = None) -> None:
        """Set simulated time."""
        self.rclpy_object.callback(taken[0])
        self.rooms.at_once.count(self)


class ServiceEntity(ArrivalEntity):
    """A service."""

    kind = 'service'
    list_name = 'services'
    is_known_to_caret = True

    __slots__ = ('_name',)

    def describe(self) -> None:
        """Set label, depth and whatever else does not change."""
        self.label = compat.service_name(self.rclpy_object)
        self.most_waiting = SERVICE_DEPTH
        self.declarable = Declarable(self.node, self.kind, self.label)

    def may_come_from_outside(self) -> bool:
        """Return whether requests may come that declared callbacks of this process do not send."""
        return self.callback is None or self.source >= 0 or bool(self.remote_publishers)

    def listen(self, rooms: Rooms) -> None:
        """Let requests be collected; the built-in services of a node share a descriptor."""
        self._take = compat.request_taker(self.rclpy_object)
        with self.handle:
            self._name = name_of_service(self.handle)
        self.listen_in(rooms, rooms.pool.loop,
                       f'services {self.node}' if compat.is_builtin(self.rclpy_object) else '')
        rooms.pool.engine.sent_requests.add_receiver(self._name, self.receive)

    def ignore(self) -> None:
        """End ``listen``."""
        if self.fd >= 0:
            self.rooms.pool.engine.sent_requests.remove_receiver(self._name, self.receive)
        super().ignore()

    def receive(self) -> None:
        """Collect a request in the thread that has just sent it."""
        pool = self.rooms.pool
        if not pool.is_inside():
            pool.report(self._collect_now)

    def _collect_now(self, now: int) -> None:
        if self.rooms.pool.running:
            self.collect()

    def record(self, say: Callable[..., None], node: int) -> None:
        """Record it with CARET's tracepoints."""
        handle = id(self.rclpy_object)
        say('rcl_service_init', handle, node, handle, self.label)
        say('rclcpp_service_callback_added', handle, self.address)
        say('rclcpp_callback_register', self.address, self.symbol)

    def post(self, taken: Any) -> None:
        """Report a request to the engine."""
        request, header = taken
        service, pool = self.rclpy_object, self.rooms.pool
        engine = pool.engine
        # a recording distinguishes requests by the time at which they became ready
        now = pool.now
        if engine.record is not None or self.source >= 0:
            now = pool.tick()
        work = Work(
            self, service.callback, (request, service.srv_type.Response()),
            partial(service.send_response, header=header))
        if self.source >= 0:
            engine.arrived(work, None, now, -1, now)
        else:
            requests = engine.sent_requests
            if not requests.is_empty():
                work.heritage = requests.of_request(
                    sender_of(header), header.request_id.sequence_number, header.source_timestamp)
                if work.heritage is not None:
                    work.then = partial(self._answer, header)
            engine.posted(work, now)

    def _answer(self, header: Any, response: Any) -> None:
        """Send a response, which the calling thread takes as well."""
        self.rclpy_object.send_response(response, header)
        self.rooms.pool.engine.sent_requests.receive_responses()


class ClientEntity(ArrivalEntity):
    """A client: its responses complete futures, whose callbacks run in the executor."""

    kind = 'client'
    list_name = 'clients'
    names_type = False
    hears_others = True  # the responses to all clients of the service

    __slots__ = ()

    def describe(self) -> None:
        """Set its label."""
        self.label = compat.service_name(self.rclpy_object)

    def listen(self, rooms: Rooms) -> None:
        """Let the spinning thread collect responses."""
        self._take = compat.response_taker(self.rclpy_object)
        self.listen_in(rooms, rooms.at_once.loop)
        rooms.pool.engine.sent_requests.add_receiver(self.handle, self.collect)

    def ignore(self) -> None:
        """End ``listen``."""
        if self.fd >= 0:
            self.rooms.pool.engine.sent_requests.remove_receiver(self.handle, self.collect)
        super().ignore()

    def post(self, taken: Any) -> None:
        """Complete the future of a response."""
        header, response = taken
        pool, number = self.rooms.pool, header.request_id.sequence_number
        compat.complete_request(
            self.rclpy_object, number, response,
            pool.outer_groups.get(self.outer) or pool.executor,
            partial(pool.engine.sent_requests.of_response, self.handle, number))
        self.rooms.at_once.handled(self)
