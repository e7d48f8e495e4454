# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The data of an HTML report, from which its script draws the timeline and makes texts.

The page has the executions and verdicts that ``timeline`` selects, as columns of numbers that
refer to lists of names; the script makes the texts of tool tips. So a page stays small. Times are
seconds since the start of the recording. A name is only ever JSON here, text in HTML or text on a
canvas, never markup or code.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import json
from typing import Any, NamedTuple

from mddag_executor.core.state import SINK_IN_TIME
from mddag_executor.core.tally import counts, VERDICTS
from mddag_executor.recording.tables import Ints, look_up, Table
from mddag_executor.replay import Replay
from mddag_executor.report.export import executions
from mddag_executor.report.tables import missed_share, short_names
from mddag_executor.report.text import format_ns, printable, shortened
from mddag_executor.report.timeline import Timeline
from msg_graph import Dag
import numpy as np

MOST_MISSES = 500
MOST_LINES = 150
"""Maximum number of lines of the timeline by callback."""
LONGEST_LABEL = 40
RED, ORANGE, BLUE, UNKNOWN = '#d7191c', '#fd8d3c', '#3182bd', '#969696'
COLOURS = (RED, ORANGE, '#fec44f', '#9ecae1', BLUE, UNKNOWN)
"""The colours of executions, from the least slack to the most, and without a verdict."""
_SHARES = (0.0, 0.1, 0.25, 0.5)
"""Thresholds between the colours: slack as a share of the deadline."""
_HIDDEN = -10       # position of a callback without line


class ReportData(NamedTuple):
    """
    The contents of a report.

    :ivar facts: below the title: pairs of a word and a text.
    :ivar result: of the run, as in the result of a replay or simulation.
    :ivar replay: the run as it was recorded or computed.
    :ivar duration_ns: from the first release to the end of the run.
    :ivar causes: the cause of each miss, by global vertex of the sink and job.
    :ivar worker_names: the names of workers, if they are more than a number.
    """

    title: str
    facts: list[tuple[str, str]]
    result: Mapping[str, Any]
    replay: Replay
    timeline: Timeline
    duration_ns: int
    causes: Mapping[tuple[int, int], str] = {}
    worker_names: Sequence[str] = ()


class Line(NamedTuple):
    """A line of a timeline: label, position from the bottom, whether it is a DAG's title."""

    label: str
    y: int
    heading: bool = False


class Prepared(NamedTuple):
    """
    A report's data, ready to be drawn.

    :ivar executions: the columns of the executions; ``marks``: of the worst misses.
    :ivar lines: of the timelines by callback, and by worker; ``n_hidden`` is the number of
        callbacks without line.
    :ivar misses: the worst misses, in the order of their releases.
    :ivar meta: for the page's script.
    """

    executions: dict[str, Any]
    marks: dict[str, Any]
    lines: list[Line]
    worker_lines: list[Line]
    n_hidden: int
    misses: Table
    meta: dict[str, Any]


def prepare(data: ReportData) -> Prepared:
    """Prepare a report's data for drawing."""
    replay, verdicts = data.replay, data.timeline.verdicts
    columns, rows = executions(replay, data.timeline.rows)
    column, table = {each.name: each for each in columns}, replay.recording.executions[rows]
    names = [printable(name) for name in column['vertex'].names]
    lines, ys, n_hidden = _lines(data, names)

    leads_to, colour = _verdicts_of(data, table)
    worst = _worst_misses(verdicts)
    misses = verdicts[worst]
    marked_at = np.where(misses['completed'] < 0, misses['deadline'], misses['completed'])
    workers, n = table['worker'].astype(np.int32), data.result['workers']
    on = np.where((workers >= 0) & (workers < n), workers, n)
    spare = int((on == n).any())
    declared, known = (np.asarray(column[name].known) for name in ('dag', 'release_ns'))
    return Prepared(
        {'left': seconds(data, table['start']), 'right': seconds(data, table['end']),
         'waited': (table['start'] - table['ready']) / 1e9, 'worker': workers,
         'workers': (n + spare - on).astype(np.int32), 'callbacks': ys[column['vertex'].values],
         'name': column['vertex'].values.astype(np.int32),
         'dag': np.where(declared, column['dag'].values, -1).astype(np.int32),
         'job': table['job'].astype(np.float64),
         'release': np.where(known, seconds(data, column['release_ns'].values), np.nan),
         'verdict': leads_to.astype(np.int32), 'class': colour.astype(np.int32)},
        {'x': seconds(data, marked_at), 'workers': np.zeros(len(worst)),
         'callbacks': ys[misses['sink']], 'verdict': worst.astype(np.int32)},
        lines, _worker_lines(data, spare), n_hidden, misses,
        _meta(data, names, worst.tolist()))


def seconds(data: ReportData, times: Any) -> Any:
    """Return times of the recording in seconds since its start."""
    return (times - (data.replay.recording.start or 0)) / 1e9


def _worst_misses(verdicts: Table) -> Ints:
    """Return the rows of the worst missed deadlines, in the order of their releases."""
    missed = np.flatnonzero(verdicts['kind'] != SINK_IN_TIME)
    deadline, completed = verdicts['deadline'][missed], verdicts['completed'][missed]
    done = completed >= 0
    worst = missed[np.lexsort((deadline, np.where(done, deadline - completed, 0), done))]
    worst = worst[:MOST_MISSES]
    return worst[np.lexsort((verdicts['sink'][worst], verdicts['release'][worst]))]


