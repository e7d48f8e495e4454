# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The data of an HTML report, from which its script draws the timelines and histograms.

The page has the executions and verdicts that ``timeline`` selects, as columns of numbers that
refer to lists of names; the script makes the texts of tool tips. So a page stays small. Times are
microseconds since the start of the recording, each less the one before it; durations are
nanoseconds, with the digits that are shown of them. A name is only ever JSON here, text in HTML or
text on a canvas, never markup or code.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
import json
from typing import Any, NamedTuple
import zlib

from mddag_executor.analysis.as_recorded import Replay
from mddag_executor.analysis.explain import Explanation
from mddag_executor.analysis.usage import PoolUse
from mddag_executor.core.state import SINK_IN_TIME
from mddag_executor.core.tally import counts, SinkTally, VERDICTS
from mddag_executor.recording.columns import Ints, Table
from mddag_executor.recording.joins import distinct, rows_by
from mddag_executor.report.columns import executions
from mddag_executor.report.tables import missed_share, short_names
from mddag_executor.report.text import format_ns, printable, shortened
from mddag_executor.report.timeline import Timeline
from msg_graph import Dag
import numpy as np

MOST_MISSES = 500
MOST_HISTOGRAMS = 30
LONGEST_LABEL = 44
COLOURS = ('missed', 'least', 'less', 'more', 'most', 'unknown')
"""Classes of executions: missed, least slack to most slack, and without a verdict."""
SHARES = (0.0, 0.1, 0.25, 0.5)
"""Thresholds between the classes: slack as a share of the deadline."""
_BARS, _MOST_BARS = 60, 400     # of a histogram


class ReportData(NamedTuple):
    """
    The contents of a report.

    :ivar facts: below the title: pairs of a word and a text.
    :ivar result: of the run, as in the result of a replay or simulation.
    :ivar replay: the run as it was recorded or computed.
    :ivar duration_ns: from the first release to the end of the run.
    :ivar explanation: why deadlines were missed; None: it was not recorded, but computed.
    :ivar worker_names: the names of workers, if they are more than a number.
    """

    title: str
    facts: list[tuple[str, str]]
    result: Mapping[str, Any]
    replay: Replay
    timeline: Timeline
    duration_ns: int
    explanation: Explanation | None = None
    worker_names: Sequence[str] = ()


class Line(NamedTuple):
    """A line of the timeline by callback: label, whether it is a DAG's title, and its DAG."""

    label: str
    heading: bool
    dag: str


def slack_class(share: float) -> str:
    """Return the class of a slack, given as a share of the deadline."""
    return COLOURS[int(np.searchsorted(SHARES, share, 'right'))]


def shown_misses(verdicts: Table) -> Ints:
    """
    Return the rows of the missed deadlines to list, in the order of their releases.

    The worst miss of each sink comes before the second worst of any. Misses of one rank are
    compared by their lateness as a share of the deadline. A job that never completed is late by
    at least its deadline.
    """
    missed = np.flatnonzero(verdicts['kind'] != SINK_IN_TIME)
    release, deadline, until, sink = (
        verdicts[name][missed] for name in ('release', 'deadline', 'until', 'sink'))
    late = (until - deadline) / np.maximum(1, deadline - release)
    late = np.where(verdicts['completed'][missed] < 0, np.maximum(1, late), late)
    order = np.lexsort((release, -late, sink))
    rank = np.empty(len(missed), dtype=np.int64)
    for mine in rows_by(sink[order], int(sink.max(initial=0)) + 1):
        rank[order[mine]] = np.arange(len(mine))
    worst = missed[np.lexsort((release, -late, rank))[:MOST_MISSES]]
    return worst[np.lexsort((verdicts['sink'][worst], verdicts['release'][worst]))]


