# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Which job does a message belong to?  Publications are noted, messages are looked up.

Theory of operation
-------------------
A message says when it was published: its source timestamp, which the middleware reads from the
system clock inside ``publish``.  Every ``publish`` of a trigger topic by a callback of this
executor is noted as a *publication*: the window of system time that it took, the publisher's
running number, and the execution that published it (the one whose callback runs in that thread).

1.  A message belongs to the publication of its topic whose window holds its source timestamp and
    which has its publication sequence number.  A message of a publisher in another process or
    thread may lie in a window, too: its number is another one.
2.  Publications of one publisher never overlap: they are serialised, as the middleware does
    anyway.  So a doubt can only remain between two publishers with the same number.  Then, and
    when nothing fits, the answer is None and the message runs as an undeclared callback: never
    dropped, never guessed.  Only where the middleware gives no numbers, the window decides alone.
3.  A publisher is expected to have sent nothing before it was counted.  Messages of two of its
    publications in a row that lie in no other window and differ from the count by the same number
    show that it had.
4.  A signal's handler may publish with the publisher whose ``publish`` it interrupts.  Which of
    the two gets which number is not known, so neither has one.

Publications of other processes that these announce (``announcements``) are found in the same way.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
import threading
from time import time_ns
from typing import Any, NamedTuple

from msg_graph import TaskSet

KEEP = 256
"""How many publications of a topic are remembered."""

ROUNDING_NS = 2
"""DDS stamps are multiples of 2**-32 s: they may lie this far outside of the window."""

_STILL_PUBLISHING = 2 ** 63 - 1
_NO_NUMBER = -(2 ** 62)


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


class RemotePublisher:
    """
    A publisher in another process, which is counted there.

    :ivar offset: from this count to the middleware's number.
    :ivar other_offset: the offset of the last message, if it differs, and the count of the
        publication in whose window that message was; else None.
    """

    __slots__ = ('offset', 'other_offset')

    def __init__(self) -> None:
        self.offset = 0
        self.other_offset: tuple[int, int] | None = None

    def learn(self, count: int, number: int) -> bool:
        """
        Return whether the publication of a count is known to have another number than expected.

        To be asked only for messages that lie in no other publication's window.
        """
        before, self.other_offset = self.other_offset, (number - count, count)
        if before is None or before[0] != number - count or before[1] == count:
            return False
        self.offset, self.other_offset = number - count, None
        return True


class PublisherState(RemotePublisher):
    """
    What is kept for each publisher: its topic, and how many messages it has published.

    :ivar deliver: called with the begin of each publication (system time, ns) when its message has
        been sent: they take it from the subscriptions of this process (see ``inline``).
    :ivar noted_by: the ``Jobs`` that ``notes`` is of: what is kept there of the topic.
    """

    __slots__ = ('lock', 'topic', 'count', 'deliver', 'noted_by', 'notes', '_delivery')

    def __init__(self, topic: str) -> None:
        super().__init__()
        # reentrant: a signal's handler may publish while it is held
        self.lock = threading.RLock()
        self.topic = topic
        self.count = 0
        self.deliver: tuple[Callable[[int], None], ...] = ()
        self.noted_by: Jobs | None = None
        self.notes: _Topic | None = None
        self._delivery: dict[object, Callable[[int], None]] = {}

    def set_delivery(self, owner: object, deliver: Callable[[int], None] | None) -> None:
        """Set what one executor's intake has called; a node's groups may be on several."""
        with self.lock:
            self._delivery.pop(owner, None)
            if deliver is not None:
                self._delivery[owner] = deliver
            self.deliver = tuple(self._delivery.values())


class Publication:
    """One call of ``publish``: window of system time in ns, sequence number, origin."""

    __slots__ = ('begin', 'end', 'publisher', 'sequence', 'origin')

    def __init__(
        self, begin: int, publisher: RemotePublisher,
        origin: Origin | Announced, sequence: int, end: int = _STILL_PUBLISHING,
    ) -> None:
        self.begin = begin
        self.end = end
        self.publisher = publisher
        self.sequence = sequence
        self.origin = origin


Announce = Callable[[Callable[[Any, Any], None], str, list[Publication]], None]


