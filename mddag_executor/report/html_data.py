# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The data of an HTML report, from which its script draws the timeline and makes texts.

The page has the executions that ``timeline`` selects, as columns of numbers. They refer to tables
of names, jobs and verdicts, from which the script makes the texts of tool tips. So a page stays
small. Times are seconds since the first instant. A name is only ever JSON here, text in HTML or
text on a canvas, never markup or code.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import json
from typing import Any, NamedTuple

from mddag_executor.core import Tables, Tally
from mddag_executor.core.tally import counts, VERDICTS
from mddag_executor.replay.usage import Usage
from mddag_executor.report.tables import missed_share, short_names
from mddag_executor.report.text import format_ns, printable, shortened
from mddag_executor.report.timeline import Shown, Timeline
from msg_graph import Dag, TaskSet
import numpy as np

MOST_MISSES = 200
MOST_LINES = 150
"""Maximum number of lines of the timeline by callback; a single DAG may have more."""
LONGEST_LABEL = 40
UNKNOWN = '#969696'
COLOURS = ('#d7191c', '#fd8d3c', '#fec44f', '#9ecae1', '#3182bd', UNKNOWN)
"""The colours of executions, from the least slack to the most, and without a verdict."""
_SHARES = (0.0, 0.1, 0.25, 0.5)
"""Thresholds between the colours: slack as a share of the deadline."""
_HIDDEN = -10       # position of a callback without line


class ReportData(NamedTuple):
    """
    The contents of a report.

    :ivar breakdown: by sink the parts of its response times, as in the result of a replay.
    :ivar facts: below the title: pairs of a word and a text.
    :ivar duration_ns: from the first release to the end of the run.
    :ivar paths: end-to-end times of the declared paths, as in the result of a replay.
    :ivar recorded: the callbacks of an imported recording, as in the result of a replay.
    :ivar misses: causes of missed deadlines, as in the result of a replay.
    :ivar causes: the cause of each miss, by global vertex of the sink and job.
    :ivar worker_names: the names of workers, if they are more than a number.
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


NumberedJobs = dict[tuple[int, int], tuple[int, float | None]]


class Line(NamedTuple):
    """A line of a timeline: label, position from the bottom, whether it is a DAG's title."""

    label: str
    y: int
    heading: bool


class SinkJob(NamedTuple):
    """
    The verdict about a job at a sink (a global vertex).

    Times are ns since the origin; ``completed`` is None if it never completed. ``place`` is the
    index in the page's table of verdicts.
    """

    sink: int
    job: int
    release: int
    deadline: int
    completed: int | None
    verdict: str
    place: int

    @property
    def missed(self) -> bool:
        """Return whether the deadline was missed."""
        return self.completed is None or self.completed > self.deadline

    @property
    def shown(self) -> int:
        """Return the time of its mark in the pictures."""
        return self.deadline if self.completed is None else self.completed

    @property
    def slack_share(self) -> float:
        """Return the slack as a share of the deadline; negative if that was missed."""
        if self.completed is None:
            return float('-inf')
        return (self.deadline - self.completed) / max(1, self.deadline - self.release)


class Prepared(NamedTuple):
    """
    A report's data, ready to be drawn.

    :ivar executions: the columns of the executions; ``marks``: of the missed deadlines.
    :ivar lines: of the timeline by callback; ``n_hidden`` is the number of DAGs without line.
    :ivar misses: the worst misses, in the order of their releases.
    :ivar meta: for the page's script.
    """

    executions: dict[str, Any]
    marks: dict[str, Any]
    lines: list[Line]
    n_hidden: int
    worker_lines: list[int]
    gaps: list[tuple[float, float]]
    origin: int
    misses: list[SinkJob]
    meta: dict[str, Any]


