# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Replay rescheduled: the recorded load, scheduled again by the core.

The recorded load (see ``load``) is scheduled in virtual time.  Recorded ends of jobs don't matter,
only their releases, execution times, and the executor's times for noticing, dispatch and
transport.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, TYPE_CHECKING

from mddag_executor.analysis.as_recorded import recording_result, Replay
from mddag_executor.analysis.spans import crowded, Spans
from mddag_executor.analysis.usage import share
from mddag_executor.core import EXPIRE_AFTER_NS, NEVER, processes_of, Tables, Tally
from mddag_executor.core.tables import DEMOTE, ON_LATE
from mddag_executor.errors import UsageError
from mddag_executor.memory import give_back
from mddag_executor.recording.columns import Table
from mddag_executor.recording.head import Head, ReplayError
from mddag_executor.recording.joins import different, distinct
from mddag_executor.recording.recording import Recording
from mddag_executor.recording.tables import Columns, UNKNOWN
from mddag_executor.simulate import LogEntry, schedule, Settings
from mddag_executor.simulate.execution_times import with_execution_times
from mddag_executor.simulate.policies import ALL_POLICIES, preempts, ROS2
from mddag_executor.simulate.run import check
from mddag_executor.simulate.workload import SKIPPED
from mddag_executor.sources.open import Given, open_recording, undeclared
from mddag_executor.sources.progress import Progress
from mddag_executor.text import counted, listed
from mddag_executor.whatif.computed import ComputedRun
from mddag_executor.whatif.load import LoadBuilder, RecordedLoad
from msg_graph import EMPTY_TASK_SET, Process, TaskSet
from msg_graph.derive import gc_paused
from msg_graph.model import MOST_WORKERS
import numpy as np

if TYPE_CHECKING:
    from mddag_executor.results.replays import (
        PathsResult,
        RecordedRun,
        RecordedRunRare,
        RescheduleResult,
        RescheduleResultRare,
    )


