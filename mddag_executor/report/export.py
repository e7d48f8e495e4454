# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A recording for spreadsheets and data frames: one row per execution, or per job and sink.

Executions: a row is one run of a callback on a worker; a suspended coroutine has several,
``first`` marks the first. Undeclared callbacks have neither DAG nor job.

Jobs: a row is the verdict about one job at one sink: ``in_time``, ``late``, ``overdue`` (not
completed when the run ended past its deadline), ``expired``, ``failed`` or ``aborted``; the last
four have no completion.

Columns that end in ``_ns`` are integer nanoseconds: times on the recording's clock, or durations.
``start_s`` and ``release_s`` are seconds since the run's first release (or an earlier execution).
``reference_deadline_ns`` is the vertex's (RAD), ``slack_ns`` its remainder at the end. ``worker``
-1 is a spare thread in addition to the pool.

Rows are in the order of their releases; without release, of their ready times.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import csv
import io
from typing import Any, BinaryIO, NamedTuple

from mddag_executor.core.tally import VERDICTS
from mddag_executor.errors import MddagError
from mddag_executor.recording.frames import named, numbers
from mddag_executor.recording.tables import Ints, Mask, Recording, sort_by
from mddag_executor.replay import Replay
from mddag_executor.replay.usage import ran
from mddag_executor.report.text import printable
import numpy as np

_BATCH = 65_536


class Column(NamedTuple):
    """
    A column to export.

    :ivar values: numbers, or with ``names`` indices of names.
    :ivar known: which rows have a value; None: all.
    """

    name: str
    values: Any
    known: Mask | None = None
    names: Sequence[str] = ()


def executions(replay: Replay, rows: Ints | None = None) -> tuple[list[Column], Ints]:
    """Return the columns of executions (all, or these rows), and their rows of the table."""
    recording, judged = replay.recording, replay.judged
    rows = ran(recording.executions) if rows is None else rows
    release, known = _releases(replay, rows)
    ready = recording.executions['ready'][rows]
    order = sort_by(np.where(known, release, ready))
    rows, release, known = rows[order], release[order], known[order]
    table = recording.executions[rows]
    declared = table['vertex'] >= 0
    names = [vertex.name for vertex in recording.task_set.vertices]
    others, which = np.unique(table['callback'][~declared], return_inverse=True)
    vertex = table['vertex'].astype(np.int64)
    vertex[~declared] = len(names) + which
    names += [recording.who.name(each) for each in others.tolist()]
    start, end = table['start'], table['end']
    reference = release + np.array([*judged.tables.rad_offset[:-1], 0])[table['vertex']]
    first = table['piece'] == 0
    return [
        Column('dag', table['dag'], declared, [dag.name for dag in recording.task_set.dags]),
        Column('job', table['job'], declared), Column('vertex', vertex, None, names),
        Column('worker', table['worker']), Column('first', first),
        Column('start_s', _seconds(recording, start)), Column('release_ns', release, known),
        Column('ready_ns', table['ready']), Column('start_ns', start), Column('end_ns', end),
        Column('waiting_ns', start - table['ready'], first),
        Column('executing_ns', end - start), Column('reference_deadline_ns', reference, known),
        Column('slack_ns', reference - end, known)], rows


def _releases(replay: Replay, rows: Ints) -> tuple[Ints, Mask]:
    """Return the releases of the jobs of executions (rows), and which are known."""
    dags, vertex, job = (
        replay.recording.executions[name][rows] for name in ('dag', 'vertex', 'job'))
    release, known = np.zeros(len(rows), dtype=np.int64), np.zeros(len(rows), dtype=np.bool_)
    for dag, jobs_of in enumerate(replay.judged.jobs):
        mine = np.flatnonzero((dags == dag) & (vertex >= 0))
        row = jobs_of.rows_of(job[mine])
        mine, row = mine[row >= 0], row[row >= 0]
        release[mine], known[mine] = jobs_of.release[row], True
    return release, known


