# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The tables of an HTML report; every name in them is escaped."""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence
from html import escape
from pathlib import Path

from mddag_executor.core.tally import counts, total
from mddag_executor.replay.chains import Breakdown
from mddag_executor.report.html_data import json_for_html, Prepared, ReportData
from mddag_executor.report.replays import (
    CALLBACKS_HEADER,
    callbacks_rows,
    PATHS_HEADER,
    paths_rows,
    RECORDED_HEADER,
    recorded_rows,
)
from mddag_executor.report.tables import (
    each_sink,
    missed_share,
    short_names,
    Sink,
    sink_columns,
)
from mddag_executor.report.text import format_ns, printable
from mddag_executor.text import counted

_STYLE = Path(__file__).with_name('html.css')
MOST_ROWS = 50
"""Number of sinks in the page itself; a script adds the others."""
_COLOURS = {
    'release_lag_ns': '#c7c7c7', 'waiting_ns': '#fd8d3c', 'executing_ns': '#3182bd',
    'suspended_ns': '#9e9ac8', 'transport_ns': '#74c476', 'unknown_ns': '#636363'}
_PARTS = [(name.removesuffix('_ns').replace('_', ' '), _COLOURS.get(name, '#8c6d31'))
          for name in Breakdown._fields]


class Html(str):
    """Text that is already markup."""

    __slots__ = ()


def page_head(title: str) -> str:
    """Return the begin of a page, up to the end of its style."""
    return (f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
            f'<title>{title}</title>'
            '\n<meta name="viewport" content="width=device-width">\n'
            '<link rel="icon" href="data:,">\n'
            f'<style>{_STYLE.read_text(encoding="utf-8")}</style>\n')


