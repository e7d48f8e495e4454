# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Announcements that a job gets no message, between the executors of several machines.

Theory of operation
-------------------
The jobs of a DAG with ``release_from: header_stamp`` are identified by the stamps of messages
(``other_processes``).  If an execution ends without a topic of ``may_publish``, there is no
message, and so no stamp: the executor that has the subscriber would wait until the job expires,
and count a miss.

1.  So the executor that ran the execution publishes a *silence*: the stamp of the job, the vertex
    and the topic.  All executors with the same declaration (its digest is in the name of the
    topic) receive it.  Those that have the subscriber, but not the vertex, leave its results out
    of the job of that stamp: they are not due.
2.  The job is opened by its silence if no message of it has arrived yet.  Then its message finds
    it open, and results that another machine owes are missed if that machine is dead.
3.  Without a silence the job expires, and its results are missed.  Nothing else says that a
    callback has ended without publishing: its machine may be dead.
4.  A job without a stamp (none of its messages has one) has no silence either.
5.  Silences come from outside, and are believed as far as announcements are (``hearing``).
"""

from __future__ import annotations

from functools import partial
import hashlib
import os
import struct
import time
from typing import TYPE_CHECKING

from mddag_executor.executor.attribution import Announced, Origin
from mddag_executor.executor.hearing import Allowance, is_plausible
from mddag_executor.executor.publishing import publish_as_executor
from mddag_executor.executor.quiet_nodes import quiet_node
from msg_graph import TaskSet
from msg_graph.model import optional_edges
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import UInt8MultiArray

if TYPE_CHECKING:
    from mddag_executor.executor.workers import WorkerPool

_QOS = QoSProfile(
    reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=1000)
# stamp of the job; DAG, vertex, topic
_ENTRY = struct.Struct('<qiiI')


def may_be_silent(task_set: TaskSet, process: str | None) -> bool:
    """
    Return whether a job of a header stamp may lack a message of another process.

    :param process: the declared process of the executor; None: any node may be elsewhere.
    """
    for dag in task_set.dags:
        if dag.release_from == 'header_stamp':
            for vertex in dag.vertices:
                for after, _ in optional_edges(vertex, dag.vertices):
                    nodes = {vertex.callback.node, dag.vertices[after].callback.node}
                    places = nodes if process is None else {*map(task_set.process_of, nodes)}
                    if len(places) > 1:
                        return True
    return False


class Silences:
    """Announces, and receives, which topics jobs of header stamps did not get."""

    def __init__(self, task_set: TaskSet, pool: WorkerPool) -> None:
        self._pool = pool
        self._engine = pool.engine
        self._topics = sorted({t for c in task_set.callbacks for t in c.may_publish})
        self._number = {topic: i for i, topic in enumerate(self._topics)}
        self.node = quiet_node(
            f'_mddag_silences_{os.getpid()}_{os.urandom(4).hex()}', pool.context,
            is_remapped=True)
        name = f'/mddag/silences_{hashlib.sha256(task_set.text.encode()).hexdigest()[:8]}'
        self._publisher: Publisher | None = self.node.create_publisher(
            UInt8MultiArray, name, _QOS)
        self.subscriptions = [self.node.create_subscription(
            UInt8MultiArray, name, self._hear, _QOS, callback_group=ReentrantCallbackGroup())]
        self._allowance = Allowance(pool.unlocked_calls, name)
        self._engine.optional_topics.on_silent.append(self._announce)

    def close(self) -> None:
        """Stop announcing."""
        if self._publisher is not None:
            self._engine.optional_topics.on_silent.remove(self._announce)
            self._publisher = None
            self.node.destroy_node()

    def _announce(self, origin: Origin, topic: str) -> None:
        """Announce that a vertex ends without a topic (rule 1); the engine's lock is held."""
        others, publisher = self._engine.other_processes, self._publisher
        stamp = None if others is None else others.stamp_of(origin)
        if stamp is not None and publisher is not None:
            entry = _ENTRY.pack(stamp, origin.dag, origin.vertex, self._number[topic])
            self._pool.unlocked_calls.append(
                partial(publish_as_executor, publisher, UInt8MultiArray(data=entry)))

    def _hear(self, message: UInt8MultiArray) -> None:
        """Handle a silence of another executor, or of this one, which changes nothing."""
        if len(message.data) != _ENTRY.size or not self._allowance.has_time():
            return
        begin = time.thread_time_ns()
        stamp, dag, vertex, topic = _ENTRY.unpack(message.data)
        others, now = self._engine.other_processes, self._pool.tick()
        releases = self._pool.stamped_releases
        if (topic < len(self._topics) and others is not None and others.is_stamped(dag, vertex)
                and (releases.is_other or is_plausible(releases.clock.of_system(stamp), now))):
            name = self._topics[topic]
            release = releases.release(stamp, name, now)
            self._engine.hear_silent(Announced(stamp, dag, vertex, release), name, now)
        self._allowance.spend(time.thread_time_ns() - begin)