def _verdicts_of(data: ReportData, table: Table) -> tuple[Ints, Ints]:
    """
    Return by execution the row of the shown verdict with the least slack that it leads to.

    It is -1 without such a verdict. Also return the index of the colour.
    """
    verdicts, first_vertex = data.timeline.verdicts, data.replay.judged.tables.first_vertex
    share = np.where(
        verdicts['completed'] < 0, -np.inf, (verdicts['deadline'] - verdicts['completed'])
        / np.maximum(1, verdicts['deadline'] - verdicts['release']))
    found, least = np.full(len(table), -1), np.full(len(table), np.inf)
    for dag, first in zip(data.replay.task_set.dags, first_vertex):
        for sink in dag.sinks:
            mine = np.flatnonzero(np.isin(table['vertex'] - first, _ancestors(dag, sink)))
            judged = np.flatnonzero(verdicts['sink'] == first + sink)
            at = look_up(verdicts['job'][judged], table['job'][mine])
            mine, judged = mine[at >= 0], judged[at[at >= 0]]
            nearer = share[judged] < least[mine]
            found[mine[nearer]], least[mine[nearer]] = judged[nearer], share[judged[nearer]]
    return found, np.where(
        found < 0, len(COLOURS) - 1, np.searchsorted(_SHARES, least, 'right'))


def _ancestors(dag: Dag, sink: int) -> list[int]:
    found = [sink]
    seen = {sink}
    for vertex in found:
        more = [each for each in dag.vertices[vertex].predecessors if each not in seen]
        seen.update(more)
        found += more
    return found


def _meta(data: ReportData, names: list[str], worst: list[int]) -> dict[str, Any]:
    """Return the tables for the texts of the page's script; releases in s, other times in ns."""
    task_set, verdicts = data.replay.task_set, data.timeline.verdicts
    declared = [vertex.name for vertex in task_set.vertices]
    short = short_names(declared)
    responses = (verdicts['completed'] - verdicts['release']).tolist()
    return {
        'duration': data.duration_ns / 1e9, 'declared': len(declared), 'names': names,
        'short': [printable(short[name]) for name in declared],
        'dags': [printable(dag.name) for dag in task_set.dags],
        'workers': [printable(name) for name in data.worker_names],
        'verdicts': list(zip(
            *(verdicts[name].tolist() for name in ('sink', 'dag', 'job')),
            seconds(data, verdicts['release']).tolist(),
            (verdicts['deadline'] - verdicts['release']).tolist(),
            [None if completed < 0 else response
             for completed, response in zip(verdicts['completed'].tolist(), responses)],
            [VERDICTS[kind] for kind in verdicts['kind'].tolist()])),
        'missed': worst}


def json_for_html(value: Any) -> str:
    """Return JSON that can be in a script element with any contents."""
    text = json.dumps(value, ensure_ascii=True, separators=(',', ':'), allow_nan=False)
    return text.replace('<', '\\u003c').replace('>', '\\u003e').replace('&', '\\u0026')


def label(text: str, longest: int = LONGEST_LABEL) -> str:
    """Return a name for an axis: harmless, and shortened in its middle."""
    return shortened(printable(text), longest)


def _lines(data: ReportData, names: list[str]) -> tuple[list[Line], Any, int]:
    """
    Return the lines of the timeline by callback, from the top: the worst DAGs come first.

    Also return the position of each name, and the number of names without a line.
    """
    dags, sinks = data.replay.task_set.dags, data.result['dags']
    short = short_names(vertex.name for dag in dags for vertex in dag.vertices)
    texts: list[tuple[str, bool]] = []
    rows = np.zeros(len(names), dtype=np.int32)
    for dag in sorted(dags, key=lambda dag: -max(
            missed_share(counts(sink)) for sink in sinks[dag.name]['sinks'].values())):
        first = data.replay.judged.tables.first_vertex[dag.index]
        texts.append((f'{dag.name}, every {format_ns(dag.period_ns)}', True))
        rows[first:first + len(dag.vertices)] = len(texts) + np.arange(len(dag.vertices))
        texts += [(short[vertex.name], False) for vertex in dag.vertices]
    n_declared = len(data.replay.task_set.vertices)
    others = names[n_declared:]
    texts += [('undeclared', True)] * bool(others)
    rows[n_declared:] = len(texts) + np.arange(len(others))
    texts = [*texts, *((name, False) for name in others)][:MOST_LINES]
    top = len(texts) - 1
    return ([Line(label(text), top - i, heading) for i, (text, heading) in enumerate(texts)],
            np.where(rows > top, _HIDDEN, top - rows), int((rows > top).sum()))


def _worker_lines(data: ReportData, spare: int) -> list[Line]:
    """Return the lines of the timeline by worker; at the bottom are the missed deadlines."""
    n = data.result['workers']
    names = [printable(name) for name in data.worker_names] or [f'worker {w}' for w in range(n)]
    names += ['spare threads'] * spare + ['missed deadlines']
    return [Line(name, len(names) - 1 - i) for i, name in enumerate(names)]
