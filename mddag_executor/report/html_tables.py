# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The tables of an HTML report; every name in them is escaped."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Sequence
from html import escape
from pathlib import Path

from mddag_executor.analysis.causes import CAUSES
from mddag_executor.core.tally import counts, total, VERDICTS
from mddag_executor.recording.columns import Table
from mddag_executor.report.html_data import ReportData, slack_class
from mddag_executor.report.replays import callbacks_table, times_table
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
"""Number of rows that a table of sinks shows at first."""


class Html(str):
    """Text that is already markup."""

    __slots__ = ()


def page_head(title: str) -> str:
    """Return the begin of a page, up to the end of its style."""
    return (f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
            f'<title>{title}</title>'
            '\n<meta name="viewport" content="width=device-width">\n'
            '<meta name="color-scheme" content="light dark">\n'
            '<link rel="icon" href="data:,">\n'
            f'<style>{_STYLE.read_text(encoding="utf-8")}</style>\n')


def html_table(
    header: Sequence[str], rows: Iterable[Sequence[object]], texts: int, bad: Container[int] = (),
    attributes: Sequence[str] = (),
) -> str:
    """
    Return a table.

    :param texts: number of text columns on the left; the others are right-aligned.
    :param bad: columns that are highlighted if they are neither 0 nor empty.
    :param attributes: of each row, already markup.
    """
    kinds = [' class="text"' if i < texts else '' for i in range(len(header))]
    lines = ['<table><thead><tr>', *(
        f'<th{kind}>{escape(title)}</th>' for kind, title in zip(kinds, header)),
        '</tr></thead><tbody>\n']
    for number, row in enumerate(rows):
        lines.append(f'<tr {attributes[number]}>' if attributes else '<tr>')
        for i, cell in enumerate(row):
            shown = cell if isinstance(cell, Html) else escape(
                '-' if cell is None else printable(str(cell)))
            kind = ' class="bad"' if i in bad and cell else kinds[i]
            lines.append(f'<td{kind}>{shown}</td>')
        lines.append('</tr>\n')
    return ''.join([*lines, '</tbody></table>'])


def _reached(sink: Sink) -> float:
    """Return the longest response time as a share of the deadline; 0 if it never completed."""
    response = sink.result['response_ns']
    return 0.0 if response is None else float(
        response['max'] / max(1, sink.result['relative_deadline_ns']))


def _ranked(data: ReportData) -> list[Sink]:
    """Return the sinks: the largest share of misses first, then the nearest to its deadline."""
    return sorted(each_sink(data.result['dags']), key=lambda sink: (
        -missed_share(counts(sink.result)), -_reached(sink)))


def worst_line(data: ReportData) -> Iterator[str]:
    """Yield which sink was worst, and why, if any job was due."""
    worst = next((sink for sink in _ranked(data) if counts(sink.result).due), None)
    if worst is None:
        return
    verdicts, response = counts(worst.result), worst.result['response_ns']
    text = f'worst sink: {worst.name}: '
    if verdicts.missed:
        text += f'{verdicts.missed} of {counted(verdicts.due, "deadline")} missed'
        causes = (data.result.get('misses') or {'sinks': {}})['sinks'].get(worst.name, {})
        if any(causes.values()):
            text += f', most often because of: {max(causes, key=lambda cause: causes[cause])}'
        text += '; '
    yield text + ('it never completed' if response is None else (
        f'longest response time {format_ns(response["max"], 3)}, {100 * _reached(worst):.0f} % of '
        f'the deadline of {format_ns(worst.result["relative_deadline_ns"])}'))


def data_table(
    table: str, search: str = '', more: int = 0, name: str = 'data', note: str = ''
) -> str:
    """
    Return a table that the page's script makes sortable and searchable.

    :param search: what its search box is for; empty: it has none.
    :param more: the number of rows if some of them are hidden at first.
    :param note: markup next to the search box.
    """
    box = (f'<input type="search" placeholder="{escape(search)}" aria-label="{escape(search)}"> '
           if search else '')
    button = f'<button type="button" class="all">show all {more}</button> ' if more else ''
    head = f'<p class="search">{box}{button}<span class="note">{note}</span></p>\n'
    return (f'<div class="data" id="mddag-{name}">\n{head if box or button or note else ""}'
            f'<div class="scroll" tabindex="0">{table}</div></div>\n')


