# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Measure any executor by what its callbacks did.

Theory of operation
-------------------
The nodes themselves write the ledger, so any executor can be measured with the same yardstick,
and an executor cannot embellish its figures: each body appends how long it took, each sink
appends (release, completion).  Appending to a list is one indivisible step in CPython, so no lock
is taken in a callback.

*Due* are the nominal releases (first release plus k periods) whose deadline lies inside the
measured window, whether or not the executor ever noticed them.  Of these a sink is *on time* when
it completed by its deadline, *late* when it completed after it, and *missing* when it has not
completed when the books are closed.  A release that an executor skipped, a message that got lost
and a job that still waits are all missing.  What was not yet due at the window's end is not
counted either way.

CPU for each callback is all CPU that the process took during the window (executor, middleware,
interpreter, publishing, emulation of short bodies), divided by the vertices that executed in it.
In ``spin`` mode the CPU that the bodies were to take is subtracted.  Legs of a sync callback
that do not complete the join are not counted as callbacks: their cost is overhead.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
import time
from typing import Any

from mddag_executor.clocks import epoch_offset_ns
from mddag_executor.core.tally import quantiles_us, SinkTally
from mddag_executor.live.execution import ExecutionPlan
from msg_graph import Dag, TaskSet, Vertex

_EARLY_NS = 1_000_000
"""How much before its nominal time a release may be noted: clocks are read twice (ns)."""


@dataclass(frozen=True)
class Reading:
    """What is counted at one instant: ns since the epoch, CPU of the process (ns), bodies run."""

    at_ns: int
    cpu_ns: int
    bodies: tuple[int, ...]


class Ledger:
    """
    Books about one run of synthetic nodes.

    ``durations[dag][vertex]`` takes how long each body took (ns), ``completions[dag][vertex]`` of
    a sink (release, completion) in ns since the epoch, ``delays[dag]`` by how much the source's
    body started after its release.  ``misattributed`` takes (vertex name, release by the message,
    release by the executor) where these differ, ``unattributed`` the names of vertices that ran as
    no job.

    :param keep: how much of each to keep, the last; None: all.
    """

    def __init__(self, task_set: TaskSet, keep: int | None = None) -> None:
        self.task_set = task_set
        self.durations: list[list[deque[int]]] = [
            [deque(maxlen=keep) for _ in d.vertices] for d in task_set.dags]
        self.completions: list[list[deque[tuple[int, int]]]] = [
            [deque(maxlen=keep) for _ in d.vertices] for d in task_set.dags]
        self.delays: list[deque[int]] = [deque(maxlen=keep) for _ in task_set.dags]
        self.misattributed: deque[tuple[str, int, int]] = deque(maxlen=keep)
        self.unattributed: deque[str] = deque(maxlen=keep)
        self.first_release: list[int | None] = [None for _ in task_set.dags]
        self.clock_offset_ns = epoch_offset_ns()
        #: Executions up to this long were emulated busily, longer ones by sleep.
        self.busy_below_ns = 0
        #: By so much the same release may differ: each process has a trace clock of its own.
        self.tolerance_ns = 0

    def reading(self) -> Reading:
        """Read the counters now."""
        return Reading(
            at_ns=time.monotonic_ns() + self.clock_offset_ns,
            cpu_ns=time.process_time_ns(),
            bodies=tuple(len(vertex) for dag in self.durations for vertex in dag))


@dataclass(frozen=True)
class Books:
    """The ledger of a run, the readings between which it is measured, the joins given up."""

    ledger: Ledger
    start: Reading
    end: Reading
    evicted_joins: int = 0

    def plain(self) -> dict[str, Any]:
        """Return what ``add`` takes of another process, as JSON has it."""
        return {
            **{name: [[list(vertex) for vertex in dag] for dag in getattr(self.ledger, name)]
               for name in ('durations', 'completions')},
            **{name: list(getattr(self.ledger, name))
               for name in ('misattributed', 'unattributed', 'first_release')},
            'delays': [list(delays) for delays in self.ledger.delays],
            'busy_below_ns': self.ledger.busy_below_ns, 'evicted_joins': self.evicted_joins,
            'start': asdict(self.start), 'end': asdict(self.end)}

    @classmethod
    def of_processes(cls, task_set: TaskSet, parts: Sequence[dict[str, Any]]) -> Books:
        """
        Return the books of a run from those of its processes (``plain``), of one at least.

        The window is that in which all of them measured; what each counted in its own, which is
        hardly another one, counts for its part of that.
        """
        ledger = Ledger(task_set)
        for part in parts:
            for name in ('durations', 'completions'):
                for dag, vertices in zip(getattr(ledger, name), part[name]):
                    for vertex, entries in zip(dag, vertices):
                        vertex.extend(entries)
            for delays, more in zip(ledger.delays, part['delays']):
                delays.extend(more)
            ledger.misattributed.extend(part['misattributed'])
            ledger.unattributed.extend(part['unattributed'])
            ledger.busy_below_ns = max(ledger.busy_below_ns, part['busy_below_ns'])
            for dag, first in enumerate(part['first_release']):
                if first is not None:
                    ledger.first_release[dag] = first
        begin = max(part['start']['at_ns'] for part in parts)
        until = max(begin, min(part['end']['at_ns'] for part in parts))
        cpu = 0
        bodies = [0] * len(task_set.vertices)
        for part in parts:
            first, last = Reading(**part['start']), Reading(**part['end'])
            share = (until - begin) / max(1, last.at_ns - first.at_ns)
            cpu += round((last.cpu_ns - first.cpu_ns) * share)
            for i, (before, after) in enumerate(zip(first.bodies, last.bodies)):
                bodies[i] += round((after - before) * share)
        return cls(ledger, Reading(begin, 0, (0,) * len(bodies)),
                   Reading(until, cpu, tuple(bodies)),
                   sum(part['evicted_joins'] for part in parts))