def jobs(replay: Replay) -> list[Column]:
    """Return the columns of the verdicts about jobs at sinks."""
    recording, verdicts = replay.recording, replay.judged.verdicts
    verdicts = verdicts[sort_by(verdicts['release'], verdicts['sink'])]
    completed = verdicts['completed']
    done = completed >= 0
    return [
        Column('dag', verdicts['dag'], None, [dag.name for dag in recording.task_set.dags]),
        Column('job', verdicts['job']),
        Column('sink', verdicts['sink'], None, [v.name for v in recording.task_set.vertices]),
        Column('release_s', _seconds(recording, verdicts['release'])),
        Column('release_ns', verdicts['release']), Column('deadline_ns', verdicts['deadline']),
        Column('completed_ns', completed, done),
        Column('response_ns', completed - verdicts['release'], done),
        Column('slack_ns', verdicts['deadline'] - completed, done),
        Column('verdict', verdicts['kind'], None, [VERDICTS[kind] for kind in sorted(VERDICTS)])]


def _seconds(recording: Recording, times: Ints) -> Any:
    return (times - (recording.start or 0)) / 1e9


# --- formats -------------------------------------------------------------------------------------

def write_csv(file: BinaryIO, columns: Sequence[Column]) -> None:
    """Write CSV (RFC 4180, UTF-8) with a header line; a missing value is an empty cell."""
    text = io.TextIOWrapper(file, 'utf-8', 'backslashreplace', newline='')
    writer = csv.writer(text)
    writer.writerow([column.name for column in columns])
    for begin in range(0, len(columns[0].values), _BATCH):
        writer.writerows(zip(*(_cells(column, begin) for column in columns)))
    text.flush()
    text.detach()


def _cells(column: Column, begin: int) -> Iterator[Any]:
    """Return some values as CSV cells; names are made harmless for terminals and spreadsheets."""
    values = column.values[begin:begin + _BATCH]
    if column.names:
        names = [_harmless(name) for name in column.names]
        found: Any = [names[place] for place in values.tolist()]
    elif values.dtype == np.bool_:
        found = ['true' if value else 'false' for value in values.tolist()]
    elif values.dtype == np.float64:
        found = [f'{value:.9f}' for value in values.tolist()]
    else:
        found = values.tolist()
    if column.known is None:
        return iter(found)
    known = column.known[begin:begin + _BATCH].tolist()
    return iter([value if there else None for value, there in zip(found, known)])


def _harmless(name: str) -> str:
    text = printable(name)
    return f"'{text}" if text[:1] in ('=', '+', '-', '@') else text


def arrow_table(columns: Sequence[Column]) -> Any:
    """Return columns as an Arrow table, names as dictionaries."""
    import pyarrow
    arrays = [
        named(column.values, column.names, column.known) if column.names else numbers(
            column.values.astype(np.int64) if column.values.dtype.kind == 'i' else column.values,
            column.known) for column in columns]
    return pyarrow.table(arrays, schema=pyarrow.schema([
        pyarrow.field(column.name, array.type, nullable=column.known is not None)
        for column, array in zip(columns, arrays)]))


def write_parquet(file: BinaryIO, columns: Sequence[Column]) -> None:
    """Write Parquet."""
    import pyarrow.parquet
    pyarrow.parquet.write_table(arrow_table(columns), file, compression='zstd')


def check_available(form: str) -> None:
    """Check that a format can be written, before long work starts."""
    if form not in ('parquet', 'tables'):
        return
    try:
        import pyarrow  # noqa: F401
    except ImportError as error:    # also of a version that needs a newer NumPy
        raise MddagError(
            f'-o *.{form}: pyarrow does not load ({" ".join(str(error).split())}): '
            "pip install 'mddag_executor[export]'") from None


def write(form: str, file: BinaryIO, replay: Replay, rows: str) -> None:
    """Write a recording's executions or jobs (``rows``) as csv or parquet, or all as pftrace."""
    if form == 'pftrace':
        from mddag_executor.report.perfetto import write_perfetto
        write_perfetto(file, replay)
    else:
        columns = executions(replay)[0] if rows == 'executions' else jobs(replay)
        {'csv': write_csv, 'parquet': write_parquet}[form](file, columns)
