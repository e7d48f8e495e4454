# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The newest ``/diagnostics`` of executors, and tables of them.

The statuses are those of ``mddag_executor.executor.diagnostics``; others on the topic are ignored.
A DAG's status has values for each of its sinks, under keys such as
``in_time_ratio NODE:CALLBACK``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import time
from typing import Any, cast, NamedTuple, TYPE_CHECKING

from mddag_executor.report.text import format_ns, printable, table

if TYPE_CHECKING:
    from mddag_executor.results.comparisons import TopResult, TopSink

LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')
GONE = 'GONE'
GONE_AFTER_S = 5.0
MOST_STATUSES = 1000

# The key of each column by its title.  Columns after `wrong` are left out on a terminal that is
# too narrow for them.
_PROCESS = {'process': 'process'}
_SINK_COLUMNS = {
    'sink': 'sink', 'state': 'level', 'in time': 'in_time_ratio', 'p99': 'response_p99_ms',
    'deadline': 'deadline_ms', 'wrong': 'wrong'}
_FURTHER_COLUMNS = {
    'results': 'window_results', 'least margin': 'margin_ms', 'DAG': 'dag', 'jobs': 'jobs',
    'period': 'period_ms', 'worst window': 'worst_window'}
_POOL_COLUMNS = {
    'workers': 'workers', 'state': 'level', 'busy': 'busy_ratio', 'CPU': 'cpu_ratio',
    'idle': 'idle_workers', 'queue': 'queue', 'dropped': 'dropped', 'per s': 'callbacks_per_s',
    'us each': 'cpu_us_per_callback', 'compute': 'computing', 'lost': 'lost', 'skipped': 'skipped',
    'no job': 'unattributed'}
_SHARES = ('busy_ratio', 'cpu_ratio')
_WORST_FIRST = ('ERROR', 'STALE', 'WARN', GONE)
_LEAST_WIDTHS = {'process': 18, 'sink': 18, 'wrong': 16}     # of columns that can be cut
_LARGEST = 1e15
_MOST_MESSAGES = 5  # messages of statuses that are not OK, below the tables on a terminal


class Status(NamedTuple):
    """A received status: process, name, level, message, values, and time of arrival (s)."""

    process: str
    name: str
    level: str
    message: str
    values: dict[str, str]
    came: float

    @property
    def owner(self) -> str:
        """Return the prefix of the name (``Thresholds.name``)."""
        return self.name.partition(': ')[0]

    @property
    def subject(self) -> str:
        """Return the name without its prefix: a DAG, or the workers."""
        return self.name.partition(': ')[2] or self.name

    @property
    def is_pool(self) -> bool:
        """Return whether it is about the workers, not a DAG."""
        return 'idle_workers' in self.values

    @property
    def is_ours(self) -> bool:
        """Return whether an executor of this project has sent it."""
        return self.is_pool or 'window_missed_ratio' in self.values


class Sink(NamedTuple):
    """A sink in the status of its DAG; ``values`` are those of the DAG and its own."""

    process: str
    dag: str
    sink: str
    level: str
    wrong: str
    values: dict[str, str]

    def badness(self) -> tuple[Any, ...]:
        """Return the key of an order that begins with the worst sink."""
        rank = (_WORST_FIRST.index(self.level) if self.level in _WORST_FIRST
                else len(_WORST_FIRST))
        share, response, deadline = (
            _number(self.values.get(key))
            for key in ('in_time_ratio', 'response_p99_ms', 'deadline_ms'))
        return (rank, 1.0 if share is None else share,
                -response / deadline if response is not None and deadline else 0.0,
                self.sink, self.process)

    def result(self) -> TopSink:
        """Return the sink for JSON."""
        return cast('TopSink', {
            'process': self.process, 'dag': self.dag, 'sink': self.sink, 'level': self.level,
            'wrong': self.wrong, **{key: _number(self.values.get(key)) for key in (
                'window_results', 'in_time_ratio', 'response_p99_ms', 'deadline_ms',
                'margin_ms')}})


def _number(text: str | None) -> float | None:
    try:
        number = float(text or '')
    except ValueError:
        return None
    return number if abs(number) < _LARGEST else None   # also without NaN


def sinks_of(statuses: Sequence[Status]) -> list[Sink]:
    """Return the sinks in statuses of DAGs, the worst first."""
    found = []
    for status in statuses:
        if status.is_pool:
            continue
        sinks: dict[str, dict[str, str]] = {}
        for key, value in status.values.items():
            what, _, sink = key.partition(' ')
            if sink:
                sinks.setdefault(sink, {})[what] = value
        of_dag = {key: status.values.get(key, '') for key in _FURTHER_COLUMNS.values()
                  if key not in ('window_results', 'margin_ms')}
        for sink, values in sinks.items():
            is_gone = status.level == GONE
            found.append(Sink(
                status.process, status.subject, sink,
                GONE if is_gone else values.get('level', status.level),
                status.message if is_gone else values.get('wrong', ''), {**of_dag, **values}))
    return sorted(found, key=Sink.badness)


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

    def result(self) -> TopResult:
        """Return sinks, the worst first, and statuses for JSON."""
        statuses = self.statuses()
        return {
            'sinks': [sink.result() for sink in sinks_of(statuses)],
            'statuses': [
                {'process': s.process, 'name': s.name, 'level': s.level, 'message': s.message,
                 'values': s.values} for s in statuses]}


