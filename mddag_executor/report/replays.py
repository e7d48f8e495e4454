# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Tables of a replay: response times of sinks, execution times of callbacks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from mddag_executor.report.explained import causes_line
from mddag_executor.report.tables import (
    guessed_lines,
    ratio,
    requirement_table,
    run_lines,
    short_names,
    times,
    unfinished_lines,
    with_means,
    worst_first,
)
from mddag_executor.report.text import Cell, format_ns, listed, printable, table
from mddag_executor.text import counted
from msg_graph.binding import is_background

_PARTS = {
    'release lag': 'release_lag_ns', 'waiting': 'waiting_ns', 'for group': 'waiting_group_ns',
    'for program': 'waiting_program_ns',
    'executing': 'executing_ns', 'suspended': 'suspended_ns', 'transport': 'transport_ns',
    'unknown': 'unknown_ns'}
_RARE = 'for group', 'for program', 'suspended', 'unknown'
_CALLBACKS = (
    'callback', 'executions', 'busy', 'mean', 'longest', 'mean wait', 'longest wait', 'CPU',
    'interpreter')
PATHS_HEADER = ('path', 'arrived', 'case', 'count', 'min', 'median', 'p99', 'max')


def times_tables(dags: Mapping[str, Any]) -> Iterator[str]:
    """Yield tables of the parts of response times: mean, and of the worst job."""
    found = [(sink.shown_name, sink.result['breakdown']) for sink in worst_first(dags)]
    yield 'Where the response times went, on average:'
    yield table(*times_table(found, 'mean'))
    yield 'The same of the worst job of each sink:'
    yield table(*times_table(found, 'worst'))


def times_table(
    found: Iterable[tuple[str, Mapping[str, Any] | None]], which: str
) -> tuple[list[str], list[list[Cell]]]:
    """
    Return titles and rows of a table of the parts of response times.

    :param found: sinks, and their ``breakdown`` in the result of a replay.
    :param which: ``mean``, or ``worst`` for the worst job of each sink.
    """
    rows = [(name, each and each[which]) for name, each in found]
    # most programs have neither groups that wait nor coroutines, and most recordings no gaps
    parts = {name: key for name, key in _PARTS.items()
             if name not in _RARE or any(each and each[key] for _, each in rows)}
    job = ['job'] if which == 'worst' else []
    return ['sink', *job, *parts], [
        [name, *((each or {}).get(key) for key in job), *times(each, *parts.values())]
        for name, each in rows]


def callbacks_table(
    callbacks: Mapping[str, Mapping[str, Any]]
) -> tuple[list[str], list[list[Cell]]]:
    """Return titles and rows of the table of callbacks, without columns that are not known."""
    short = short_names(key for key in callbacks if ':' in key)     # others are descriptions
    rows: list[list[Cell]] = []
    for key, use in callbacks.items():
        n, busy = use.get('measured', 0), use.get('measured_busy_ns', 0)
        rows.append([
            short.get(key, key), use['executions'],
            *times({'longest_wait_ns': None, **with_means(use)}, 'busy_ns', 'mean_ns',
                   'longest_ns', 'mean_wait_ns', 'longest_wait_ns'),
            f'{use["cpu_ns"] / busy:.0%}' if n and busy else None,
            f'{use["held_interpreter"] / n:.0%}' if n else None])
    known = [i for i, cells in enumerate(zip(*rows)) if any(cell is not None for cell in cells)]
    return [_CALLBACKS[i] for i in known], [[row[i] for i in known] for row in rows]


def communications_table(
    communications: Iterable[Mapping[str, Any]]
) -> tuple[list[str], list[list[Cell]]]:
    """
    Return titles and rows of the table of messages, from publication to callback.

    Those of ROS itself come last.
    """
    rows: list[list[Cell]] = [
        [each['topic'], each['publisher'], each['callback'], each['sent'], each['arrived'],
         *times(each['latency_ns'], 'min', 'median', 'p99', 'max')]
        for each in sorted(communications, key=lambda each: is_background(each['topic'], ''))]
    return ['topic', 'publisher', 'callback', 'sent', 'arrived', 'min', 'median', 'p99',
            'max'], rows


