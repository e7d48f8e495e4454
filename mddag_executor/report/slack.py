# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The result of the slack search as tables of text, and as a page with bars."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from html import escape
import math
from typing import Any

from mddag_executor.report.html_tables import bar, Html, html_table, page_head
from mddag_executor.report.tables import percent, short_names, times
from mddag_executor.report.text import Cell, format_ns, listed, printable, table
from mddag_executor.text import counted

_QUESTION = 'How much longer each callback may take'
_MARGINS = 'sink', 'deadline', 'least margin', 'of it', '99 % have', 'median'
_PATHS = 'path', 'required', *_MARGINS[2:]
_PATHS_TITLE = 'How much less than required the paths take now'


def lines(result: Mapping[str, Any]) -> Iterator[str]:
    """Yield the tables of callbacks (tightest first) and sinks, and the lines below."""
    short = _short(result)
    yield from _missed_lines(result)
    yield from _load_lines(result)
    rows = [[short[name], _times(one['factor']), short[one['breaks']]]
            for name, one in _tightest(result)]
    if rows:
        yield f'\n{_QUESTION}, if the others take as long as now:'
        yield table(('callback', 'may take', 'then misses'), rows)
    yield 'How long before their deadlines the sinks complete now:'
    yield table(_MARGINS, [
        [short[name], *_margins(sink)] for name, sink in _least_first(result['sinks'])])
    if 'requirements' in result:
        yield f'{_PATHS_TITLE} (the factors above are those of the sinks):'
        yield table(_PATHS, [[name, *_margins(path)]
                             for name, path in _least_first(result['requirements'])])
    yield from _summary(result)


def _is_judged(result: Mapping[str, Any]) -> bool:
    """Return whether some sinks complete in time."""
    sinks = result['sinks']
    never = sum(sink['margin_ns'] is None and not result['missed'].get(name)
                for name, sink in sinks.items())
    return never < len(sinks) and len(result['left_out']) < len(sinks)


def _margins(sink: Mapping[str, Any]) -> list[Cell]:
    margin, deadline = sink['margin_ns'], sink['relative_deadline_ns']
    of_it = None if margin is None or margin['min'] < 0 else percent(margin['min'], deadline)
    return [format_ns(deadline), *times(margin, 'min'), of_it, *times(margin, 'p1', 'median')]


def _missed_lines(result: Mapping[str, Any]) -> Iterator[str]:
    missed = result['missed']
    if missed:
        yield (f'{counted(sum(missed.values()), "deadline")} missed: '
               + listed([f'{name} ({n})' for name, n in missed.items()]))
    if result['left_out']:
        yield ('left out, because shorter execution times do not help: '
               + listed(result['left_out']))


def _summary(result: Mapping[str, Any]) -> Iterator[str]:
    never = [name for name, sink in result['sinks'].items()
             if sink['margin_ns'] is None and not result['missed'].get(name)]
    if never:
        yield f'never completed, so not judged: {counted(len(never), "sink")}: {listed(never)}'
    if not _is_judged(result):
        if len(never) < len(result['sinks']):
            yield 'every sink misses every deadline, whatever the callbacks take'
        return
    useless = sum(one['factor'] == 0 for one in result['callbacks'].values())
    if useless:
        yield (f'{counted(useless, "callback")}: deadlines are missed however little one alone '
               'takes')
    free = sum(one['factor'] is None for one in result['callbacks'].values())
    most = result['most']
    if free:
        yield f'{counted(free, "callback")} may take {most:g} times as long and more'


def _load_lines(result: Mapping[str, Any]) -> Iterator[str]:
    """Yield the factor for all callbacks together, and the sufficient workers and CPUs."""
    if not _is_judged(result):
        return
    load, most = result['load'], result['most']
    yield 'the load as a whole: ' + (
        f'{most:g} times and more' if load['factor'] is None else
        f'it must be less than {1 / most:g} times; {printable(load["breaks"])} misses'
        if load['factor'] == 0 else
        f'{_times(load["factor"])}, then {printable(load["breaks"])} misses')
    pools = [(f' in {printable(process["name"])}', process['workers'])
             for process in result.get('processes', ())]
    for name, place, fewer in (
            ('worker', '', result['workers']), *(('worker', *pool) for pool in pools),
            ('CPU', '', result['cpus'])):
        if fewer is not None:
            some = f'{fewer["least"]} of {counted(fewer["given"], name)}{place}'
            yield f'{some} {"is" if fewer["least"] == 1 else "are"} enough' + (
                '' if fewer['breaks'] is None else
                f'; with one less {printable(fewer["breaks"])} misses')


def page(result: Mapping[str, Any], title: str) -> Iterator[str]:
    """Yield the parts of an HTML page."""
    heading = escape(printable(f'Slack: {title}'))
    yield f'{page_head(heading)}</head><body>\n<h1>{heading}</h1>\n'
    for line in (*_missed_lines(result), *_load_lines(result), *_summary(result)):
        yield f'<p class="note">{escape(line)}</p>\n'
    short = _short(result)
    rows = [(short[name], short[one['breaks']], _bar(one['factor'], result['most']))
            for name, one in _tightest(result)]
    if rows:
        yield (f'<h2>{_QUESTION}</h2>\n<p class="note">If the others take as long as now. The '
               f'bars are logarithmic, up to {result["most"]:g} times.</p>\n<div class="wide">')
        yield html_table(('callback', 'then misses', 'may take'), rows, 2) + '</div>'
    yield '<h2>Margins of the sinks</h2>\n'
    yield html_table(_MARGINS, [(short[name], *_margins(sink))
                                for name, sink in _least_first(result['sinks'])], 1)
    if 'requirements' in result:
        yield f'<h2>{_PATHS_TITLE}</h2>\n'
        yield html_table(_PATHS, [(name, *_margins(path))
                                  for name, path in _least_first(result['requirements'])], 1)
    yield '</body></html>\n'


def _short(result: Mapping[str, Any]) -> dict[str, str]:
    return short_names({*result['callbacks'], *result['sinks']})


def _tightest(result: Mapping[str, Any]) -> list[tuple[str, Any]]:
    return sorted(((name, one) for name, one in result['callbacks'].items()
                   if one['factor']), key=lambda item: item[1]['factor'])


def _least_first(sinks: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Return sinks by margin as a share of the deadline, the least first."""
    def share(item: tuple[str, Any]) -> float:
        margin = item[1]['margin_ns']
        return float('-inf') if margin is None else margin['min'] / item[1]['relative_deadline_ns']

    return sorted(sinks.items(), key=share)


def _times(factor: float) -> str:
    """Return a factor as text, never rounded up."""
    return f'{math.floor(factor * 100) / 100:.2f} times'


def _bar(factor: float, most: float) -> Html:
    kind = 'missed' if factor < 1.1 else 'least' if factor < 1.5 else 'most'
    return bar(max(0.0, math.log(factor) / math.log(most)), kind, _times(factor))