def tables(statuses: list[Status], width: int | None = None) -> str:
    """
    Return the tables of sinks and of workers, and messages that are in neither of them.

    :param width: of a terminal: only the columns that fit, and the first messages; None: all.
    """
    sinks, pools = sinks_of(statuses), [s for s in statuses if s.is_pool]
    labels = _labels(statuses)
    is_several = width is None or len(labels) > 1
    parts = []
    if sinks:
        columns = _columns(
            {**(_PROCESS if is_several else {}), **_SINK_COLUMNS, **_FURTHER_COLUMNS}, sinks,
            labels)
        parts.append(_table(columns, [s.level for s in sinks], width, set(_FURTHER_COLUMNS)))
    if pools:
        columns = _columns({**(_PROCESS if is_several else {}), **_POOL_COLUMNS}, pools, labels)
        further = set(list(_POOL_COLUMNS)[2:])
        parts.append(_table(columns, [s.level for s in pools], width, further))
    shown = {(sink.process, sink.dag) for sink in sinks}
    lines = [printable(' '.join([
        s.level, *([labels[s.process]] if is_several else []), f'{s.subject}: {s.message}']))
        for s in statuses
        if s.level != 'OK' and (s.is_pool or (s.process, s.subject) not in shown)]
    if width is not None:
        lines = [line[:width] for line in lines[:_MOST_MESSAGES]]
    if lines:
        parts.append(''.join(line + '\n' for line in lines))
    return '\n'.join(parts)


def _labels(statuses: Sequence[Status]) -> dict[str, str]:
    """Return how to call each process: by the prefix of its names if all of them differ."""
    owners = {s.process: s.owner for s in statuses}
    is_named = len(owners) > 1 and len(set(owners.values())) == len(owners)
    return owners if is_named else {process: process for process in owners}


def _columns(
    keys: Mapping[str, str], rows: Sequence[Status | Sink], labels: Mapping[str, str]
) -> dict[str, list[str]]:
    """Return the cells of columns by title, without columns that are empty in all rows."""
    found = {title: [_cell(row, key, labels) for row in rows] for title, key in keys.items()}
    return {title: cells for title, cells in found.items()
            if title not in ('wrong', 'worst window') or any(cells)}


def _table(
    columns: dict[str, list[str]], levels: Sequence[str], width: int | None, further: set[str]
) -> str:
    """Return a table; on a terminal without the last columns that have no room."""
    columns = dict(columns)
    if width is not None:
        whole = {title: max(map(len, (title, *cells))) for title, cells in columns.items()}
        least = {title: min(n, _LEAST_WIDTHS.get(title, n)) for title, n in whole.items()}
        while len(columns) > 1 and (
                _width(whole if (last := next(reversed(columns))) in further else least, columns)
                > width):
            del columns[last]
        for title in ('wrong', 'sink'):
            if title in columns:
                room = max(_LEAST_WIDTHS[title], width - _width(whole, columns) + whole[title])
                columns[title] = [_cut(text, room, title == 'sink') for text in columns[title]]
                whole[title] = max(map(len, (title, *columns[title])))
    return table(list(columns), list(zip(*columns.values())), most=width,
                 marked=[width is not None and level not in ('OK', GONE) for level in levels])


def _cut(text: str, most: int, is_name: bool) -> str:
    """Cut the end of a text, or the beginning of a name (its namespace)."""
    if len(text) <= most:
        return text
    return '…' + text[1 - most:] if is_name else text[:most - 1] + '…'


def _width(widths: Mapping[str, int], titles: Mapping[str, Any]) -> int:
    return sum(widths[title] + 2 for title in titles) - 2


def _cell(row: Status | Sink, key: str, labels: Mapping[str, str]) -> str:
    if key == 'process':
        return printable(labels[row.process])
    if key in row._fields:
        return printable(getattr(row, key))
    text = row.values.get(key) or ''
    number = _number(text)
    if number is None:
        return printable(text) or ('' if key == 'worst_window' else '-')
    if key == 'in_time_ratio':
        return f'{round(1e4 * number) // 10 / 10:g} %'      # 99.96 % is not 100 %
    if key in _SHARES:
        return f'{100 * number:.0f} %'
    return format_ns(round(number * 1e6), 3) if key.endswith('_ms') else f'{number:.0f}'
