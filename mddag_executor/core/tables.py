# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Static tables of a task set, used by the scheduling rules.

Theory of operation
-------------------
A task set is flattened into columns.  A *global vertex index* numbers the vertices of all DAGs one
after the other, in DAG order; a *local* one is the index of a vertex in its DAG.  After the
declared DAGs comes the *undeclared DAG*, with one vertex and no judged sink.  Every undeclared
callback runs as a job of it, released when the callback became ready and with ``default_deadline``
as its deadline, so that it neither starves nor overtakes everything else.

An open job owns a *region* of consecutive execution ids (see ``state``): one id for each vertex,
or, if sync callbacks run leg by leg (live), one id for each *leg* of a sync vertex.  A leg is one
message that the sync waits for: on each of its topics one from each preceding vertex that
publishes the topic (``legs_of``).

The offsets are relative to a job's release:

* ``rad_offset``: reference absolute deadline (RAD) minus release: of a sink its own relative
deadline, of any other vertex the least among the sinks that it leads to (Yano and Azumi, RTSS 2024
WiP, extended GEDF).
* ``dag_deadline``: the latest deadline of the DAG (GEDF with one deadline for each DAG).
* ``late_deadline``: the same for how long late work is put off; 0 of a DAG without any deadline,
  as its work has been put off by ``UNJUDGED_PERIODS`` already.
* ``latest_start``: the latest start of the vertex with which every sink that it leads to is in
time, if each vertex takes its mean execution time (0 if none is declared) and never waits: the
least difference of these sinks' deadlines and the longest paths to them (least laxity first).
* ``reach_deadline``, ``reach_start``: the same two of each sink that the vertex leads to
(``reach_sink``), from ``first_reach`` of the vertex on.  ``mean_time`` is the declared mean
execution time, ``height`` the number of edges on the longest path to a sink.
* ``importance``: the highest of the sinks that it leads to, over trigger and queue edges.

``is_optional``, next to ``successors``: 1 if the edge becomes true only in some jobs, because its
topic is one that the vertex may publish.  ``gates``, from ``first_gate`` of a sink on: the
executions, as offsets in the region of a job, that such edges on its paths start; the sink is due
when all of them are known to start.

``driven``: DRIVEN for a sync with ``driven_by`` (rule 14), AFTER_DRIVEN for all vertices after
one, their sum for both.

``judged``: 0 for a sink without a deadline (``deadline: none``).  It is ordered as if it had one
of ``UNJUDGED_PERIODS`` periods: behind nearly everything that has a deadline, and it never
starves.

``process`` is the number of the declared process that a callback runs in, from 1.

For policies that order callbacks, not jobs:

* ``entity``: index of the callback in the wait set of an executor of ROS 2: timers, then
subscriptions, services and clients, each in the order of the declaration.  Vertices of one
callback are one entity.
* ``chain_rank``: fixed priority by chains, as in PiCAS; smaller is more urgent.  A chain is a path
from the source to a sink.  Chains rank by the sink's relative deadline, then by the period and
order of their DAGs; a callback has the rank of its most urgent chain (so all paths of a DAG with
the same least deadline are one chain).  Within a chain later callbacks, those with more vertices
on the longest path to them from the source, are more urgent; ties go by index.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from msg_graph import Callback, Dag, TaskSet, Vertex
from msg_graph.model import legs_of, optional_edges, path_lengths, topological_order

NEVER = 2 ** 62
"""A time that is never reached, ns: larger than any clock, small enough to add to."""

DEFAULT_DEADLINE_NS = 100_000_000
"""The relative deadline by which undeclared callbacks are ordered, ns."""
MAX_ACTIVE_JOBS = 64
"""How many jobs of a DAG may be open at a time."""
EXPIRE_AFTER_NS = 1_000_000_000
"""An idle job expires this long after its latest deadline, ns."""
MOST_SKIPPED = 1000
"""After a long stop (a suspended machine) at most this many releases are judged one by one."""

