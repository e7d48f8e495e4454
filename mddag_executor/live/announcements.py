# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What the executors of one machine announce to each other of their publications.

Theory of operation
-------------------
A message says when it was published and the how-manieth of its publisher it is, and nothing else
of its job.  Within a process the window of time of each publication is noted (``jobs``).  So the
process that publishes for another one announces just that, right behind the message: topic,
window, sequence number, and the job, on a topic of its own.  Both have the same system clock.

1.  *Announced* is each publication on a topic by which a DAG leaves the process, for the DAGs that
    ``processes:`` divides and whose jobs no header stamp identifies (``other_processes``); also
    one of no job, so that nobody waits for it.
2.  A job is called by the executor that released it first and its number there, wherever it goes,
    and has one release, by the steady clock that all processes of a machine share.
    Those of a topic that overlap in time are announced together, when the last of them has
    returned: a message may lie in the windows of all.  Between processes nobody could say when
    that is so; so what several processes publish on one topic is a doubt (``contested``).
3.  A message that may come from another process and belongs to no publication that is known waits
    for its announcement, which is under way: for ``WAIT_S`` at the least, and until the look after
    that, as the process may just have been stopped.  Then it runs as undeclared, and is counted.
    Publications of one publisher are announced in their order, so its messages stay in order.
4.  Announced publications are looked up with those of this process, by one rule (``Jobs.find``):
    window and sequence number.
5.  Only executors with the same declaration understand each other: its digest is in the name of
    the topic.  Each process has a topic of its own, so that nobody hears itself.
"""

from __future__ import annotations

from collections.abc import Callable
import hashlib
import os
import struct
import threading
import time
from typing import Any, TYPE_CHECKING

from mddag_executor.clocks import TraceClock
from mddag_executor.live.jobs import Announced, NO_ORIGIN, Origin, Publication, RemotePublisher
from mddag_executor.live.other_processes import contested
from mddag_executor.live.work import Work
from msg_graph import TaskSet
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import UInt8MultiArray

if TYPE_CHECKING:
    from mddag_executor.live.engine import Engine

WAIT_S = 0.1
_QOS = QoSProfile(
    reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=1000)
# whose, publisher, sequence, begin, end; home, number and release of the job; DAG, vertex, topic
_ENTRY = struct.Struct('<QQQqqQQqiiI')


class Announcements:
    """
    Announces publications to the other processes, and takes in what these announce.

    :param process: which of the declared ones this is.
    :param give: gets each message that waited no longer than for its announcement, with the origin
        that was found, or None.
    """

    def __init__(
        self, task_set: TaskSet, process: str, context: Context, engine: Engine,
        engine_lock: threading.Lock, clock: TraceClock,
        give: Callable[[Work, Origin | Announced | None], None],
    ) -> None:
        self._jobs = engine.jobs
        self._engine = engine
        self._engine_lock = engine_lock
        self._clock = clock
        self._give = give
        self._topics = sorted({t for c in task_set.callbacks for t in c.publishes})
        self._number = {topic: i for i, topic in enumerate(self._topics)}
        self._contested = contested(task_set)
        self._token = int.from_bytes(os.urandom(8), 'little')
        self._publishers: dict[tuple[int, int], RemotePublisher] = {}
        self._waiting: list[tuple[float, Work]] = []
        self._looked_at = 0.0  # monotonic, s
        self._lock = threading.Lock()
        digest = hashlib.sha256(task_set.text.encode()).hexdigest()[:8]
        names = [each.name for each in task_set.processes]
        own = names.index(process)
        # Its own arguments go before those of the process, which name the process' nodes.
        name = f'mddag_jobs_{os.getpid()}_{own}'
        self.node = Node(
            name, context=context, enable_rosout=False, start_parameter_services=False,
            cli_args=['--ros-args', '-r', f'__node:={name}'],
            parameter_overrides=[Parameter('start_type_description_service', value=False)])
        self._n_others = len(names) - 1
        self._publisher: Publisher | None = self.node.create_publisher(
            UInt8MultiArray, f'/mddag/jobs_{digest}/p{own}', _QOS)
        self.subscriptions = [
            self.node.create_subscription(
                UInt8MultiArray, f'/mddag/jobs_{digest}/p{i}', self._hear, _QOS,
                callback_group=ReentrantCallbackGroup())
            for i in range(len(names)) if i != own]
        engine.jobs.announce = self._announce

    def unmatched(self) -> list[str]:
        """Return the topics on which the processes have not met yet."""
        publisher = self._publisher
        if publisher is None:
            return []
        found = [s.topic_name for s in self.subscriptions if not s.get_publisher_count()]
        if publisher.get_subscription_count() < self._n_others:
            found.append(publisher.topic_name)
        return found

    def close(self) -> None:
        """Announce nothing more."""
        self._jobs.announce = None
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
            self._token, id(publication.publisher), publication.sequence, publication.begin,
            publication.end, home, number, release, dag, origin.vertex, self._number[topic])

    def _job(self, origin: Origin) -> tuple[tuple[int, int], int] | None:
        """Return name and release of a job; None for none, and one that has ended meanwhile."""
        others = self._engine.other_processes
        if origin is NO_ORIGIN or others is None:
            return None
        with self._engine_lock:
            release = self._engine.open_release(origin)
            if release is None:
                return None
            name = others.name_of(origin)
            if name is None:  # it was released here, and may come back
                name = (self._token, origin.job)
                others.name(name, origin)
        return name, release - self._clock.offset_ns

    def _hear(self, message: UInt8MultiArray) -> None:
        """Handle what another process announces, and give on what has waited for it."""
        if len(message.data) % _ENTRY.size:
            return
        with self._lock:
            for entry in _ENTRY.iter_unpack(message.data):
                self._take_in(*entry)
            found = self._found()
        for work, origin in found:
            self._give(work, origin)

    def _take_in(
        self, whose: int, of: int, sequence: int, begin: int, end: int, home: int, number: int,
        release: int, dag: int, vertex: int, topic: int,
    ) -> None:
        if topic < len(self._topics) and dag < len(self._engine.dag_names):  # else of a stranger
            publisher = self._publishers.setdefault((whose, of), RemotePublisher())
            self._jobs.take_in(self._topics[topic], Publication(
                begin, publisher, Announced((home, number), dag, vertex, release), sequence, end))

    def _found(self) -> list[tuple[Work, Origin | Announced]]:
        """Return the messages that wait no longer, and whose they are."""
        found = []
        for entry in list(self._waiting):
            work = entry[1]
            if (origin := self._find(work)) is not None:
                self._waiting.remove(entry)
                found.append((work, origin))
        return found

    def _find(self, work: Work, counted: bool = False) -> Origin | Announced | None:
        assert work.info is not None
        return self._jobs.find(
            work.entity.topic, work.info['source_timestamp'],
            work.info.get('publication_sequence_number'), counted)

    def take(self, work: Work) -> None:
        """Take a message that may come from another process; give it on when it is known."""
        if work.entity.topic in self._contested:
            self._jobs.doubtful += 1
            self._give(work, None)
            return
        with self._lock:
            origin = self._find(work)
            if origin is None:
                self._waiting.append((time.monotonic() + WAIT_S, work))
                return
        self._give(work, origin)

    def look(self) -> None:
        """Give on what has waited for too long (rule 3)."""
        if not self._waiting:
            return
        with self._lock:
            late = [entry for entry in self._waiting if entry[0] <= self._looked_at]
            self._looked_at = time.monotonic()
            for entry in late:
                self._waiting.remove(entry)
            found = [(work, self._find(work, counted=True)) for _, work in late]
        for work, origin in found:
            self._give(work, origin)
