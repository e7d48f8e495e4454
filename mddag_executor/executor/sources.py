# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Collect messages, requests and responses from entities, and make work of them.

A source belongs to one entity.  It has a descriptor to which the middleware writes at each arrival
(``loop``); ``collect`` then takes what has arrived.  Messages and requests are taken under the
engine's lock, so they stay in order whichever thread takes them.  This costs no parallelism,
because rclpy keeps the GIL while it takes.

Anything beyond a bound stays in the middleware: requests beyond ``SERVICE_DEPTH``, and messages
beyond ``MOST`` if the QoS profile keeps all.  These are collected when a waiting one starts
(``Entity.collect_more``).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from mddag_executor.executor import compat
from mddag_executor.executor.bounds import MOST
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.gaps import Gaps
from mddag_executor.executor.hall import Hall
from mddag_executor.executor.jobs import Publication, stamped_release
from mddag_executor.executor.listeners import clear_listener, MANY, set_listener, take_count
from mddag_executor.executor.loop import ChannelSource, EventLoop
from mddag_executor.executor.work import Work
from rclpy.exceptions import InvalidHandle

SERVICE_DEPTH = 10
"""How many requests wait in Python at most: the depth of rclpy's default profile for services."""


class EntitySource(ChannelSource):
    """An entity with a listener."""

    def __init__(self, entity: Entity) -> None:
        self.entity = entity
        self.handle: Any = entity.rclpy.handle

    def listen(self) -> None:
        """Let the middleware announce arrivals; raise InvalidHandle if the entity is destroyed."""
        with self.handle:
            set_listener(self.entity.kind, self.handle.pointer, self.fd)

    def ignore(self) -> None:
        """End ``listen``."""
        try:
            with self.handle:
                clear_listener(self.entity.kind, self.handle.pointer)
        except InvalidHandle:
            pass  # it is just being destroyed


class Source(EntitySource):
    """
    An entity at which messages, requests or responses arrive.

    :param take: takes one arrival and returns it; None: there is none.
    :param fail: receives the exceptions of takes.
    """

    def __init__(
        self, entity: Entity, loop: EventLoop, take: Callable[[], Any],
        fail: Callable[[BaseException], None],
    ) -> None:
        super().__init__(entity)
        self._loop = loop
        self._take = take
        self._fail = fail

    def collect(self, left: int = 0) -> None:
        """
        Collect the arrivals; the rest after ``MOST`` is announced again.

        :param left: how many at most; 0: those announced since the last call.
        """
        entity, take = self.entity, self._take
        try:
            if not left:
                left = take_count(self.fd) if self.is_counted else MANY
                if not left:
                    return  # another thread has collected it
            if entity.removed:
                return  # another executor may have it now
            for _ in range(left if left < MOST else MOST):
                if 0 < entity.most_waiting <= len(entity.waiting):
                    entity.collect_more = partial(self.collect, MANY)
                    return
                left -= 1
                taken = take()
                if taken is None:
                    return
                self.post(taken)
        except compat.RCL_ERRORS as error:
            if not compat.alive(entity.rclpy):
                return
            self._fail(error)
        except Exception as error:
            if self.fd < 0:
                return  # it was just removed
            self._fail(error)
        if left:
            self._loop.announce(self, left)

    def post(self, taken: Any) -> None:
        """Handle an arrival."""
        raise NotImplementedError


class SubscriptionSource(Source):
    """
    A subscription.

    :param publishers: returns the ids of the publishers of a subscription (see ``gaps``).
    """

    def __init__(
        self, entity: Entity, pool: Hall,
        publishers: Callable[[Any], frozenset[bytes] | None],
    ) -> None:
        super().__init__(entity, pool.loop, compat.message_taker(entity.rclpy), pool.fail)
        self._pool = pool
        self._gaps = Gaps(
            partial(publishers, entity.rclpy), partial(compat.publisher_count, entity.rclpy))
        self._with_info = compat.callback_type(entity.rclpy) is compat.WITH_INFO
        self._is_plain = (
            pool.engine.record is None and entity.callback is None and not entity.is_own)

    def post(self, taken: Any, publication: Publication | None = None) -> None:
        """
        Report a message to the engine.

        :param publication: the one that has just sent it, if certain.
        """
        entity, pool, gaps = self.entity, self._pool, self._gaps
        number = taken[1].get('publication_sequence_number')
        if number == gaps.expected:
            gaps.expected += 1
        elif missing := gaps.missing(number):
            pool.engine.never_taken(entity, missing, pool.now)
        work = Work(entity, entity.rclpy.callback, taken if self._with_info else (taken[0],))
        if self._is_plain:
            pool.engine.ready(work, pool.now)
        else:
            self._post_known(work, taken[1], publication)

    def _post_known(
        self, work: Work, info: dict[str, Any], publication: Publication | None
    ) -> None:
        """Report a message that is recorded, or may belong to a job, or is the executor's own."""
        entity, engine = self.entity, self._pool.engine
        if entity.is_own:
            work.function(*work.args)
            return
        message, stamp = work.args[0], info['source_timestamp']
        now = self._pool.now
        if engine.record is not None:
            now = self._pool.tick()  # it becomes ready right after it was taken
            engine.taken(
                entity, message, stamp, info.get('publication_sequence_number'), now)
        if entity.callback is None:
            engine.ready(work, now)
            return
        if entity.awaits and publication is None and self._pool.announcements is not None:
            self._pool.announcements.take(work, info, now)
            return
        origin = None
        release = header = -1
        if entity.source >= 0:
            release, header = engine.jobs.release(
                engine.tables.dag_of[entity.source], message, stamp, now, self._pool.clock)
        elif entity.targets:
            origin = publication.origin if publication is not None else engine.jobs.find(
                entity.topic, stamp, info.get('publication_sequence_number'))
            if origin is None and entity.remote_publishers:
                release, header = stamped_release(message, self._pool.clock)
        engine.arrived(work, origin, release, header, now)

    def collect_published(self, publication: Publication | None) -> bool:
        """
        Collect the announced arrivals, right after a publication.

        If only the publication's message was announced, the message is known to be the
        publication's.  The caller holds the engine's lock.

        :return: whether there was any arrival.
        """
        announced = take_count(self.fd)
        if not announced:
            return False  # nothing was announced, or it was just removed
        if announced > 1 or self.entity.most_waiting:
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
            if not publication.holds(info['source_timestamp']) or (
                    sequence is not None and not publication.numbers.agree_at_once(
                        publication.sequence, sequence)):
                publication = None
        self.post(taken, publication)
        return True


class ServiceSource(Source):
    """A service."""

    def __init__(self, entity: Entity, pool: Hall) -> None:
        super().__init__(entity, pool.loop, compat.request_taker(entity.rclpy), pool.fail)
        self._pool = pool

    def post(self, taken: Any) -> None:
        """Report a request to the engine."""
        request, header = taken
        service, engine = self.entity.rclpy, self._pool.engine
        # a recording tells requests apart by the time at which they became ready
        now = self._pool.now if engine.record is None else self._pool.tick()
        work = Work(
            self.entity, service.callback, (request, service.srv_type.Response()),
            partial(service.send_response, header=header))
        if self.entity.source >= 0:
            engine.arrived(work, None, now, -1, now)
        else:
            engine.ready(work, now)
