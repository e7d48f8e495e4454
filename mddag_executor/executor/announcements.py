# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Announcements of publications between the executors of one machine.

Theory of operation
-------------------
A message carries its source timestamp and publication sequence number, but not its job.  Within a
process the time window of each publication is noted (``attribution``).  A process that publishes
for another one announces the same, right after the message, on a separate topic: topic, window,
sequence number, and job.  Both processes have the same system clock.

1.  *Announced* is each publication on a topic by which a DAG leaves the process, for the DAGs that
    ``processes:`` divides and whose jobs no header stamp identifies (``other_processes``).  A
    publication of no job is announced as well, so that no message waits for it.
2.  A job has one name everywhere: the executor that released it first, and its number there.  It
    has one release, by the steady clock that all processes of a machine share.  Publications of a
    topic that overlap in time are announced together, when the last of them has returned, because
    a message may lie in the windows of all.  This cannot be decided across processes.  So messages
    on a topic that several processes publish are ambiguous (``contested``).
3.  A message that may come from another process and fits no known publication waits for its
    announcement: for ``WAIT_NS`` at least, and until the next check, as the process may just have
    been stopped.  Then it runs as undeclared, and is counted.  Publications of one publisher are
    announced in order, so its messages stay in order.
4.  Announced publications are looked up with those of this process, by one rule
    (``Attribution.find``): window and sequence number.
5.  *Announcements come from outside.*  One that cannot be true (an unknown vertex or topic, a
    release in the future or long ago) is ignored.  They are handled before all callbacks, so they
    get a twentieth of a core at most; those beyond that are ignored as well, with a warning.
6.  *Not published.*  If an execution ends without a topic of ``may_publish`` that starts a
    callback elsewhere, that is announced as well, with the sequence number ``SILENT``.  The job is
    opened in a process where it is not open yet, so that its results count as not due there.
7.  *Lost.*  A process opens a job as soon as the publication is announced that starts one of its
    callbacks.  If the message is lost, the job expires there, and its results count as missed.
8.  *Ended early.*  If a job expires or fails, that is announced with the sequence number
    ``ENDED``.  It ends then in all processes, also where nothing of it has arrived, so that the
    results that it owes there count as missed.
9.  Executors understand each other only if they have the same declaration: its digest is in the
    name of the topic.  Each process has its own topic, so that it does not receive its own
    announcements.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
import hashlib
import os
import struct
import time
from typing import Any, TYPE_CHECKING

from mddag_executor.core.state import EXPIRED, FAILED
from mddag_executor.executor.attribution import (
    Announced,
    header_stamp,
    NO_ORIGIN,
    Origin,
    Publication,
    PublisherNumbers,
)
from mddag_executor.executor.bounds import REMEMBERED
from mddag_executor.executor.hearing import Allowance, is_plausible
from mddag_executor.executor.other_processes import contested
from mddag_executor.executor.publishing import publish_as_executor
from mddag_executor.executor.quiet_nodes import quiet_node
from mddag_executor.executor.work import Work
from msg_graph import TaskSet
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import UInt8MultiArray

if TYPE_CHECKING:
    from mddag_executor.executor.workers import WorkerPool

WAIT_NS = 100_000_000
"""How long a message waits for its announcement; this is checked twice in that time."""
_QOS = QoSProfile(
    reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=1000)
MOST_ENTRIES = 256
"""The most publications that are announced together: those of one topic that overlap."""
# sender, publisher, sequence, begin, end; home, number and release of the job; DAG, vertex, topic
SILENT = 2 ** 64 - 1
"""In place of a sequence number: the topic was not published in the job."""
ENDED = SILENT - 1
"""In place of a sequence number: the job has ended early.  The reason replaces the publisher."""
_EARLY_ENDS = EXPIRED, FAILED
_ENTRY = struct.Struct('<QQQqqQQqiiI')


