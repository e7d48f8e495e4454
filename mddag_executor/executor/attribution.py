# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Find the job that a message belongs to: publications are noted, messages are looked up.

Theory of operation
-------------------
1.  The source timestamp of a message says when it was published.  The middleware reads it from the
    system clock inside ``publish``.  Every ``publish`` of a trigger topic by a callback of this
    executor is noted as a *publication*: its window of system time, the publisher's sequence
    count, and the publishing execution.
2.  A subscription of this process is served by the publishing thread (``publishing``), which knows
    the publication.  If nothing else has arrived, no lookup is needed.
3.  Any other message belongs to the publication of its topic whose window contains its timestamp
    and which has its publication sequence number.  A publisher is assumed to have sent nothing
    before it was counted.  Two consecutive messages that differ from the count by the same number
    show that it had.
4.  If no publication fits (a publisher in another process) or several do, the result is None and
    the message runs as an undeclared callback.  It is never dropped, and its job is never guessed.

Publications announced by other processes (``announcements``) are found in the same way.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
from itertools import count
import secrets
import threading
from time import time_ns
from typing import Any, NamedTuple

from mddag_executor.core import NEVER
from mddag_executor.executor.bounds import MOST, REMEMBERED
from mddag_executor.executor.stamps import StampedReleases
from msg_graph import TaskSet

ROUNDING_NS = 2
"""DDS timestamps are multiples of 2**-32 s: they may be this far outside of the window."""

MANY_UNLIKE = 4
"""After this many publications in a row the numbers of a publisher are known to have shifted."""

NO_NUMBER = -(2 ** 62)
"""The count of a publication made by a signal handler within another one of its publisher."""


class Origin(NamedTuple):
    """The publishing execution: its job's slot, DAG and index, and its global vertex."""

    slot: int
    dag: int
    job: int
    vertex: int


new_origin: Callable[[tuple[int, int, int, int]], Origin] = partial(tuple.__new__, Origin)
"""Return an ``Origin`` with these fields: in two thirds of the time of a call of the class."""

NO_ORIGIN = Origin(-1, -1, -1, -1)


class Announced(NamedTuple):
    """
    What another process announces about a publishing execution.

    :ivar name: of its job: the process that first released it, and its number there; or the
        header stamp that identifies it.
    :ivar dag: its index, -1: none.
    :ivar vertex: the global vertex.
    :ivar release: of the job, on the machine's steady clock in ns.
    """

    name: int | tuple[int, int]
    dag: int
    vertex: int
    release: int


class PublisherNumbers:
    """
    The difference between a publisher's count and the middleware's sequence numbers.

    :ivar offset: sequence number minus count; 0 as long as the publisher is assumed to have sent
        nothing before it was counted.
    """

    __slots__ = ('offset', '_found', '_unlike')

    def __init__(self) -> None:
        self.offset = 0
        # the count of the last publication whose message was found
        self._found = NO_NUMBER
        # another possible offset, the count of the last message that it would explain, and for
        # how many publications in a row it does
        self._unlike = (0, NO_NUMBER, 0)

    def agree(self, count: int, sequence: int) -> bool:
        """
        Return whether a message is the publication with this count; only its window fits.

        Messages of two publications in a row that differ from the count by the same number show
        that the publisher had sent messages before.  Once messages were found, the difference only
        changes when a publication has failed, which ``MANY_UNLIKE`` in a row show: two may be of
        another publisher, in windows that follow each other.  A message that differs after that of
        the publication was found is of another publisher.
        """
        offset = sequence - count
        if offset == self.offset:
            self.confirm(count, sequence)
            return True
        if count <= self._found:
            return False
        unlike, last, times = self._unlike
        times = times + (count != last) if unlike == offset else 1
        self._unlike = offset, count, times
        if times < (2 if self._found == NO_NUMBER else MANY_UNLIKE):
            return False
        self.confirm(count, sequence)
        return True

    def agree_at_once(self, count: int, sequence: int) -> bool:
        """
        Return whether the only message announced during the publication with this count is its.

        The first one is believed; a later one may be of another publisher, if another thread has
        received that of the publication meanwhile.
        """
        if count == NO_NUMBER:
            return True
        if self._found != NO_NUMBER:
            return self.agree(count, sequence)
        self.confirm(count, sequence)
        return True

    def confirm(self, count: int, sequence: int) -> None:
        """Note that a message is the publication with this count."""
        self.offset = sequence - count
        if count > self._found:
            self._found = count
        self._unlike = (0, NO_NUMBER, 0)


