# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Which job does a message belong to?  Publications are noted, messages are looked up.

Theory of operation
-------------------
1.  A message says when it was published: its source timestamp, which the middleware reads from the
    system clock inside ``publish``.  Every ``publish`` of a trigger topic by a callback of this
    executor is noted as a *publication*: the window of system time that it took, the publisher's
    running number, and the execution that published it.
2.  A subscription of this process is served by the thread that publishes (``publishing``), which
    knows its publication: if nothing else has arrived, there is nothing to look up.
3.  Any other message belongs to the publication of its topic whose window holds its timestamp and
    which has its publication sequence number.  A publisher is expected to have sent nothing before
    it was counted; two messages in a row that differ by the same number show that it had.
4.  When no publication fits (a publisher in another process) or several do, the answer is None and
    the message runs as an undeclared callback: never dropped, never guessed.

Publications of other processes that these announce (``announcements``) are found in the same way.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
import threading
from time import time_ns
from typing import Any, NamedTuple

from mddag_executor.executor.bounds import MOST
from msg_graph import TaskSet

ROUNDING_NS = 2
"""DDS stamps are multiples of 2**-32 s: they may lie this far outside of the window."""

_STILL_PUBLISHING = 2 ** 63 - 1
NO_NUMBER = -(2 ** 62)
"""The count of a publication within another one of its publisher, in a signal handler."""


class Origin(NamedTuple):
    """The execution that published: its job's slot, DAG and index, and its global vertex."""

    slot: int
    dag: int
    job: int
    vertex: int


NO_ORIGIN = Origin(-1, -1, -1, -1)


class Announced(NamedTuple):
    """
    What another process announces of the execution that published.

    :ivar name: of its job: where that was released first, and its number there.
    :ivar dag: its index, -1 for none.
    :ivar vertex: the global vertex.
    :ivar release: of the job, on the machine's steady clock in ns.
    """

    name: tuple[int, int]
    dag: int
    vertex: int
    release: int


class PublisherNumbers:
    """
    How a publisher's own count and the middleware's publication sequence numbers differ.

    A publisher is expected to have sent nothing before it was counted.

    :ivar offset: what the sequence number is more than the count.
    """

    __slots__ = ('offset', '_unlike')

    def __init__(self) -> None:
        self.offset = 0
        # the offset and the count of the last message that another offset would explain
        self._unlike: tuple[int, int] | None = None

    def agree(self, count: int, sequence: int) -> bool:
        """
        Return whether a message is the publication of this count, whose window alone fits.

        Messages of two publications in a row that differ from the count by the same number show
        that the publisher had sent something before.
        """
        offset = sequence - count
        if offset == self.offset:
            self._unlike = None
            return True
        if count == NO_NUMBER:
            return False
        if self._unlike is not None and self._unlike[0] == offset and self._unlike[1] != count:
            self.offset, self._unlike = offset, None
            return True
        self._unlike = offset, count
        return False


class PublisherState:
    """
    What is kept for each publisher: its topic, and how many messages it has published.

    :ivar is_tracked: whether a declared callback has published a trigger topic with it: from then
        on its publications are counted.
    :ivar sending: the publication that is just being sent.
    :ivar lock: serialises the publications of a trigger topic; a signal handler may publish in the
        thread that holds it.
    """

    __slots__ = ('lock', 'topic', 'count', 'numbers', 'is_tracked', 'sending')

    def __init__(self, topic: str) -> None:
        self.lock = threading.RLock()
        self.topic = topic
        self.count = 0
        self.numbers = PublisherNumbers()
        self.is_tracked = False
        self.sending: Publication | None = None


class Publication:
    """One call of ``publish``: window of system time in ns, sequence number, origin."""

    __slots__ = ('begin', 'end', 'numbers', 'sequence', 'origin')

    def __init__(
        self, begin: int, numbers: PublisherNumbers, origin: Origin | Announced, sequence: int,
        end: int = _STILL_PUBLISHING,
    ) -> None:
        self.begin = begin
        self.end = end
        self.numbers = numbers
        self.sequence = sequence
        self.origin = origin

    def holds(self, stamp: int) -> bool:
        """Return whether a message with this source timestamp may be its message."""
        return self.begin - ROUNDING_NS <= stamp <= self.end + ROUNDING_NS


Announce = Callable[[Callable[[Any, Any], None], str, list[Publication]], None]


class Topic:
    """The publications of one trigger topic."""

    __slots__ = (
        'publications', 'announced', 'is_announced', 'open', 'to_announce', 'lock', 'on_header')

    def __init__(self) -> None:
        self.publications: deque[Publication] = deque(maxlen=MOST)
        self.announced: deque[Publication] = deque(maxlen=4 * MOST)
        self.is_announced = False
        # how many publications have not returned; what is announced once there are none
        self.open = 0
        self.to_announce: list[Publication] = []
        self.lock = threading.Lock()
        # gets the stamp of each message, where other processes subscribe (see ``other_processes``)
        self.on_header: Callable[[int, Origin], None] | None = None