def page_data(data: ReportData, misses: Ints) -> dict[str, Any]:
    """
    Return what the page's script draws, ready for JSON.

    :param misses: the listed misses, rows of ``data.timeline.verdicts``.
    """
    verdicts, task_set = data.timeline.verdicts, data.replay.task_set
    columns, rows = executions(data.replay, data.timeline.rows)
    column = {each.name: each for each in columns}
    order = np.argsort(column['start_ns'].values, kind='stable')
    table = data.replay.recording.executions[rows[order]]
    names = [printable(name) for name in column['vertex'].names]
    lines, line_of = _lines(data, names)
    declared = [vertex.name for vertex in task_set.vertices]
    short = short_names(declared)
    leads_to, colour = _verdicts_of(data, table)
    start, n = _since(data, table['start']), data.result['workers']
    workers = [printable(name) for name in data.worker_names] or [f'worker {w}' for w in range(n)]
    on = table['worker'].astype(np.int64)
    spare = (on < 0) | (on >= len(workers))
    recorded = data.replay.recording.jobs
    places = recorded.places(table)
    jobs = distinct(places[(places >= 0) & (table['vertex'] >= 0)])
    waited = np.where(spare & (table['ready'] < 0), 0, table['start'] - table['ready'])
    response = verdicts['completed'] - verdicts['release']
    deadlines = data.replay.judged.tables.sink_deadline
    return {
        'duration': max(1, data.duration_ns), 'declared': len(declared), 'names': names,
        'short': [printable(short[name]) for name in declared],
        'dags': [printable(dag.name) for dag in task_set.dags],
        'dagOf': [vertex.dag for vertex in task_set.vertices],
        'deadlines': [int(deadlines[i]) for i in range(len(declared))],
        'workers': workers + ['spare threads'] * bool(spare.any()),
        'lines': lines, 'lineOf': line_of, 'kinds': [VERDICTS[kind] for kind in sorted(VERDICTS)],
        'jobs': {
            'dag': (np.searchsorted(recorded.first, jobs, 'right') - 1).tolist(),
            'job': _steps(recorded.number[jobs]),
            'release': _steps(_us(_since(data, recorded.release[jobs])))},
        'executions': {
            'start': _steps(_us(start)), 'ran': _shown(table['end'] - table['start']),
            'waited': _shown(waited), 'worker': np.where(spare, len(workers), on).tolist(),
            'name': column['vertex'].values[order].tolist(), 'job': table['job'].tolist(),
            'sink': np.append(verdicts['sink'], -1)[leads_to].tolist(), 'colour': colour.tolist()},
        'verdicts': {
            'sink': verdicts['sink'].tolist(), 'job': verdicts['job'].tolist(),
            'release': _steps(_us(_since(data, verdicts['release']))),
            'response': [None if never else took for never, took in zip(
                (verdicts['completed'] < 0).tolist(), response.tolist())],
            'kind': verdicts['kind'].tolist()},
        'misses': misses.tolist(),
        'gaps': [[int(_since(data, time)) for time in gap] for gap in data.timeline.gaps],
        'busy': _over_time(data, data.timeline.busy_over_time),
        'late': _over_time(data, data.timeline.missed_over_time),
        'histograms': list(_histograms(data))}


def _since(data: ReportData, times: Any) -> Any:
    """Return times of the recording since its start, ns."""
    return times - (data.replay.recording.start or 0)


def _us(times: Ints) -> Ints:
    """Return times in us, the unit in which they are shown."""
    return np.rint(times / 1000).astype(np.int64)


def _steps(values: Ints) -> list[int]:
    """Return the first value, and what each other one adds to the one before: small numbers."""
    steps: list[int] = np.diff(values, prepend=0).tolist()
    return steps