_CASES = ('all', 'best', 'worst', 'worst_with_external_latency')


def recorded_tables(result: Mapping[str, Any], callbacks: bool) -> Iterator[str]:
    """
    Yield the tables of recorded data except jobs: paths, callbacks, messages.

    :param callbacks: also show the callbacks if there are DAGs.
    """
    if result.get('requirements') and not result.get('recorded'):
        yield 'End to end, as required; whole paths, to the end of the last callback:'
        yield requirement_table(result['requirements'])
    if result.get('paths'):
        yield 'End to end, from the first publication to the start of the last callback:'
        yield table(PATHS_HEADER, paths_rows(result['paths']))
    if callbacks or not result['dags']:
        yield table(*callbacks_table(
            result['callbacks'] or result.get('recorded_callbacks', {})))
    if not result['dags'] and result.get('communications'):
        yield 'Messages, from publication to the start of the callback:'
        yield table(*communications_table(result['communications']))


def paths_rows(paths: Mapping[str, Any]) -> Iterator[list[Cell]]:
    """Yield the rows of the table of paths."""
    for name, path in paths.items():
        shown: Cell = name
        arrived: Cell = f'{path["arrived"]} of {path["flows"]}'
        every = {case.replace('_', '-'): path['response_time'][case] for case in _CASES}
        every['data age'] = path['data_age']
        for case, of in every.items():
            yield [shown, arrived, case, None if of is None else of['count'],
                   *times(of, 'min', 'median', 'p99', 'max')]
            shown = arrived = ''


def summary(result: Mapping[str, Any]) -> Iterator[str]:
    """Yield the lines below the tables of a replay."""
    yield from unfinished_lines(result.get('unfinished', ()))
    if result['skip_ns']:
        yield f'left out: jobs released in the first {format_ns(result["skip_ns"])}' + (
            '' if result['skip_ns'] < result['duration_ns'] else
            f', so all of them: the run has only {format_ns(result["duration_ns"])}')
    yield from run_lines(result, _use(result))
    if result.get('misses') is not None:
        yield from causes_line(result['misses'])
    if result['rescheduled']:
        if result['estimated_executions']:
            yield (f'{result["estimated_executions"]} of {result["executions"]} executions did '
                   'not complete in the recording: they take the median of their callback, '
                   'or as long as they ran')
        if result.get('skipped_jobs'):
            yield (f'{counted(result["skipped_jobs"], "job")} whose first callback did not run in '
                   'the recording: skipped again, so expired')
        return
    undeclared = result['undeclared']
    if undeclared['executions']:
        yield (f'{counted(undeclared["executions"], "run")} of undeclared callbacks and tasks, '
               f'{format_ns(undeclared["busy_ns"], 3)} altogether')
    dropped = result['dropped']
    if dropped:
        yield f'{sum(dropped.values())} dropped: ' + ', '.join(
            f'{printable(reason)} {n}' for reason, n in dropped.items())
    lost = result['messages_lost']
    if lost:
        yield (f'{counted(sum(lost.values()), "message")} lost by the middleware: '
               + listed([f'{name} {n}' for name, n in lost.items()]))
    yield from guessed_lines(result.get('guessed', {}))


def _use(result: Mapping[str, Any]) -> str:
    """Return how busy the workers were or, if rescheduled, would be."""
    use = result['worker_use']['use']
    if result['rescheduled']:
        return '' if use is None else f', workers busy {100 * use:.1f} %'
    lent = result['worker_use']['lent_ns']
    more = f'; {format_ns(lent, 3)} in callbacks that had lent their worker' if lent else ''
    return f' (all callbacks: {ratio(use)}{more})'
