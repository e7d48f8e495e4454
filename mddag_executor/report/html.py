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
from mddag_executor.core.tally import total
from mddag_executor.errors import MddagError
from mddag_executor.replay import Replay, Reschedule
from mddag_executor.replay.computed import ComputedRun
from mddag_executor.report.explained import causes_line
from mddag_executor.report.html_data import (
    COLOURS,
    json_for_html,
    prepare,
    Prepared,
    ReportData,
)
from mddag_executor.report.html_tables import (
    callbacks_html,
    html_table,
    misses_html,
    page_head,
    sinks_html,
    worst_html,
    worst_line,
)
from mddag_executor.report.replays import PATHS_HEADER, paths_rows
from mddag_executor.report.tables import never_due_lines, pool_text, ratio, verdicts_line
from mddag_executor.report.text import format_ns, printable
from mddag_executor.report.timeline import Timeline
from mddag_executor.simulate import Load, SimulatedRun
from mddag_executor.text import counted
from msg_graph import TaskSet

_SCRIPT = Path(__file__).with_name('html.js')
_LEGEND = (
    'deadline missed', 'slack below 10 % of the deadline', 'below 25 %', 'below 50 %',
    '50 % and more', 'no deadline, or no verdict')
_BARS = 'Each bar is one execution, in the colour of the least slack that it leads to.'


def check_available() -> None:
    """Check that reports can be made, before long work starts."""
    try:
        import bokeh  # noqa: F401
    except ImportError:
        raise MddagError(
            "--report: Bokeh is not installed: pip install 'mddag_executor[report]'") from None


def of_outcome(outcome: Replay | Reschedule) -> ReportData:
    """Return the data of a report about a recorded run."""
    result = outcome.result()
    trace = result['recording']['trace']
    if isinstance(outcome, Replay):
        return _data(
            'Replay as recorded', [('recording', trace)], result, outcome, outcome.duration_ns,
        )._replace(causes=outcome.explanation.causes(),
                   worker_names=outcome.recording.worker_names)
    what, title = ('bag', 'Bag') if outcome.recorded is None else ('recording', 'Replay')
    data = _data(f'{title}, rescheduled', [(what, trace)], result,
                 Replay(outcome.computed().recording(result['workers'])), outcome.duration_ns)
    return data._replace(facts=[*data.facts, *(('assumed', note) for note in outcome.notes)],
                         worker_names=outcome.worker_names)


def of_run(task_set: TaskSet, load: Load, run: SimulatedRun) -> ReportData:
    """Return the data of a report about a run that was simulated with its log."""
    replay = Replay(ComputedRun.of_run(task_set, load, run).recording(run.settings.workers))
    return _data('Simulation', [('declaration', task_set.file)], run.result(), replay,
                 run.ended_ns)


def _data(
    title: str, facts: list[tuple[str, str]], result: Mapping[str, Any], replay: Replay,
    duration_ns: int,
) -> ReportData:
    facts = [*facts, ('pool', pool_text(result)), ('duration', format_ns(result['duration_ns'])),
             ('utilisation', ratio(result['utilisation']))]
    return ReportData(title, facts, result, replay, Timeline(replay.recording, replay.judged),
                      duration_ns)


def write(file: BinaryIO, data: ReportData) -> None:
    """Write a report."""
    from bokeh.embed import components
    from bokeh.resources import Resources
    from mddag_executor.report.html_plots import figures, THEME
    prepared = prepare(data)
    script, divisions = components(figures(data, prepared), theme=THEME)
    library = Resources(mode='inline', components=['bokeh']).render_js()
    for part in _page(data, prepared, library, script, list(divisions)):
        file.write(part.encode('utf-8', 'backslashreplace'))


def _page(
    data: ReportData, prepared: Prepared, library: str, script: str, divisions: list[str]
) -> Iterator[str]:
    overview, workers, callbacks, *histograms = (
        f'<div class="mddag-plot">{division}</div>' for division in divisions)
    task_set = data.replay.task_set
    title = escape(printable(
        f'{data.title}: {PurePath(task_set.file or data.facts[0][1]).name}'))
    yield page_head(title)
    yield library
    yield f'</head><body>\n<h1>{title}</h1>\n'
    yield from _head(data)
    if task_set.dags:
        yield misses_html(data, prepared)
        yield f'<h2>Sinks</h2>\n{sinks_html(data)}\n'
    else:
        yield _note('No DAG is declared: give a GRAPH to judge deadlines.')
    legend = ''.join(f'<span><i style="background:{colour}"></i>{text}</span>'
                     for colour, text in zip(COLOURS, _LEGEND))
    yield (f'<h2 id="mddag-timeline">Timeline</h2>\n<p class="legend">{legend}'
           '<span><b class="miss">&#9660;</b>a missed deadline that the table lists</span></p>\n')
    yield _note('Times count from the beginning of the run. Drag the window of the first picture, '
                'or its edges. In the others drag to move, zoom with Ctrl and the wheel (or the '
                'tools above a picture), and point at a bar for its facts.')
    yield ('<p class="buttons"><button id="mddag-previous">&#9664; previous miss</button> '
           '<button id="mddag-next">next miss &#9654;</button> '
           '<button id="mddag-whole">whole run</button> <span id="mddag-status"></span></p>\n')
    yield f'{overview}\n{_note(_BARS)}'
    yield f'<h3>By worker</h3>\n{workers}\n<h3>By callback</h3>\n'
    if prepared.n_hidden:
        yield _note('DAGs that missed the largest share of their deadlines come first. Left '
                    f'out: {counted(prepared.n_hidden, "callback")}.')
    yield f'{callbacks}\n'
    if data.result.get('paths'):
        yield '<h2>End to end</h2>\n' + _note(
            'From the first publication to the start of the last callback.')
        paths = html_table(PATHS_HEADER, paths_rows(data.result['paths']), 3)
        yield f'<div class="wide">{paths}</div>\n'
    if histograms:
        yield '<h2>Response times against deadlines</h2>\n' + _note(
            'Nearest to its deadline, or furthest past it, first. What never completed is in the '
            'table of sinks only.')
        yield f'<div class="grid">{"".join(histograms)}</div>\n'
        yield f'<h2>Where the time of the worst jobs went</h2>\n{worst_html(data)}\n'
    yield f'<h2>Callbacks</h2>\n{callbacks_html(data)}\n'
    yield f'<footer>mddag_executor {escape(__version__)}</footer>\n'
    yield ('<script id="mddag-meta" type="application/json">'
           f'{json_for_html(prepared.meta)}'
           f'</script>\n{script}\n<script>{_SCRIPT.read_text(encoding="utf-8")}</script>\n')
    yield '</body></html>\n'


def _note(text: str, kind: str = 'note') -> str:
    return f'<p class="{kind}">{escape(printable(text))}</p>\n'


def _head(data: ReportData) -> Iterator[str]:
    dags = data.result['dags']
    every = total(dags)
    yield '<p class="facts">' + ' '.join(
        f'<span><b>{escape(printable(word))}</b> {escape(printable(text))}</span>'
        for word, text in data.facts) + '</p>\n'
    if dags:
        good = every.due and not every.missed
        lines = [*worst_line(data)]
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
