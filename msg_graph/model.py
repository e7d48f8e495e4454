# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The derived task set, all that the rest of a program needs to know about a message graph.

It includes figures of a DAG: topological order, longest path, load. Everything is immutable. All
times are integers in nanoseconds.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

Kind = Literal['timer', 'subscription', 'sync', 'service']
ReleaseFrom = Literal['arrival', 'source_timestamp', 'header_stamp']
OnLate = Literal['continue', 'demote']
Keep = Literal['all', 'newest']
Importance = Literal['high', 'normal', 'low']

MOST_WORKERS = 4096
"""The maximum of one executor, declared or requested."""


@dataclass(frozen=True, slots=True)
class ExecutionTime:
    """
    Execution time of a callback, as a distribution given by quantiles.

    :ivar quantiles_ns: the quantiles, never decreasing; a single value is a constant.
    :ivar percent: for each quantile the share (0 to 100, increasing) of executions that take at
        most that time. Below the first and above the last the distribution is flat.
    """

    quantiles_ns: tuple[int, ...]
    percent: tuple[float, ...]

    def draw(self, u: float) -> int:
        """
        Return the execution time (ns) at the share ``u`` of the distribution.

        Interpolates linearly between the quantiles: a uniform ``u`` draws from the distribution.

        :raises ValueError: ``u`` is not within 0 and 1.
        """
        if not 0.0 <= u <= 1.0:
            raise ValueError(f'u is {u}: draw with a number from 0 to 1')
        at = u * 100.0
        if at <= self.percent[0]:
            return self.quantiles_ns[0]
        if at >= self.percent[-1]:
            return self.quantiles_ns[-1]
        above = bisect_right(self.percent, at)
        low, high = self.percent[above - 1], self.percent[above]
        first, second = self.quantiles_ns[above - 1], self.quantiles_ns[above]
        return round(first + (second - first) * (at - low) / (high - low))

    @property
    def mean_ns(self) -> int:
        """Return the mean of the distribution that ``draw`` draws from, in ns."""
        percent, quantiles = self.percent, self.quantiles_ns
        area = quantiles[0] * percent[0] + quantiles[-1] * (100.0 - percent[-1])
        for i in range(1, len(percent)):
            area += (quantiles[i - 1] + quantiles[i]) / 2 * (percent[i] - percent[i - 1])
        return round(area / 100.0)


@dataclass(frozen=True, slots=True)
class WeaklyHard:
    """
    How many results of a sink may miss their deadlines: ``misses`` of any ``of`` in a row.

    Source: G. Bernat, A. Burns and A. Llamosi, "Weakly hard real-time systems", IEEE Transactions
    on Computers 50(4), 2001.
    """

    misses: int
    of: int

    def __str__(self) -> str:
        return f'{self.misses} of {self.of}'


