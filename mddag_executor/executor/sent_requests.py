# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The requests that executions of jobs have sent, with what they inherit (``core.rules``, rule 15).

Theory of operation
-------------------
1.  What a request inherits is known when it is sent: the *heritage* of the running execution
    (``Scheduler.heritage``).  It is noted here, and found again when the request is taken by a
    service or action of this executor.
2.  A request to a service is identified by its client and its sequence number.  Another thread may
    take it before the sending one knows the number.  Requests of a client are sent one after the
    other, so a request that is not older than the one that is just being sent is this one.
3.  A request to an action is identified by its goal.
4.  Another note is for the response: its callbacks inherit the same.  When the response is taken,
    the note of its request is removed as well.  It is still there if the request went to another
    process, or if another thread took the request before it was noted.
5.  *Delivery within the process.*  The middleware has delivered a request when ``send`` returns.
    So the sending thread takes the request at once (by its *receivers*), and the thread that sends
    the response takes the response.  Otherwise a worker would begin something less urgent before
    it knows of them.

Requests that others have sent are never found: those of other processes, of other executors, of
threads outside of callbacks, and of undeclared callbacks that inherit nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from time import time_ns
from typing import Any

from mddag_executor.executor.attribution import ROUNDING_NS
from mddag_executor.executor.bounds import MOST

Heritage = tuple[int, int]
"""What a request inherits: a priority, and the vertex of the execution that has it."""

SERVICE, ACTION = 'service', 'action'


class SentRequests:
    """The requests of one executor.  Any thread may note one, without a lock."""

    def __init__(self) -> None:
        # by what identifies a request, or the response to it; the latter with the request
        self._notes: dict[Any, tuple[Heritage, Any]] = {}
        # by client: what the request inherits that is just being sent, and since when
        self._sending: dict[bytes, tuple[Heritage, int]] = {}
        # what takes the arrivals of a service, by its name; of action servers; of clients
        self._receivers: dict[Any, tuple[Callable[[], object], ...]] = {}

    def add_receiver(self, key: Any, receive: Callable[[], object]) -> None:
        """
        Let a function take the arrivals of a service or client of the executor at once.

        :param key: the name of a service, ``ACTION`` for an action server, or a client's handle.
        """
        self._receivers[key] = (*self._receivers.get(key, ()), receive)

    def remove_receiver(self, key: Any, receive: Callable[[], object]) -> None:
        """End ``add_receiver``; does nothing if it was not called."""
        rest = tuple(each for each in self._receivers.get(key, ()) if each != receive)
        if rest:
            self._receivers[key] = rest
        else:
            self._receivers.pop(key, None)

    def _receive(self, key: Any) -> None:
        for receive in self._receivers.get(key, ()):
            receive()

    def receive_responses(self) -> None:
        """Take a response that was just sent: one to a request of which there is a note."""
        for client in {key[0] for key in list(self._notes) if len(key) == 3}:
            self._receive(client)

    def send(
        self, send: Callable[[], int], sender: bytes, service: str, client: Any,
        heritage: Heritage,
    ) -> int:
        """
        Send a request to a service; return its sequence number.

        :param sender: the middleware's id of the client; ``service``: the name of the service.
        :param client: the client's handle.
        """
        self._sending[sender] = heritage, time_ns()
        try:
            number = send()
            self._note((sender, number), heritage)
        finally:
            self._sending.pop(sender, None)
        self._note((client, SERVICE, number), heritage, (sender, number))
        self._receive(service)
        return number

    def send_to_action(
        self, send: Callable[[], int], kind: str, goal: bytes, client: Any, heritage: Heritage
    ) -> int:
        """
        Send a request to an action; return its sequence number.

        :param kind: ``goal``, ``cancel`` or ``result``; ``goal``: the id of the goal.
        """
        self._note((kind, goal), heritage)
        try:
            number = send()
        except BaseException:
            self._notes.pop((kind, goal), None)
            raise
        self._note((client, kind, number), heritage, (kind, goal))
        self._receive(ACTION)
        return number

    def _note(self, key: Any, heritage: Heritage, request: Any = None) -> None:
        """Note what a request inherits, or the callbacks of the response to a request."""
        notes = self._notes
        notes[key] = heritage, request
        if len(notes) > 4 * MOST:  # they are never answered
            for old in list(notes)[:MOST]:
                notes.pop(old, None)

    def _pop(self, key: Any) -> Heritage | None:
        """Return and remove a note; that of a response with the one of its request."""
        heritage, request = self._notes.pop(key, (None, None))
        if request is not None:
            self._notes.pop(request, None)
        return heritage

    def is_empty(self) -> bool:
        """Return whether no request, and no response, can be found."""
        return not (self._notes or self._sending)

    def of_request(self, sender: bytes | None, number: int, stamp: int) -> Heritage | None:
        """
        Return what a request to a service inherits; None: nothing.

        :param sender: the id of its client, if known; ``number``: its sequence number.
        :param stamp: when it was sent, system time in ns.
        """
        if sender is None:
            return None
        sending = self._sending.get(sender)  # first: it is noted before this ends
        found = self._pop((sender, number))
        if found is None and sending is not None and stamp >= sending[1] - ROUNDING_NS:
            found = sending[0]
        return found

    def of_response(self, client: Any, number: int) -> Heritage | None:
        """Return what the callbacks of the response to a client's request inherit."""
        return self._pop((client, SERVICE, number))

    def of_action(self, keys: Iterable[tuple[Any, ...]]) -> Heritage | None:
        """
        Return what an execution inherits that handles requests to an action, or responses.

        :param keys: kind and goal of each request; handle, kind and number of each response.
        """
        found = [self._pop(key) for key in keys]
        return min((each for each in found if each is not None), default=None)
