# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Rows of a run for spreadsheets and data frames: one for each execution, or for each sink's job.

Theory of operation
-------------------
The exporter observes a replay and hands out rows while it goes on; what it keeps are the jobs that
are open and, because a callback may still run when its job has ended, the last few that were, and
executions that have ended until it is known what they completed.

Executions (``ExecutionRow``): a row is one run of a callback on a worker; a coroutine that was
suspended has several, ``first`` marks the first.  What no DAG declares has neither DAG nor job.

Jobs (``JobRow``): a row is the verdict about one job at one sink: ``in_time``, ``late``,
``overdue`` (not completed when the run ended past its deadline), ``expired``, ``failed`` or
``aborted``; the last four have no completion.

Columns that end in ``_ns`` are whole nanoseconds: times on the trace's clock, or durations.
``start_s`` and ``release_s`` are seconds since the run's first release (or execution, where one
came before).

Rows come in the order of their releases, what has no release by its readiness (``Ordered``).  The
exporter hands them out as they end, so as many as ``MOST_ORDERED`` are held back and sorted: a row
that ended after more than so many later ones stands where it ended.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
import csv
import heapq
import io
from typing import Any, BinaryIO, get_args, get_type_hints, NamedTuple

from mddag_executor.core import Tables
from mddag_executor.core.state import (
    Decision,
    DROP,
    JOB_END,
    SINK_COMPLETED,
)
from mddag_executor.core.tally import VERDICTS
from mddag_executor.errors import MddagError
from mddag_executor.replay import Replay
from mddag_executor.replay.computed import ComputedRun
from mddag_executor.replay.happenings import Observer, Piece
from mddag_executor.replay.judge import Judge
from mddag_executor.report.text import printable
from mddag_executor.report.timeline import no_names
from msg_graph import TaskSet

KEEP_ENDED = 4096
MOST_HELD = 1024
MOST_ORDERED = 65536
BATCH = 65536


class ExecutionRow(NamedTuple):
    """
    One run of a callback on a worker.

    ``reference_deadline_ns`` is the vertex's (RAD); ``slack_ns`` what was left of it at the end.
    ``worker`` -1 is a spare thread beside the pool.  ``waiting_ns`` is only in the first of
    several rows of one execution.
    """

    dag: str | None
    job: int | None
    vertex: str
    worker: int
    first: bool
    start_s: float
    release_ns: int | None
    ready_ns: int
    start_ns: int
    end_ns: int
    waiting_ns: int | None
    executing_ns: int
    reference_deadline_ns: int | None
    slack_ns: int | None


class JobRow(NamedTuple):
    """The verdict about one job at one sink."""

    dag: str
    job: int
    sink: str
    release_s: float
    release_ns: int
    deadline_ns: int
    completed_ns: int | None
    response_ns: int | None
    slack_ns: int | None
    verdict: str


class Ran(NamedTuple):
    """
    An execution to export.

    ``legs`` are those of its vertex that it completed (none: it was not its last piece, or never
    did), ``whole`` whether it completed the vertex, which then publishes.
    """

    row: ExecutionRow
    piece: Piece
    legs: tuple[int, ...] = ()
    whole: bool = False


class Target:
    """Where rows go; here: nowhere."""

    def begin(self, task_set: TaskSet, tables: Tables) -> None:
        """Begin with what the run is of."""

    def execution(self, ran: Ran) -> None:
        """Write an execution."""

    def verdict(self, row: JobRow, vertex: int) -> None:
        """Write a verdict; the vertex is the global index of the sink."""

    def finish(self) -> None:
        """Write what is left."""

    def abandon(self) -> None:
        """Write nothing more, after an error."""