class Jobs:
    """
    Notes publications, and finds the job that a message belongs to.

    :param task_set: the declaration; None: there is no job.
    :ivar topics: what is kept of each topic that a declared callback publishes.
    """

    def __init__(self, task_set: TaskSet | None) -> None:
        topics = {t for c in task_set.callbacks for t in c.publishes} if task_set else set()
        self.topics = {t: Topic() for t in topics}
        self._release_from = [d.release_from for d in task_set.dags] if task_set else []
        self.unknown = 0
        self.doubtful = 0
        # announces publications to other processes that have returned
        self.announce: Announce | None = None

    def publish(
        self, send: Callable[[Any, Any], None], publisher: Any, msg: Any,
        state: PublisherState, topic: Topic, origin: Origin,
    ) -> Publication:
        """Send a message and note the publication; the caller holds the publisher's lock."""
        if topic.on_header is not None:
            topic.on_header(header_stamp(msg), origin)
        publication = Publication(time_ns(), state.numbers, origin, state.count)
        interrupted, state.sending = state.sending, publication
        if interrupted is not None:  # by a signal handler: who gets which number is not known
            interrupted.sequence = publication.sequence = NO_NUMBER
        topic.publications.append(publication)
        is_announced = topic.is_announced and self.announce is not None
        if is_announced:
            with topic.lock:
                topic.open += 1
        publication.begin = time_ns()  # again: the thread may have waited for the GIL
        try:
            send(publisher, msg)
        finally:
            publication.end = time_ns()
            state.sending = interrupted
            if is_announced:
                self._announce_when_alone(send, state.topic, topic, publication)
        return publication

    def _announce_when_alone(
        self, send: Callable[[Any, Any], None], name: str, topic: Topic, publication: Publication
    ) -> None:
        """Announce a topic's publications when none of them is being sent: windows overlap."""
        several: list[Publication] = []
        with topic.lock:
            topic.open -= 1
            topic.to_announce.append(publication)
            if not topic.open:
                several, topic.to_announce = topic.to_announce, []
        if several and self.announce is not None:
            self.announce(send, name, several)

    def announce_on(self, topics: set[str]) -> None:
        """Have the publications on these topics announced."""
        for name, topic in self.topics.items():
            topic.is_announced = name in topics

    def take_in(self, topic: str, publication: Publication) -> None:
        """Note a publication that another process has announced."""
        self.topics[topic].announced.append(publication)

    def note_headers(self, on_header: Callable[[int, Origin], None], topics: set[str]) -> None:
        """Have ``on_header`` called for each message on these topics, before it is published."""
        for name, topic in self.topics.items():
            topic.on_header = on_header if name in topics else None

    def find(
        self, topic: str, stamp: int, sequence: int | None, counted: bool = True
    ) -> Origin | Announced | None:
        """
        Return the origin of a message, or None when nothing or more than one thing fits.

        :param stamp: its source timestamp, system time in ns.
        :param sequence: its publication sequence number, where the middleware gives one.
        :param counted: whether it counts that nothing was found.
        """
        known = self.topics.get(topic)
        if known is None:
            self.unknown += counted
            return None
        # copies: other threads append meanwhile
        fits = [p for p in (*known.publications.copy(), *known.announced.copy())
                if p.begin - ROUNDING_NS <= stamp <= p.end + ROUNDING_NS]
        if len(fits) == 1:
            found = fits[0]
            if sequence is None or found.numbers.agree(found.sequence, sequence):
                return found.origin
        elif fits and sequence is not None:
            matches = [p for p in fits if p.sequence + p.numbers.offset == sequence]
            if len(matches) == 1:
                return matches[0].origin
        if len(fits) > 1:
            self.doubtful += counted
        else:
            self.unknown += counted
        return None

    def is_released_at_arrival(self, dag: int) -> bool:
        """Return whether the jobs of a DAG are released when the message of the source arrives."""
        return self._release_from[dag] == 'arrival'

    def release(
        self, dag: int, message: Any, source_timestamp: int, now: int
    ) -> tuple[int, int]:
        """
        Return the release of the job that a source's message starts, on the trace's clock.

        :param now: the time on the trace's clock.
        :return: the release, and the header's stamp where it comes from that, else -1.
        """
        kind = self._release_from[dag]
        stamp = header_stamp(message) if kind == 'header_stamp' else -1
        if kind == 'arrival' or (kind == 'header_stamp' and stamp < 0):
            return now, -1  # raw, without a header, or not stamped: only its arrival is known
        if kind == 'source_timestamp':
            return steady_time(source_timestamp, now), -1
        return steady_time(stamp, now), stamp


def steady_time(system_time: int, now: int) -> int:
    """Return a time of the system's clock on the trace's clock, which reads ``now``."""
    return now - time_ns() + system_time


def header_stamp(message: Any) -> int:
    """Return the stamp of a message's header (or of a Header), system time in ns; -1 for none."""
    stamp = getattr(getattr(message, 'header', message), 'stamp', None)
    if stamp is None:
        return -1
    try:
        return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec) or -1
    except (AttributeError, TypeError, ValueError):
        return -1  # something else is called so