class Announcements:
    """
    Announces publications to the other processes, and receives their announcements.

    :param process: the declared process that this is.
    :param pool: its engine is used; all but ``unmatched`` and ``close`` needs its lock.
    """

    def __init__(self, task_set: TaskSet, process: str, pool: WorkerPool) -> None:
        self._pool = pool
        self._attribution = pool.engine.attribution
        self._engine = pool.engine
        self._clock = pool.clock
        self._topics = sorted({t for c in task_set.callbacks for t in c.publishes})
        self._number = {topic: i for i, topic in enumerate(self._topics)}
        self._contested = contested(task_set)
        self._token = int.from_bytes(os.urandom(8), 'little')
        self._publishers: dict[tuple[int, int], PublisherNumbers] = {}
        # until when (trace's clock) each message waits, and its info from the middleware
        self._waiting: list[tuple[int, Work, dict[str, Any]]] = []
        # when they were checked last, and whether they will be
        self._checked_at = 0
        self._checks_later = False
        # the name of the job that ends because another process says so
        self._heard: tuple[int, int] | None = None
        digest = hashlib.sha256(task_set.text.encode()).hexdigest()[:8]
        names = [each.name for each in task_set.processes]
        own = names.index(process)
        self.node = quiet_node(
            f'_mddag_jobs_{os.getpid()}_{own}', pool.context, is_remapped=True)
        self._n_others = len(names) - 1
        self._publisher: Publisher | None = self.node.create_publisher(
            UInt8MultiArray, f'/mddag/jobs_{digest}/p{own}', _QOS)
        self.subscriptions = [
            self.node.create_subscription(
                UInt8MultiArray, f'/mddag/jobs_{digest}/p{i}', self._hear, _QOS,
                callback_group=ReentrantCallbackGroup())
            for i in range(len(names)) if i != own]
        self._allowance = Allowance(
            pool.unlocked_calls, self.subscriptions[0].topic_name if self._n_others else '')
        self._attribution.announce = self._announce
        self._engine.optional_topics.on_silent.append(self._announce_silent)
        self._engine.verdicts.on_end = self._announce_end

    def unmatched(self) -> list[str]:
        """Return the topics on which the processes have not discovered each other."""
        publisher = self._publisher
        if publisher is None:
            return []
        found = [s.topic_name for s in self.subscriptions if not s.get_publisher_count()]
        if publisher.get_subscription_count() < self._n_others:
            found.append(publisher.topic_name)
        return found

    def close(self) -> None:
        """Stop announcing."""
        if self._publisher is not None:
            self._attribution.announce = None
            self._engine.optional_topics.on_silent.remove(self._announce_silent)
            self._engine.verdicts.on_end = None
            self._publisher = None
            self.node.destroy_node()

    def _announce(
        self, send: Callable[[Any, Any], None], topic: str, several: list[Publication]
    ) -> None:
        """Announce publications to the others (rules 1 and 2)."""
        entries = b''.join(self._entry(topic, publication) for publication in several)
        publisher = self._publisher
        if publisher is not None:
            send(publisher, UInt8MultiArray(data=entries))

    def _entry(self, topic: str, publication: Publication) -> bytes:
        origin = publication.origin
        assert isinstance(origin, Origin)
        job = self._job(origin)
        dag = -1 if job is None else origin.dag
        (home, number), release = job or ((0, 0), 0)
        return _ENTRY.pack(
            self._token, id(publication.numbers), publication.sequence, publication.begin,
            publication.end, home, number, release, dag, origin.vertex, self._number[topic])

    def _announce_silent(self, origin: Origin, topic: str) -> None:
        """Announce that a vertex ends without a topic (rule 6); the engine's lock is held."""
        others = self._engine.other_processes
        if others is None or not others.is_announced(origin) or topic in self._contested:
            return
        job = self._job(origin)
        if job is not None:
            (home, number), release = job
            self._send(_ENTRY.pack(
                self._token, 0, SILENT, 0, 0, home, number, release, origin.dag, origin.vertex,
                self._number[topic]))

    def _announce_end(self, dag: int, job: int, end: int) -> None:
        """Announce that a job has ended early (rule 8); the engine's lock is held."""
        others = self._engine.other_processes
        release = None if others is None else others.ended(dag, job)
        if release is None or others is None or end not in _EARLY_ENDS:
            return
        name = others.name_of(Origin(-1, dag, job, -1)) or (self._token, job)
        if name == self._heard:
            return
        self._send(_ENTRY.pack(
            self._token, _EARLY_ENDS.index(end), ENDED, 0, 0, *name,
            release - self._clock.offset_ns, dag, self._engine.tables.source[dag], 0))

    def _send(self, entry: bytes) -> None:
        """Publish an announcement of the executor's own soon, without the engine's lock."""
        if self._publisher is not None:
            self._pool.unlocked_calls.append(
                partial(publish_as_executor, self._publisher, UInt8MultiArray(data=entry)))

    def _job(self, origin: Origin) -> tuple[tuple[int, int], int] | None:
        """Return name and release of a job; None: no job, or it has ended meanwhile."""
        others = self._engine.other_processes
        if origin is NO_ORIGIN or others is None:
            return None
        with self._pool.lock:
            release = self._engine.open_release(origin)
            if release is None:
                return None
            name = others.name_of(origin)
            if name is None:  # it was released here, and may come back
                name = (self._token, origin.job)
                others.note(name, origin)
        return name, release - self._clock.offset_ns

    def _hear(self, message: UInt8MultiArray) -> None:
        """Handle announcements of another process; pass on the messages that waited for them."""
        size, rest = divmod(len(message.data), _ENTRY.size)
        if rest or size > MOST_ENTRIES or not self._allowance.has_time():
            return
        begin = time.thread_time_ns()
        for entry in _ENTRY.iter_unpack(message.data):
            if not self._is_plausible(*entry[-4:]):
                continue
            home, number, release, dag, vertex, topic = entry[5:]
            job = Announced((home, number), dag, vertex, release + self._clock.offset_ns)
            if entry[2] == SILENT:
                self._engine.hear_silent(job, self._topics[topic], self._pool.tick())
            elif entry[2] == ENDED:
                self._hear_end(job, entry[1])
            else:
                self._note(*entry)
                if dag >= 0:
                    self._engine.hear_published(job, self._topics[topic], self._pool.tick())
        for entry in list(self._waiting):
            origin = self._find(entry[1], entry[2])
            if origin is not None:
                self._waiting.remove(entry)
                self._give(entry[1], origin)
        self._allowance.spend(time.thread_time_ns() - begin)

    def _hear_end(self, job: Announced, reason: int) -> None:
        if job.dag >= 0 and reason < len(_EARLY_ENDS) and isinstance(job.name, tuple):
            self._heard = job.name
            self._engine.hear_ended(job, _EARLY_ENDS[reason], self._pool.tick())
            self._heard = None

    def _is_plausible(self, release: int, dag: int, vertex: int, topic: int) -> bool:
        """Return whether an announcement may be true: it comes from outside."""
        if topic >= len(self._topics):
            return False
        if dag < 0:  # a publication of no job
            return True
        first = self._engine.tables.first_vertex
        return (dag < len(self._engine.dag_names) and first[dag] <= vertex < first[dag + 1]
                and is_plausible(release, self._allowance.updated_at))

    def _give(self, work: Work, origin: Origin | Announced | None) -> None:
        """Pass on a message after a possible wait for its announcement."""
        now = self._pool.tick()
        release = stamp = -1
        if isinstance(origin, Announced):
            release = origin.release + self._clock.offset_ns
        elif origin is None and work.entity.remote_publishers:
            stamp = header_stamp(work.args[0])
            release = self._pool.stamped_releases.release(stamp, work.entity.topic, now)
        self._engine.arrived(work, origin, release, stamp, now)

    def _note(
        self, whose: int, of: int, sequence: int, begin: int, end: int, home: int, number: int,
        release: int, dag: int, vertex: int, topic: int,
    ) -> None:
        publisher = self._publishers.pop((whose, of), None) or PublisherNumbers()
        self._publishers[whose, of] = publisher  # the latest is last
        if len(self._publishers) > REMEMBERED:
            del self._publishers[next(iter(self._publishers))]
        self._attribution.note_announced(self._topics[topic], Publication(
            begin, publisher, Announced((home, number), dag, vertex, release), sequence, end))

    def _find(
        self, work: Work, info: dict[str, Any], counted: bool = False
    ) -> Origin | Announced | None:
        return self._attribution.find(
            work.entity.topic, info['source_timestamp'],
            info.get('publication_sequence_number'), counted)

    def receive(self, work: Work, info: dict[str, Any], now: int) -> None:
        """Handle a message that may be of another process; pass it on when its job is known."""
        if work.entity.topic in self._contested:
            self._attribution.doubtful += 1
            self._give(work, None)
            return
        origin = self._find(work, info)
        if origin is not None:
            self._give(work, origin)
            return
        if not self._checks_later:
            self._check_later()
        self._waiting.append((now + WAIT_NS, work, info))

    def _check_later(self) -> None:
        self._checks_later = True
        self._pool.due.call_at(
            time.monotonic_ns() + WAIT_NS // 2, lambda: self._pool.report(self._check))

    def _check(self, now: int) -> None:
        """Pass on messages that have waited for too long (rule 3)."""
        late = [entry for entry in self._waiting if entry[0] <= self._checked_at]
        self._checked_at = now
        self._checks_later = False
        for entry in late:
            self._waiting.remove(entry)
            self._give(entry[1], self._find(entry[1], entry[2], counted=True))
        if self._waiting:
            self._check_later()