UNJUDGED_PERIODS = 10
"""A sink without a deadline is ordered as if it had one of this many periods of its DAG, …"""
UNJUDGED_NS = 1_000_000_000
"""… and at least this long."""

CONTINUE, DEMOTE = range(2)
KEEP_ALL, KEEP_TIMELY, KEEP_NEWEST = range(3)
"""Which waiting executions remain when the next one is ready (rule 11)."""
DRIVEN, AFTER_DRIVEN = 1, 2
"""Bits of ``Tables.driven``."""
IMPORTANCE = {'low': 0, 'normal': 1, 'high': 2}
IMPORTANT = 2
"""The highest importance."""
ON_LATE = {'continue': CONTINUE, 'demote': DEMOTE}
"""The treatments of late jobs, by their names in declarations and options."""

_WAIT_SET = {'timer': 0, 'subscription': 1, 'sync': 1, 'service': 2}
"""Kinds of callbacks in the order in which executors of ROS 2 check them."""


class Tables(NamedTuple):
    """
    Columns of a task set, immutable while a run lasts.

    All times are in nanoseconds; the period of a DAG that has one job only is NEVER.  Lists are
    indexed by DAG (``period``, ``dag_deadline``, …) or by global vertex index (``rad_offset``,
    ``dag_of``, …); the last DAG and the last vertex are the undeclared ones.
    """

    n_dags: int
    n_vertices: int
    period: list[int]
    dag_deadline: list[int]
    late_deadline: list[int]
    on_late: list[int]
    max_active_jobs: list[int]
    expire_after: list[int]
    first_vertex: list[int]
    n_region: list[int]
    source: list[int]
    first_sink: list[int]
    sinks: list[int]
    dag_of: list[int]
    index_in_dag: list[int]
    rad_offset: list[int]
    latest_start: list[int]
    first_reach: list[int]
    reach_sink: list[int]
    reach_deadline: list[int]
    reach_start: list[int]
    keep: list[int]
    mean_time: list[int]
    height: list[int]
    importance: list[int]
    sink_deadline: list[int]
    judged: list[int]
    entity: list[int]
    chain_rank: list[int]
    region_offset: list[int]
    n_legs: list[int]
    first_leg: list[int]
    n_predecessors: list[int]
    first_successor: list[int]
    successors: list[int]
    is_optional: list[int]
    driven: list[int]
    first_gate: list[int]
    gates: list[int]
    group: list[int]
    process: list[int]
    n_groups: int
    n_entities: int
    n_queues: int

    @staticmethod
    def build(
        task_set: TaskSet | None,
        *,
        legs: bool = False,
        default_deadline: int = DEFAULT_DEADLINE_NS,
        max_active_jobs: int = NEVER,
        expire_after: int = NEVER,
        on_late: str = 'continue',
    ) -> Tables:
        """
        Flatten a task set.

        :param task_set: the DAG tasks; ``None``: there is no declared DAG.
        :param legs: as live: sync vertices run once for each leg, not once when all have arrived,
            and the declared callback groups do not count: the driver has the real ones.
        :param default_deadline: relative deadline of undeclared callbacks, ns.
        :param max_active_jobs: bound on the open jobs of a DAG that declares none itself.
        :param expire_after: how long after its latest deadline an idle job stays open, ns.
        :param on_late: the treatment of late jobs of a DAG that does not declare it.
        """
        columns = _Columns(legs, max_active_jobs, expire_after, ON_LATE[on_late])
        columns.enter(task_set.callbacks if task_set is not None else ())
        for dag in task_set.dags if task_set is not None else ():
            columns.add_dag(dag)
        columns.lists['importance'] += [] if task_set is None else importances(task_set)
        columns.lists['process'] += [] if task_set is None else processes_of(task_set)
        return columns.finish(default_deadline)


