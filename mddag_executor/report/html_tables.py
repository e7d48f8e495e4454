# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The tables of an HTML report; every name in them is escaped."""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence
from html import escape

from mddag_executor.core.tally import total
from mddag_executor.replay.chains import Breakdown
from mddag_executor.report.html_data import KINDS, Prepared, ReportData
from mddag_executor.report.replays import (
    CALLBACKS_HEADER,
    callbacks_rows,
    PATHS_HEADER,
    paths_rows,
    RECORDED_HEADER,
    recorded_rows,
)
from mddag_executor.report.tables import short_names, sink_rows
from mddag_executor.report.text import format_ns, printable

_COLOURS = {
    'release_lag_ns': '#c7c7c7', 'waiting_ns': '#fd8d3c', 'executing_ns': '#3182bd',
    'suspended_ns': '#9e9ac8', 'transport_ns': '#74c476', 'unknown_ns': '#636363'}
_PARTS = [(name.removesuffix('_ns').replace('_', ' '), _COLOURS.get(name, '#8c6d31'))
          for name in Breakdown._fields]


class Html(str):
    """Text that is markup already."""

    __slots__ = ()


def html_table(
    header: Sequence[str], rows: Iterable[Sequence[object]], texts: int, bad: Container[int] = (),
    attributes: Iterable[str] | None = None,
) -> str:
    """
    Return a table.

    :param texts: how many columns on the left hold text; the others are aligned to the right.
    :param bad: columns that stand out where they are neither 0 nor empty.
    :param attributes: of each row, markup already.
    """
    extra = iter(attributes) if attributes is not None else None
    lines = ['<table><thead><tr>', *(
        f'<th{_text(i < texts)}>{escape(title)}</th>' for i, title in enumerate(header)),
        '</tr></thead><tbody>\n']
    for row in rows:
        lines.append(f'<tr{" " + next(extra) if extra is not None else ""}>')
        for i, cell in enumerate(row):
            shown = cell if isinstance(cell, Html) else escape(
                '-' if cell is None else printable(str(cell)))
            mark = ' class="bad"' if i in bad and cell else _text(i < texts)
            lines.append(f'<td{mark} data-title="{escape(header[i])}">{shown}</td>')
        lines.append('</tr>\n')
    return ''.join([*lines, '</tbody></table>'])


def _text(is_text: bool) -> str:
    return ' class="text"' if is_text else ''


def sinks_html(data: ReportData) -> str:
    """Return the table of sinks: verdicts, and response times by the deadline."""
    header, rows = sink_rows(data.tally.result()['dags'])
    bad = range(header.index('late'), header.index('median'))
    return f'<div class="wide">{html_table(header, rows, 2, bad)}</div>'


def misses_html(data: ReportData, prepared: Prepared) -> str:
    """Return the table of the worst misses, by time."""
    if not data.timeline.n_missed:
        due = total(data.tally.result()['dags']).due
        return ('<p class="note">No deadline was missed.</p>\n' if due else
                '<p class="note">No job was due at any sink: nothing is proven.</p>\n')
    short = short_names(vertex.name for vertex in data.task_set.vertices)
    rows = []
    for miss in (prepared.misses[i] for i in prepared.worst):
        vertex = data.task_set.vertices[miss.sink]
        dag = data.task_set.dags[vertex.dag]
        release = miss.deadline - data.tables.sink_deadline[miss.sink]
        late = None if miss.completed is None else format_ns(miss.completed - miss.deadline)
        response = None if miss.completed is None else format_ns(miss.completed - release)
        rows.append((dag.name, short[vertex.name], KINDS[miss.kind], miss.job,
                     f'{release / 1e9:.6f} s', response, late))
    header = ('DAG', 'sink', 'what', 'job', 'released at', 'response', 'late by')
    shown = len(prepared.worst)
    what = f'The {shown} worst of {data.timeline.n_missed}' if shown < data.timeline.n_missed \
        else 'All'
    what += ' in the order of time'
    attributes = (f'data-miss="{i}"' for i in prepared.worst)
    return (f'<h2>Missed deadlines</h2>\n<p class="note">{what}; click on one to see it in the '
            f'timeline.</p>\n<div class="scroll">'
            f'{html_table(header, rows, 3, attributes=attributes)}</div>\n')


def worst_html(data: ReportData) -> str:
    """Return a table with a bar for each sink: where the time of its worst job went."""
    short = short_names(vertex.name for vertex in data.task_set.vertices)
    rows = []
    worst_of = {vertex: each['worst'] for vertex, each in data.breakdown.items()}
    longest = max((
        (worst['completed_ns'] - worst['release_ns']) / data.tables.sink_deadline[vertex]
        for vertex, worst in worst_of.items()), default=0.0)
    used = [any(worst[name] for worst in worst_of.values()) for name in Breakdown._fields]
    for vertex, worst in worst_of.items():
        one = data.task_set.vertices[vertex]
        response = worst['completed_ns'] - worst['release_ns']
        deadline = data.tables.sink_deadline[vertex]
        split = [worst[name] for name in Breakdown._fields]
        rows.append((
            data.task_set.dags[one.dag].name, short[one.name],
            _stack(split, deadline, max(1.0, longest)), worst['job'], format_ns(response),
            *(format_ns(part, 3) for part, shown in zip(split, used) if shown),
            format_ns(deadline)))
    parts = [part for part, shown in zip(_PARTS, used) if shown]
    legend = ''.join(f'<span><i style="background:{colour}"></i>{name}</span>'
                     for name, colour in parts)
    header = ('DAG', 'sink', 'worst job', 'job', 'response', *(name for name, _ in parts),
              'deadline')
    return (f'<p class="legend">{legend}</p>\n<p class="note">The bars have one scale: parts of '
            'the deadline, which is the red line.</p>\n'
            f'<div class="wide">{html_table(header, rows, 3)}</div>')


def _stack(parts: Sequence[int], deadline: int, longest: float) -> Html:
    """Return a bar on a scale from 0 to ``longest``, in parts of the deadline."""
    whole = max(1, deadline) * longest
    bars = ''.join(
        f'<i style="width:{100 * max(0, part) / whole:.3f}%;background:{colour}"></i>'
        for part, (_, colour) in zip(parts, _PARTS))
    return Html(f'<div class="stack">{bars}<u style="left:{100 * deadline / whole:.3f}%"></u>'
                '</div>')


def paths_html(data: ReportData) -> str:
    """Return the table of the declared paths' end-to-end times."""
    return f'<div class="wide">{html_table(PATHS_HEADER, paths_rows(data.paths), 3)}</div>'


def callbacks_html(data: ReportData) -> str:
    """Return the table of callbacks: how often each ran, how long, how long it waited."""
    rows = list(callbacks_rows(data.usage.callbacks()))
    undeclared = data.usage.undeclared()
    if undeclared['executions']:
        rows += callbacks_rows({'undeclared callbacks': undeclared})
    tables = [html_table(CALLBACKS_HEADER, rows, 1)]
    if data.recorded:
        tables.append(html_table(RECORDED_HEADER, recorded_rows(data.recorded), 1))
    return '<h3>In the recording</h3>\n'.join(
        f'<div class="scroll">{each}</div>\n' for each in tables)