class _Topic:
    """The publications of one topic: all of the last ones, and those that have not returned."""

    def __init__(self) -> None:
        self.publications: deque[Publication] = deque(maxlen=KEEP)
        self.open: list[Publication] = []
        self.announced: deque[Publication] = deque(maxlen=KEEP)
        self.is_announced = False
        # what is announced once no publication of the topic is open
        self.to_announce: list[Publication] = []
        self.lock = threading.RLock()
        # The longest window of those kept; a maximum of two generations, so that it is forgotten.
        self.longest = 0
        self._longest_lately = 0
        # gets the stamp of each message, where other processes subscribe (see ``other_processes``)
        self.on_header: Callable[[int, Origin], None] | None = None
        self._count = 0

    def ended(self, publication: Publication, end: int) -> None:
        length = end - publication.begin
        with self.lock:
            if length > self._longest_lately:
                self._longest_lately = length
                self.longest = max(self.longest, length)
            self._count += 1
            if self._count >= KEEP:
                self._count = 0
                self.longest, self._longest_lately = self._longest_lately, 0
        publication.end = end
        self.open.remove(publication)


class Jobs:
    """
    Notes publications, and finds the job that a message belongs to.

    :param task_set: the declaration; None: there is no job.
    """

    def __init__(self, task_set: TaskSet | None) -> None:
        topics = {t for c in task_set.callbacks for t in c.publishes} if task_set else set()
        self._topics = {t: _Topic() for t in topics}
        self._release_from = [d.release_from for d in task_set.dags] if task_set else []
        self.unknown = 0
        self.doubtful = 0
        # announces publications to other processes that have returned
        self.announce: Announce | None = None

    def publish(
        self, send: Callable[[Any, Any], None], publisher: Any, msg: Any,
        state: PublisherState, origin: Origin, begin: int,
    ) -> None:
        """
        Send a message and note the publication; the caller holds the publisher's lock.

        :param begin: system time (ns), since when it holds that.
        """
        if state.noted_by is not self:
            state.noted_by, state.notes = self, self._topics.get(state.topic)
        topic = state.notes
        if topic is None:
            send(publisher, msg)
            return
        if topic.on_header is not None:
            topic.on_header(header_stamp(msg), origin)
        publication = Publication(begin, state, origin, state.count)
        for interrupted in topic.open.copy():
            if interrupted.publisher is state:
                interrupted.sequence = publication.sequence = _NO_NUMBER
        topic.open.append(publication)
        topic.publications.append(publication)
        # Again: the thread may have waited for the interpreter meanwhile, and others published.
        publication.begin = time_ns()
        try:
            send(publisher, msg)
        finally:
            topic.ended(publication, time_ns())
        if topic.is_announced and self.announce is not None:
            with topic.lock:
                topic.to_announce.append(publication)
                if topic.open:
                    return  # their stamps may lie in this window, so they are announced together
                several, topic.to_announce = topic.to_announce, []
            self.announce(send, state.topic, several)

    def announce_on(self, topics: set[str]) -> None:
        """Have the publications on these topics announced."""
        for name, topic in self._topics.items():
            topic.is_announced = name in topics

    def take_in(self, topic: str, publication: Publication) -> None:
        """Note a publication that another process has announced."""
        self._topics[topic].announced.append(publication)

    def note_headers(self, on_header: Callable[[int, Origin], None], topics: set[str]) -> None:
        """Have ``on_header`` called for each message on these topics, before it is published."""
        for name, topic in self._topics.items():
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
        known = self._topics.get(topic)
        if known is None:
            self.unknown += counted
            return None
        fits: list[Publication] = []
        if known.open:
            fits.extend(p for p in known.open.copy() if p.begin - ROUNDING_NS <= stamp)
        # All that was noted before one that ended this long ago has ended before the stamp.
        first = stamp - known.longest - ROUNDING_NS
        publications = known.publications
        for i in range(len(publications) - 1, -1, -1):
            # By index: other threads append meanwhile, which may only show an entry twice.
            publication = publications[i]
            if publication.end < first:
                break
            if (publication.begin - ROUNDING_NS <= stamp <= publication.end + ROUNDING_NS
                    and publication not in fits):
                fits.append(publication)
        if known.announced:  # by several processes, so in no order
            fits.extend(p for p in known.announced.copy()
                        if p.begin - ROUNDING_NS <= stamp <= p.end + ROUNDING_NS)
        if len(fits) == 1:
            publication = fits[0]
            publisher, count = publication.publisher, publication.sequence
            if sequence is None:
                return publication.origin
            if sequence - count == publisher.offset:
                publisher.other_offset = None
                return publication.origin
            if count != _NO_NUMBER and publisher.learn(count, sequence):
                return publication.origin
        elif sequence is not None:
            matches = [p for p in fits if p.sequence + p.publisher.offset == sequence]
            if len(matches) == 1:
                return matches[0].origin
        if len(fits) > 1:
            self.doubtful += counted
        else:
            self.unknown += counted
        return None

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