def prepare(data: ReportData) -> Prepared:
    """Prepare a report's data for drawing."""
    shown = data.timeline.shown()
    starts = np.concatenate([shown.releases['release'], shown.executions['ready']])
    origin = int(starts.min()) if len(starts) else 0
    verdicts = _verdicts(shown, origin)
    missed = sorted((each for each in verdicts.values() if each.missed),
                    key=lambda miss: miss.shown)
    worst = sorted(missed, key=_badness)[:MOST_MISSES]
    worst.sort(key=lambda miss: (miss.release, miss.sink))
    lines, ys, n_hidden = _lines(data)
    worker_lines = _worker_lines(data)
    jobs = _numbered_jobs(data, shown, verdicts, origin)
    marks = {
        'x': [miss.shown / 1e9 for miss in missed], 'workers': [0] * len(missed),
        'callbacks': [ys[miss.sink] for miss in missed],
        'verdict': np.array([miss.place for miss in missed], dtype=np.int32)}
    return Prepared(
        _executions(data, shown, origin, verdicts, jobs, ys, worker_lines), marks, lines, n_hidden,
        worker_lines, [((a - origin) / 1e9, (b - origin) / 1e9)
                       for a, b in data.timeline.gaps()], origin, worst,
        _meta(data, verdicts, jobs, worst))


def _badness(miss: SinkJob) -> tuple[int, int, int]:
    """Return the sort key of misses: uncompleted ones first, then the latest."""
    if miss.completed is None:
        return 0, 0, miss.deadline
    return 1, miss.deadline - miss.completed, miss.deadline


def _verdicts(shown: Shown, origin: int) -> dict[tuple[int, int], SinkJob]:
    table = shown.verdicts
    rows = zip(*(table[name].tolist() for name in (
        'sink', 'job', 'release', 'deadline', 'completed', 'kind')))
    return {
        (sink, job): SinkJob(
            sink, job, release - origin, deadline - origin,
            None if completed < 0 else completed - origin, VERDICTS[kind], place)
        for place, (sink, job, release, deadline, completed, kind) in enumerate(rows)}


def _numbered_jobs(
    data: ReportData, shown: Shown, verdicts: Mapping[tuple[int, int], SinkJob], origin: int
) -> NumberedJobs:
    """Return by DAG and number of each job its index in the page's table and its release (s)."""
    jobs: NumberedJobs = {}

    def add(dag: int, job: int, release: float | None) -> None:
        if (dag, job) not in jobs:
            jobs[dag, job] = len(jobs), release

    for dag, job, release in zip(*(
            shown.releases[name].tolist() for name in ('dag', 'job', 'release'))):
        add(dag, job, (release - origin) / 1e9)
    for each in verdicts.values():
        add(data.tables.dag_of[each.sink], each.job, each.release / 1e9)
    declared = shown.executions[shown.row >= 0]
    for dag, job in zip(declared['dag'].tolist(), declared['job'].tolist()):
        add(dag, job, None)
    return jobs


def _executions(
    data: ReportData, shown: Shown, origin: int, verdicts: Mapping[tuple[int, int], SinkJob],
    jobs: NumberedJobs, ys: list[int],
    worker_lines: list[int],
) -> dict[str, Any]:
    """Return the columns of executions: times, lines, and indices in the page's tables."""
    table, n_declared = shown.executions, len(data.task_set.vertices)
    names = np.where(shown.row >= 0, shown.row, n_declared - 1 - shown.row)
    leads_to = list(_leads_to(data))
    place, job_place, colour = (np.full(len(table), -1, dtype=np.int32) for _ in range(3))
    colour[:] = len(COLOURS) - 1
    for i, (row, dag, job) in enumerate(zip(
            shown.row.tolist(), table['dag'].tolist(), table['job'].tolist())):
        if row < 0:
            continue
        job_place[i] = jobs[dag, job][0]
        found = [verdicts[sink, job] for sink in leads_to[row] if (sink, job) in verdicts]
        if found:
            least = min(found, key=lambda each: each.slack_share)
            place[i] = least.place
            colour[i] = int(np.searchsorted(_SHARES, least.slack_share, 'right'))
    workers = np.array(worker_lines, dtype=np.int32)
    on = table['worker'].astype(np.int32)
    return {
        'left': (table['start'] - origin) / 1e9, 'right': (table['end'] - origin) / 1e9,
        'waited': (table['start'] - table['ready']) / 1e9, 'worker': on,
        'workers': workers[np.where((on >= 0) & (on < data.workers), on, -1)],
        'callbacks': np.array(ys, dtype=np.int32)[names], 'name': names.astype(np.int32),
        'job': job_place, 'verdict': place, 'class': colour}


