# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The data of an HTML report: what its pictures are drawn from in the browser.

Theory of operation
-------------------
All executions that the timeline kept go into the file, and the browser chooses what it draws:
each one where few are in view, sums where there are many.  To keep the file small

* times are in units of 100 ns since the first instant, and numbers that follow one another are
  stored as differences;
* each column becomes bytes of equal weight one after the other (first all lowest bytes, and so
  on), as many as its largest number needs, which compresses well;
* all columns together are one zlib stream in base64.

A signed number n is stored as 2n, or as -2n-1 where it is negative.  What a column is called and
how it is stored stands in the JSON beside it, with the names: a name is only ever JSON here, text
in HTML or text on a canvas, never markup or code.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
import json
from typing import Any, NamedTuple
import zlib

from mddag_executor.core import Tables, Tally
from mddag_executor.replay.chains import Chains
from mddag_executor.replay.usage import Usage
from mddag_executor.report.tables import short_names
from mddag_executor.report.text import format_ns, printable
from mddag_executor.report.timeline import (
    END,
    Ints,
    JOB,
    READY,
    ROW,
    START,
    Timeline,
    WORKER,
)
from msg_graph import TaskSet
import numpy as np

UNIT_NS = 100
MOST_MISSES = 200
LONGEST_LABEL = 40
_LARGEST = 2 ** 51      # what JavaScript's numbers hold exactly, with room for the sign


class ReportData(NamedTuple):
    """
    What a report is about.

    :ivar facts: what stands below the title: pairs of a word and a text.
    :ivar duration_ns: from the first release to the end of the run.
    :ivar paths: end-to-end times of the declared paths, as in the result of a replay.
    :ivar recorded: the callbacks of an imported recording, as in the result of a replay.
    :ivar misses: why deadlines were missed, as in the result of a replay.
    :ivar worker_names: what workers are called, where that is more than a number.
    """

    title: str
    facts: list[tuple[str, str]]
    task_set: TaskSet
    tables: Tables
    tally: Tally
    chains: Chains
    usage: Usage
    timeline: Timeline
    workers: int
    duration_ns: int
    warnings: list[str]
    paths: Mapping[str, Any] = {}
    recorded: Mapping[str, Any] = {}
    misses: Mapping[str, Any] | None = None
    worker_names: Sequence[str] = ()


class Line(NamedTuple):
    """A line of the picture by callback: its label, its place from the bottom, whether a DAG."""

    label: str
    y: int
    heading: bool


class Miss(NamedTuple):
    """A missed deadline; times in ns since the origin, ``completed`` None where it never was."""

    sink: int
    job: int
    deadline: int
    completed: int | None
    kind: int


class Prepared(NamedTuple):
    """A report's data, ready to be drawn; ``meta`` is for JSON, ``blob`` is base64."""

    meta: dict[str, Any]
    blob: str
    lines: list[Line]
    origin: int
    misses: list[Miss]