new_address: Callable[[], int] = count(secrets.randbits(46) << 16).__next__
"""
Returns a number that is an address in a trace.

Unlike an address, it is never used again, nor by another process.
"""


class PublisherState:
    """
    The state of a publisher: its topic, and how many messages it has published.

    :ivar address: the publisher's address in a trace.
    :ivar is_tracked: whether its publications are counted: since it was first used, by any
        thread, for a topic that a declared callback publishes.
    :ivar sending: the publication that is being sent.
    :ivar recorded_by: the number of the recorder that has last recorded it; 0: none.
    :ivar lock: serialises the publications of a trigger topic; reentrant, as a signal handler may
        publish in the thread that owns it.
    """

    __slots__ = ('lock', 'topic', 'count', 'numbers', 'is_tracked', 'sending', 'address',
                 'recorded_by', '__weakref__')

    def __init__(self, topic: str) -> None:
        self.lock = threading.RLock()
        self.topic = topic
        self.address = new_address()
        self.recorded_by = 0
        self.count = 0
        self.numbers = PublisherNumbers()
        self.is_tracked = False
        self.sending: Publication | None = None


class Publication:
    """One call of ``publish``: window of system time in ns, sequence number, origin."""

    __slots__ = ('begin', 'end', 'numbers', 'sequence', 'origin')

    def __init__(
        self, begin: int, numbers: PublisherNumbers, origin: Origin | Announced, sequence: int,
        end: int = NEVER,
    ) -> None:
        self.begin = begin
        self.end = end
        self.numbers = numbers
        self.sequence = sequence
        self.origin = origin

    def covers(self, stamp: int) -> bool:
        """Return whether a message with this source timestamp may belong to the publication."""
        return self.begin - ROUNDING_NS <= stamp <= self.end + ROUNDING_NS


Announce = Callable[[Callable[[Any, Any], None], str, list[Publication]], None]


class Topic:
    """The publications of one trigger topic."""

    __slots__ = (
        'publications', 'announced', 'is_announced', 'open', 'to_announce', 'lock', 'on_header',
        'is_optional')

    def __init__(self, is_optional: bool) -> None:
        # whether a callback publishes it only sometimes
        self.is_optional = is_optional
        self.publications: deque[Publication] = deque(maxlen=MOST)
        self.announced: deque[Publication] = deque(maxlen=4 * MOST)
        self.is_announced = False
        # how many publications have not returned; announcements wait until this is zero
        self.open = 0
        self.to_announce: list[Publication] = []
        self.lock = threading.Lock()
        # receives the stamp of each message if other processes subscribe (see ``other_processes``)
        self.on_header: Callable[[int, Origin], None] | None = None