@dataclass(frozen=True, slots=True)
class Callback:
    """
    A declared callback: the unit that an executor runs.

    :ivar node: fully qualified name of its node.
    :ivar name: its name within the node.
    :ivar key: ``node:name``, unique in the declaration.
    :ivar kind: timer, subscription, sync or service.
    :ivar timer_period_ns: period of its timer; None for other kinds.
    :ivar topics: the topics that start it: one for a subscription, two or more for a sync, that
        of ``driven_by`` first.
    :ivar service: the service that it serves, or None.
    :ivar period_ns: of a source, the period of its DAG, declared or its timer's; else None.
    :ivar publishes: topics that it publishes, including those of ``may_publish``, which come last.
    :ivar may_publish: topics that it publishes only in some of its executions.
    :ivar reads: topics and callbacks of its node whose data it reads later (queue edges).
    :ivar deadline_ns: of a judged sink, its relative deadline; else None.
    :ivar release_from: where a source's release time comes from.
    :ivar group: name of its mutually exclusive callback group within the node, or None.
    :ivar dag: of a source, the declared name of its DAG, or None.
    :ivar execution_time: its execution time; None: not declared.
    :ivar line: line of its declaration, counted from 1.
    :ivar on_late: of a source, the treatment of late jobs; None: the default of the run.
    :ivar max_active_jobs: of a source, the bound on open jobs of its DAG, or None.
    :ivar holds_interpreter: whether it computes in Python (True), or waits, or computes with the
        interpreter's lock released (False); None: not declared.
    :ivar keep: of a source or sink: ``newest`` if an execution that has not started is dropped
        when the next job's is ready.
    :ivar importance: of a sink, in an overload.
    :ivar tolerate: of a sink: how many deadline misses are tolerated, or None.
    :ivar judged: of a sink: False if it has no deadline to be judged by (``deadline: none``).
    :ivar once: of a timer: whether it fires only once.
    :ivar sporadic: of a source: whether ``period_ns`` is only the least time
        between two releases.
    :ivar driven_by: of a sync of different rates: the topic each message of which has a result;
        the others are queue edges.  None for other syncs.
    :ivar file: name of the file that declares it; None: that of the task set.
    """

    node: str
    name: str
    key: str
    kind: Kind
    timer_period_ns: int | None
    topics: tuple[str, ...]
    service: str | None
    period_ns: int | None
    publishes: tuple[str, ...]
    reads: tuple[str, ...]
    deadline_ns: int | None
    release_from: ReleaseFrom
    group: str | None
    dag: str | None
    execution_time: ExecutionTime | None
    line: int
    on_late: OnLate | None = None
    max_active_jobs: int | None = None
    holds_interpreter: bool | None = None
    keep: Keep = 'all'
    importance: Importance = 'normal'
    tolerate: WeaklyHard | None = None
    may_publish: tuple[str, ...] = ()
    judged: bool = True
    once: bool = False
    sporadic: bool = False
    driven_by: str | None = None
    file: str | None = None

    @property
    def triggers(self) -> tuple[str, ...]:
        """Return the topics that are trigger edges: all, or only that of ``driven_by``."""
        return self.topics if self.driven_by is None else (self.driven_by,)

    @property
    def other_topics(self) -> tuple[str, ...]:
        """Return the topics of a sync that are queue edges, as another one drives it."""
        return () if self.driven_by is None else self.topics[1:]


@dataclass(frozen=True, slots=True)
class Vertex:
    """
    One callback in one DAG; a callback that several messages of a job start has several vertices.

    :ivar name: the callback's key if this is its only vertex; else ``key@dag``, or, for several
        vertices in one DAG, ``key@dag#1``, ``key@dag#2``, … in order of index.
    :ivar dag: index of its DAG.
    :ivar index: its index in its DAG.
    :ivar predecessors: indices, in the DAG, of the vertices that start it, ascending.
    :ivar successors: indices, in the DAG, of the vertices that it starts, in the order of the
        topics that it publishes, those of one topic ascending.
    :ivar deadline_ns: relative deadline of a sink; None for other vertices, and for a sink that
        declares ``deadline: none``.
    """

    name: str
    callback: Callback
    dag: int
    index: int
    predecessors: tuple[int, ...]
    successors: tuple[int, ...]
    deadline_ns: int | None