def prepare(data: ReportData) -> Prepared:
    """Return what the pictures of a report are drawn from."""
    columns = data.timeline.columns()
    executions = columns.executions
    n_declared = len(data.task_set.vertices)
    undeclared = data.timeline.undeclared_names()
    origin = _origin(columns.releases, executions)
    lines, ys = _lines(data.task_set, undeclared)
    rows = np.where(executions[ROW] >= 0, executions[ROW], n_declared - 1 - executions[ROW])
    start = _units(executions[START], origin)
    sinks = data.tables.sinks
    place = {vertex: i for i, vertex in enumerate(sinks)}
    releases = columns.releases[:, np.lexsort((columns.releases[1], columns.releases[0]))]
    verdicts = columns.verdicts.copy()
    verdicts[0] = [place[v] for v in verdicts[0].tolist()]
    verdicts = verdicts[:, np.lexsort((verdicts[1], verdicts[0]))]
    packer = Packer()
    packer.add('start', start, delta=True)
    packer.add('took', _units(executions[END], origin) - start)
    packer.add('wait', start - _units(executions[READY], origin))
    packer.add('row', rows)
    packer.add('worker', executions[WORKER])
    packer.add('job', _differences_by(executions[JOB], rows))
    packer.add('release_dag', releases[0], delta=True)
    packer.add('release_job', releases[1], delta=True)
    packer.add('release_time', _units(releases[2], origin), delta=True)
    packer.add('verdict_sink', verdicts[0], delta=True)
    packer.add('verdict_job', verdicts[1], delta=True)
    packer.add('verdict_slack', np.where(
        verdicts[3] >= 0, (verdicts[2] - verdicts[3]) // UNIT_NS, 0))
    packer.add('verdict_kind', verdicts[4])
    misses = _misses(verdicts, origin, [data.tables.sink_deadline[v] for v in data.tables.sinks])
    names = [vertex.name for vertex in data.task_set.vertices]
    short = short_names(names)
    meta = {
        'unit_ns': UNIT_NS, 'origin_ns': origin, 'workers': data.workers,
        'duration': data.duration_ns // UNIT_NS,
        'executions': data.timeline.n_executions, 'kept': data.timeline.kept,
        'gaps': [[_unit(a, origin), _unit(b, origin)] for a, b in data.timeline.gaps()],
        'dags': [printable(dag.name) for dag in data.task_set.dags],
        'rows': [*_rows(data, names, ys, place),
                 *({'name': printable(name), 'dag': -1, 'y': ys[n_declared + i], 'sinks': []}
                   for i, name in enumerate(undeclared))],
        'sinks': [{'row': v, 'dag': data.tables.dag_of[v], 'name': printable(short[names[v]]),
                   'deadline': data.tables.sink_deadline[v] // UNIT_NS} for v in sinks],
        'worker_lines': _worker_lines(data),
        'worker_names': [printable(name) for name in data.worker_names],
        'misses': [miss[:2] for miss in misses], 'columns': packer.columns}
    return Prepared(meta, packer.blob(), lines, origin, misses)


def json_for_html(value: Any) -> str:
    """Return JSON that can stand in a script element whatever it holds."""
    text = json.dumps(value, ensure_ascii=True, separators=(',', ':'), allow_nan=False)
    return text.replace('<', '\\u003c').replace('>', '\\u003e').replace('&', '\\u0026')


def label(text: str, longest: int = LONGEST_LABEL) -> str:
    """Return a name as it stands at an axis: harmless, and shortened in its middle."""
    text = printable(text)
    if len(text) <= longest:
        return text
    half = (longest - 1) // 2
    return f'{text[:longest - 1 - half]}…{text[-half:]}'


class Packer:
    """Puts columns of whole numbers into one compressed text."""

    def __init__(self) -> None:
        self.columns: list[dict[str, Any]] = []
        self._zlib = zlib.compressobj(6)
        self._parts: list[bytes] = []

    def add(self, name: str, values: Ints, delta: bool = False) -> None:
        """Add a column; with ``delta`` as differences from one number to the next."""
        if delta:
            values = np.diff(values, prepend=0)
        values = np.clip(values, -_LARGEST, _LARGEST)
        plain = np.where(values < 0, -2 * values - 1, 2 * values).astype('<u8')
        width = max(1, (int(plain.max(initial=0)).bit_length() + 7) // 8)
        planes = plain.view(np.uint8).reshape(-1, 8).T[:width]
        self._parts.append(self._zlib.compress(np.ascontiguousarray(planes).tobytes()))
        self.columns.append({'name': name, 'n': len(values), 'width': width, 'delta': delta})

    def blob(self) -> str:
        """Return the text; call it once, at the end."""
        self._parts.append(self._zlib.flush())
        return base64.b64encode(b''.join(self._parts)).decode()


def _origin(releases: Ints, executions: Ints) -> int:
    starts = [int(column.min()) for column in (releases[2], executions[READY]) if len(column)]
    return min(starts, default=0)


def _unit(time: int, origin: int) -> int:
    return time // UNIT_NS - origin // UNIT_NS


def _units(times: Ints, origin: int) -> Ints:
    return times // UNIT_NS - origin // UNIT_NS


def _differences_by(values: Ints, rows: Ints) -> Ints:
    """Return each value minus the one before it of the same row."""
    order = np.argsort(rows, kind='stable')
    differences = np.diff(values[order], prepend=0)
    firsts = np.flatnonzero(np.diff(rows[order], prepend=-1))
    differences[firsts] = values[order][firsts]
    result = np.empty_like(differences)
    result[order] = differences
    return result


def _lines(task_set: TaskSet, undeclared: list[str]) -> tuple[list[Line], list[int]]:
    """Return the lines of the picture by callback, from the top, and the place of each row."""
    short = short_names(vertex.name for vertex in task_set.vertices)
    texts: list[tuple[str, bool]] = []
    for dag in task_set.dags:
        texts.append((label(f'{dag.name}, every {format_ns(dag.period_ns)}'), True))
        texts.extend((label(short[vertex.name]), False) for vertex in dag.vertices)
    if undeclared:
        texts.append(('undeclared', True))
        texts.extend((label(name), False) for name in undeclared)
    lines = [Line(text, len(texts) - 1 - i, heading) for i, (text, heading) in enumerate(texts)]
    return lines, [line.y for line in lines if not line.heading]


def _worker_lines(data: ReportData) -> list[int]:
    """Return the place of each worker, and at last of spare threads (0: there are none)."""
    spare = any(not 0 <= worker < data.workers for worker in data.timeline.workers)
    return [data.workers - w + spare for w in range(data.workers)] + [int(spare)]


def _rows(
    data: ReportData, names: list[str], ys: list[int], place: dict[int, int]
) -> Iterator[dict[str, Any]]:
    """Yield what is known of each declared vertex, with the sinks that it leads to."""
    for dag in data.task_set.dags:
        first = data.tables.first_vertex[dag.index]
        leads_to: list[list[int]] = [[] for _ in dag.vertices]
        for sink in dag.sinks:
            seen = {sink}
            todo = [sink]
            for local in todo:
                leads_to[local].append(place[first + sink])
                before = [p for p in dag.vertices[local].predecessors if p not in seen]
                seen.update(before)
                todo.extend(before)
        for vertex in dag.vertices:
            row = first + vertex.index
            yield {'name': printable(names[row]), 'dag': dag.index, 'y': ys[row],
                   'sinks': leads_to[vertex.index]}


def _misses(verdicts: Ints, origin: int, relative: list[int]) -> list[Miss]:
    """
    Return the worst misses, in the order in which their jobs were released.

    Worst are those that never completed, then those that completed latest.
    """
    late = (verdicts[3] < 0) | (verdicts[3] > verdicts[2])
    found = verdicts[:, late]
    order = np.lexsort((found[2], found[2] - found[3], found[3] >= 0))[:MOST_MISSES]
    misses = [
        Miss(sink, job, deadline - origin, None if completed < 0 else completed - origin, kind)
        for sink, job, deadline, completed, kind in found[:, order].T.tolist()]
    return sorted(misses, key=lambda miss: (miss.deadline - relative[miss.sink], miss.sink))
