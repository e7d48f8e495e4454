# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What executors report of themselves on ``/diagnostics``: the newest of it, and its tables.

The statuses are those of ``mddag_executor.executor.diagnostics``; others on the topic are left
out.
On a terminal rich draws the tables (the extra ``top``), elsewhere they are plain text.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import time
from typing import Any

from mddag_executor.report.text import printable, table

LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')
GONE = 'GONE'
GONE_AFTER_S = 5.0
MOST_STATUSES = 1000
_STYLES = {'OK': 'green', 'WARN': 'yellow', 'ERROR': 'bold red', 'STALE': 'magenta', GONE: 'dim'}

_DAG_TITLES = ('process', 'DAG', 'state', 'period ms', 'jobs', 'lately', 'missed', 'p50 ms',
               'p99 ms', 'max ms', 'of deadline', 'least margin ms', 'message')
_DAG_KEYS = ('period_ms', 'jobs', 'window_results', 'window_missed', 'response_p50_ms',
             'response_p99_ms', 'response_max_ms', 'deadline_used_max', 'margin_min_ms')
_POOL_TITLES = ('process', 'workers of', 'state', 'idle', 'queue', 'per s', 'busy', 'CPU',
                'us each', 'compute', 'dropped', 'skipped', 'no job', 'message')
_POOL_KEYS = ('idle_workers', 'queue', 'callbacks_per_s', 'busy_ratio', 'cpu_ratio',
              'cpu_us_per_callback', 'computing', 'dropped', 'skipped', 'unattributed')


@dataclass(frozen=True)
class Status:
    """A status as it came: whose it is, name, level, message, values, and when it came (s)."""

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
        """Return whether an executor of this kind has sent it."""
        return self.is_pool or 'window_missed_ratio' in self.values


class Board:
    """The newest statuses of all processes, of a thousand at most."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._statuses: dict[tuple[str, str], Status] = {}

    def take(self, message: Any) -> None:
        """Show a ``DiagnosticArray``."""
        now = self._clock()
        for each in message.status:
            level = each.level[0] if isinstance(each.level, bytes) else int(each.level)
            status = Status(
                each.hardware_id, each.name, LEVELS[level] if level < len(LEVELS) else str(level),
                each.message, {pair.key: pair.value for pair in each.values}, now)
            if status.is_ours:
                # At the end, so that the first one is the one that was silent for longest.
                self._statuses.pop((status.process, status.name), None)
                self._statuses[(status.process, status.name)] = status
                if len(self._statuses) > MOST_STATUSES:
                    del self._statuses[next(iter(self._statuses))]

    def statuses(self) -> list[Status]:
        """Return them by process and name; of a process that is silent, as GONE."""
        now = self._clock()
        found = []
        for _, s in sorted(self._statuses.items()):
            if now - s.came > GONE_AFTER_S:
                s = Status(s.process, s.name, GONE, f'nothing heard for {now - s.came:.0f} s',
                           s.values, s.came)
            found.append(s)
        return found

    def result(self) -> dict[str, Any]:
        """Return what there is for machines."""
        return {'statuses': [
            {'process': s.process, 'name': s.name, 'level': s.level, 'message': s.message,
             'values': s.values} for s in self.statuses()]}


def dag_rows(statuses: list[Status]) -> list[list[str]]:
    """Return the rows of the table of DAGs: one list for all processes, DAG by DAG."""
    return [_row(s, _DAG_KEYS) for s in sorted(statuses, key=lambda s: (s.name, s.process))
            if not s.is_pool]


def pool_rows(statuses: list[Status]) -> list[list[str]]:
    """Return the rows of the table of workers."""
    return [_row(s, _POOL_KEYS) for s in statuses if s.is_pool]


def _row(status: Status, keys: tuple[str, ...]) -> list[str]:
    name = status.name
    if status.is_pool:
        name = name.rpartition(': ')[0] or name
    cells = (status.process, name, status.level, *(status.values.get(k) or '-' for k in keys),
             status.message)
    return [printable(cell) for cell in cells]


def plain(statuses: list[Status]) -> str:
    """Return both tables as text."""
    return (table(_DAG_TITLES, dag_rows(statuses)) + '\n'
            + table(_POOL_TITLES, pool_rows(statuses)))


def picture(statuses: list[Status]) -> Any:
    """Return both tables for rich; nothing in them is taken for markup."""
    from rich.console import Group
    tables = (_rich(_DAG_TITLES, dag_rows(statuses)), _rich(_POOL_TITLES, pool_rows(statuses)))
    return Group(*tables)


def _rich(titles: tuple[str, ...], rows: list[list[str]]) -> Any:
    from rich.table import Table
    from rich.text import Text
    made = Table(box=None, pad_edge=False, header_style='bold')
    for i, title in enumerate(titles):
        words = i < 3 or i == len(titles) - 1
        made.add_column(Text(title), justify='left' if words else 'right', no_wrap=i != 1,
                        overflow='fold' if i == 1 else 'ellipsis')
    for row in rows:
        style = _STYLES.get(row[2], '')
        made.add_row(*(Text(cell, style=style if i == 2 else '') for i, cell in enumerate(row)))
    return made