class Reschedule:
    """
    The schedule of a recorded load.

    :param run: the recording; ``work``: its load.
    :param recorded: the replay as recorded; None: it was a bag.
    :ivar processes: nodes of each process; empty: one process.
    :ivar workers: of all processes.
    :ivar decisions: decisions of the core; ``busy``: by worker its busy time, ns.
    :ivar warnings: missing or doubtful data, one line each.
    """

    def __init__(
        self, run: Recording, work: RecordedLoad, tables: Tables, settings: Settings,
        warnings: list[str], skip: int, overheads: bool, processes: Sequence[Process],
        recorded: Replay | None,
    ) -> None:
        self.task_set, self._run, self.notes = run.task_set, run, run.run.notes
        self.work, self.tables, self.settings = work, tables, settings
        self.recorded, self.processes, self.warnings = recorded, processes, warnings
        self.workers = settings.workers
        self._skip, self._overheads = skip, overheads
        self.tally = Tally(run.task_set, tables)
        result = schedule(tables, work.load, settings)
        self.decisions, self.busy = result.decisions, result.busy
        result.count_into(self.tally, work.load, settings)

    @cached_property
    def log(self) -> Sequence[LogEntry]:
        """Return starts, ends and preemptions, on the recording's clock; runs the load again."""
        return schedule(self.tables, self.work.load, self.settings, log=True).log

    @property
    def worker_names(self) -> list[str]:
        """Return the names of workers, if they are more than a number."""
        return [f'{process.name} {w}' for process, workers in zip(
            self.processes, self.settings.pools) for w in range(workers)]

    @property
    def _requires(self) -> bool:
        return any(path.requirements for path in self.task_set.paths)

    @property
    def duration_ns(self) -> int:
        """Return the duration of the recording."""
        return max(0, self.settings.duration_ns - self._run.run.begin)

    @property
    def _scheduled_ns(self) -> int:
        """Return how long callbacks are scheduled: a part also has jobs of before its begin."""
        begin = self._run.run.begin
        return self.settings.duration_ns - min([begin, *self.work.load.times[:1]])

    def computed(self) -> ComputedRun:
        """Return the schedule as a computed run."""
        end = self.settings.duration_ns
        return ComputedRun(
            self.task_set, self.work.load, self.log, self.decisions, end, True,
            self.work.jobs, self.settings.judge_from, self._run.run.judged_releases,
            self.processes)

    @cached_property
    def _computed_replay(self) -> Replay:
        return Replay(self.computed().recording(self.workers))

    def table(self, name: str) -> Table:
        """Return a table of the computed run or of its results, as ``Replay.table`` does."""
        return self._computed_replay.table(name)

    def to_arrow(self, name: str) -> Any:
        """Return a table as an Arrow table, with names instead of numbers; see ``table``."""
        return self._computed_replay.to_arrow(name)

    def to_pandas(self, name: str) -> Any:
        """Return a table as a pandas data frame, with names instead of numbers; see ``table``."""
        return self._computed_replay.to_pandas(name)

    def result(self) -> RescheduleResult:
        """Return the result format of ``replay --json``, including the recorded run."""
        settings, work, verdicts = self.settings, self.work, self.tally.result()
        miss = verdicts['first_miss']
        if miss is not None:
            dag = self.task_set.dag(miss['dag']).index
            miss = {**miss, 'job': int(work.jobs[dag][miss['job']])}
        cpus: RescheduleResultRare = {}
        processes: RescheduleResultRare = {}
        skips: RescheduleResultRare = {}
        notes: RescheduleResultRare = {}
        required: PathsResult = {}
        if self._requires:
            required = self.computed().requirements()
        if settings.cpus is not None:
            cpus['cpus'] = settings.cpus
        if self.processes:
            processes['processes'] = [
                {'name': each.name, 'nodes': list(each.nodes), 'workers': workers}
                for each, workers in zip(self.processes, settings.pools)]
        if skipped := work.load.fates.count(SKIPPED):
            skips['skipped_jobs'] = skipped
        if self.notes:
            notes['notes'] = list(self.notes)
        return {
            'policy': settings.policy, 'on_late': settings.on_late, 'workers': self.workers,
            'preemptive': bool(settings.preemptive), **cpus, 'duration_ns': self.duration_ns,
            **processes, 'utilisation': share(work.demand, self.workers, self._scheduled_ns),
            **verdicts, 'first_miss': miss, 'rescheduled': True, 'skip_ns': self._skip,
            'executions': work.executions, 'estimated_executions': work.estimated, **skips,
            'overheads': {
                'included': self._overheads, 'added_ns': settings.dispatch_overhead_ns,
                'dispatch_median_ns': work.dispatch_ns,
                'transport_median_ns': work.transport_ns},
            'worker_use': {
                'busy_ns': {str(w): took for w, took in enumerate(self.busy)},
                'use': share(sum(self.busy), self.workers, self._scheduled_ns)},
            'recorded': self._recorded_result(),
            **required,
            'recording': recording_result(self._run), **notes, 'warnings': self.warnings}

    def _recorded_result(self) -> RecordedRun | None:
        """Return the verdicts about the recorded run; None: it was a bag."""
        if self.recorded is None:
            return None
        more: RecordedRunRare = {}
        if self._requires:
            more['requirements'] = self.recorded.requirements.result()
        return {
            'policy': self.recorded.recording.run.head.policy,
            'workers': self.recorded.recording.run.head.workers, **self.recorded.tally.result(),
            **more}