class Exporter(Observer):
    """Makes rows of a replay that it watches."""

    def __init__(self, target: Target) -> None:
        self.target = target
        self._name_of: Callable[[int], str] = no_names
        self._jobs: dict[tuple[int, int], int] = {}
        # by vertex, job and ready time: what has ended, until it is known what it completed
        self._held: dict[tuple[int, int, int], Ran] = {}
        self._legs: dict[tuple[int, int], tuple[int, ...]] = {}
        self._completed: tuple[int, tuple[int, int, int]] | None = None
        self._ended: deque[tuple[int, int]] = deque()
        self._origin: int | None = None

    def of(self, replay: Replay) -> list[Observer]:
        """Export a replay: return the observers to come after the judge."""
        self._name_of = replay.run.who.name
        return self._begin(replay.task_set, replay.judge)

    def of_computed(self, run: ComputedRun) -> None:
        """Export a schedule that was computed."""
        judge = Judge(run.task_set, compare=False, judge_from=run.judge_from)
        run.play([judge, *self._begin(run.task_set, judge)])
        self.finish()

    def _begin(self, task_set: TaskSet, judge: Judge) -> list[Observer]:
        self._tables = judge.tables
        self._names = [vertex.name for vertex in task_set.vertices]
        self._dags = [dag.name for dag in task_set.dags]
        self.target.begin(task_set, judge.tables)
        return [self]

    def released(self, dag: int, job: int, release: int, now: int) -> None:
        """Open a job."""
        self._jobs[dag, job] = release
        if self._origin is None:
            self._origin = release

    def ran(
        self, callback: int, dag: int, vertex: int, job: int, worker: int, ready: int, start: int,
        end: int, first: int,
    ) -> None:
        """Make a row of an execution, and hand it out or hold it back."""
        self._hand_out_completed()
        piece = Piece(
            callback, dag, vertex, job, worker, ready, start, end, bool(first))
        release = self._jobs.get((dag, job)) if vertex >= 0 else None
        reference = None if release is None else release + self._tables.rad_offset[vertex]
        row = ExecutionRow(
            self._dags[dag] if vertex >= 0 else None, job if vertex >= 0 else None,
            self._names[vertex] if vertex >= 0 else self._name_of(callback), worker, bool(first),
            self._seconds(start), release, ready, start, end, start - ready if first else None,
            end - start, reference, None if reference is None else reference - end)
        if vertex < 0:
            self.target.execution(Ran(row, piece))
            return
        key = (vertex, job, ready)
        self._hand_out(key)     # a piece before it, of a coroutine
        self._held[key] = Ran(row, piece, self._legs.pop((vertex, job), ()))
        if len(self._held) > MOST_HELD:
            self._hand_out(next(iter(self._held)))

    def completed(
        self, dag: int, vertex: int, job: int, leg: int, whole: bool, end: int, ready: int,
        start: int, ended: int, busy: int, number: int, cpu: int, held: int,
    ) -> None:
        """Note what an execution completed; one may complete several legs, one after the other."""
        if self._completed is not None and self._completed[0] != number:
            self._hand_out_completed()
        if number < 0:      # of a simulated sync callback, which runs once for all legs
            self._legs[vertex, job] = (*self._legs.get((vertex, job), ()), leg)
            if len(self._legs) > MOST_HELD:
                del self._legs[next(iter(self._legs))]
            return
        key = (vertex, job, ready)
        ran = self._held.get(key)
        if ran is not None:
            self._held[key] = ran._replace(legs=(*ran.legs, leg), whole=bool(whole))
            self._completed = (number, key)

    def _hand_out_completed(self) -> None:
        if self._completed is not None:
            self._hand_out(self._completed[1])
            self._completed = None

    def _hand_out(self, key: tuple[int, int, int]) -> None:
        ran = self._held.pop(key, None)
        if ran is not None:
            self.target.execution(ran)

    def finish(self) -> None:
        """Hand out what is left, once the run is over."""
        for key in list(self._held):
            self._hand_out(key)
        self.target.finish()

    def _seconds(self, time: int) -> float:
        if self._origin is None:
            self._origin = time
        return (time - self._origin) / 1e9

    def decided(self, decisions: Sequence[Decision]) -> None:
        """Hand out verdicts."""
        for kind, dag, vertex, job, deadline, time in decisions:
            if kind == JOB_END:
                self._ended.append((dag, job))
                if len(self._ended) > KEEP_ENDED:
                    self._jobs.pop(self._ended.popleft(), None)
            elif kind != DROP:
                self._verdict(kind, dag, vertex, job, deadline, time)

    def _verdict(
        self, kind: int, dag: int, vertex: int, job: int, deadline: int, time: int
    ) -> None:
        release = deadline - self._tables.sink_deadline[vertex]
        completed = time if kind in SINK_COMPLETED else None
        self.target.verdict(JobRow(
            self._dags[dag], job, self._names[vertex], self._seconds(release), release, deadline,
            completed, None if completed is None else completed - release,
            None if completed is None else deadline - completed, VERDICTS[kind]), vertex)


