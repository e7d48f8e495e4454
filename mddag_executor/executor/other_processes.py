# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
DAGs over several processes: find the job that a message from another process belongs to.

Theory of operation
-------------------
An executor sees only the publications of its own process.  Across processes and machines the
message itself must identify its job.  It does if the DAG's source declares ``release_from:
header_stamp``: nodes pass the stamp of the sensor's message on from the source to the sinks, and
that stamp is the release of the job.  For other DAGs that the declared ``processes`` divide, the
executors of one machine announce the job of each publication to each other (``announcements``).
For such DAGs only:

1.  A vertex is *here* when an entity of this executor is bound to its callback now.  A job has in
    this process the vertices that are here when it is released here; its other sinks are judged
    elsewhere (rule 9 of ``core.rules``).
2.  A message whose publication is known here belongs to that publication's job.
3.  Any other message on a topic *enters* when exactly one vertex that is not here publishes the
    topic to it (or several do to one sync, which waits for as many messages), and its header has a
    stamp that is not zero.  It belongs to the open job of that stamp; if there is none yet, it
    starts one, whose release is the stamp.  If publications are announced, the announcement gives
    its job and vertex.
4.  The job of a stamp is the one that a source's message or an entering message with that stamp
    has started here, or one of whose callbacks here has published a message with that stamp, or
    that a *silence* has started (``silences``).  The job of an announced name is the one that was
    released here or has entered by that name.  So a DAG may leave a process and come back.
5.  An ambiguous message (two vertices elsewhere that publish the topic, no stamp, a job that has
    ended, a second message for the same vertex of the same job) runs as undeclared, and is counted
    as unattributed.

A stamp is a time of the system clock.  Machines must synchronise it (PTP, NTP); the difference
adds to the response times.  A timer that is a source has its nominal due time as release in its
own process, and elsewhere the stamp that its node gave the message: a stamp taken from the clock
in the callback is later by the dispatch latency.

Two executors in one process that share a graph are treated as two processes.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence, Set
import threading
from typing import Any

from mddag_executor.core import Scheduler, Tables
from mddag_executor.core.state import IDLE
from mddag_executor.executor.attribution import Attribution, Origin
from mddag_executor.executor.bounds import REMEMBERED
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.verdicts import Record
from msg_graph import Dag, TaskSet, Vertex