def reschedule(
    path: Given | Recording | Callable[[], Recording],
    task_set: TaskSet | None = None,
    *,
    policy: str | None = None,
    workers: int | Mapping[str, int] | None = None,
    preemptive: bool | None = None,
    on_late: str | None = None,
    overheads: bool = True,
    dispatch_overhead: int = 0,
    name: str | None = None,
    progress: Progress | None = None,
    skip: int = 0,
    cpus: int | None = None,
    processes: Callable[[TaskSet, list[list[int]]], Sequence[Process]] | None = None,
    times: Callable[[Recording], Sequence[Any]] | None = None,
) -> Reschedule:
    """
    Run the core with the releases and execution times of a trace.

    :param path: a trace of this executor, a recording, or a function that reads one.
    :param task_set: the declaration to schedule by; None: the one in the trace.
    :param policy: a row of ``mddag_executor.simulate.ALL_POLICIES``; None: as recorded.
    :param workers: size of the pool of each process, or by the name of a process that of this
        one; otherwise as recorded: of callbacks of several recorded processes the largest one.
    :param preemptive: whether a smaller key preempts a larger one; None: as recorded, if the
        policy supports it.
    :param on_late: handling of late jobs of a DAG that does not declare it; None: as recorded.
    :param overheads: whether noticing, dispatch and transport take their recorded times, or none.
    :param dispatch_overhead: added to each execution, ns.
    :param name: the trace's name in messages, if not its path.
    :param progress: called regularly with the number of events read.
    :param skip: warm-up time after the first release; jobs released in it are not judged, ns.
    :param cpus: shared by executions that compute; None: as recorded, enough for all if unknown.
    :param processes: returns the nodes of each process, from the task set and the time of each
        vertex; None: as recorded, or as in ``task_set``.
    :param times: returns by DAG the execution times of its jobs and vertices, ns, for a recording
        without executions.
    :raises mddag_executor.trace.TraceError: if the file is not a trace.
    :raises mddag_executor.ReplayError: if the trace has nothing to replay, none of the
        declaration's callbacks; or if it is an ordinary bag, and an execution time is not
        declared.
    :raises mddag_executor.errors.MddagError: for an invalid policy, number of workers or CPUs, or
        overhead.
    """
    changes = Changes(
        policy, workers, preemptive, on_late, overheads, dispatch_overhead, cpus, processes)
    recording = path if isinstance(path, Recording) else path() if callable(path) else (
        open_recording(path, task_set, name, progress))
    observed = Observed(recording, skip, None if times is None else times(recording))
    del recording   # of a bag only the load is needed
    return observed.reschedule(changes)


@dataclass(frozen=True)
class Changes:
    """
    The parameters of a schedule, as those of ``reschedule``; None: as recorded.

    :raises mddag_executor.errors.MddagError: for an invalid policy, number of workers or CPUs, or
        overhead.
    """

    policy: str | None = None
    workers: int | Mapping[str, int] | None = None
    preemptive: bool | None = None
    on_late: str | None = None
    overheads: bool = True
    dispatch_overhead: int = 0
    cpus: int | None = None
    processes: Callable[[TaskSet, list[list[int]]], Sequence[Process]] | None = None

    def __post_init__(self) -> None:
        if self.policy is not None:
            preempts(self.policy, self.preemptive or False)
        pools = (self.workers,) if isinstance(self.workers, int) else tuple(
            (self.workers or {}).values())
        check(Settings(
            pools=pools or Settings.pools, cpus=self.cpus,
            dispatch_overhead_ns=self.dispatch_overhead))


