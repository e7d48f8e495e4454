# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Counts of the core's decisions: per DAG and sink, in the result format of the commands.

Live executor, replayer and simulator all use this module, so their figures have the same meaning.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, cast, NamedTuple, TYPE_CHECKING

from mddag_executor.core.jobs import is_miss
from mddag_executor.core.state import (
    ABORTED,
    COMPLETED,
    Decision,
    DROP,
    EXPIRED,
    FAILED,
    JOB_END,
    LATE,
    NOT_JUDGED,
    OUTDATED,
    SINK_ABORTED,
    SINK_DEMOTED,
    SINK_DROPPED,
    SINK_EXPIRED,
    SINK_FAILED,
    SINK_IN_TIME,
    SINK_LATE,
    SINK_MISSED,
    SINK_NOT_DUE,
    SINK_OVERDUE,
)
from mddag_executor.core.tables import NEVER, Tables
from mddag_executor.core.weakly_hard import MissWindow
from msg_graph import Dag, TaskSet, Vertex, WeaklyHard

if TYPE_CHECKING:
    from mddag_executor.results.sinks import (
        DagCounts,
        FirstMiss,
        JobEnds,
        ResponseTimes,
        SinkCounts,
        SinkVerdicts,
        Verdicts,
    )

VERDICTS = {
    SINK_IN_TIME: 'in_time', SINK_LATE: 'late', SINK_MISSED: 'overdue', SINK_EXPIRED: 'expired',
    SINK_ABORTED: 'aborted', SINK_FAILED: 'failed', SINK_DROPPED: 'dropped',
    SINK_OVERDUE: 'overdue'}
"""The names of the core's verdicts."""
OUTCOMES = {COMPLETED: 'completed', LATE: 'late', ABORTED: 'aborted', EXPIRED: 'expired',
            FAILED: 'failed', OUTDATED: 'dropped'}