class _Columns:
    """Collects the columns of ``Tables`` DAG by DAG."""

    def __init__(
        self, legs: bool, max_active_jobs: int, expire_after: int, on_late: int
    ) -> None:
        self._legs = legs
        self._max_active_jobs = max_active_jobs
        self._expire_after = expire_after
        self._on_late = on_late
        self._groups: dict[tuple[str, str], int] = {}
        self._entities: dict[str, int] = {}
        self._n_queues = 0
        # the callback of each vertex, and its most urgent chain
        self._chains: list[tuple[str, tuple[int, ...]]] = []
        names = [n for n in Tables._fields if n not in (
            'n_dags', 'n_vertices', 'n_groups', 'n_entities', 'n_queues')]
        self.lists: dict[str, list[int]] = {name: [] for name in names}
        self.lists['first_sink'].append(0)
        self.lists['first_successor'].append(0)
        self.lists['first_reach'].append(0)
        self.lists['first_gate'].append(0)

    def enter(self, callbacks: Sequence[Callback]) -> None:
        """Assign each declared callback its index in the wait set."""
        for callback in sorted(callbacks, key=lambda each: _WAIT_SET[each.kind]):
            self._entities[callback.key] = len(self._entities)

    def add_dag(self, dag: Dag) -> None:
        lists = self.lists
        first = len(lists['dag_of'])
        reached = reached_sinks(dag)
        heights = [0] * len(dag.vertices)
        maybe = [optional_edges(vertex, dag.vertices) for vertex in dag.vertices]
        for index in reversed(topological_order(dag)):
            heights[index] = 1 + max((heights[s] for s in dag.vertices[index].successors),
                                     default=-1)
        self._chains += [
            (vertex.callback.key, (offset, dag.period_ns, dag.index, -late, vertex.index))
            for vertex, offset, late in zip(
                dag.vertices, rad_offsets(dag), path_lengths(dag, [1] * len(dag.vertices)))]
        region = 0
        for vertex, sinks in zip(dag.vertices, reached):
            countdown, n_legs = len(vertex.predecessors), 1
            if self._legs and countdown > 0:
                countdown = n_legs = len(legs_of(vertex, dag.vertices))
            lists['dag_of'].append(dag.index)
            lists['index_in_dag'].append(vertex.index)
            lists['rad_offset'].append(min(deadline for _, deadline, _ in sinks))
            lists['latest_start'].append(min(start for _, _, start in sinks))
            lists['reach_sink'].extend(first + sink for sink, _, _ in sinks)
            lists['reach_deadline'].extend(deadline for _, deadline, _ in sinks)
            lists['reach_start'].extend(start for _, _, start in sinks)
            lists['first_reach'].append(len(lists['reach_sink']))
            lists['mean_time'].append(mean_time(vertex))
            lists['height'].append(heights[vertex.index])
            lists['keep'].append(
                KEEP_NEWEST if vertex.callback.keep == 'newest'
                else KEEP_TIMELY if vertex.callback.kind == 'timer' else KEEP_ALL)
            lists['sink_deadline'].append(-1 if vertex.successors else leaf_deadline(vertex, dag))
            lists['judged'].append(int(vertex.deadline_ns is not None))
            lists['entity'].append(self._entities[vertex.callback.key])
            lists['region_offset'].append(region)
            lists['n_legs'].append(n_legs)
            lists['first_leg'].append(self._n_queues)
            lists['n_predecessors'].append(countdown)
            lists['successors'].extend(first + s for s in reversed(vertex.successors))
            starts_sometimes = {after for after, _ in maybe[vertex.index]}
            lists['is_optional'].extend(
                int(after in starts_sometimes) for after in reversed(vertex.successors))
            lists['first_successor'].append(len(lists['successors']))
            lists['group'].append(self._group(vertex.callback.node, vertex.callback.group))
            region += n_legs
            self._n_queues += n_legs
        self._add_gates(dag, first, maybe)
        lists['driven'].extend([0] * len(dag.vertices))
        for index in topological_order(dag):
            vertex, at = dag.vertices[index], first + index
            lists['driven'][at] |= int(vertex.callback.driven_by is not None) * DRIVEN
            for after in vertex.successors if lists['driven'][at] else ():
                lists['driven'][first + after] |= AFTER_DRIVEN
        lists['period'].append(NEVER if dag.once else dag.period_ns)
        leaves = [vertex for vertex in dag.vertices if not vertex.successors]
        judged = [dag.vertices[sink] for sink in dag.sinks]
        lists['dag_deadline'].append(max(leaf_deadline(v, dag) for v in judged or leaves))
        lists['late_deadline'].append(lists['dag_deadline'][-1] if judged else 0)
        lists['on_late'].append(self._on_late if dag.on_late is None else ON_LATE[dag.on_late])
        lists['max_active_jobs'].append(dag.max_active_jobs or self._max_active_jobs)
        lists['expire_after'].append(self._expire_after)
        lists['first_vertex'].append(first)
        lists['n_region'].append(region)
        lists['source'].append(first + dag.source)
        lists['sinks'].extend(first + vertex.index for vertex in leaves)
        lists['first_sink'].append(len(lists['sinks']))

    def _add_gates(self, dag: Dag, first: int, maybe: list[list[tuple[int, str]]]) -> None:
        """Add the gates of the vertices of a DAG."""
        gates: list[set[int]] = [set() for _ in dag.vertices]
        for index in topological_order(dag):
            for after, topic in maybe[index]:
                vertex = dag.vertices[after]
                leg = legs_of(vertex, dag.vertices).index(
                    (vertex.callback.topics.index(topic), index)) if self._legs else 0
                gates[after].add(self.lists['region_offset'][first + after] + leg)
            for after in dag.vertices[index].successors:
                gates[after] |= gates[index]
        for of_vertex in gates:
            self.lists['gates'].extend(sorted(of_vertex))
            self.lists['first_gate'].append(len(self.lists['gates']))

    def _group(self, node: str, group: str | None) -> int:
        if group is None or self._legs:
            return -1
        return self._groups.setdefault((node, group), len(self._groups))

    def finish(self, default_deadline: int) -> Tables:
        """Add the undeclared DAG and freeze."""
        lists = self.lists
        n_dags = len(lists['period'])
        n_vertices = len(lists['dag_of'])
        undeclared = {
            'dag_of': n_dags, 'index_in_dag': 0, 'rad_offset': default_deadline,
            'latest_start': default_deadline, 'first_reach': len(lists['reach_sink']),
            'keep': KEEP_ALL, 'mean_time': 0, 'height': 0,
            'importance': IMPORTANT, 'sink_deadline': -1, 'judged': 0,
            'entity': len(self._entities), 'region_offset': 0,
            'n_legs': 1, 'first_leg': self._n_queues,
            'n_predecessors': 0, 'first_successor': len(lists['successors']),
            'driven': 0, 'first_gate': len(lists['gates']), 'group': -1, 'process': 1,
            'period': default_deadline, 'dag_deadline': default_deadline,
            'late_deadline': default_deadline, 'on_late': self._on_late,
            'max_active_jobs': NEVER, 'expire_after': NEVER, 'first_vertex': n_vertices,
            'n_region': 1, 'source': n_vertices, 'first_sink': len(lists['sinks']),
        }
        for name, value in undeclared.items():
            lists[name].append(value)
        self._chains.append(('', (default_deadline, default_deadline, n_dags, 0, 0)))
        lists['chain_rank'] = self._ranks()
        return Tables(
            n_dags=n_dags, n_vertices=n_vertices, n_groups=len(self._groups),
            n_entities=len(self._entities), n_queues=self._n_queues + 1, **lists)

    def _ranks(self) -> list[int]:
        """Return the rank of each vertex's callback, by its most urgent vertex."""
        best: dict[str, tuple[int, ...]] = {}
        for key, chain in self._chains:
            best[key] = min(chain, best.get(key, chain))
        ranks = {key: rank for rank, key in enumerate(sorted(best, key=lambda key: best[key]))}
        return [ranks[key] for key, _ in self._chains]