def sinks_html(data: ReportData) -> str:
    """Return the table of sinks, the worst ones first: verdicts and response times."""
    columns, cells = sink_columns(data.result['dags'])
    header = ['DAG', 'sink', *columns]
    ranked = _ranked(data)
    rows = [(sink.dag, sink.shown_name, *cells(sink), _reached_bar(_reached(sink)))
            for sink in ranked]
    shown = html_table(
        [*header, 'max of deadline'], rows, 2,
        [i for i in range(header.index('late'), header.index('median')) if header[i] != 'not due'],
        [f'data-dag="{escape(printable(sink.dag))}"' + ' hidden' * (i >= MOST_ROWS)
         for i, sink in enumerate(ranked)])
    return data_table(
        shown, 'search sinks', len(rows) if len(rows) > MOST_ROWS else 0, 'sinks',
        'The worst ones come first. Click on a title to sort, on a sink to see its DAG in the '
        'timeline by callback.')


def _reached_bar(share: float) -> Html:
    """Return a bar from 0 to the deadline, in the colour of the slack that is left."""
    return bar(share, slack_class(1 - share), f'{100 * share:.0f} %')


def bar(share: float, kind: str, text: str) -> Html:
    """Return a bar of a class with a text next to it; at most its whole width is filled."""
    return Html(f'<span class="bar"><i class="{kind}" style="width:{100 * min(1.0, share):.1f}%">'
                f'</i></span><b>{text}</b>')


def misses_html(data: ReportData, misses: Table) -> str:
    """Return the table of the listed misses, by time."""
    if not data.timeline.n_missed:
        return ('<p class="note">No deadline was missed.</p>\n' if total(data.result['dags']).due
                else '<p class="note">No job was due at any sink: nothing is proven.</p>\n')
    task_set, start = data.replay.task_set, data.replay.recording.start or 0
    why = _why(data, misses)
    short = short_names([*(vertex.name for vertex in task_set.vertices), *(
        name for name in why.get('mostly behind', ()) if name)])
    header = ('DAG', 'sink', 'verdict', *why, 'job', 'released at', 'response', 'late by')
    rows = []
    for miss, *texts in zip(misses, *why.values()):
        sink, job, release, deadline, completed = (int(miss[name]) for name in (
            'sink', 'job', 'release', 'deadline', 'completed'))
        rows.append((
            task_set.dags[miss['dag']].name, short[task_set.vertices[sink].name],
            VERDICTS[miss['kind']], *(short.get(text, text) or None for text in texts), job,
            f'{(release - start) / 1e9:.6f} s',
            *(None if completed < 0 else format_ns(completed - since, 3)
              for since in (release, deadline))))
    what = 'All' if len(rows) == data.timeline.n_missed else (
        f'{len(rows)} of {data.timeline.n_missed} (the worst of each sink come first into this '
        'list)')
    table = html_table(header, rows, 3 + len(why),
                       attributes=[f'data-miss="{i}"' for i in range(len(rows))])
    return '<h2>Missed deadlines</h2>\n' + data_table(
        table, 'search misses', 0, 'misses',
        f'{what}, in the order of time. Click on a title to sort, on a miss to see it in the '
        'timeline.')


def _why(data: ReportData, misses: Table) -> dict[str, list[str]]:
    """Return the columns that say why each miss was late, without those that no miss has."""
    explanation = data.explanation
    if explanation is None:
        return {}
    row = explanation.misses_of(misses).tolist()
    longest, causes = explanation.longest_behind(), explanation.found.causes.tolist()
    found = {'cause': [CAUSES[causes[each]] for each in row]}
    if any(longest):
        found['mostly behind'] = [longest[each] for each in row]
    return found


def worst_html(data: ReportData) -> str:
    """Return a table of where the time of the worst job of each sink went, the worst one first."""
    vertices, deadlines = data.replay.task_set.vertices, data.replay.judged.tables.sink_deadline
    short = short_names(vertex.name for vertex in vertices)
    found = sorted(data.replay.chains.breakdown().items(), key=lambda item: (
        item[1]['worst']['release_ns'] - item[1]['worst']['completed_ns']) / deadlines[item[0]])
    rows = [(short[vertices[sink].name], each) for sink, each in found[:MOST_ROWS]]
    return data_table(html_table(*times_table(rows, 'worst'), 1), name='worst')


def callbacks_html(data: ReportData) -> str:
    """Return the table of callbacks: executions, execution times, waiting times."""
    usage = data.replay.usage
    callbacks = usage.callbacks() or data.result.get('recorded_callbacks', {})
    undeclared = usage.undeclared()
    if undeclared['executions'] and usage.callbacks():
        callbacks = {**callbacks, 'undeclared callbacks': undeclared}
    return data_table(html_table(*callbacks_table(callbacks), 1), 'search callbacks',
                      name='callbacks')