def _shown(durations: Ints) -> list[int]:
    """Return durations, ns, rounded to the four digits that are shown, or to 1 us."""
    digits = np.floor(np.log10(np.maximum(1, np.abs(durations)))).astype(np.int64)
    unit = 10 ** np.clip(digits - 3, 0, 3)
    rounded: list[int] = ((durations + unit // 2) // unit * unit).tolist()
    return rounded


def _over_time(data: ReportData, use: PoolUse) -> dict[str, Any]:
    """Return the begin of the first step, the length of all, and the sum of each (ns)."""
    return {'start': int(_since(data, use.start or 0)), 'step': int(use.step),
            'sums': [int(each) for each in use.busy]}


def _verdicts_of(data: ReportData, table: Table) -> tuple[Ints, Ints]:
    """
    Return by execution the row of the shown verdict with the least slack that it leads to.

    It is -1 without such a verdict. Also return the index of the class.
    """
    verdicts, first_vertex = data.timeline.verdicts, data.replay.judged.tables.first_vertex
    share = np.where(
        verdicts['completed'] < 0, -np.inf, (verdicts['deadline'] - verdicts['completed'])
        / np.maximum(1, verdicts['deadline'] - verdicts['release']))
    found, least = np.full(len(table), -1), np.full(len(table), np.inf)
    of_dag = rows_by(table['dag'] + 1, len(data.replay.task_set.dags) + 1)[1:]
    of_sink = rows_by(verdicts['sink'], len(data.replay.task_set.vertices))
    jobs = data.replay.recording.jobs
    place, judged_place = jobs.places(table), jobs.places(verdicts)
    for dag, first, rows in zip(data.replay.task_set.dags, first_vertex, of_dag):
        for sink in dag.sinks:
            mine = rows[np.isin(table['vertex'][rows] - first, _ancestors(dag, sink))]
            judged_in = np.full(len(jobs) + 1, -1)      # by place of a job; the last is for none
            judged_in[judged_place[of_sink[first + sink]]] = of_sink[first + sink]
            judged_in[-1] = -1
            judged = judged_in[place[mine]]
            mine, judged = mine[judged >= 0], judged[judged >= 0]
            nearer = share[judged] < least[mine]
            found[mine[nearer]], least[mine[nearer]] = judged[nearer], share[judged[nearer]]
    return found, np.where(
        found < 0, len(COLOURS) - 1, np.searchsorted(SHARES, least, 'right'))


def _ancestors(dag: Dag, sink: int) -> list[int]:
    found = [sink]
    seen = {sink}
    for vertex in found:
        more = [each for each in dag.vertices[vertex].predecessors if each not in seen]
        seen.update(more)
        found += more
    return found


def packed(value: Any) -> str:
    """Return a value as JSON, deflated, in base64: the page's script unpacks it."""
    text = json.dumps(value, ensure_ascii=True, separators=(',', ':'), allow_nan=False)
    return base64.b64encode(zlib.compress(text.encode('ascii'))).decode('ascii')


def unpacked(text: str) -> Any:
    """Return what ``packed`` was given."""
    return json.loads(zlib.decompress(base64.b64decode(text)))


def label(text: str, longest: int = LONGEST_LABEL) -> str:
    """Return a name for an axis: harmless, and shortened in its middle."""
    return shortened(printable(text), longest)


def _lines(data: ReportData, names: list[str]) -> tuple[list[Line], list[int]]:
    """
    Return the lines of the timeline by callback, from the top: the worst DAGs come first.

    Also return the line of each name.
    """
    dags, sinks = data.replay.task_set.dags, data.result['dags']
    short = short_names(vertex.name for dag in dags for vertex in dag.vertices)
    lines: list[Line] = []
    line_of = [0] * len(names)
    for dag in sorted(dags, key=lambda dag: -max((
            missed_share(counts(sink)) for sink in sinks[dag.name]['sinks'].values()),
            default=0.0)):      # all of its sinks may have `deadline: none`
        first, name = data.replay.judged.tables.first_vertex[dag.index], printable(dag.name)
        every = f'every {format_ns(dag.period_ns)}'
        if len(dag.vertices) == 1:      # needs no title
            line_of[first] = len(lines)
            one = short[dag.vertices[0].name]
            lines.append(Line(f'{label(one, LONGEST_LABEL - len(every) - 2)}, {every}', False,
                              name))
            continue
        lines.append(Line(label(f'{dag.name}, {every}'), True, name))
        for place, vertex in enumerate(dag.vertices):
            line_of[first + place] = len(lines)
            lines.append(Line(label(short[vertex.name]), False, name))
    n_declared = len(data.replay.task_set.vertices)
    if names[n_declared:] and dags:
        lines.append(Line('undeclared', True, 'undeclared'))
    for number, name in enumerate(names[n_declared:], n_declared):
        line_of[number] = len(lines)
        lines.append(Line(label(name), False, 'undeclared'))
    return lines, line_of


# --- histograms ----------------------------------------------------------------------------------

def _histograms(data: ReportData) -> Iterator[dict[str, Any]]:
    """Yield the histograms of response times, of the sinks with the least slack first."""
    tally = data.replay.tally
    short = short_names(tally.vertex_name(vertex) for vertex in tally.sinks)
    sinks = [(short[tally.vertex_name(vertex)], sink)
             for vertex, sink in tally.sinks.items() if sink.responses]
    sinks.sort(key=lambda item: -(item[1].longest or 0) / max(1, item[1].relative_deadline_ns))
    for name, sink in sinks[:MOST_HISTOGRAMS]:
        yield histogram(label(name), sink)


def histogram(title: str, tally: SinkTally) -> dict[str, Any]:
    """
    Return a histogram of response times.

    ``bars`` are pairs of the index of a bar and the number of jobs; all bars are ``width`` ns
    wide. The deadline is a multiple of the width, so no bar is partly late. Responses far beyond
    the deadline are left out of the bars; ``later`` has their number, the least and the largest.
    """
    deadline = max(1, tally.relative_deadline_ns)
    responses = np.sort(np.fromiter(
        tally.responses, dtype=np.int64, count=len(tally.responses)))
    longest = int(responses[-1])
    limit = min(longest, max(4 * deadline, int(1.5 * responses[len(responses) // 2])))
    width = deadline / min(_MOST_BARS, max(1, round(_BARS * deadline / max(deadline, limit))))
    places = np.floor(np.maximum(responses - 1, 0) / width).astype(np.int64)
    last = min(max(int(limit // width), round(deadline / width) - 1), _MOST_BARS - 1)
    inside, later = places[places <= last], responses[places > last]
    bars, jobs = np.unique(inside, return_counts=True)
    return {'title': f'{title}: deadline {format_ns(deadline)}', 'deadline': deadline,
            'width': width, 'bars': list(zip(bars.tolist(), jobs.tolist())),
            'later': [len(later), int(later[0]), int(later[-1])] if len(later) else None}
