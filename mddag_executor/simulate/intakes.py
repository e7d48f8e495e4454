# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The time that processes need to notice messages and timers, in virtual time.

Theory of operation
-------------------
1. Each process has an additional thread, its *intake*.  It notices due timers, and receives the
   messages of other processes.  (Within a process the publishing thread delivers them.)
2. The intake needs the GIL of its process (``machine``).  If a callback computes, the intake waits
   for a switch interval; then the callback is stopped.  The callback of the message or timer is
   ready when the intake has noticed it.
3. So a *way* into a process gets an additional vertex.  A way is an edge from a vertex of another
   process, or to a source that is a timer.  The vertex has no group, holds nothing, and belongs to
   a pool of one worker, numbered after those of the processes: the most urgent message is received
   first.
4. Timers that are due while another timer of their process is noticed are noticed with it.

Results of a run are in terms of the tables without these vertices.  The log has the end of a
vertex ``~v`` when the intake has noticed the trigger of vertex ``v``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

from mddag_executor.core import Tables
from mddag_executor.core.state import JOB_END
from mddag_executor.simulate.engine import END
from mddag_executor.simulate.load import edge_numbers, edges_of, Load, SKIPPED
from mddag_executor.simulate.schedule import schedule, Scheduled, Settings
from msg_graph import Dag, TaskSet, Vertex
import numpy as np

Way = tuple[int | None, int]
"""Two local vertices: the sender in another process (None: a timer), and the next vertex."""


class Costs(NamedTuple):
    """
    The costs of intakes, ns; the defaults are of a machine with two cores.

    :ivar timer_ns: GIL time of a timer; ``timer_ready_ns``: from due until its callback is ready,
        if nothing computes; ``message_ns``: GIL time of a message of another process;
        ``message_ready_ns``: from the end of its publisher.
    :ivar send_ns: the additional cost of a message to another process for its publisher.
    """

    timer_ns: int = 280_000
    timer_ready_ns: int = 170_000
    message_ns: int = 480_000
    message_ready_ns: int = 170_000
    send_ns: int = 100_000

    @property
    def timer_rest(self) -> int:
        """Return the remaining time of the intake when the timer's callback is ready."""
        return max(0, self.timer_ns - self.timer_ready_ns)

    @property
    def message_rest(self) -> int:
        """Return the remaining time of the intake when the message's callback is ready."""
        return max(0, self.message_ns - self.message_ready_ns)

    @property
    def delay_ns(self) -> int:
        """Return the transport time of a message to the intake."""
        return max(0, self.message_ready_ns - self.message_ns)