@dataclass(frozen=True, slots=True)
class Dag:
    """
    A DAG task: period, graph, and one relative deadline for each sink.

    :ivar name: unique among the DAGs: the source's ``dag:``, else its node.
    :ivar index: its index among the DAGs, in the order of the sources in the file.
    :ivar period_ns: time between two releases.
    :ivar source: index of the one vertex with no predecessor.
    :ivar sinks: indices of the vertices with a deadline, ascending: those with no successor,
        except those that declare ``deadline: none``.
    :ivar edges: trigger edges as pairs of indices, ascending.
    :ivar release_from: where a job's release time comes from; for a timer it is its due time, and
        ``header_stamp`` is the release in other processes of the DAG.
    :ivar on_late: the treatment of late jobs; None: not declared.
    :ivar max_active_jobs: bound on the open jobs; None: not declared.
    """

    name: str
    index: int
    period_ns: int
    vertices: tuple[Vertex, ...]
    source: int
    sinks: tuple[int, ...]
    edges: tuple[tuple[int, int], ...]
    release_from: ReleaseFrom
    on_late: OnLate | None
    max_active_jobs: int | None

    @property
    def once(self) -> bool:
        """Return whether it has one job only, as its source is a timer that fires once."""
        return self.vertices[self.source].callback.once

    @property
    def sporadic(self) -> bool:
        """Return whether the period is only the least time between two releases."""
        return self.vertices[self.source].callback.sporadic

    def jobs_in(self, duration_ns: int) -> int:
        """Return the number of releases in a time, if the first one is at its begin."""
        jobs = -(-duration_ns // self.period_ns)
        return min(1, jobs) if self.once else jobs


@dataclass(frozen=True, slots=True)
class QueueEdge:
    """
    Data that a callback reads without being started by it.

    :ivar reader: key of the reading callback.
    :ivar topic: the topic that is read; None for a member variable.
    :ivar writers: keys of the callbacks that publish the topic, or that write the variable.
    """

    reader: str
    topic: str | None
    writers: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Path:
    """
    An end-to-end path over trigger and queue edges.

    :ivar name: unique among the paths.
    :ivar callbacks: keys of the callbacks along it, in the order in which data passes them.
    :ivar reaction_ns: the required maximum reaction time; None: none is required.
    :ivar age_ns: the required maximum data age; None: none is required.
    :ivar tolerate: how many inputs (of the reaction) or outputs (of the age) may be late, or None.
    """

    name: str
    callbacks: tuple[str, ...]
    reaction_ns: int | None = None
    age_ns: int | None = None
    tolerate: WeaklyHard | None = None

    @property
    def requirements(self) -> dict[str, int]:
        """Return the required times, ns, by 'reaction' and 'age'."""
        required = {'reaction': self.reaction_ns, 'age': self.age_ns}
        return {what: time for what, time in required.items() if time is not None}


@dataclass(frozen=True, slots=True)
class Process:
    """
    A process that nodes run in.

    :ivar name: unique among the processes.
    :ivar nodes: its declared nodes, in file order.
    """

    name: str
    nodes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class TaskSet:
    """
    The DAG tasks of a declaration.

    :ivar dags: the DAGs, by index.
    :ivar callbacks: every declared callback, in file order.
    :ivar queue_edges: by reader in file order, then in the order of its ``reads``.
    :ivar paths: the declared end-to-end paths, in file order.
    :ivar workers: declared number of workers, or None.
    :ivar file: name of the declaration's file.
    :ivar text: the text of the declaration, resolved if it includes other files.
    :ivar processes: the declared processes, which contain each declared node once; may be empty.
    :ivar concurrent: the nodes whose callbacks may overlap whatever executor their program has.
    :ivar vertices: the vertices of all DAGs, DAG by DAG.
    """

    dags: tuple[Dag, ...]
    callbacks: tuple[Callback, ...]
    queue_edges: tuple[QueueEdge, ...]
    paths: tuple[Path, ...]
    workers: int | None
    file: str
    text: str
    processes: tuple[Process, ...] = ()
    concurrent: tuple[str, ...] = ()
    vertices: tuple[Vertex, ...] = field(init=False, repr=False, compare=False)
    _vertex: dict[str, Vertex] = field(init=False, repr=False, compare=False)
    _dag: dict[str, Dag] = field(init=False, repr=False, compare=False)
    _callback: dict[str, Callback] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        every = tuple(vertex for dag in self.dags for vertex in dag.vertices)
        object.__setattr__(self, 'vertices', every)
        object.__setattr__(self, '_vertex', {vertex.name: vertex for vertex in every})
        object.__setattr__(self, '_dag', {dag.name: dag for dag in self.dags})
        object.__setattr__(self, '_callback', {c.key: c for c in self.callbacks})

    def process_of(self, node: str) -> str | None:
        """Return the name of the process that a node runs in; None: not declared."""
        return next((p.name for p in self.processes if node in p.nodes),
                    self.processes[0].name if self.processes else None)

    def vertex(self, name: str) -> Vertex:
        """Return the vertex with this name; raise ``KeyError`` if there is none."""
        return self._vertex[name]

    def dag(self, name: str) -> Dag:
        """Return the DAG with this name; raise ``KeyError`` if there is none."""
        return self._dag[name]

    def callback(self, key: str) -> Callback:
        """Return the callback ``node:name``; raise ``KeyError`` if there is none."""
        return self._callback[key]

    def with_callbacks(self, change: Mapping[str, Mapping[str, Any]]) -> TaskSet:
        """Return the task set with some fields of callbacks changed, by key; edges stay."""
        new = {c.key: replace(c, **change.get(c.key, {})) for c in self.callbacks}
        return replace(self, callbacks=tuple(new.values()), dags=tuple(
            replace(dag, vertices=tuple(
                replace(vertex, callback=new[vertex.callback.key],
                        deadline_ns=new[vertex.callback.key].deadline_ns)
                for vertex in dag.vertices)) for dag in self.dags))

    def callback_indices(self) -> dict[str, int]:
        """Return the index of each callback in ``callbacks``, by its key."""
        return {callback.key: place for place, callback in enumerate(self.callbacks)}

    def places_of_vertices(self) -> list[int]:
        """Return by vertex (see ``vertices``) the index of its callback in ``callbacks``."""
        places = self.callback_indices()
        return [places[vertex.callback.key] for vertex in self.vertices]


def topological_order(dag: Dag) -> list[int]:
    """Return the vertices (indices in the DAG), each after its predecessors."""
    waiting = [len(vertex.predecessors) for vertex in dag.vertices]
    order = [dag.source]
    for index in order:
        for after in dag.vertices[index].successors:
            waiting[after] -= 1
            if waiting[after] == 0:
                order.append(after)
    return order


def legs_of(vertex: Vertex, vertices: Sequence[Vertex]) -> list[tuple[int, int]]:
    """Return the messages that start a vertex, its legs: topic index and publishing vertex."""
    topics = vertex.callback.triggers
    if len(topics) <= 1:
        return [(0, before) for before in vertex.predecessors]
    return [
        (place, before) for place, topic in enumerate(topics) for before in vertex.predecessors
        if topic in vertices[before].callback.publishes]


def optional_edges(vertex: Vertex, vertices: Sequence[Vertex]) -> list[tuple[int, str]]:
    """
    Return the vertices that an execution may leave unstarted, as it publishes only sometimes.

    :return: pairs of a successor's index and a topic; the successor is not due in a job in which
        this vertex completes without publishing the topic.
    """
    return [(after, topic) for after in vertex.successors
            for topic in vertices[after].callback.triggers
            if topic in vertex.callback.may_publish]


def path_lengths(dag: Dag, weights: Sequence[int]) -> list[int]:
    """
    Return for each vertex the length of the longest path from the source through it.

    :param weights: of each vertex, by its index in the DAG; the vertex's own weight is included.
    """
    lengths = [0] * len(dag.vertices)
    for index in topological_order(dag):
        before = dag.vertices[index].predecessors
        lengths[index] = weights[index] + max((lengths[p] for p in before), default=0)
    return lengths


def mean_execution_times(dag: Dag) -> list[int] | None:
    """Return each vertex's mean execution time in ns; None if one is not declared."""
    means = []
    for vertex in dag.vertices:
        if vertex.callback.execution_time is None:
            return None
        means.append(vertex.callback.execution_time.mean_ns)
    return means


def load_of(dag: Dag) -> float | None:
    """
    Return the load of the DAG in cores, with mean execution times: sum(C) / T.

    None if an execution time is not declared; 0 for a DAG that has one job only.
    """
    means = mean_execution_times(dag)
    return 0.0 if dag.once else None if means is None else sum(means) / dag.period_ns


EMPTY_TASK_SET = TaskSet((), (), (), (), None, '', '')
"""The task set without a declaration."""
