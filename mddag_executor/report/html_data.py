# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The data of an HTML report: what its pictures are drawn from in the browser.

The executions that the timeline kept go into the file, as columns of the pictures: those around
missed deadlines, and some of all other times (``timeline``).  Times are seconds since the first
instant.  A name is only ever JSON here, text in HTML or text on a canvas, never markup or code.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import json
from typing import Any, NamedTuple

from mddag_executor.core import Tables, Tally
from mddag_executor.recording.tables import Ints
from mddag_executor.replay.usage import Usage
from mddag_executor.report.tables import short_names
from mddag_executor.report.text import format_ns, printable
from mddag_executor.report.timeline import (
    ABORTED,
    DONE,
    END,
    EXPIRED,
    FAILED,
    JOB,
    OVERDUE,
    READY,
    ROW,
    START,
    Timeline,
    WORKER,
)
from msg_graph import TaskSet
import numpy as np

MOST_MISSES = 200
LONGEST_LABEL = 40
KINDS = {
    DONE: 'late', OVERDUE: 'not completed at the end', EXPIRED: 'expired', ABORTED: 'aborted',
    FAILED: 'failed'}
UNKNOWN = '#969696'
CLASSES = ((0.0, '#d7191c'), (0.1, '#fd8d3c'), (0.25, '#fec44f'), (0.5, '#9ecae1'),
           (float('inf'), '#3182bd'))
"""The colour of an execution whose slack is less than such a share of the deadline."""


class ReportData(NamedTuple):
    """
    What a report is about.

    :ivar breakdown: by sink where the times of its jobs went, as in the result of a replay.
    :ivar facts: what stands below the title: pairs of a word and a text.
    :ivar duration_ns: from the first release to the end of the run.
    :ivar paths: end-to-end times of the declared paths, as in the result of a replay.
    :ivar recorded: the callbacks of an imported recording, as in the result of a replay.
    :ivar misses: why deadlines were missed, as in the result of a replay.
    :ivar causes: the cause of each miss, by global vertex of the sink and job.
    :ivar worker_names: what workers are called, where that is more than a number.
    """

    title: str
    facts: list[tuple[str, str]]
    task_set: TaskSet
    tables: Tables
    tally: Tally
    breakdown: Mapping[int, Any]
    usage: Usage
    timeline: Timeline
    workers: int
    duration_ns: int
    warnings: list[str]
    paths: Mapping[str, Any] = {}
    recorded: Mapping[str, Any] = {}
    misses: Mapping[str, Any] | None = None
    causes: Mapping[tuple[int, int], str] = {}
    worker_names: Sequence[str] = ()


class Line(NamedTuple):
    """A line of the picture by callback: its label, its place from the bottom, whether a DAG."""

    label: str
    y: int
    heading: bool


class SinkJob(NamedTuple):
    """
    What came of a job at a sink; ``sink`` is its global vertex.

    Times are ns since the origin; ``completed`` is None where it never was.
    """

    sink: int
    job: int
    deadline: int
    completed: int | None
    kind: int

    @property
    def missed(self) -> bool:
        """Return whether the deadline was missed."""
        return self.completed is None or self.completed > self.deadline

    @property
    def shown(self) -> int:
        """Return when it is marked in the pictures."""
        return self.deadline if self.completed is None else self.completed


class Prepared(NamedTuple):
    """
    A report's data, ready to be drawn.

    :ivar executions: the columns of the executions; ``marks`` those of the missed deadlines.
    :ivar misses: in the order of ``SinkJob.shown``.
    :ivar worst: of these the worst ones, in the order of their releases.
    :ivar steps: for the page's script: start, deadline and end of each miss (s), and its text.
    """

    executions: dict[str, Any]
    marks: dict[str, Any]
    lines: list[Line]
    worker_lines: list[int]
    gaps: list[tuple[float, float]]
    origin: int
    misses: list[SinkJob]
    worst: list[int]
    steps: list[tuple[float, float, float, str]]


def prepare(data: ReportData) -> Prepared:
    """Return what the pictures of a report are drawn from."""
    columns = data.timeline.columns()
    origin = _origin(columns.releases, columns.executions)
    lines, ys = _lines(data.task_set, data.timeline.undeclared_names())
    verdicts = {
        (v, job): SinkJob(v, job, deadline - origin, None if done < 0 else done - origin, kind)
        for v, job, deadline, done, kind in columns.verdicts.T.tolist()}
    misses = sorted((each for each in verdicts.values() if each.missed),
                    key=lambda miss: miss.shown)
    releases = [miss.deadline - data.tables.sink_deadline[miss.sink] for miss in misses]
    worst = sorted(range(len(misses)), key=lambda i: _badness(misses[i]))[:MOST_MISSES]
    worst.sort(key=lambda i: (releases[i], misses[i].sink))
    words = _Words(data, verdicts, {
        (dag, job): release - origin for dag, job, release in columns.releases.T.tolist()})
    steps = [(release / 1e9, miss.deadline / 1e9, miss.shown / 1e9,
              f'{words.job(miss.sink, miss.job)}: {words.verdict(miss)}')
             for release, miss in zip(releases, misses)]
    return Prepared(
        words.executions(columns.executions, origin, ys), words.marks(misses, ys), lines,
        words.worker_lines, [((a - origin) / 1e9, (b - origin) / 1e9)
                             for a, b in data.timeline.gaps()], origin, misses, worst, steps)


def _badness(miss: SinkJob) -> tuple[int, int, int]:
    """Return what misses are ordered by: first those that never completed, then the latest."""
    if miss.completed is None:
        return 0, 0, miss.deadline
    return 1, miss.deadline - miss.completed, miss.deadline