def quantile(ordered: Sequence[int], q: float) -> int:
    """Return the nearest-rank quantile ``q`` (0 to 1) of values in ascending order."""
    return ordered[min(len(ordered) - 1, max(0, -int(-q * len(ordered) // 1) - 1))]


class Counts(NamedTuple):
    """
    Verdicts about the jobs of one or several sinks; ``late`` includes the overdue.

    Demoted jobs have another verdict as well; only recordings of version 2.0 and before have
    aborted ones.  Jobs in which the sink was not due are not among the ``due``.
    """

    due: int
    in_time: int
    late: int
    expired: int
    aborted: int
    failed: int
    dropped: int
    demoted: int
    not_due: int

    @property
    def missed(self) -> int:
        """Return the number of results that were not in time."""
        # an overdue result that turned out to be in time makes a difference negative
        return max(0, self.due - self.in_time)

    def minus(self, earlier: Counts) -> Counts:
        """Return the difference to earlier counts."""
        return Counts(*(now - before for now, before in zip(self, earlier)))

    @classmethod
    def total(cls, several: Iterable[Counts]) -> Counts:
        """Return the sums of several."""
        return cls(*(sum(column) for column in zip(cls(*[0] * len(cls._fields)), *several)))


def counts(sink: Mapping[str, Any]) -> Counts:
    """Return the verdicts in the result of a sink, or in its counts (``SinkTally.verdicts``)."""
    overdue = sink.get('overdue', 0)
    aborted, failed, dropped = (sink.get(key, 0) for key in ('aborted', 'failed', 'dropped'))
    in_time = sink['completed'] - (sink['late'] - overdue)
    due = sink['completed'] + overdue + sink['expired'] + aborted + failed + dropped
    return Counts(due, in_time, sink['late'], sink['expired'], aborted, failed, dropped,
                  sink.get('demoted', 0), sink.get('not_due', 0))


def is_kept(sink: Mapping[str, Any]) -> bool:
    """Return whether a sink's result has no more misses than its declaration tolerates."""
    tolerate = sink.get('tolerate')
    if tolerate is None:
        return not counts(sink).missed
    return bool(tolerate['worst'] <= tolerate['misses'])


def total(dags: Mapping[str, Any]) -> Counts:
    """Return the verdicts about all sinks of a result."""
    return Counts.total(counts(sink) for dag in dags.values() for sink in dag['sinks'].values())


def never_due(dags: Mapping[str, Any]) -> list[str]:
    """Return the sinks of a result without a due job, whose deadlines were never tested."""
    return [name for dag in dags.values() for name, sink in dag['sinks'].items()
            if not counts(sink).due]


def of_processes(
    task_set: TaskSet, results: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """
    Combine the verdicts of a run's processes (``Tally.result``).

    A sink is judged in its node's process, a job counted in its source's.

    :param results: by process, of those that have left one.
    """
    dags: dict[str, Any] = {}
    nothing: Mapping[str, Any] = {'jobs': 0, 'sinks': {}}
    for dag in task_set.dags:
        parts = {name: result['dags'][dag.name] for name, result in results.items()}
        part_of = [parts.get(str(task_set.process_of(v.callback.node)), nothing)
                   for v in dag.vertices]
        dags[dag.name] = {'jobs': part_of[dag.source]['jobs'], 'sinks': {
            vertex.name: part_of[vertex.index]['sinks'].get(vertex.name)
            or SinkTally(vertex.deadline_ns or 0, None).result()
            for vertex in (dag.vertices[sink] for sink in dag.sinks)}}
    misses = [r['first_miss'] for r in results.values() if r['first_miss'] is not None]
    first = min(misses, key=lambda miss: int(miss['deadline_ns']), default=None)
    return {'deadline_missed': first is not None, 'first_miss': first,
            'never_due': never_due(dags), 'dags': dags}


class SinkTally:
    """
    The results of one sink: counts, and response times (completion minus release, ns).

    :ivar numbers: the number of decisions by kind; of overdue sinks those without verdict so far.
    """

    def __init__(self, relative_deadline_ns: int, keep: int | None) -> None:
        self.relative_deadline_ns = relative_deadline_ns
        self.numbers = [0] * (SINK_NOT_DUE + 1)
        self.shortest, self.longest = NEVER, -NEVER
        self.responses: Any = deque(maxlen=keep)

    @property
    def completed(self) -> int:
        """Return the number of completed jobs."""
        return self.numbers[SINK_IN_TIME] + self.numbers[SINK_LATE]

    def done(self, response: int, late: bool) -> None:
        """Count a completion."""
        self.numbers[SINK_LATE if late else SINK_IN_TIME] += 1
        self.responses.append(response)
        if response < self.shortest:
            self.shortest = response
        if response > self.longest:
            self.longest = response

    def verdicts(self) -> SinkVerdicts:
        """Return the number of each verdict; ``late`` includes the overdue."""
        numbers = self.numbers
        overdue = numbers[SINK_MISSED] + numbers[SINK_OVERDUE]
        found: SinkVerdicts = {
            'completed': self.completed, 'late': numbers[SINK_LATE] + overdue, 'overdue': overdue,
            'expired': numbers[SINK_EXPIRED], 'failed': numbers[SINK_FAILED],
            'dropped': numbers[SINK_DROPPED]}
        if numbers[SINK_ABORTED]:
            found['aborted'] = numbers[SINK_ABORTED]
        if numbers[SINK_DEMOTED]:
            found['demoted'] = numbers[SINK_DEMOTED]
        if numbers[SINK_NOT_DUE]:
            found['not_due'] = numbers[SINK_NOT_DUE]
        return found

    def result(self) -> SinkCounts:
        """Return the sink's part of the result."""
        response: ResponseTimes | None = None
        if self.responses:
            ordered = self.responses if isinstance(self.responses, memoryview) else sorted(
                self.responses)
            response = {
                'min': self.shortest, 'median': quantile(ordered, 0.5),
                'p99': quantile(ordered, 0.99), 'max': self.longest}
        return cast('SinkCounts', {
            'relative_deadline_ns': self.relative_deadline_ns, **self.verdicts(),
            'response_ns': response})


class Tally:
    """
    Counts of a run.

    :param keep: how many of the last response times to keep for each sink (None: all).
    """

    def __init__(self, task_set: TaskSet | None, tables: Tables, keep: int | None = None) -> None:
        self._tables = tables
        self._dags = task_set.dags if task_set is not None else ()
        self.jobs = [0] * tables.n_dags
        self.ends = [dict.fromkeys(OUTCOMES, 0) for _ in range(tables.n_dags)]
        self.sinks = {v: SinkTally(tables.sink_deadline[v], keep) for v in tables.sinks
                      if tables.judged[v]}
        #: By sink: its misses in any window, if the declaration tolerates some.
        self.windows = {v: MissWindow(tolerate.of) for v in self.sinks
                        if (tolerate := self._tolerate(v)) is not None}
        #: By vertex and job: the deadlines of sinks that are overdue and have no verdict yet.
        self.overdue: dict[tuple[int, int], int] = {}
        #: The miss with the earliest deadline.
        self.first_miss: FirstMiss | None = None

    def released(self, dag: int) -> None:
        """Count the release of a job."""
        if dag < self._tables.n_dags:
            self.jobs[dag] += 1

    def add(self, decisions: Iterable[Decision]) -> None:
        """Count decisions of the core."""
        for kind, dag, vertex, job, deadline, time in decisions:
            if self.overdue and kind <= JOB_END:
                # a verdict, or the end of a job of which some sinks are no longer judged
                for sink_vertex in self._sinks_of(dag) if kind == JOB_END else (vertex,):
                    self._end_overdue(sink_vertex, job)
            if kind == SINK_IN_TIME:
                sink = self.sinks[vertex]
                sink.done(time - deadline + sink.relative_deadline_ns, False)
            elif kind == JOB_END:
                if vertex != NOT_JUDGED:
                    self.ends[dag][deadline] += 1
            elif kind != DROP:
                self._add_unusual(kind, vertex, job, deadline, time)

    def _add_unusual(self, kind: int, vertex: int, job: int, deadline: int, time: int) -> None:
        """Count a decision about a sink that was not in time."""
        sink = self.sinks[vertex]
        if kind == SINK_LATE:
            sink.done(time - deadline + sink.relative_deadline_ns, True)
        else:
            sink.numbers[kind] += 1
        if kind == SINK_OVERDUE:
            self.overdue[vertex, job] = deadline
        elif is_miss(kind):
            self._add_miss(vertex, job, deadline, time if kind == SINK_LATE else None)

    def add_results(self, parts: Iterable[tuple[Any, ...]]) -> None:
        """
        Count all results of a run at once.

        :param parts: some decisions each, as arrays: kind, vertex, job, deadline, and time.
        """
        import numpy as np
        sinks = sorted(self.sinks)
        responses: dict[int, list[Any]] = {v: [np.empty(0, dtype=np.int64)] for v in sinks}
        missed: dict[int, list[int]] = {v: [] for v in self.windows}
        for kind, vertex, job, deadline, time in parts:
            order = np.argsort(vertex, kind='stable')
            for v, mine in zip(sinks, np.split(order, np.searchsorted(vertex[order], sinks))[1:]):
                if not len(mine):
                    continue
                sink, done = self.sinks[v], mine[kind[mine] <= SINK_LATE]
                for each, count in enumerate(np.bincount(kind[mine]).tolist()):
                    sink.numbers[each] += count
                responses[v].append(time[done] - deadline[done] + sink.relative_deadline_ns)
                if v in missed:
                    missed[v] += job[mine[kind[mine] > SINK_IN_TIME]].tolist()
            misses = np.flatnonzero(kind > SINK_IN_TIME)
            first = misses[deadline[misses].argmin()] if len(misses) else None
            if first is not None and (
                    self.first_miss is None
                    or deadline[first] < self.first_miss['deadline_ns']):
                self.first_miss = self._miss(
                    int(vertex[first]), int(job[first]), int(deadline[first]),
                    int(time[first]) if kind[first] == SINK_LATE else None)
        for v, several in responses.items():
            sink, ordered = self.sinks[v], np.concatenate(several)
            several.clear()
            ordered.sort()
            if len(ordered):
                sink.shortest, sink.longest = int(ordered[0]), int(ordered[-1])
            sink.responses = memoryview(ordered)
        for v, jobs in missed.items():
            for each in sorted(jobs):
                self.windows[v].add(each)

    def _end_overdue(self, vertex: int, job: int) -> None:
        """Let the verdict of a sink replace its overdue state."""
        if self.overdue.pop((vertex, job), None) is not None:
            self.sinks[vertex].numbers[SINK_OVERDUE] -= 1

    def _add_miss(self, vertex: int, job: int, deadline: int, completed: int | None) -> None:
        if vertex in self.windows:
            self.windows[vertex].add(job)
        if self.first_miss is None or deadline < self.first_miss['deadline_ns']:
            self.first_miss = self._miss(vertex, job, deadline, completed)

    def _miss(
        self, vertex: int, job: int, deadline: int, completed: int | None
    ) -> FirstMiss:
        dag = self._dags[self._tables.dag_of[vertex]]
        return {'dag': dag.name, 'vertex': self.vertex_name(vertex), 'job': job,
                'deadline_ns': deadline, 'completed_ns': completed}

    def _first_of_all(self) -> FirstMiss | None:
        """Return the miss of the earliest deadline; overdue sinks without a verdict count."""
        first = self.first_miss
        for (vertex, job), deadline in self.overdue.items():
            if first is None or deadline < first['deadline_ns']:
                first = self._miss(vertex, job, deadline, None)
        return first

    def sinks_of(self, dag: Dag) -> dict[int, SinkTally]:
        """Return the results of the sinks of a DAG, by global vertex."""
        return {v: self.sinks[v] for v in self._sinks_of(dag.index)}

    def _sinks_of(self, dag: int) -> list[int]:
        first = self._tables.first_sink
        return [v for v in self._tables.sinks[first[dag]:first[dag + 1]] if v in self.sinks]

    def vertex_name(self, vertex: int) -> str:
        """Return the name of a global vertex."""
        return self._vertex(vertex).name

    def _vertex(self, vertex: int) -> Vertex:
        dag = self._dags[self._tables.dag_of[vertex]]
        return dag.vertices[self._tables.index_in_dag[vertex]]

    def tolerated(self, vertex: int) -> int:
        """Return how many misses a sink with a window tolerates in it."""
        tolerate = self._tolerate(vertex)
        return 0 if tolerate is None else tolerate.misses

    def _tolerate(self, vertex: int) -> WeaklyHard | None:
        return self._vertex(vertex).callback.tolerate if self._dags else None

    def _sink_result(self, vertex: int) -> SinkCounts:
        result = self.sinks[vertex].result()
        tolerate = self._tolerate(vertex)
        if tolerate is not None:
            result['tolerate'] = {
                'misses': tolerate.misses, 'of': tolerate.of,
                'worst': self.windows[vertex].worst_with(
                    job for v, job in self.overdue if v == vertex)}
        return result

    @property
    def missed(self) -> bool:
        """Return whether any deadline was missed."""
        return self.first_miss is not None or bool(self.overdue)

    def result(self) -> Verdicts:
        """Return the result format's verdicts: ``deadline_missed`` to ``dags``."""
        dags: dict[str, DagCounts] = {}
        for dag in self._dags:
            dags[dag.name] = {
                'jobs': self.jobs[dag.index],
                'ends': cast('JobEnds', {
                    OUTCOMES[e]: n for e, n in self.ends[dag.index].items()
                    if n or e != ABORTED}),
                'sinks': {self.vertex_name(v): self._sink_result(v)
                          for v in self.sinks_of(dag)}}
        return {'deadline_missed': self.missed, 'first_miss': self._first_of_all(),
                'never_due': never_due(dags), 'dags': dags}