def html_table(
    header: Sequence[str], rows: Iterable[Sequence[object]], texts: int, bad: Container[int] = (),
    attributes: Iterable[str] | None = None,
) -> str:
    """
    Return a table.

    :param texts: number of text columns on the left; the others are right-aligned.
    :param bad: columns that are highlighted if they are neither 0 nor empty.
    :param attributes: of each row, already markup.
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


def _reached(sink: Sink) -> float:
    """Return the longest response time as a share of the deadline; 0 if it never completed."""
    response = sink.result['response_ns']
    return 0.0 if response is None else float(
        response['max'] / max(1, sink.result['relative_deadline_ns']))


def _ranked(data: ReportData) -> list[Sink]:
    """Return the sinks: the largest share of misses first, then the nearest to its deadline."""
    return sorted(each_sink(data.tally.result()['dags']), key=lambda sink: (
        -missed_share(counts(sink.result)), -_reached(sink)))


def worst_line(data: ReportData) -> str | None:
    """Return which sink was worst, and why; None: no job was due."""
    worst = next((sink for sink in _ranked(data) if counts(sink.result).due), None)
    if worst is None:
        return None
    verdicts, response = counts(worst.result), worst.result['response_ns']
    text = f'worst sink: {worst.name}: '
    if verdicts.missed:
        text += f'{verdicts.missed} of {counted(verdicts.due, "deadline")} missed'
        causes = {} if data.misses is None else data.misses['sinks'].get(worst.name, {})
        if any(causes.values()):
            text += f', most often because of: {max(causes, key=lambda cause: causes[cause])}'
        text += '; '
    if response is None:
        return text + 'it never completed'
    return text + (
        f'longest response time {format_ns(response["max"], 3)}, {100 * _reached(worst):.0f} % of '
        f'the deadline of {format_ns(worst.result["relative_deadline_ns"])}')


def sinks_html(data: ReportData) -> str:
    """
    Return the table of sinks, the worst ones first: verdicts and response times.

    The rows after the first ``MOST_ROWS`` are data for the page's script, which adds them on
    demand.
    """
    dags = data.tally.result()['dags']
    columns, cells = sink_columns(dags)
    header = ['DAG', 'sink', *columns]
    ranked = _ranked(data)
    full = [(sink.dag, sink.shown_name, *cells(sink), _reached_bar(_reached(sink)))
            for sink in ranked]
    bad = range(header.index('late'), header.index('median'))
    shown = html_table([*header, 'max of deadline'], full[:MOST_ROWS], 2, bad,
                       attributes=(f'data-reached="{_reached(sink):.4f}"' for sink in ranked))
    rest = [[*('-' if cell is None else printable(str(cell)) for cell in row[:-1]), _reached(sink)]
            for row, sink in zip(full[MOST_ROWS:], ranked[MOST_ROWS:])]
    more = (f'<button id="mddag-all-sinks">show all {len(full)}</button>' if rest else '')
    return ('<p class="search"><input id="mddag-search" type="search" placeholder="search sinks" '
            f'aria-label="search sinks"> {more} <span class="note">The worst ones come first; '
            'click on a title to sort.</span></p>\n'
            f'<div class="wide" id="mddag-sinks">{shown}</div>\n'
            f'<script id="mddag-more-sinks" type="application/json">{json_for_html(rest)}'
            '</script>')


def _reached_bar(share: float) -> Html:
    """Return a bar from 0 to the deadline, red beyond it."""
    colour = '#d7191c' if share > 1 else '#fd8d3c' if share > 0.9 else '#3182bd'
    return Html(f'<span class="reached"><i style="width:{100 * min(1.0, share):.1f}%;'
                f'background:{colour}"></i></span><b>{100 * share:.0f} %</b>')


def misses_html(data: ReportData, prepared: Prepared) -> str:
    """Return the table of the worst misses, by time."""
    if not data.timeline.n_missed:
        due = total(data.tally.result()['dags']).due
        return ('<p class="note">No deadline was missed.</p>\n' if due else
                '<p class="note">No job was due at any sink: nothing is proven.</p>\n')
    short = short_names(vertex.name for vertex in data.task_set.vertices)
    rows = []
    for miss in prepared.misses:
        vertex = data.task_set.vertices[miss.sink]
        dag = data.task_set.dags[vertex.dag]
        late = None if miss.completed is None else format_ns(miss.completed - miss.deadline, 3)
        response = None if miss.completed is None else format_ns(miss.completed - miss.release, 3)
        cause = [data.causes.get((miss.sink, miss.job))] if data.causes else []
        rows.append((dag.name, short[vertex.name], miss.verdict, *cause, miss.job,
                     f'{miss.release / 1e9:.6f} s', response, late))
    header = ('DAG', 'sink', 'verdict', *(['cause'] if data.causes else []), 'job', 'released at',
              'response', 'late by')
    shown = len(prepared.misses)
    what = f'The {shown} worst of {data.timeline.n_missed}' if shown < data.timeline.n_missed \
        else 'All'
    what += ' in the order of time'
    attributes = (f'data-miss="{i}"' for i in range(shown))
    return (f'<h2>Missed deadlines</h2>\n<p class="note">{what}; click on one to see it in the '
            f'timeline.</p>\n<div class="scroll">'
            f'{html_table(header, rows, 3 + bool(data.causes), attributes=attributes)}</div>\n')


def worst_html(data: ReportData) -> str:
    """Return a table with a bar for each sink: the parts of its worst job's time."""
    short = short_names(vertex.name for vertex in data.task_set.vertices)
    rows = []
    worst_of = {vertex: each['worst'] for vertex, each in data.breakdown.items()}
    if len(worst_of) > MOST_ROWS:       # sinks with the least slack
        worst_of = dict(sorted(worst_of.items(), key=lambda item: (
            item[1]['release_ns'] - item[1]['completed_ns'])
            / data.tables.sink_deadline[item[0]])[:MOST_ROWS])
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
            _stack(split, deadline, max(1.0, longest)), worst['job'], format_ns(response, 3),
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
    """Return the table of callbacks: executions, execution times, waiting times."""
    rows = list(callbacks_rows(data.usage.callbacks()))
    undeclared = data.usage.undeclared()
    if undeclared['executions']:
        rows += callbacks_rows({'undeclared callbacks': undeclared})
    tables = [html_table(CALLBACKS_HEADER, rows, 1)]
    if data.recorded:
        tables.append(html_table(RECORDED_HEADER, recorded_rows(data.recorded), 1))
    return '<h3>In the recording</h3>\n'.join(
        f'<div class="scroll">{each}</div>\n' for each in tables)