class _Words:
    """What is known of executions and jobs, in words."""

    def __init__(
        self, data: ReportData, verdicts: Mapping[tuple[int, int], SinkJob],
        releases: Mapping[tuple[int, int], int],
    ) -> None:
        self._data = data
        self._verdicts = verdicts
        self._releases = releases
        self._names = [vertex.name for vertex in data.task_set.vertices]
        self._short = short_names(self._names)
        self._leads_to = list(_leads_to(data))
        self.worker_lines = _worker_lines(data)

    def executions(self, executions: Ints, origin: int, ys: list[int]) -> dict[str, Any]:
        """Return the columns of executions; ``a`` to ``d`` are the lines about them."""
        undeclared = self._data.timeline.undeclared_names()
        n_declared = len(self._names)
        rows = np.where(executions[ROW] >= 0, executions[ROW], n_declared - 1 - executions[ROW])
        names = [printable(name) for name in (*self._names, *undeclared)]
        texts: list[tuple[str, str, str, str]] = []
        colours = []
        for row, job, worker, ready, start, end in zip(
                rows.tolist(), *executions[[JOB, WORKER, READY, START, END]].tolist()):
            least = self._least(row, job) if row < n_declared else None
            verdict = '' if row >= n_declared else 'no verdict known'
            if least is not None:
                verdict = self.verdict(least)
            colours.append(self._colour(least))
            texts.append((
                names[row], 'declared by no DAG' if row >= n_declared else self.job(row, job),
                f'started {_instant(start - origin)} {self._worker(worker)}, waited '
                f'{format_ns(start - ready)}, ran {format_ns(end - start)}', verdict))
        lines = [self.worker_lines[w if 0 <= w < self._data.workers else -1]
                 for w in executions[WORKER].tolist()]
        return {
            'left': (executions[START] - origin) / 1e9, 'right': (executions[END] - origin) / 1e9,
            'workers': np.array(lines, dtype=np.int32),
            'callbacks': np.array(ys, dtype=np.int32)[rows], 'colour': colours, **_lines_of(texts)}

    def marks(self, misses: list[SinkJob], ys: list[int]) -> dict[str, Any]:
        """Return the columns of missed deadlines."""
        return {
            'x': [miss.shown / 1e9 for miss in misses], 'workers': [0] * len(misses),
            'callbacks': [ys[miss.sink] for miss in misses], **_lines_of([
                (printable(self._names[miss.sink]), self.job(miss.sink, miss.job),
                 self.verdict(miss), '') for miss in misses])}

    def job(self, vertex: int, job: int) -> str:
        """Return which job it is, and when it was released."""
        dag = self._data.tables.dag_of[vertex]
        release = self._releases.get((dag, job))
        text = f'job {job} of {printable(self._data.task_set.dags[dag].name)}'
        return text if release is None else f'{text}, released at {_instant(release)}'

    def verdict(self, miss: SinkJob) -> str:
        """Return what came of a job at a sink."""
        relative = self._data.tables.sink_deadline[miss.sink]
        name, due = printable(self._short[self._names[miss.sink]]), format_ns(relative)
        if miss.completed is None:
            return f'MISSED at {name}: {KINDS[miss.kind]} (deadline {due})'
        slack = miss.deadline - miss.completed
        how = f'{format_ns(-slack)} late' if slack < 0 else f'{format_ns(slack)} of slack'
        return (f'{"MISSED" if slack < 0 else "in time"} at {name}: response '
                f'{format_ns(relative - slack)}, {how} (deadline {due})')

    def _least(self, row: int, job: int) -> SinkJob | None:
        """Return the verdict with the least slack of those that an execution leads to."""
        found = [verdict for sink in self._leads_to[row]
                 if (verdict := self._verdicts.get((sink, job))) is not None]
        return min(found, key=_slack, default=None)

    def _colour(self, verdict: SinkJob | None) -> str:
        if verdict is None:
            return UNKNOWN
        share = _slack(verdict) / max(1, self._data.tables.sink_deadline[verdict.sink])
        return next(colour for limit, colour in CLASSES if share < limit)

    def _worker(self, worker: int) -> str:
        if worker < 0:
            return 'on a spare thread'
        names = self._data.worker_names
        return f'on {printable(names[worker]) if worker < len(names) else f"worker {worker}"}'


def _slack(verdict: SinkJob) -> float:
    return float('-inf') if verdict.completed is None else verdict.deadline - verdict.completed


def _instant(ns: int) -> str:
    return f'{ns / 1e9:.6f} s'


def _lines_of(texts: list[tuple[str, str, str, str]]) -> dict[str, list[str]]:
    """Return the columns of the four lines that are shown about a place."""
    return {key: [text[i] for text in texts] for i, key in enumerate('abcd')}


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


def _origin(releases: Ints, executions: Ints) -> int:
    starts = [int(column.min()) for column in (releases[2], executions[READY]) if len(column)]
    return min(starts, default=0)


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


def _leads_to(data: ReportData) -> Iterator[list[int]]:
    """Yield the sinks that each declared vertex leads to, as global vertices."""
    for dag in data.task_set.dags:
        found: list[list[int]] = [[] for _ in dag.vertices]
        for sink in dag.sinks:
            seen = {sink}
            todo = [sink]
            for local in todo:
                found[local].append(data.tables.first_vertex[dag.index] + sink)
                before = [p for p in dag.vertices[local].predecessors if p not in seen]
                seen.update(before)
                todo.extend(before)
        yield from found