class Ordered(Target):
    """
    A target that puts rows into the order of time, and passes them on.

    :param target: where to.
    :param execution: gives the time by which an execution comes.
    """

    def __init__(self, target: Target, execution: Callable[[ExecutionRow], int]) -> None:
        self._target = target
        self._execution = execution
        self._count = 0
        self._executions: list[tuple[int, int, Ran]] = []
        self._verdicts: list[tuple[int, int, int, tuple[JobRow, int]]] = []

    def begin(self, task_set: TaskSet, tables: Tables) -> None:
        """Begin with what the run is of."""
        self._target.begin(task_set, tables)

    def execution(self, ran: Ran) -> None:
        """Hold an execution back until its turn."""
        self._count += 1
        heapq.heappush(self._executions, (self._execution(ran.row), self._count, ran))
        if len(self._executions) > MOST_ORDERED:
            self._target.execution(heapq.heappop(self._executions)[-1])

    def verdict(self, row: JobRow, vertex: int) -> None:
        """Hold a verdict back until its turn."""
        self._count += 1
        heapq.heappush(self._verdicts, (row.release_ns, vertex, self._count, (row, vertex)))
        if len(self._verdicts) > MOST_ORDERED:
            self._target.verdict(*heapq.heappop(self._verdicts)[-1])

    def finish(self) -> None:
        """Pass on what is left."""
        for *_, ran in sorted(self._executions):
            self._target.execution(ran)
        for *_, verdict in sorted(self._verdicts):
            self._target.verdict(*verdict)
        self._target.finish()

    def abandon(self) -> None:
        """Write nothing more, after an error."""
        self._target.abandon()


def by_release(row: ExecutionRow) -> int:
    """Return the release of an execution's job, the readiness of what has none."""
    return row.ready_ns if row.release_ns is None else row.release_ns


def by_start(row: ExecutionRow) -> int:
    """Return when an execution started: so tracks are filled from the left."""
    return row.start_ns


class Rows(Target):
    """
    A target that writes rows of one kind.

    :param kind: of the rows: executions, or jobs.
    """

    def __init__(
        self, kind: type[ExecutionRow] | type[JobRow], writer: CsvWriter | ParquetWriter
    ) -> None:
        self._kind = kind
        self._writer = writer

    def execution(self, ran: Ran) -> None:
        """Write an execution."""
        if self._kind is ExecutionRow:
            self._writer.write(ran.row)

    def verdict(self, row: JobRow, vertex: int) -> None:
        """Write a verdict."""
        if self._kind is JobRow:
            self._writer.write(row)

    def finish(self) -> None:
        """Write what is left."""
        self._writer.end()

    def abandon(self) -> None:
        """Write nothing more, after an error."""
        self._writer.abandon()