class Observed:
    """
    The load and the verdicts of a recording, of which schedules are made.

    :param skip: warm-up time after the first release; jobs released in it are not judged, ns.
    :param times: by DAG the execution times of its jobs and vertices, ns, for a recording without
        executions.
    """

    def __init__(
        self, recording: Recording, skip: int = 0, times: Sequence[Any] | None = None
    ) -> None:
        if recording.task_set is EMPTY_TASK_SET:
            raise undeclared(recording.name, recording.run.imported)
        self._run, self._skip = recording, skip
        self._recorded = Replay(recording, skip) if recording.run.messages is None else None
        placed = recording.run.placed
        with gc_paused():
            self._builder: LoadBuilder | None = LoadBuilder(
                recording, Tables.build(recording.task_set), recorded_workers(recording, placed),
                _processes(recording, placed), times)
        give_back()

    def reschedule(self, changes: Changes, *, again: bool = False) -> Reschedule:
        """
        Return a schedule of the recorded load.

        :param again: whether another schedule will be made; otherwise the load is used up, which
            takes less memory.
        """
        run, skip, recorded, builder = self._run, self._skip, self._recorded, self._builder
        assert builder is not None, 'the load is used up'
        self._builder = copy(builder) if again else None
        head = run.run.head
        policy = _policy(head, run.name, changes.policy)
        cpus, preemptive, on_late = changes.cpus, changes.preemptive, changes.on_late
        if cpus is None:
            cpus = head.cpus if head.cpus > 0 else None
        if preemptive is None:
            preemptive = head.preemptive and policy != ROS2
        if on_late is None:     # any other number is damage
            on_late = next((name for name, n in ON_LATE.items() if n == head.on_late), 'continue')
        tables_of = partial(
            Tables.build, default_deadline=head.default_deadline, on_late=on_late,
            max_active_jobs=head.max_active_jobs if head.max_active_jobs > 0 else NEVER,
            expire_after=EXPIRE_AFTER_NS)
        tables = tables_of(run.task_set)
        placed = _placed(run, builder) if changes.processes is None else changes.processes(
            run.task_set, builder.times())
        if len(placed) < 2:
            placed = ()
        if DEMOTE in tables.on_late:  # by measured times, as the executor does
            tables = tables_of(with_execution_times(run.task_set, builder.times()))
        tables = tables._replace(process=[*_processes(run, placed), 1])
        pools = _pools(run, placed, changes.workers)
        notes = []
        if changes.policy is None and len(placed) > 1 and policy == ROS2:
            notes.append(
                f'{run.name}: rescheduled with policy fifo, because {policy} (polling) is known '
                'of one process only: choose another with --policy')
            policy = 'fifo'
        preempts(policy, preemptive, len(placed))
        with gc_paused():
            work = builder.build(changes.overheads, tables.process, pools)
        tables = with_groups(
            tables, builder.callback_of, run.exclusive_groups(), declared_first=not run.run.same)
        left_out = builder.left_out
        del builder     # the load has copies of its data
        if recorded is None:    # of a bag only the load is needed
            run = self._run = replace(run, columns=Columns())
        give_back()
        if work.silent and recorded is None:
            raise ReplayError(
                run.name, 'it has no execution times, and none is declared for '
                f'{counted(len(work.silent), "callback")}: {listed(work.silent)}',
                'give a GRAPH that declares it')
        judge_from = run.run.begin + skip if skip else -NEVER
        begin, judge_until = run.run.judged_releases or (-NEVER, NEVER)
        warnings = run.missing.lines()
        if recorded is not None:
            warnings, judge_from = recorded.warnings, recorded.judged.judge_from
        warnings = [*warnings, *notes, *self._doubts(work, left_out, cpus)]
        settings = Settings(
            policy, pools, run.end, preemptive, dispatch_overhead_ns=changes.dispatch_overhead,
            cpus=cpus, judge_from=max(begin, judge_from), judge_until=judge_until,
            on_late=on_late)
        with gc_paused():
            return Reschedule(
                run, work, tables, settings, warnings, skip, changes.overheads, placed, recorded)

    def _doubts(self, work: RecordedLoad, left_out: int, cpus: int | None) -> Iterator[str]:
        """
        Yield a warning for each part of the load that is not recorded.

        :param left_out: number of runs of undeclared callbacks in other processes.
        """
        run = self._run
        if work.elsewhere:
            yield (
                f'{run.name}: {counted(len(work.elsewhere), "callback")} ran where nothing was '
                f'recorded, so in what-ifs they take no time: {listed(work.elsewhere)}')
        if work.silent:
            yield (
                f'{run.name}: {counted(len(work.silent), "callback")} never ran in it, and no '
                f'execution_time is declared, so what-ifs leave out: {listed(work.silent)}')
        if left_out:
            yield (
                f'{run.name}: {counted(left_out, "run")} of undeclared callbacks in processes of '
                'declared ones take no time: declare them, as mddag graph from-trace does')
        if cpus is not None and run.run.declared and work.executions and not len(
                work.load.computed):
            yield (
                f'{run.name}: CPU times are not recorded in it, so with --cpus each '
                'execution computes all the time')
        waited = set(run.executions['vertex'][run.executions['piece'] > 0].tolist()) - {UNKNOWN}
        if waited and not run.run.head.preemptive:
            yield (
                f'{run.name}: the time in which coroutines waited is left out: '
                + listed(sorted({run.task_set.vertices[v].callback.key for v in waited})))
        if stepping := _stepping(run):
            yield (
                f'{run.name}: the time in which programs did not spin is left out, as if they '
                f'ran callbacks all the time: {listed(stepping)}')


