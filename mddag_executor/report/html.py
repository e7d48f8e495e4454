# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The HTML report of a run: one file with tables and pictures that needs no network.

``of_outcome`` and ``of_run`` return a report's data, ``write`` writes the page.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from html import escape
from pathlib import Path, PurePath
from typing import Any, BinaryIO

from mddag_executor import __version__
from mddag_executor.analysis.as_recorded import Replay
from mddag_executor.core.requirements import as_dags, not_met
from mddag_executor.core.tally import total
from mddag_executor.recording.columns import Ints
from mddag_executor.report.explained import causes_line
from mddag_executor.report.html_data import packed, page_data, ReportData, shown_misses
from mddag_executor.report.html_tables import (
    callbacks_html,
    data_table,
    html_table,
    misses_html,
    page_head,
    sinks_html,
    worst_html,
    worst_line,
)
from mddag_executor.report.replays import communications_table, PATHS_HEADER, paths_rows
from mddag_executor.report.tables import (
    never_due_lines,
    pool_text,
    ratio,
    requirement_columns,
    verdicts_line,
    worst_first,
)
from mddag_executor.report.text import format_ns, printable
from mddag_executor.report.timeline import Timeline
from mddag_executor.simulate import SimulatedRun, Workload
from mddag_executor.text import counted
from mddag_executor.whatif.computed import ComputedRun
from mddag_executor.whatif.reschedule import Reschedule
from msg_graph import TaskSet

_SCRIPT = Path(__file__).with_name('html.js')
_LEGEND = {
    'missed': 'deadline missed', 'least': 'slack below 10 % of the deadline',
    'less': 'below 25 %', 'more': 'below 50 %', 'most': '50 % and more',
    'unknown': 'no deadline, or no verdict'}
_KEYS = (('n, p', 'next and previous miss'), ('Left, Right', 'move'), ('+, -', 'zoom'),
         ('0', 'the whole run'))


def of_outcome(
    outcome: Replay | Reschedule, result: Mapping[str, Any] | None = None
) -> ReportData:
    """
    Return the data of a report about a recorded run.

    :param result: of the outcome, if it is known already.
    """
    result = outcome.result() if result is None else result
    trace = result['recording']['trace']
    if isinstance(outcome, Replay):
        return _data(
            'Replay as recorded', [('recording', trace)], result, outcome, outcome.duration_ns,
        )._replace(explanation=outcome.explanation,
                   worker_names=outcome.recording.names.workers)
    what, title = ('bag', 'Bag') if outcome.recorded is None else ('recording', 'Replay')
    data = _data(f'{title}, rescheduled', [(what, trace)], result,
                 Replay(outcome.computed().recording(result['workers'])), outcome.duration_ns)
    return data._replace(facts=[*data.facts, *(('assumed', note) for note in outcome.notes)],
                         worker_names=outcome.worker_names)


def of_run(task_set: TaskSet, load: Workload, run: SimulatedRun) -> ReportData:
    """Return the data of a report about a run that was simulated with its log."""
    replay = Replay(ComputedRun.of_run(task_set, load, run).recording(run.settings.workers))
    result = {**run.result(), 'requirements': replay.requirements.result()}
    return _data('Simulation', [('declaration', task_set.file)], result, replay, run.ended_ns)


def _data(
    title: str, facts: list[tuple[str, str]], result: Mapping[str, Any], replay: Replay,
    duration_ns: int,
) -> ReportData:
    facts = [*facts, ('pool', pool_text(result)), ('duration', format_ns(result['duration_ns']))]
    every = result.get('worker_use', {}).get('use')
    if result['dags']:
        facts.append(('utilisation', ratio(result['utilisation'])))
    if every is not None:
        facts.append(('utilisation by all callbacks', ratio(every)))
    return ReportData(title, facts, result, replay, Timeline(replay.recording, replay.judged),
                      duration_ns)


def write(file: BinaryIO, data: ReportData) -> None:
    """Write a report."""
    misses = shown_misses(data.timeline.verdicts)
    for part in _page(data, misses):
        file.write(part.encode('utf-8', 'backslashreplace'))