class Intakes:
    """
    The intakes of the processes of a run.

    :param tables: of the task set, with the process of each vertex.
    """

    def __init__(
        self, task_set: TaskSet, tables: Tables, costs: Costs | None = None
    ) -> None:
        self._plain = tables
        self._cost = costs = costs or Costs()
        self._ways = [_ways(dag, tables) for dag in task_set.dags]
        self._costs = [[costs.timer_ns if before is None else costs.message_ns
                        for before, _ in ways]
                       for ways in self._ways]
        built = Tables.build(
            replace(task_set, dags=tuple(map(_with_intakes, task_set.dags, self._ways))),
            default_deadline=tables.dag_deadline[-1])
        # by vertex its number without intakes, or ~ of the vertex that is noticed
        self._vertex: list[int] = []
        for first, dag, ways in zip(tables.first_vertex, task_set.dags, self._ways):
            self._vertex += range(first, first + len(dag.vertices))
            self._vertex += [~(first + after) for _, after in ways]
        self._vertex.append(tables.n_vertices)
        pools = max(tables.process)
        self._tables = built._replace(
            max_active_jobs=tables.max_active_jobs, expire_after=tables.expire_after,
            n_groups=tables.n_groups,
            group=[tables.group[v] if v >= 0 else -1 for v in self._vertex],
            process=[tables.process[v] if v >= 0 else pools + tables.process[~v]
                     for v in self._vertex])

    def schedule(
        self, load: Load, settings: Settings, *, log: bool = False, compiled: bool | None = None,
    ) -> Scheduled:
        """Run the core over a load like ``schedule``, with the work of the intakes."""
        ended, entries, decisions, busy = schedule(
            self._tables, self._load(load), replace(settings, intakes=True), log=log,
            compiled=compiled)
        from mddag_executor.simulate.compiled import Rows
        vertex = np.array(self._vertex)
        changes, found = (np.array(rows, dtype=np.int64).reshape(-1, 6)
                          for rows in (entries, decisions))
        changes[:, 4] = vertex[changes[:, 4]]
        changes = changes[(changes[:, 4] >= 0) | (changes[:, 1] == END)]
        which = found[:, 0] != JOB_END
        found[which, 2] = vertex[found[which, 2]]
        return Scheduled(
            ended, Rows(changes), Rows(found),  # type: ignore[arg-type]
            busy[:settings.workers * settings.processes])

    def _load(self, load: Load) -> Load:
        """Return a load with the work of the intakes, and a row for each job."""
        counts = np.bincount(
            np.asarray(load.dags, dtype=np.int64), minlength=len(self._ways)).tolist()
        given: dict[str, Any] = {
            name: np.asarray(getattr(load, name), dtype=np.int64)
            for name in ('costs', 'holds', 'computed', 'locks', 'fates')}
        if not len(given['locks']):
            given['locks'] = np.zeros(len(given['costs']), dtype=np.int64)
        columns: dict[str, Any] = {}
        bases: list[int] = []
        for name, column in given.items():
            if len(column):
                blocks = [self._wider(dag, block, name, 1 if stride else count)
                          for dag, (block, stride, count) in enumerate(zip(
                              np.split(column, load.cost_base[1:]), load.cost_stride, counts))]
                columns[name] = np.concatenate(blocks)
                bases = np.cumsum([0, *map(len, blocks[:-1])]).tolist()
        strides = [n + len(ways) for n, ways in zip(self._plain.n_region, self._ways)]
        grown = load._replace(
            **columns, cost_base=bases,
            cost_stride=strides + load.cost_stride[len(strides):], **self._delays(load))
        return self._join_rounds(grown)

    def _wider(self, dag: int, block: Any, name: str, times: int) -> Any:
        """Return the block of a DAG in a column, repeated, with the values of the intakes."""
        if dag >= len(self._ways):
            return block    # the undeclared callbacks
        rows = np.tile(block.reshape(-1, self._plain.n_region[dag]), (times, 1))
        added = np.zeros((len(rows), len(self._ways[dag])), dtype=np.int64)
        if name in ('costs', 'computed'):
            added[:] = self._costs[dag]
        elif name == 'locks':
            added[:] = 1
        elif name == 'fates' and self._is_timer(dag):
            source = self._plain.source[dag] - self._plain.first_vertex[dag]
            added[:, -1] = SKIPPED * (rows[:, source] == SKIPPED)
        return np.concatenate([rows, added], axis=1).ravel()

    def _is_timer(self, dag: int) -> bool:
        return self._ways[dag][-1:] != [] and self._ways[dag][-1][0] is None

    def _join_rounds(self, load: Load) -> Load:
        """Join the noticing of timers that are due while another is noticed (rule 4)."""
        times, dags, jobs, releases = (
            np.array(column, dtype=np.int64) for column in (
                load.times, load.dags, load.jobs,
                load.releases if len(load.releases) else load.times))
        is_timer = np.array([*map(self._is_timer, range(len(self._ways))), False])
        process = np.array([self._tables.process[source] for source in self._tables.source])
        for number in np.unique(process[:-1][is_timer[:-1]]):
            which = np.flatnonzero((process[dags] == number) & is_timer[dags])
            first = 0
            while first < len(which):
                end = first + int(np.searchsorted(
                    times[which[first:]], times[which[first]] + self._cost.timer_ready_ns))
                several = which[first:max(end, first + 1)]
                times[several] = times[several[-1]]
                offsets = [self._tables.rad_offset[self._tables.source[dag]]
                           for dag in dags[several]]
                for place in np.argsort(releases[several] + offsets, kind='stable')[1:]:
                    dag, job = dags[several[place]], jobs[several[place]]
                    load.costs[
                        load.cost_base[dag] + (job + 1) * load.cost_stride[dag] - 1] = 1
                first += len(several)
        order = np.lexsort((dags, times))
        columns: dict[str, Any] = {
            'times': times[order], 'dags': dags[order], 'jobs': jobs[order],
            'releases': releases[order]}
        return load._replace(**columns)

    def _delays(self, load: Load) -> dict[str, Any]:
        """Return the columns of transport times: to an intake, not from it."""
        if not load.delay_base:
            return {}
        numbers = edge_numbers(self._plain)
        places: list[list[int]] = [[] for _ in self._ways]
        for a, b in edge_numbers(self._tables):
            before, after = self._vertex[a], self._vertex[b]
            # the edges of intakes follow the others: those of messages, then those of timers
            places[self._tables.dag_of[a]].append(
                numbers[before, max(after, ~after)] if before >= 0
                else -1 - (self._tables.n_predecessors[a] > 0))
        blocks = []
        for place, n, block in zip(
                places, edges_of(self._plain),
                np.split(np.asarray(load.delays, dtype=np.int64), load.delay_base[1:])):
            rows = block.reshape(-1, n) if n else block.reshape(1, 0)
            rest = np.full((len(rows), 2), (-self._cost.message_rest, -self._cost.timer_rest))
            blocks.append(np.concatenate([rows, rest], axis=1)[:, place].ravel())
        return {
            'delays': np.concatenate(blocks),
            'delay_base': np.cumsum([0, *map(len, blocks[:-1])]).tolist(),
            'delay_stride': [stride and len(place)
                             for stride, place in zip(load.delay_stride, places)]}


def _ways(dag: Dag, tables: Tables) -> list[Way]:
    """Return the ways into processes of a DAG."""
    first = tables.first_vertex[dag.index]
    ways: list[Way] = [(before, after) for before, after in dag.edges
                       if tables.process[first + before] != tables.process[first + after]]
    if dag.vertices[dag.source].callback.kind == 'timer':
        ways.append((None, dag.source))
    return ways


def _with_intakes(dag: Dag, ways: list[Way]) -> Dag:
    """Return a DAG with a vertex for each way, after the others."""
    vertices, source = list(dag.vertices), dag.source
    for new, (before, after) in enumerate(ways, len(vertices)):
        later = vertices[after]
        if before is None:
            source = new
            vertices[after] = replace(later, predecessors=(new,))
        else:
            vertices[before] = replace(vertices[before], successors=tuple(
                new if s == after else s for s in vertices[before].successors))
            vertices[after] = replace(later, predecessors=tuple(
                new if p == before else p for p in later.predecessors))
        vertices.append(Vertex(
            f'intake of {later.name} {new}', replace(later.callback, group=None), dag.index, new,
            () if before is None else (before,), (after,), None))
    return replace(dag, vertices=tuple(vertices), source=source, edges=tuple(sorted(
        (v.index, s) for v in vertices for s in v.successors)))