def _stepping(run: Recording) -> list[str]:
    """
    Return the declared callbacks that waited until something spun, for 1 % of the time.

    Those that still waited at the end of the run do not count: the load lacks them anyway.  Nor
    does the time in which their program ran others, which the schedule has too.
    """
    found: set[str] = set()
    table = run.executions
    least = (run.end - (run.start or run.end)) / 100
    for closed in run.closed_times():
        rows = np.flatnonzero(closed.executions & (table['vertex'] >= 0) & (
            table['piece'] == 0) & (table['worker'] >= 0))
        every, behind_others = (Spans(*crowded(*times, 1)).within(
            table['ready'][rows], table['start'][rows]) for times in (closed.times, closed.runs))
        waited = every - behind_others
        if waited.sum() > least:
            found.update(run.task_set.vertices[vertex].callback.key
                         for vertex in distinct(table['vertex'][rows[waited > 0]]).tolist())
    return sorted(found)


def _processes(run: Recording, placed: Sequence[Process]) -> list[int]:
    return processes_of(replace(run.task_set, processes=tuple(placed)))


def _placed(run: Recording, builder: LoadBuilder) -> Sequence[Process]:
    """
    Return the processes of a recording, or of another declaration that judges it.

    The trace of one of several processes only has the callbacks of that process.
    """
    declared = run.task_set.processes
    if run.run.placed:
        return declared or run.run.placed
    vertices = run.task_set.vertices
    ran = {run.task_set.process_of(vertices[v].callback.node) for v in builder.callback_of}
    return declared if len(ran) == 1 or not run.run.same else ()


def recorded_workers(run: Recording, placed: Sequence[Process]) -> tuple[int, ...]:
    """
    Return the workers of each process, at least of one.

    They are those of the recorded process in which its callbacks ran, or of the largest of them.
    """
    if len(placed) < 2:
        return (run.run.workers_each,)
    table = run.executions
    table = table[table['worker'] >= 0]
    recorded, which = different(table['process'])
    own = run.run.own_processes
    counts = [own.get(number) or len(distinct(table['worker'][which == place]))
              for place, number in enumerate(recorded.tolist())]
    of_vertex = np.array([*_processes(run, placed), 0], dtype=np.int64)[table['vertex']]
    found = []
    for number in range(1, len(placed) + 1):
        mine = distinct(which[of_vertex == number]).tolist()
        found.append(max((counts[each] for each in mine), default=run.run.workers_each))
    return tuple(found)


def _pools(
    run: Recording, placed: Sequence[Process], given: int | Mapping[str, int] | None
) -> tuple[int, ...]:
    """Return the workers of each process as requested, otherwise as recorded."""
    if isinstance(given, int):
        return (given,) * max(1, len(placed))
    names = [process.name for process in placed]
    for name in given or ():
        if not names:
            raise UsageError(f'--workers: {name}: there is one process: give a number alone')
        if name not in names:
            raise UsageError(f'--workers: there is no process {name}: name one of {listed(names)}')
    recorded = recorded_workers(run, placed)
    if given:
        recorded = tuple(given.get(name, n) for name, n in zip(names, recorded))
    for workers in recorded:
        if not 1 <= workers <= MOST_WORKERS:
            raise ReplayError(
                run.name, f'it says that it was recorded with {counted(workers, "worker")}',
                'give --workers')
    return recorded


def _policy(head: Head, name: str, policy: str | None) -> str:
    """Return the policy as requested, otherwise as recorded."""
    if policy is None:
        policy = head.policy
        if policy not in ALL_POLICIES:
            raise ReplayError(
                name, f"it was recorded with policy '{policy}', which this version does not have",
                f'give --policy, one of {", ".join(ALL_POLICIES)}')
    return policy


def with_groups(
    tables: Tables, callback_of: dict[int, int], groups: dict[int, int], declared_first: bool
) -> Tables:
    """
    Return tables with the callback groups of the recording.

    :param callback_of: by global vertex the callback that ran as it.
    :param groups: by callback its group in the recording, -1 for a reentrant one.
    :param declared_first: whether declared groups have priority over recorded ones.
    """
    numbers: dict[tuple[bool, int], int] = {}
    column = []
    for vertex, declared in enumerate(tables.group):
        recorded = groups.get(callback_of.get(vertex, 0))
        if recorded is None or (declared_first and declared >= 0):
            choice = (False, declared)
        else:
            choice = (True, recorded)
        column.append(-1 if choice[1] == -1 else numbers.setdefault(choice, len(numbers)))
    return tables._replace(group=column, n_groups=len(numbers))