def measure(
    ledger: Ledger, plan: ExecutionPlan, start: Reading, end: Reading
) -> dict[str, Any]:
    """
    Judge what came due between two readings.

    :return: the figures of ``bench live --json`` (``sink_jobs_due``, ``on_time``, …,
        ``cpu_us_per_callback``), the window, and for each DAG and sink due, on_time, late,
        missing and the response times (completion minus nominal release, ns) of the completed.
    """
    dags: dict[str, Any] = {}
    totals = dict.fromkeys(('due', 'on_time', 'late', 'missing'), 0)
    for dag in ledger.task_set.dags:
        sinks = {}
        for index in dag.sinks:
            sink = _judge(ledger, dag, dag.vertices[index], start.at_ns, end.at_ns)
            sinks[dag.vertices[index].name] = sink
            for name in totals:
                totals[name] += sink[name]
        dags[dag.name] = {'sinks': sinks}
    due = totals['due']
    return {
        'mode': plan.mode, 'seed': plan.seed, 'workers': plan.workers,
        'utilisation': plan.utilisation, 'utilisation_taken': _taken(ledger, plan),
        'window_start_ns': start.at_ns, 'window_ns': end.at_ns - start.at_ns,
        'sink_jobs_due': due, 'on_time': totals['on_time'], 'late': totals['late'],
        'missing': totals['missing'],
        'on_time_ratio': totals['on_time'] / due if due else None,
        **_throughput(ledger, plan, start, end),
        'source_delay_us': quantiles_us([d for delays in ledger.delays for d in list(delays)]),
        'attribution': {
            'wrong': len(ledger.misattributed), 'none': len(ledger.unattributed)},
        'dags': dags}


def _judge(ledger: Ledger, dag: Dag, vertex: Vertex, start: int, end: int) -> dict[str, Any]:
    """Return one sink's verdicts about the deadlines within ]start, end]."""
    deadline, period = vertex.deadline_ns or 0, dag.period_ns
    first = ledger.first_release[dag.index]
    if first is None:
        return judge_sink(deadline, (), {})
    completed: dict[int, int] = {}
    for release, completion in list(ledger.completions[dag.index][vertex.index]):
        job = (release - first + min(_EARLY_NS, period // 4)) // period
        completed.setdefault(first + job * period, completion)
    first_job = max(0, (start - deadline - first) // period + 1)
    return judge_sink(
        deadline, range(first + first_job * period, end - deadline + 1, period), completed)


def judge_sink(
    deadline: int, due: Sequence[int], completed: Mapping[int, int]
) -> dict[str, Any]:
    """
    Return the verdicts about a sink.

    :param due: the releases of its jobs; ``completed``: when those completed, by release.
    """
    tally = SinkTally(deadline, None)
    for release in due:
        if release in completed:
            response = completed[release] - release
            tally.done(response, response > deadline)
    return {
        'relative_deadline_ns': deadline, 'due': len(due),
        'on_time': tally.completed - tally.late, 'late': tally.late,
        'missing': len(due) - tally.completed, 'response_ns': tally.result()['response_ns']}


def _throughput(
    ledger: Ledger, plan: ExecutionPlan, start: Reading, end: Reading
) -> dict[str, Any]:
    counts = [after - before for before, after in zip(start.bodies, end.bodies)]
    callbacks = sum(counts)
    cpu = end.cpu_ns - start.cpu_ns
    # CPU that the emulation itself takes is execution, not overhead.
    times = [plan.execution_ns(v.dag, v.index) for v in ledger.task_set.vertices]
    bodies = [plan.body(v) for v in ledger.task_set.vertices]
    cpu -= sum(n * t for v, (n, t) in enumerate(zip(counts, times))
               if bodies[v] != 'sleep' or t <= ledger.busy_below_ns)
    seconds = (end.at_ns - start.at_ns) / 1e9
    return {
        'callbacks': callbacks,
        'callbacks_per_s': callbacks / seconds if seconds > 0 else 0.0,
        'cpu_us_per_callback': max(0, cpu) / 1000 / callbacks if callbacks else None}


def _taken(ledger: Ledger, plan: ExecutionPlan) -> float:
    """
    Return the normalised utilisation from the mean times that the bodies really took.

    What never ran counts with its planned time, so a starving executor looks no better.
    """
    total = 0.0
    for vertex in ledger.task_set.vertices:
        durations = ledger.durations[vertex.dag][vertex.index]
        mean = sum(durations) / len(durations) if durations else plan.execution_ns(
            vertex.dag, vertex.index)
        total += mean / ledger.task_set.dags[vertex.dag].period_ns
    return total / plan.workers