def processes_of(task_set: TaskSet) -> list[int]:
    """Return by vertex the number of its declared process, from 1."""
    place = {node: number for number, process in enumerate(task_set.processes, 1)
             for node in process.nodes}
    return [place.get(vertex.callback.node, 1) for vertex in task_set.vertices]


def importances(task_set: TaskSet) -> list[int]:
    """
    Return the importance of each vertex: the highest of the sinks that need it.

    It is inherited backwards over trigger edges, and over queue edges: from a callback to those
    whose data it reads.
    """
    found = [IMPORTANCE[vertex.callback.importance] if vertex.deadline_ns is not None else 0
             for vertex in task_set.vertices]
    of: dict[str, list[int]] = {}
    for number, vertex in enumerate(task_set.vertices):
        of.setdefault(vertex.callback.key, []).append(number)
    before: list[set[int]] = [set() for _ in found]
    first = 0
    for dag in task_set.dags:
        for vertex in dag.vertices:
            before[first + vertex.index].update(first + each for each in vertex.predecessors)
        first += len(dag.vertices)
    for edge in task_set.queue_edges:
        for reader in of.get(edge.reader, ()):
            before[reader].update(*(of.get(writer, ()) for writer in edge.writers))
    # the most important first: each vertex is reached once with its importance
    for importance in range(IMPORTANT, 0, -1):
        reached = [number for number, each in enumerate(found) if each == importance]
        while reached:
            for number in before[reached.pop()]:
                if found[number] < importance:
                    found[number] = importance
                    reached.append(number)
    return found