def _page(data: ReportData, misses: Ints) -> Iterator[str]:
    task_set = data.replay.task_set
    title = escape(printable(
        f'{data.title}: {PurePath(task_set.file or data.facts[0][1]).name}'))
    yield f'{page_head(title)}</head><body>\n<h1>{title}</h1>\n'
    yield from _head(data)
    yield '<noscript><p class="warning">The pictures need JavaScript.</p></noscript>\n'
    if task_set.dags:
        yield misses_html(data, data.timeline.verdicts[misses])
        yield f'<h2>Sinks</h2>\n{sinks_html(data)}'
    else:
        yield _note('No DAG is declared: give a GRAPH to judge deadlines.')
    yield from _timeline(data, bool(len(misses)))
    if data.result.get('requirements'):
        header, cells = requirement_columns(data.result['requirements'])
        yield '<h2>Requirements of paths</h2>\n' + _note(
            'A reaction is counted from the change after the input before, an age from the input; '
            'both up to the end of the last callback.')
        yield data_table(html_table(
            header, map(cells, worst_first(as_dags(data.result['requirements']))), 1,
            {header.index('late')}), name='requirements')
    if data.result.get('paths'):
        yield '<h2>End to end</h2>\n' + _note(
            'From the first publication to the start of the last callback.')
        yield data_table(html_table(PATHS_HEADER, paths_rows(data.result['paths']), 3),
                         name='paths')
    if any(sink.responses for sink in data.replay.tally.sinks.values()):
        yield '<h2>Response times against deadlines</h2>\n' + _note(
            'The sink nearest to its deadline, or furthest past it, comes first. Jobs that never '
            'completed are in the table of sinks only.')
        yield '<div class="grid" id="mddag-histograms"></div>\n'
        yield f'<h2>Where the time of the worst jobs went</h2>\n{worst_html(data)}'
    yield f'<h2>Callbacks</h2>\n{callbacks_html(data)}'
    if not task_set.dags and data.result.get('communications'):
        yield '<h2>Messages</h2>\n' + _note(
            'Times are from the publication to the start of the callback.')
        yield data_table(html_table(*communications_table(data.result['communications']), 3),
                         'search messages', name='messages')
    yield f'<footer>mddag_executor {escape(__version__)}</footer>\n'
    yield ('<script id="mddag-data" type="application/octet-stream">'
           f'{packed(page_data(data, misses))}</script>\n'
           f'<script>{_SCRIPT.read_text(encoding="utf-8")}</script>\n</body></html>\n')


def _timeline(data: ReportData, missed: bool) -> Iterator[str]:
    """Yield the part of the page that has the timelines; the script draws them."""
    judged = bool(data.replay.task_set.dags)
    legend = ''.join(
        f'<span><i class="{kind}"></i>{text}</span>' for kind, text in _LEGEND.items()
        if (judged or kind == 'unknown') and (missed or kind != 'missed'))
    if data.timeline.gaps:
        legend += '<span><i class="gap"></i>executions left out</span>'
    if missed:
        legend += ('<span><b class="miss">&#9660;</b>missed deadline</span>'
                   '<span><i class="job"></i>chosen job, until its deadline</span>'
                   '<span><i class="late"></i>its lateness</span>')
    keys = ''.join(f'<span><kbd>{key}</kbd> {text}</span>' for key, text in _KEYS
                   if missed or 'miss' not in text)
    yield ('<section id="mddag-timeline"><h2>Timeline</h2>\n'
           f'<p class="legend">{legend}</p>\n')
    yield _note('Times count from the beginning of the run. Each bar is one execution'
                + (', in the colour of the least slack that it leads to' if judged else '')
                + '; point at it for its facts. Drag the window of the first picture, or its '
                'edges; drag the others to move, and zoom with Ctrl and the wheel.')
    button = '<button type="button" id="mddag-{}">{}</button> '.format
    yield '<div class="buttons">'
    if missed:
        yield (button('previous', '&#9664; previous miss') + button('next', 'next miss &#9654;'))
    yield (button('out', '&minus;') + button('in', '+') + button('whole', 'whole run')
           + f'<span class="keys">{keys}</span>'
           '<div id="mddag-status" role="status"></div></div>\n')
    yield ('<canvas id="mddag-overview" tabindex="0" role="img" aria-label="busy workers over the '
           'whole run"></canvas>\n<h3>By worker</h3>\n<canvas id="mddag-workers" tabindex="0" '
           'role="img" aria-label="executions by worker"></canvas>\n<h3>By callback</h3>\n'
           '<p class="search"><input type="search" id="mddag-lines" placeholder="DAG or callback" '
           'aria-label="show the DAGs or callbacks of this name"> <span class="note" '
           'id="mddag-shown"></span></p>\n<canvas id="mddag-callbacks" tabindex="0" role="img" '
           'aria-label="executions by callback"></canvas>\n<div id="mddag-tip" hidden></div>'
           '</section>\n')


def _note(text: str, kind: str = 'note') -> str:
    return f'<p class="{kind}">{escape(printable(text))}</p>\n'


def _head(data: ReportData) -> Iterator[str]:
    dags = data.result['dags']
    every = total(dags)
    yield '<p class="facts">' + ' '.join(
        f'<span><b>{escape(printable(word))}</b> {escape(printable(text))}</span>'
        for word, text in data.facts) + '</p>\n'
    if dags:
        missed = not_met(data.result.get('requirements', {}))
        good = every.due and not every.missed and not missed
        lines = [f'{path}: the required {what} is not met: {why}'
                 for (path, what), why in missed.items()]
        lines += worst_line(data)
        if data.result.get('misses') is not None:
            lines += causes_line(data.result['misses'])
        yield (f'<div class="verdict {"good" if good else "bad"}"><b>{verdicts_line(dags)}</b>'
               + ''.join(f'<p>{escape(printable(line))}</p>' for line in lines) + '</div>\n')
    for warning in [*never_due_lines(dags), *data.result.get('warnings', ())]:
        yield _note(warning, 'warning')
    shown, n = len(data.timeline.rows), data.timeline.n_executions
    if shown < n:
        yield _note(f'The timelines show {shown} of {counted(n, "execution")}: around missed '
                    'deadlines, and evenly spread over the run elsewhere. Tables and histograms '
                    'are of all; mddag export -o RUN.pftrace shows all in Perfetto.', 'warning')
