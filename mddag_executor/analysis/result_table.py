# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The results of a replay as tables: verdicts, chains, causes, usage and others.

Theory of operation
-------------------
1. A result table has a file of its own in ``analysis/tables``, with a ``ResultTable`` called
   ``TABLE``: its columns with meaning and unit, and the function that makes it.  Nothing else
   lists them: a new file is a new table of ``Replay.table``, ``to_arrow`` and ``to_pandas``, of
   ``mddag export -o FOLDER/`` and of docs/tables.md.
2. A function ``make`` gets a replay, with its recording, jobs and the other analyses.  It returns
   the declared columns, as in the tables of the recording: numbers for DAGs and vertices, integer
   nanoseconds, -1 for a time that is not known, and text where a name has no number.
3. Arrow and pandas get names instead of numbers, and null instead of an unknown value.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib import import_module
from typing import Any, NamedTuple, Protocol, TYPE_CHECKING

from mddag_executor.core.tally import VERDICTS
from mddag_executor.recording.columns import Table
from mddag_executor.recording.frames import arrow_of, named, numbers
from mddag_executor.recording.recording import Recording
import numpy as np

if TYPE_CHECKING:
    from mddag_executor.analysis.chains import Chains
    from mddag_executor.analysis.deadlines import Judged
    from mddag_executor.analysis.explain import Explanation
    from mddag_executor.analysis.paths import Paths
    from mddag_executor.analysis.requirements import Requirements
    from mddag_executor.analysis.usage import Usage
    from msg_graph import TaskSet

DAG, VERTEX = 'dag', 'vertex'
"""Columns with numbers of DAGs or vertices of the task set."""
VERDICT_NAMES = tuple(VERDICTS.get(kind, '') for kind in range(max(VERDICTS) + 1))
"""The names of verdicts, by number."""


class Replayed(Protocol):
    """What a table is made from: a recording and its analyses (``as_recorded.Replay``)."""

    recording: Recording
    task_set: TaskSet
    judged: Judged

    @property
    def chains(self) -> Chains:
        """Return the critical chains of jobs."""

    @property
    def usage(self) -> Usage:
        """Return how much time callbacks and workers used."""

    @property
    def explanation(self) -> Explanation:
        """Return the causes of missed deadlines."""

    @property
    def paths(self) -> Paths:
        """Return the flows along the declared paths."""

    @property
    def requirements(self) -> Requirements:
        """Return the verdicts about what is required of paths."""


class Column(NamedTuple):
    """
    A column of a result table.

    :ivar about: its meaning.
    :ivar unit: of its numbers, for instance ``ns``.
    :ivar names: whose numbers these are: ``DAG``, ``VERTEX``, or the names of all values.
    :ivar unknown: the value that means that there is none; None: there always is one.
    """

    about: str
    unit: str = ''
    names: str | Sequence[str] = ''
    unknown: int | None = None


class ResultTable(NamedTuple):
    """
    A table of results.

    :ivar row: what a row is: 'one row for each …'.
    :ivar make: returns the columns from a replay.
    """

    name: str
    row: str
    columns: Mapping[str, Column]
    make: Callable[[Replayed], Table]

    def table(self, replay: Replayed) -> Table:
        """Return the table, with its columns in the declared order."""
        return self.make(replay)[list(self.columns)]

    def to_arrow(self, replay: Replayed) -> Any:
        """Return it as an Arrow table, with names instead of numbers."""
        table = self.table(replay)
        return arrow_of(replay.recording.name, {
            name: (_array(replay.recording, column, table[name]), column.unit)
            for name, column in self.columns.items()})


def _array(recording: Recording, column: Column, values: Any) -> Any:
    """Return a column as an Arrow array."""
    known = None if column.unknown is None else values != column.unknown
    if values.dtype == object:
        names, codes = np.unique(values.astype(str), return_inverse=True)
        return named(codes, names.tolist(), values != '')
    if not column.names:
        return numbers(values, known)
    names_of: dict[str, Sequence[Any]] = {
        DAG: recording.task_set.dags, VERTEX: recording.task_set.vertices}
    texts = [each.name for each in names_of[column.names]] if isinstance(
        column.names, str) else list(column.names)
    return named(values, texts, known)


@cache
def result_tables() -> dict[str, ResultTable]:
    """Return the result tables by name."""
    import pkgutil

    from mddag_executor.analysis import tables
    found = [import_module(f'{tables.__name__}.{each.name}').TABLE
             for each in pkgutil.iter_modules(tables.__path__)]
    return {table.name: table for table in found}