class OtherProcesses:
    """
    The DAGs that may extend beyond this process, and the jobs of their stamps.

    ``host`` and ``find`` need the engine's lock; ``note`` may be called from any thread.

    :param start_job: starts a job of a DAG, given its release and the time; returns its slot.
    :param dags: those identified by stamps.
    :param announced: the indices of those whose publications are announced.
    """

    def __init__(
        self, task_set: TaskSet, tables: Tables, scheduler: Scheduler,
        attribution: Attribution, start_job: Callable[[int, int, int], int],
        dags: Sequence[Dag], announced: Set[int] = frozenset(),
    ) -> None:
        self._announced = announced
        self._crossing = {d.index for d in dags}
        self._dags = [d for d in task_set.dags if d.index in self._crossing | announced]
        self._tables = tables
        self._scheduler = scheduler
        self._attribution = attribution
        self._start_job = start_job
        self._callbacks = [v.callback.key for d in task_set.dags for v in d.vertices]
        self._here: dict[int, list[int]] = {}
        # the topics on which messages go to other processes
        self._leaving: set[str] = set()
        # by DAG and stamp, or DAG and name; the names of jobs that have entered
        self._jobs: dict[tuple[int, int | tuple[int, int]], Origin] = {}
        self._kept: deque[tuple[int, int | tuple[int, int]]] = deque()
        self._names: dict[tuple[int, int], tuple[int, int]] = {}
        # by DAG and job: its first stamp
        self._stamps: dict[tuple[int, int], int] = {}
        # vertices elsewhere and their topics that start vertices here
        self._entering: set[tuple[int, str]] = set()
        # by DAG and job: the release of an open job whose end is announced
        self._releases: dict[tuple[int, int], int] = {}

    @staticmethod
    def of(
        task_set: TaskSet | None, tables: Tables, scheduler: Scheduler,
        attribution: Attribution, process: str | None,
        start_job: Callable[[int, int, int], int],
    ) -> OtherProcesses | None:
        """
        Return the object for a declaration; None: no DAG extends beyond the process.

        :param process: the declared process that this is; None: publications are not announced.
        """
        if task_set is None:
            return None
        stamped = [d for d in task_set.dags if d.release_from == 'header_stamp']
        announced: set[int] = set() if process is None else divided(task_set)
        if not stamped and not announced:
            return None
        return OtherProcesses(
            task_set, tables, scheduler, attribution, start_job, stamped, announced)

    @property
    def announces(self) -> bool:
        """Return whether there are DAGs whose publications are announced."""
        return bool(self._announced)

    def host(
        self, hosted: set[str], entities: Iterable[Entity], record: Record | None, now: int
    ) -> None:
        """
        Update which callbacks are here now (rules 1 and 3), and record what changes.

        :param hosted: the keys of the callbacks.
        """
        leaving: set[str] = set()
        announced: set[str] = set()
        for dag in self._dags:
            here = [int(v.callback.key in hosted) for v in dag.vertices]
            if here != self._here.get(dag.index):
                self._here[dag.index] = here
                self._scheduler.expect(dag.index, here)
                if record is not None:
                    record('hosted', now, threading.get_native_id(), dag.index,
                           ','.join(str(i) for i, is_here in enumerate(here) if is_here))
            if not all(here):
                (announced if dag.index in self._announced else leaving).update(
                    t for v in dag.vertices if here[v.index] for t in v.callback.publishes
                    if dag.index in self._crossing or self._leaves(dag, v, here, t))
        self._leaving = {
            t for dag in self._dags for v in dag.vertices if self._here[dag.index][v.index]
            for t in v.callback.publishes if self._leaves(dag, v, self._here[dag.index], t)}
        self._entering = {
            (self._tables.first_vertex[dag.index] + v.index, t) for dag in self._dags
            for v in dag.vertices if not self._here[dag.index][v.index]
            for t in {*v.callback.publishes, *v.callback.may_publish} if any(
                self._here[dag.index][after] and t in dag.vertices[after].callback.topics
                for after in v.successors)}
        self._attribution.note_headers(self.note, leaving)
        self._attribution.announce_on(announced)
        for entity in entities:
            entity.awaits = any(
                self._callbacks[v] not in hosted and self._tables.dag_of[v] in self._announced
                for v in entity.targets)
            entity.remote_publishers = self._entrance(entity, hosted)

    def unmatched(self, entities: Iterable[Entity], nodes: Iterable[Any]) -> list[str]:
        """Return the topics of leaving or entering jobs without an endpoint of another process."""
        here = Counter(entity.label for entity in entities)
        found = [e.label for e in entities if (e.awaits or e.remote_publishers)
                 and not e.rclpy_object.get_publisher_count()]
        for publisher in (p for node in nodes for p in node.publishers):
            topic = publisher.topic_name
            if topic in self._leaving and publisher.get_subscription_count() <= here[topic]:
                found.append(topic)
        return found

    @staticmethod
    def _leaves(dag: Dag, vertex: Vertex, here: list[int], topic: str) -> bool:
        """Return whether a topic of a vertex starts a vertex that is not here."""
        return any(not here[after] and topic in dag.vertices[after].callback.topics
                   for after in vertex.successors)

    def _entrance(self, entity: Entity, hosted: set[str]) -> list[int]:
        """Return the vertices elsewhere from which messages enter at an entity."""
        remote = [v for v in entity.targets if self._callbacks[v] not in hosted]
        if len({entity.targets[v][0] for v in remote}) > 1:
            return []
        crossing = all(self._tables.dag_of[v] in self._crossing for v in remote)
        return remote if crossing else []

    def elsewhere(self) -> set[str]:
        """Return the callbacks of these DAGs that are not here."""
        return {v.callback.key for dag in self._dags for v in dag.vertices
                if not self._here.get(dag.index, [0] * len(dag.vertices))[v.index]}

    def note(self, name: int | tuple[int, int], origin: Origin) -> None:
        """Note the job of a stamp, or of a name that is announced (rule 4)."""
        if isinstance(name, tuple):
            self._names[origin.dag, origin.job] = name
        elif name < 0 or origin.dag not in self._crossing:
            return
        else:
            self._stamps.setdefault((origin.dag, origin.job), name)
        key = (origin.dag, name)
        before = self._jobs.get(key)
        if before is None:
            self._kept.append(key)
            if len(self._kept) > REMEMBERED:
                gone = self._jobs.pop(self._kept.popleft(), None)
                if gone is not None:
                    self._names.pop((gone.dag, gone.job), None)
                    self._stamps.pop((gone.dag, gone.job), None)
        elif before.job != origin.job and self._stamps.get((before.dag, before.job)) == name:
            self._stamps.pop((before.dag, before.job), None)  # a source repeats its stamp
        self._jobs[key] = origin

    def enter(
        self, dag: int, name: int | tuple[int, int], vertex: int, release: int, now: int
    ) -> Origin:
        """Find or start the job of a stamp or an announced name, for a vertex."""
        job = self.find(dag, name)
        if job is None:
            slot = self._start_job(dag, release, now)
            job = Origin(slot, dag, self._scheduler.state.job_index[slot], vertex)
            self.note(name, job)
        return job._replace(vertex=vertex)

    def enter_at(self, entity: Entity, stamp: int, release: int, now: int) -> Origin | None:
        """Find or start the job of a message from another process (rule 3)."""
        if not entity.remote_publishers:
            return None
        first = entity.remote_publishers[0]
        job = self.enter(self._tables.dag_of[first], stamp, first, release, now)
        # For a sync: the first of its legs that has no message yet.
        states, execution = self._scheduler.state.x_state, self._scheduler.execution
        return job._replace(vertex=next((
            v for v in entity.remote_publishers
            if states[execution(job.slot, *entity.targets[v])] == IDLE), first))

    def find(self, dag: int, name: int | tuple[int, int]) -> Origin | None:
        """Return the job of a stamp or name, also one that has ended; None for a new one."""
        return self._jobs.get((dag, name))

    def enters(self, vertex: int, topic: str) -> bool:
        """Return whether messages of a vertex elsewhere on a topic start a vertex here."""
        return (vertex, topic) in self._entering

    def is_here(self, dag: int) -> bool:
        """Return whether any vertex of a DAG is here."""
        return any(self._here.get(dag, ()))

    def released(self, dag: int, job: int, release: int) -> None:
        """Note the release of a job, until it has ended."""
        if dag in self._announced:
            self._releases[dag, job] = release

    def ended(self, dag: int, job: int) -> int | None:
        """Return the release of a job that has ended; None: its end is not announced."""
        return self._releases.pop((dag, job), None)

    def name_of(self, origin: Origin) -> tuple[int, int] | None:
        """Return the name of a job, None if it has none yet."""
        return self._names.get((origin.dag, origin.job))

    def stamp_of(self, origin: Origin) -> int | None:
        """Return the header stamp that identifies a job elsewhere; None: it has none yet."""
        return self._stamps.get((origin.dag, origin.job))

    def is_announced(self, origin: Origin) -> bool:
        """Return whether the job of a publication is announced."""
        return origin.dag in self._announced

    def is_stamped(self, dag: int, vertex: int) -> bool:
        """Return whether a DAG is identified by stamps, and has a vertex."""
        return dag in self._crossing and (
            0 <= vertex < len(self._callbacks) and self._tables.dag_of[vertex] == dag)


def contested(task_set: TaskSet) -> set[str]:
    """Return the topics that callbacks of several declared processes publish."""
    processes: dict[str, set[str | None]] = {}
    for callback in task_set.callbacks:
        for topic in callback.publishes:
            processes.setdefault(topic, set()).add(task_set.process_of(callback.node))
    return {topic for topic, several in processes.items() if len(several) > 1}


def divided(task_set: TaskSet) -> set[int]:
    """Return the DAGs that the declared processes divide, without a header stamp."""
    return {dag.index for dag in task_set.dags if dag.release_from != 'header_stamp' and len(
        {task_set.process_of(vertex.callback.node) for vertex in dag.vertices}) > 1}
