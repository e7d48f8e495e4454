# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The newest ``/diagnostics`` of executors, and tables of them.

The statuses are those of ``mddag_executor.executor.diagnostics``; others on the topic are ignored.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import time
from typing import Any, NamedTuple

from mddag_executor.report.text import format_ns, printable, table

LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')
GONE = 'GONE'
GONE_AFTER_S = 5.0
MOST_STATUSES = 1000


# The key of each column by its title. The most important columns come first: on a narrow terminal
# the last ones are left out.
_DAG_COLUMNS = {
    'DAG': 'name', 'state': 'level', 'results': 'window_results', 'missed': 'window_missed',
    'p99': 'response_p99_ms', 'of deadline': 'deadline_used_max', 'p50': 'response_p50_ms',
    'max': 'response_max_ms', 'jobs': 'jobs', 'period': 'period_ms',
    'least margin': 'margin_min_ms', 'demoted': 'demoted', 'worst window': 'worst_window'}
_POOL_COLUMNS = {
    'workers of': 'name', 'state': 'level', 'busy': 'busy_ratio', 'CPU': 'cpu_ratio',
    'idle': 'idle_workers', 'queue': 'queue', 'dropped': 'dropped', 'per s': 'callbacks_per_s',
    'us each': 'cpu_us_per_callback', 'compute': 'computing', 'lost': 'lost', 'skipped': 'skipped',
    'no job': 'unattributed'}
_PROCESS, _MESSAGE = {'process': 'process'}, {'message': 'message'}
_SHARES = ('deadline_used_max', 'busy_ratio', 'cpu_ratio')
_LEAST = 3          # minimum number of columns
_MOST_MESSAGES = 5  # messages of statuses that are not OK, below the tables


class Status(NamedTuple):
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
        return [
            s if now - s.came <= GONE_AFTER_S else s._replace(
                level=GONE, message=f'nothing heard for {now - s.came:.0f} s')
            for _, s in sorted(self._statuses.items())]

    def result(self) -> dict[str, Any]:
        """Return the statuses for JSON."""
        return {'statuses': [
            {key: value for key, value in s._asdict().items() if key != 'came'}
            for s in self.statuses()]}


def tables(statuses: list[Status], width: int | None = None) -> str:
    """
    Return the tables of DAGs (one for all processes) and workers.

    :param width: of a terminal: only the columns that fit, and the messages below; None: all.
    """
    dags = sorted((s for s in statuses if not s.is_pool), key=lambda s: (s.name, s.process))
    pools = [s for s in statuses if s.is_pool]
    parts = [_table(columns, rows, width) for columns, rows in (
        (_DAG_COLUMNS, dags), (_POOL_COLUMNS, pools)) if rows]
    if width is not None:
        parts.append(''.join(
            printable(f'{s.level} {s.name}: {s.message}')[:width] + '\n'
            for s in [s for s in statuses if s.level != 'OK'][:_MOST_MESSAGES]))
    return '\n'.join(parts)


def _table(keys: dict[str, str], rows: Sequence[Status], width: int | None) -> str:
    """Return a table; on a terminal it has the process only if there are several."""
    if width is None:
        keys = {**_PROCESS, **keys, **_MESSAGE}
    elif len({s.process for s in rows}) > 1:
        keys = {**_PROCESS, **keys}
    columns = [[title, *(_cell(s, key) for s in rows)] for title, key in keys.items()]
    while width is not None and len(columns) > _LEAST and sum(
            max(map(len, column)) + 2 for column in columns) - 2 > width:
        columns.pop()
    header, *body = zip(*columns)
    return table(header, body, most=width,
                 marked=[width is not None and s.level not in ('OK', GONE) for s in rows])


def _cell(status: Status, key: str) -> str:
    if key == 'name' and status.is_pool:
        return printable(status.name.rpartition(': ')[0] or status.name)
    if key in Status._fields:
        return printable(getattr(status, key))
    value = status.values.get(key) or '-'
    try:
        number = float(value)
        if key in _SHARES:
            return f'{100 * number:.0f} %'
        if key.endswith('_ms'):
            return format_ns(round(number * 1e6), 3)
        return f'{number:.0f}'
    except (ValueError, OverflowError):
        return printable(value)     # no number