def rad_offsets(dag: Dag) -> list[int]:
    """
    Return RAD minus release for each vertex of a DAG, ns, by local index.

    The rule of the paper's extended GEDF: a sink has its own deadline, every other vertex the
    least of its successors', hence the least among the sinks that it leads to.
    """
    return [min(deadline for _, deadline, _ in sinks) for sinks in reached_sinks(dag)]


def leaf_deadline(vertex: Vertex, dag: Dag) -> int:
    """Return the relative deadline by which a vertex without successors is ordered, ns."""
    if vertex.deadline_ns is None:
        return max(UNJUDGED_PERIODS * dag.period_ns, UNJUDGED_NS)
    return vertex.deadline_ns


def mean_time(vertex: Vertex) -> int:
    """Return the declared mean execution time, ns; 0 if none is declared."""
    declared = vertex.callback.execution_time
    return 0 if declared is None else declared.mean_ns


def reached_sinks(dag: Dag) -> list[list[tuple[int, int, int]]]:
    """
    Return the sinks that each vertex of a DAG leads to, by local index.

    :return: for each sink its local index, its deadline, and the latest start for it (see
        ``latest_start`` in the theory of operation; it may be negative), ns.
    """
    costs = [mean_time(vertex) for vertex in dag.vertices]
    deadlines = [NEVER if vertex.successors else leaf_deadline(vertex, dag)
                 for vertex in dag.vertices]
    starts: list[dict[int, int]] = [{} for _ in dag.vertices]
    for index in reversed(topological_order(dag)):
        vertex = dag.vertices[index]
        if not vertex.successors:
            starts[index][index] = deadlines[index]
        for after in vertex.successors:
            for sink, start in starts[after].items():
                starts[index][sink] = min(start, starts[index].get(sink, NEVER))
        starts[index] = {sink: start - costs[index] for sink, start in starts[index].items()}
    return [[(sink, deadlines[sink], start) for sink, start in sorted(each.items())]
            for each in starts]