class CsvWriter:
    """Writes rows as CSV (RFC 4180, UTF-8) below a line of titles; no value is an empty cell."""

    def __init__(self, file: BinaryIO, kind: type[ExecutionRow] | type[JobRow]) -> None:
        self._text = io.TextIOWrapper(file, 'utf-8', 'backslashreplace', newline='')
        self._writer = csv.writer(self._text)
        self._writer.writerow(kind._fields)

    def write(self, row: tuple[Any, ...]) -> None:
        """Write a row."""
        self._writer.writerow([_cell(value) for value in row])

    def end(self) -> None:
        """Leave the file to its owner."""
        self._text.flush()
        self._text.detach()

    def abandon(self) -> None:
        """Leave the file to its owner, without what is buffered."""


def _cell(value: Any) -> Any:
    """Return a value as CSV has it; a name is harmless for terminals and spreadsheets."""
    if isinstance(value, str):
        text = printable(value)
        return f"'{text}" if text[:1] in ('=', '+', '-', '@') else text
    if isinstance(value, bool):
        return 'true' if value else 'false'
    return f'{value:.9f}' if isinstance(value, float) else value


class ParquetWriter:
    """Writes rows as Parquet, names as dictionaries."""

    def __init__(self, file: BinaryIO, kind: type[ExecutionRow] | type[JobRow]) -> None:
        import pyarrow
        import pyarrow.parquet
        types = {str: pyarrow.string(), int: pyarrow.int64(), float: pyarrow.float64(),
                 bool: pyarrow.bool_()}
        fields = []
        for name, hint in get_type_hints(kind).items():
            kinds = get_args(hint) or (hint,)       # `int | None`
            fields.append(pyarrow.field(name, types[kinds[0]], nullable=len(kinds) > 1))
        self._schema: Any = pyarrow.schema(fields)
        self._arrow: Any = pyarrow
        self._batch: list[tuple[Any, ...]] = []
        self._writer: Any = pyarrow.parquet.ParquetWriter(
            file, self._schema, compression='zstd')

    def write(self, row: tuple[Any, ...]) -> None:
        """Write a row, some time."""
        self._batch.append(row)
        if len(self._batch) >= BATCH:
            self._flush()

    def _flush(self) -> None:
        if self._batch:
            columns = [self._arrow.array(column, type=field.type)
                       for column, field in zip(zip(*self._batch), self._schema)]
            self._writer.write_table(self._arrow.table(columns, schema=self._schema))
            self._batch.clear()

    def end(self) -> None:
        """Write what is left, and the footer."""
        self._flush()
        self._writer.close()

    def abandon(self) -> None:
        """Keep pyarrow from writing a footer when it is collected: the file is closed by then."""
        self._writer.is_open = False


def check_available(form: str) -> None:
    """Find out whether a format can be written, before long work starts."""
    module = {'parquet': 'pyarrow', 'pftrace': 'perfetto'}.get(form)
    if module is None:
        return
    try:
        __import__(module)
    except ModuleNotFoundError:
        raise MddagError(
            f'-o *.{form}: {module} is not installed: '
            "pip install 'mddag_executor[export]'") from None
    except ImportError as error:  # such as a pyarrow that wants a newer NumPy
        raise MddagError(
            f'-o *.{form}: {module} does not load: {" ".join(str(error).split())}: '
            'install versions that fit together') from None


def layout_of(target: Target) -> dict[str, Any]:
    """Return the layout that shows what was written for Foxglove."""
    from mddag_executor.report.foxglove import FoxgloveTarget
    assert isinstance(target, FoxgloveTarget)
    return target.layout


def target(form: str, file: BinaryIO, jobs: bool) -> Target:
    """Return what writes a format: ``csv``, ``parquet``, ``pftrace`` or ``mcap``."""
    kind = JobRow if jobs else ExecutionRow
    if form == 'csv':
        return Ordered(Rows(kind, CsvWriter(file, kind)), by_release)
    if form == 'parquet':
        return Ordered(Rows(kind, ParquetWriter(file, kind)), by_release)
    if form == 'mcap':
        from mddag_executor.report.foxglove import FoxgloveTarget
        return FoxgloveTarget(file)
    from mddag_executor.report.perfetto import PerfettoTarget
    return Ordered(PerfettoTarget(file), by_start)
