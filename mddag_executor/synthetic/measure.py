# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Measurement of synthetic nodes: the execution times of a run, and the figures from its ledger.

Theory of operation
-------------------
As in the paper's experiment, each vertex gets **one** execution time for the whole run, drawn from
its declared quantiles.  Then all of them are scaled by one factor to the requested normalised
utilisation, sum(C / T) / workers.  One such draw is one point of the experiment.  Whether its
deadlines can be met at all depends on the draw (``ExecutionPlan.infeasible``), so a figure
measured with one seed is valid for that seed only.

The nodes themselves write the ledger, so all executors are measured in the same way: each body
appends its duration, each sink appends (release, completion).  Appending to a list is one
indivisible step in CPython, so a callback locks nothing.  The ledger is closed after
``MOST_MEASURED_S``, so its memory is bounded (Autoware's: 2 MB a minute).

*Due* are the nominal releases (first release plus k periods) whose deadline lies inside the
measured window, whether or not the executor noticed them.  Of these a sink is *in time* when it
completed by its deadline, *late* when it completed after it, and *missing* when it has not
completed when the ledger is closed.  A release that an executor skipped, a lost message and a job
that still waits are all missing.  Releases not yet due at the window's end are not counted.

CPU for each callback is all CPU that the process used during the window (executor, middleware,
interpreter, publishing, emulation of short bodies), divided by the vertices that executed in it.
In ``spin`` mode the planned CPU time of the bodies is subtracted.  Legs of a sync callback that do
not complete the join are not counted as callbacks: their cost is overhead.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
import random
import time
from typing import Any, Literal, NamedTuple

from mddag_executor.clocks import epoch_offset_ns
from mddag_executor.core.tally import SinkTally
from mddag_executor.simulate.execution_times import draw_execution_times, scale_execution_times
from mddag_executor.simulate.execution_times import utilisation as normalised
from msg_graph import Dag, TaskSet, Vertex
from msg_graph.model import path_lengths

Body = Literal['sleep', 'spin', 'native']
Mode = Literal[Body, 'mixed']
BODIES: tuple[Body, ...] = ('sleep', 'spin', 'native')

WARM_UP_S = 1.0
"""The time from the start of the nodes to the window."""
MOST_MEASURED_S = 600.0
"""The longest window; a longer run goes on without being measured."""
_EARLY_NS = 1_000_000
"""How much before its nominal time a release may be noted, ns: clocks are read twice."""


class Infeasible(NamedTuple):
    """A sink whose critical path, its own time included, is longer than its deadline."""

    vertex: str
    critical_path_ns: int
    deadline_ns: int


class ExecutionPlan:
    """
    The execution time of each vertex for one run.

    :param task_set: the declared DAG tasks.
    :param seed: the same seed gives the same draw, on every machine and Python version.
    :param utilisation: normalised utilisation to scale to; None: the draw is not scaled.
    :param workers: the number of workers for normalisation.
    :param mode: the emulation: one of ``BODIES``, or ``mixed``, which draws it for each callback.
    :raises UsageError: when a utilisation is requested and no execution time is declared.
    """

    def __init__(
        self, task_set: TaskSet, seed: int = 0, utilisation: float | None = None,
        workers: int = 7, mode: Mode = 'sleep',
    ) -> None:
        self.seed = seed
        self.workers = workers
        self.mode: Mode = mode
        self.task_set = task_set
        self._times = draw_execution_times(task_set, seed, undeclared=0)
        if utilisation is not None:
            self._times = scale_execution_times(task_set, self._times, workers, utilisation)

    @property
    def utilisation(self) -> float:
        """Return the resulting normalised utilisation: sum(C / T) / workers."""
        return normalised(self.task_set, self._times, self.workers)

    def execution_ns(self, vertex: Vertex) -> int:
        """Return the execution time of a vertex, ns."""
        return self._times[vertex.dag][vertex.index]

    def body(self, vertex: Vertex) -> Body:
        """Return the emulation of a vertex."""
        if self.mode == 'mixed':
            return random.Random(f'{self.seed} {vertex.callback.key}').choice(BODIES)
        return self.mode

    def infeasible(self) -> list[Infeasible]:
        """Return the sinks that no scheduler can complete in time."""
        found = []
        for dag in self.task_set.dags:
            ends = path_lengths(dag, self._times[dag.index])
            for vertex in (dag.vertices[sink] for sink in dag.sinks):
                deadline = vertex.deadline_ns
                if deadline is not None and ends[vertex.index] > deadline:
                    found.append(Infeasible(vertex.name, ends[vertex.index], deadline))
        return found


class Reading(NamedTuple):
    """Counters at one instant: ns since the epoch, CPU of the process (ns), bodies run."""

    at_ns: int
    cpu_ns: int
    bodies: Sequence[int]


class Ledger:
    """
    The observations of a run of synthetic nodes.

    * ``durations``, by vertex: the duration of each body (ns).
    * ``completions``, by sink: (release, completion) in ns since the epoch.
    * ``delays``, by DAG whose source is a timer: its start, and the delay since its release.
    * ``first_release``, by DAG: ns since the epoch.
    * ``misattributed``: vertex name, release by the message and by the executor, if they differ.
    * ``unattributed``: the names of vertices that ran without a job.

    :ivar window: the readings at the beginning and the end of the measurement.
    :ivar is_open: whether observations are noted.
    """

    def __init__(self, task_set: TaskSet) -> None:
        self.durations: dict[str, list[int]] = {v.name: [] for v in task_set.vertices}
        self.completions: dict[str, list[tuple[int, int]]] = {
            v.name: [] for v in task_set.vertices if v.deadline_ns is not None}
        self.delays: dict[str, list[tuple[int, int]]] = {dag.name: [] for dag in task_set.dags}
        self.misattributed: list[tuple[str, int, int]] = []
        self.unattributed: list[str] = []
        self.first_release: dict[str, int] = {}
        self.is_open = False
        self.window = Reading(0, 0, ()), Reading(0, 0, ())
        self.clock_offset_ns = epoch_offset_ns()
        #: Executions up to this long were emulated busily, longer ones by sleep.
        self.busy_below_ns = 0
        #: The tolerance between two readings of one release: each process has its own trace clock.
        self.tolerance_ns = 0

    def note(self, entries: list[Any], entry: Any) -> None:
        """Add an observation, while the ledger is open; from any thread."""
        if self.is_open:
            entries.append(entry)

    def now(self) -> int:
        """Return the time, ns since the epoch."""
        return time.monotonic_ns() + self.clock_offset_ns

    def reading(self) -> Reading:
        """Read the counters now."""
        return Reading(self.now(), time.process_time_ns(),
                       [len(durations) for durations in self.durations.values()])


def measure(ledger: Ledger, plan: ExecutionPlan) -> dict[str, Any]:
    """
    Judge the results that were due in the window.

    :return: the figures of ``python -m benchmarks live --json`` (``sink_jobs_due``, ``on_time``,
        …, ``cpu_us_per_callback``), the window, and for each DAG and sink due, on_time, late,
        missing and the response times (completion minus nominal release, ns) of the completed.
    """
    start, end = ledger.window
    dags = {dag.name: {'sinks': {
        vertex.name: _judge(ledger, dag, vertex, start.at_ns, end.at_ns)
        for vertex in (dag.vertices[sink] for sink in dag.sinks)}} for dag in plan.task_set.dags}
    sums = totals([sink for dag in dags.values() for sink in dag['sinks'].values()])
    due = sums['sink_jobs_due']
    return {
        'mode': plan.mode, 'seed': plan.seed, 'workers': plan.workers,
        'utilisation': plan.utilisation, 'utilisation_taken': _measured_utilisation(ledger, plan),
        'window_ns': end.at_ns - start.at_ns, 'warm_up_ns': round(WARM_UP_S * 1e9), **sums,
        'on_time_ratio': sums['on_time'] / due if due else None,
        **_throughput(ledger, plan, start, end),
        'attribution': {
            'wrong': len(ledger.misattributed), 'none': len(ledger.unattributed)},
        'dags': dags}


def totals(sinks: Collection[Mapping[str, Any]]) -> dict[str, int]:
    """Return the sums of ``judge_sink``."""
    names = {'sink_jobs_due': 'due', 'on_time': 'on_time', 'late': 'late', 'missing': 'missing'}
    return {name: sum(sink[key] for sink in sinks) for name, key in names.items()}


def _judge(ledger: Ledger, dag: Dag, vertex: Vertex, start: int, end: int) -> dict[str, Any]:
    """Return one sink's verdicts about the deadlines within ]start, end]."""
    deadline, period = vertex.deadline_ns or 0, dag.period_ns
    first = ledger.first_release[dag.name]
    completed: dict[int, int] = {}
    for release, completion in ledger.completions[vertex.name]:
        job = (release - first + min(_EARLY_NS, period // 4)) // period
        completed.setdefault(first + job * period, completion)
    first_job = max(0, (start - deadline - first) // period + 1)
    due = range(first + first_job * period, end - deadline + 1, period)
    return judge_sink(deadline, due[:first_job == 0] if dag.once else due, completed)


def judge_sink(
    deadline: int, due: Sequence[int], completed: Mapping[int, int]
) -> dict[str, Any]:
    """Return the verdicts about a sink: ``due`` releases, and completions by release."""
    tally = SinkTally(deadline, None)
    for release in due:
        if release in completed:
            response = completed[release] - release
            tally.done(response, response > deadline)
    result = tally.result()
    return {
        'relative_deadline_ns': deadline, 'due': len(due),
        'on_time': result['completed'] - result['late'], 'late': result['late'],
        'missing': len(due) - result['completed'], 'response_ns': result['response_ns']}


def _throughput(
    ledger: Ledger, plan: ExecutionPlan, start: Reading, end: Reading
) -> dict[str, Any]:
    counts = [after - before for before, after in zip(start.bodies, end.bodies)]
    callbacks = sum(counts)
    # CPU time of the emulation itself is execution, not overhead.
    emulation = sum(
        count * planned for vertex, count in zip(plan.task_set.vertices, counts)
        if (planned := plan.execution_ns(vertex)) <= ledger.busy_below_ns
        or plan.body(vertex) != 'sleep')
    cpu_us = max(0, end.cpu_ns - start.cpu_ns - emulation) / 1000
    return {
        'callbacks': callbacks,
        'callbacks_per_s': callbacks / ((end.at_ns - start.at_ns) / 1e9),
        'cpu_us_per_callback': cpu_us / callbacks if callbacks else None}


def _measured_utilisation(ledger: Ledger, plan: ExecutionPlan) -> float:
    """
    Return the normalised utilisation from the measured mean times of the bodies.

    A vertex that never ran counts with its planned time, so a starving executor looks no better.
    """
    total = 0.0
    for vertex in plan.task_set.vertices:
        durations = ledger.durations[vertex.name] or [plan.execution_ns(vertex)]
        total += sum(durations) / len(durations) / plan.task_set.dags[vertex.dag].period_ns
    return total / plan.workers