def _meta(
    data: ReportData, verdicts: Mapping[tuple[int, int], SinkJob],
    jobs: NumberedJobs, worst: list[SinkJob],
) -> dict[str, Any]:
    """Return the tables for the texts of the page's script; times in ns, releases in s."""
    names = [vertex.name for vertex in data.task_set.vertices]
    short = short_names(names)
    return {
        'duration': data.duration_ns / 1e9, 'declared': len(names),
        'names': [printable(n) for n in (*names, *data.timeline.undeclared_names())],
        'short': [printable(short[name]) for name in names],
        'dags': [printable(dag.name) for dag in data.task_set.dags],
        'workers': [printable(name) for name in data.worker_names],
        'jobs': [[dag, job, release] for (dag, job), (_, release) in jobs.items()],
        'verdicts': [
            [each.sink, jobs[data.tables.dag_of[each.sink], each.job][0],
             each.deadline - each.release,
             None if each.completed is None else each.completed - each.release, each.verdict]
            for each in verdicts.values()],
        'missed': [[miss.place, miss.release / 1e9, miss.deadline / 1e9, miss.shown / 1e9]
                   for miss in worst]}


def json_for_html(value: Any) -> str:
    """Return JSON that can be in a script element with any contents."""
    text = json.dumps(value, ensure_ascii=True, separators=(',', ':'), allow_nan=False)
    return text.replace('<', '\\u003c').replace('>', '\\u003e').replace('&', '\\u0026')


def label(text: str, longest: int = LONGEST_LABEL) -> str:
    """Return a name for an axis: harmless, and shortened in its middle."""
    return shortened(printable(text), longest)


def _lines(data: ReportData) -> tuple[list[Line], list[int], int]:
    """
    Return the lines of the timeline by callback, from the top.

    Also return the position of each row, and the number of DAGs without line.
    """
    task_set, undeclared = data.task_set, data.timeline.undeclared_names()
    chosen = _chosen_dags(data)
    short = short_names(vertex.name for vertex in task_set.vertices)
    texts: list[tuple[str, bool]] = []
    rows: list[int] = []
    for dag in task_set.dags:
        if dag.index not in chosen:
            rows += [-1] * len(dag.vertices)
            continue
        texts.append((label(f'{dag.name}, every {format_ns(dag.period_ns)}'), True))
        for vertex in dag.vertices:
            rows.append(len(texts))
            texts.append((label(short[vertex.name]), False))
    if undeclared:
        texts.append(('undeclared', True))
        for name in undeclared:
            rows.append(len(texts))
            texts.append((label(name), False))
    lines = [Line(text, len(texts) - 1 - i, heading) for i, (text, heading) in enumerate(texts)]
    ys = [_HIDDEN if row < 0 else lines[row].y for row in rows]
    return lines, ys, len(task_set.dags) - len(chosen)


def _chosen_dags(data: ReportData) -> set[int]:
    """Return the DAGs with lines in the timeline by callback: those that missed most."""
    results = data.tally.result()['dags']

    def badness(dag: Dag) -> float:
        return -max((missed_share(counts(sink))
                     for sink in results[dag.name]['sinks'].values()), default=0.0)

    chosen: set[int] = set()
    room = MOST_LINES
    for dag in sorted(data.task_set.dags, key=badness):
        room -= 1 + len(dag.vertices)
        if room < 0 and chosen:
            break
        chosen.add(dag.index)
    return chosen


def _worker_lines(data: ReportData) -> list[int]:
    """Return the position of each worker, then of spare threads (0: none)."""
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
