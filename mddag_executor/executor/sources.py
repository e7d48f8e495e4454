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
import os
from typing import Any, ClassVar, Protocol

from mddag_executor.executor import compat
from mddag_executor.executor.bounds import MOST
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.jobs import Publication
from mddag_executor.executor.listeners import clear_listener, MANY, set_listener
from mddag_executor.executor.loop import ALWAYS, EventLoop
from mddag_executor.executor.work import Work
from rclpy.exceptions import InvalidHandle

SERVICE_DEPTH = 10
"""How many requests wait in Python at most: the depth of rclpy's default profile for services."""


class Arrivals(Protocol):
    """Receives collected messages and requests; all methods are called under the engine's lock."""

    def message(
        self, entity: Entity, args: tuple[Any, ...], info: dict[str, Any],
        publication: Publication | None,
    ) -> None:
        """Handle a message; ``publication``: the one that has just sent it, if certain."""

    def request(self, work: Work) -> None:
        """Handle a request."""

    def failed(self, error: BaseException) -> None:
        """Handle an exception of a take."""


class Source:
    """
    An entity at which messages, requests or responses arrive.

    :ivar fd: its descriptor (see ``loop``), -1: none.
    :ivar urgency: the nested epoll in which ``fd`` is registered.
    """

    __slots__ = ('entity', 'handle', 'fd', 'urgency', 'is_counted', '_loop', '_arrivals')

    kind: ClassVar[str]
    asks_others = False

    def __init__(self, entity: Entity, loop: EventLoop, arrivals: Arrivals) -> None:
        self.entity = entity
        self.handle: Any = entity.rclpy.handle
        self.fd, self.urgency, self.is_counted = -1, ALWAYS, False
        self._loop = loop
        self._arrivals = arrivals

    def listen(self) -> None:
        """
        Let the middleware announce arrivals.

        :raises InvalidHandle: when the entity has been destroyed.
        """
        with self.handle:
            set_listener(self.kind, self.handle.pointer, self.fd)

    def ignore(self) -> bool:
        """End ``listen``; return False if the entity is just being destroyed."""
        try:
            with self.handle:
                clear_listener(self.kind, self.handle.pointer)
            return True
        except InvalidHandle:
            return False

    def collect(self) -> None:
        """Collect all arrivals announced since the last call."""
        count = MANY
        if self.is_counted:
            try:
                count = os.eventfd_read(self.fd)
            except (OSError, ValueError):
                return  # another thread has collected it, or it was just removed
        self._collect(count)

    def collect_all(self) -> None:
        """Collect all arrivals, announced or not."""
        self._collect(MANY)

    def _collect(self, left: int) -> None:
        """Take ``left`` arrivals at most; the rest after ``MOST`` is announced again."""
        entity = self.entity
        if entity.removed:
            return  # another executor may have it now
        try:
            for _ in range(min(left, MOST)):
                if 0 < entity.most_waiting <= len(entity.waiting):
                    entity.collect_more = self.collect_all
                    return
                left -= 1
                if not self.take_one():
                    return
        except compat.RCL_ERRORS as error:
            if compat.alive(entity.rclpy):
                self._arrivals.failed(error)
            return
        except Exception as error:
            self._arrivals.failed(error)
        if left:
            self._loop.announce(self, left)

    def take_one(self) -> bool:
        """Take one arrival and post it; return whether there was one."""
        raise NotImplementedError


class SubscriptionSource(Source):
    """A subscription."""

    __slots__ = ('_take', '_with_info')

    kind = 'subscription'

    def __init__(self, entity: Entity, loop: EventLoop, arrivals: Arrivals) -> None:
        super().__init__(entity, loop, arrivals)
        self._take = compat.message_taker(entity.rclpy)
        self._with_info = compat.callback_type(entity.rclpy) is compat.WITH_INFO

    def take_one(self) -> bool:
        """Take a message and post it; return whether there was one."""
        taken = self._take()
        if taken is None:
            return False
        self._arrivals.message(
            self.entity, taken if self._with_info else taken[:1], taken[1], None)
        return True

    def collect_published(self, publication: Publication | None) -> bool:
        """
        Collect the announced arrivals, right after a publication.

        If only the publication's message was announced, the message is known to be the
        publication's.  The caller holds the engine's lock.

        :return: whether there was any arrival.
        """
        try:
            announced = os.eventfd_read(self.fd)
        except (OSError, ValueError):  # nothing was announced, or it was just removed
            return False
        entity = self.entity
        if announced > 1 or entity.most_waiting:
            self._collect(announced)
            return True
        try:
            taken = self._take()
        except compat.RCL_ERRORS:
            self.collect_all()  # finds out the reason
            return True
        if taken is None:
            return False
        info = taken[1]
        if publication is not None:
            if not publication.holds(info['source_timestamp']):
                publication = None
            else:
                sequence = info.get('publication_sequence_number')
                if sequence is not None:
                    publication.numbers.offset = sequence - publication.sequence
        self._arrivals.message(
            entity, taken if self._with_info else taken[:1], info, publication)
        return True


class ServiceSource(Source):
    """A service."""

    __slots__ = ('_take',)

    kind = 'service'

    def __init__(self, entity: Entity, loop: EventLoop, arrivals: Arrivals) -> None:
        super().__init__(entity, loop, arrivals)
        self._take = compat.request_taker(entity.rclpy)

    def take_one(self) -> bool:
        """Take a request and post it; return whether there was one."""
        request, header = self._take()
        if header is None:
            return False
        service = self.entity.rclpy
        self._arrivals.request(Work(
            self.entity, service.callback, (request, service.srv_type.Response()),
            partial(service.send_response, header=header)))
        return True


class ClientSource(Source):
    """
    A client: its responses complete futures, whose callbacks run in the executor.

    The spinning thread collects from it, without the engine's lock.

    :param executor: the executor.
    :param responded: called after each response.
    """

    __slots__ = ('_take', '_executor', '_responded')

    kind = 'client'

    def __init__(
        self, entity: Entity, loop: EventLoop, arrivals: Arrivals, executor: Any,
        responded: Callable[[], None],
    ) -> None:
        super().__init__(entity, loop, arrivals)
        self._take = compat.response_taker(entity.rclpy)
        self._executor = executor
        self._responded = responded

    def take_one(self) -> bool:
        """Take a response and complete its future; return whether there was one."""
        header, response = self._take()
        if header is None:
            return False
        compat.complete_request(
            self.entity.rclpy, header.request_id.sequence_number, response, self._executor)
        self._responded()
        return True
