# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The newest ``/diagnostics`` of executors, and tables of them.

The statuses are those of ``mddag_executor.executor.diagnostics``; others on the topic are ignored.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import time
from typing import Any, NamedTuple

from mddag_executor.report.text import format_ns, printable, table

LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')
GONE = 'GONE'
GONE_AFTER_S = 5.0
MOST_STATUSES = 1000


class Column(NamedTuple):
    """
    A column of a table: its title, and the field or the value of a status that it shows.

    :ivar unit: ``ms`` or ``%`` (the value is a share), or empty.
    """

    title: str
    key: str
    unit: str = ''


# The most important columns first: on a narrow terminal the last ones are left out.
_DAG_COLUMNS = (
    Column('DAG', 'name'), Column('state', 'level'), Column('results', 'window_results'),
    Column('missed', 'window_missed'), Column('p99', 'response_p99_ms', 'ms'),
    Column('of deadline', 'deadline_used_max', '%'), Column('p50', 'response_p50_ms', 'ms'),
    Column('max', 'response_max_ms', 'ms'), Column('jobs', 'jobs'),
    Column('period', 'period_ms', 'ms'), Column('least margin', 'margin_min_ms', 'ms'),
    Column('demoted', 'demoted'), Column('worst window', 'worst_window'))
_POOL_COLUMNS = (
    Column('workers of', 'name'), Column('state', 'level'), Column('busy', 'busy_ratio', '%'),
    Column('CPU', 'cpu_ratio', '%'), Column('idle', 'idle_workers'), Column('queue', 'queue'),
    Column('dropped', 'dropped'), Column('per s', 'callbacks_per_s'),
    Column('us each', 'cpu_us_per_callback'), Column('compute', 'computing'),
    Column('skipped', 'skipped'), Column('no job', 'unattributed'))
_MESSAGE = Column('message', 'message')
_PROCESS = Column('process', 'process')
_WORDS = ('process', 'name', 'level', 'message')
_LEAST = 3          # minimum number of columns
_MOST_MESSAGES = 5  # messages of statuses that are not OK, below the tables


@dataclass(frozen=True)
class Status:
    """A received status: process, name, level, message, values, and time of arrival (s)."""

    process: str
    name: str
    level: str
    message: str
    values: dict[str, str]
    came: float

    @property
    def is_pool(self) -> bool:
        """Return whether it is about the workers, not a DAG."""
        return 'idle_workers' in self.values

    @property
    def is_ours(self) -> bool:
        """Return whether an executor of this project has sent it."""
        return self.is_pool or 'window_missed_ratio' in self.values


class Board:
    """The newest statuses of all processes, at most a thousand."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._statuses: dict[tuple[str, str], Status] = {}

    def take(self, message: Any) -> None:
        """Add a ``DiagnosticArray``."""
        now = self._clock()
        for each in message.status:
            level = each.level[0] if isinstance(each.level, bytes) else int(each.level)
            status = Status(
                each.hardware_id, each.name, LEVELS[level] if level < len(LEVELS) else str(level),
                each.message, {pair.key: pair.value for pair in each.values}, now)
            if status.is_ours:
                # At the end, so that the first status is the oldest one.
                self._statuses.pop((status.process, status.name), None)
                self._statuses[(status.process, status.name)] = status
                if len(self._statuses) > MOST_STATUSES:
                    del self._statuses[next(iter(self._statuses))]

    def statuses(self) -> list[Status]:
        """Return the statuses by process and name; those of silent processes are GONE."""
        now = self._clock()
        found = []
        for _, s in sorted(self._statuses.items()):
            if now - s.came > GONE_AFTER_S:
                s = Status(s.process, s.name, GONE, f'nothing heard for {now - s.came:.0f} s',
                           s.values, s.came)
            found.append(s)
        return found

    def result(self) -> dict[str, Any]:
        """Return the statuses for JSON."""
        return {'statuses': [
            {'process': s.process, 'name': s.name, 'level': s.level, 'message': s.message,
             'values': s.values} for s in self.statuses()]}


def of_dags(statuses: list[Status]) -> list[Status]:
    """Return the statuses of DAGs: one list for all processes, DAG by DAG."""
    return sorted((s for s in statuses if not s.is_pool), key=lambda s: (s.name, s.process))


def of_pools(statuses: list[Status]) -> list[Status]:
    """Return the statuses of workers."""
    return [s for s in statuses if s.is_pool]


def _cell(status: Status, column: Column) -> str:
    """Return the cell of a status in a column."""
    if column.key == 'name' and status.is_pool:
        return printable(status.name.rpartition(': ')[0] or status.name)
    if column.key in _WORDS:
        return printable(getattr(status, column.key))
    value = status.values.get(column.key) or '-'
    try:
        number = float(value)
        if column.unit == '%':
            return f'{100 * number:.0f} %'
        if column.unit == 'ms':
            return format_ns(round(number * 1e6), 3)
        return f'{number:.0f}'
    except (ValueError, OverflowError):
        return printable(value)     # no number


def columns_that_fit(
    columns: Sequence[Column], rows: Sequence[Status], width: int
) -> list[Column]:
    """Return the columns that fit on a terminal; the process only if there are several."""
    kept = [*([_PROCESS] if len({s.process for s in rows}) > 1 else []), *columns]

    def needed(column: Column) -> int:
        return max(len(column.title), *(len(_cell(s, column)) for s in rows), 0)

    while len(kept) > _LEAST and sum(needed(column) + 2 for column in kept) - 2 > width:
        kept.pop()
    return kept


def tables(statuses: list[Status], width: int | None = None) -> str:
    """
    Return the tables of DAGs and workers.

    :param width: of a terminal: only the columns that fit, and the messages below; None: all.
    """
    parts = []
    for every, rows in ((_DAG_COLUMNS, of_dags(statuses)), (_POOL_COLUMNS, of_pools(statuses))):
        columns = [_PROCESS, *every, _MESSAGE]
        if width is not None:
            columns = columns_that_fit(every, rows, width)
        parts.append(table(
            [column.title for column in columns],
            ([_cell(s, column) for column in columns] for s in rows),
            marked=[width is not None and s.level not in ('OK', GONE) for s in rows],
            most=width))
    if width is not None:
        parts.append(''.join(
            printable(f'{s.level} {s.name}: {s.message}')[:width] + '\n'
            for s in [s for s in statuses if s.level != 'OK'][:_MOST_MESSAGES]))
    return '\n'.join(parts)