class Attribution:
    """
    Notes publications, and finds the job that a message belongs to.

    :param task_set: the declaration; None: there are no jobs.
    :ivar topics: the state of each topic that a declared callback publishes.
    """

    def __init__(self, task_set: TaskSet | None) -> None:
        callbacks = task_set.callbacks if task_set else ()
        optional = {t for c in callbacks for t in c.may_publish}
        self.topics = {t: Topic(t in optional) for c in callbacks for t in c.publishes}
        # by DAG, job and vertex: the optional topics that its executions have published
        self._published: dict[tuple[int, int, int], set[str]] = {}
        self._release_from = [d.release_from for d in task_set.dags] if task_set else []
        self.unknown = 0
        self.doubtful = 0
        # announces publications that have returned to other processes
        self.announce: Announce | None = None

    def publish(
        self, send: Callable[[Any, Any], None], publisher: Any, msg: Any,
        state: PublisherState, topic: Topic, origin: Origin,
    ) -> Publication:
        """Send a message and note the publication; the caller holds the publisher's lock."""
        if topic.on_header is not None:
            topic.on_header(header_stamp(msg), origin)
        if topic.is_optional:
            self.note_optional(state.topic, origin)
        publication = Publication(time_ns(), state.numbers, origin, state.count)
        interrupted, state.sending = state.sending, publication
        if interrupted is not None:  # by a signal handler: the order of the numbers is unknown
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

    def note_optional(self, topic: str, origin: Origin) -> None:
        """Note that an execution has published a topic, if that is published only sometimes."""
        if origin is NO_ORIGIN or topic not in self.topics or not self.topics[topic].is_optional:
            return
        published = self._published
        published.setdefault((origin.dag, origin.job, origin.vertex), set()).add(topic)
        if len(published) > 2 * REMEMBERED:  # of jobs that ended before these vertices completed
            for key in list(published)[:REMEMBERED]:
                published.pop(key, None)

    def published(self, origin: Origin) -> set[str]:
        """Return, and forget, the optional topics that a vertex has published in a job."""
        return self._published.pop((origin.dag, origin.job, origin.vertex), set())

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
        """Announce the publications on these topics from now on."""
        for name, topic in self.topics.items():
            topic.is_announced = name in topics

    def note_announced(self, topic: str, publication: Publication) -> None:
        """Note a publication that another process has announced."""
        self.topics[topic].announced.append(publication)

    def note_headers(self, on_header: Callable[[int, Origin], None], topics: set[str]) -> None:
        """Call ``on_header`` for each message on these topics, before it is published."""
        for name, topic in self.topics.items():
            topic.on_header = on_header if name in topics else None

    def find(
        self, topic: str, stamp: int, sequence: int | None, counted: bool = True
    ) -> Origin | Announced | None:
        """
        Return the origin of a message, or None when no publication or more than one fits.

        :param stamp: its source timestamp, system time in ns.
        :param sequence: its publication sequence number, if the middleware reports one.
        :param counted: whether a failed lookup is counted.
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
                matches[0].numbers.confirm(matches[0].sequence, sequence)
                return matches[0].origin
        if len(fits) > 1:
            self.doubtful += counted
        else:
            self.unknown += counted
        return None

    def is_released_at_arrival(self, dag: int) -> bool:
        """Return whether jobs of a DAG are released when the message of the source arrives."""
        return self._release_from[dag] == 'arrival'

    def release_of(
        self, dag: int, topic: str, message: Any, source_timestamp: int, now: int,
        releases: StampedReleases,
    ) -> tuple[int, int]:
        """
        Return the release of the job that a source's message starts, on the trace's clock.

        :param topic: of the message; ``now``: the time of its arrival.
        :return: the release, and the header's stamp if the release was taken from it, else -1.
        """
        kind = self._release_from[dag]
        if kind == 'source_timestamp':
            return releases.clock.of_system(source_timestamp), -1
        stamp = -1 if kind == 'arrival' else header_stamp(message)
        # raw, without header or stamp: only its arrival is known
        return now if stamp < 0 else releases.release(stamp, topic, now), stamp


def header_stamp(message: Any) -> int:
    """Return the stamp of a message's header (or of a Header), system time in ns; -1: none."""
    stamp = getattr(getattr(message, 'header', message), 'stamp', None)
    if stamp is None:
        return -1
    try:
        return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec) or -1
    except (AttributeError, TypeError, ValueError):
        return -1  # a field of another type has this name
