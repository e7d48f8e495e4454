# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A recording for spreadsheets and data frames (CSV, Parquet), and for Perfetto."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
import csv
import io
from pathlib import Path
from typing import Any, BinaryIO

from mddag_executor.analysis.as_recorded import Replay
from mddag_executor.analysis.result_table import result_tables
from mddag_executor.errors import MddagError
from mddag_executor.recording.frames import named, numbers
from mddag_executor.recording.tables import TABLES
from mddag_executor.report.columns import Column, executions, jobs
from mddag_executor.report.text import printable
import numpy as np

_BATCH = 65_536


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


TABLE_FORMS: dict[str, Callable[[BinaryIO, Sequence[Column]], None]] = {
    'csv': write_csv, 'parquet': write_parquet}
"""By form (the end of a file's name) what writes the executions or jobs of a recording."""
FORMS = ('pftrace', *TABLE_FORMS)


def table_files() -> frozenset[str]:
    """Return the names of the files that ``write_tables`` writes."""
    return frozenset(f'{name}.parquet' for name in (*TABLES, *result_tables()))


def write_tables(replay: Replay, folder: Path) -> None:
    """Write each table of a recording and of its results as a Parquet file into a folder."""
    import pyarrow.parquet
    for name in (*TABLES, *result_tables()):
        with (folder / f'{name}.parquet').open('wb') as file:
            pyarrow.parquet.write_table(replay.to_arrow(name), file, compression='zstd')


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
    """
    Write a recording in one of the ``FORMS``.

    :param rows: of a table: ``executions`` or ``jobs``; a pftrace has both.
    """
    if form == 'pftrace':
        from mddag_executor.report.perfetto import write_perfetto
        write_perfetto(file, replay)
    else:
        TABLE_FORMS[form](file, executions(replay)[0] if rows == 'executions' else jobs(replay))
