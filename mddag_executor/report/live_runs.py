# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The table of a live run, and lines of text below it."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from mddag_executor.core.tally import counts, never_due, total
from mddag_executor.report.tables import (
    drift_lines,
    guessed_lines,
    MOST_LINES,
    never_due_lines,
    percent,
    requirement_table,
    sink_table,
    unfinished_lines,
    verdicts_line,
)
from mddag_executor.report.text import listed, printable
from mddag_executor.text import counted, step_text

_DECLARED_KINDS = ('timer', 'subscription', 'service')
SHOWN_NS = 10_000_000
"""Less waiting for other callbacks of the program is not worth a line."""


def live_lines(result: dict[str, Any]) -> Iterator[str]:
    """Yield the table of a run's sinks (there is none without a declaration), and the lines."""
    if result['dags']:
        yield sink_table(result['dags'])
        if result['requirements']:
            yield requirement_table(result['requirements'])
        yield verdicts_line(result['dags'])
    else:
        yield 'no declaration was given, so no deadline was judged'
    stops = result['stops']
    if stops['misses']:
        yield (f'{stops["misses"]} of {total(result["dags"]).missed} misses '
               f'are due to {counted(stops["count"], "stop")} ({stops["total_ns"] / 1e9:.2f} s), '
               'in which no thread of this process ran')
    for each in result['clock_steps'][:MOST_LINES]:
        yield step_text(each['step_ns'])
    yield from unfinished_lines(result['unfinished'])
    yield from never_due_lines(result['dags'])
    yield from _early_lines(result)
    if 'processes' in result:
        yield from _absent(result['dags'])
    measured = result['measured']
    if measured is not None:
        yield from _measured_lines(measured)
    callbacks = result['callbacks']
    for one, many, numbers in (
            ('dropped', 'dropped', result['dropped']),
            ('message lost by the middleware', 'messages lost by the middleware',
             _numbers(callbacks, 'lost')),
            ('run of callbacks that raised', 'runs of callbacks that raised',
             _numbers(callbacks, 'failed')),
            ('timer release skipped', 'timer releases skipped', _numbers(callbacks, 'skipped')),
            ('message without a job', 'messages without a job',
             _numbers(callbacks, 'unattributed')),
            ('run of undeclared callbacks', 'runs of undeclared callbacks', {
                name: each['ran'] for name, each in callbacks.items()
                if each['ran'] and not each['declared']})):
        if numbers:
            names = [f'{name} {n}' for name, n in numbers.items()]
            # without a declaration they are all that there is to see
            yield f'{counted(sum(numbers.values()), one, many)}: ' + (
                listed(names) if result['dags'] else printable(', '.join(names)))
    yield from guessed_lines(_numbers(callbacks, 'guessed'))
    for each in result.get('exclusion', ()):
        if each['waited_ns'] >= SHOWN_NS:
            yield (f'callbacks of --node {printable(each["program"])} waited '
                   f'{each["waited_ns"] / 1e9:.2f} s in all, as its executor would not run '
                   'them at the same time (--concurrent NODE lets them overlap)')
    deaf = {name: each['incompatible_qos'] for name, each in result['callbacks'].items()
            if each.get('incompatible_qos') and not each['ran']}
    if deaf:
        yield (f'{counted(len(deaf), "callback")} without messages, as a publisher has an '
               'incompatible QoS: '
               + listed([f'{name} ({policy})' for name, policy in deaf.items()]))
    drift = result.get('drift', ())
    yield from drift_lines(drift)
    yield from _never_ran(result, {each['callback'] for each in drift})
    for trace in (result['trace'], *(p['trace'] for p in result.get('processes', ()))):
        if trace is not None:
            lost = trace['lost']
            why = 'the disk was too slow' if trace['error'] is None else 'writing failed'
            yield (f'trace: {printable(str(Path(trace["path"]).absolute()))}'
                   + (f' ({counted(lost, "event")} lost: {why})' if lost else ''))
    if not result['dags'] and result['trace'] is not None:
        yield _next_step(printable(result['trace']['path']), callbacks)
    for process in result.get('processes', ()):
        if process['died']:
            yield printable(f'process {process["name"]} {process["how"]}: '
                            f'{process["said"] or "it said nothing"}')


def _next_step(path: str, callbacks: dict[str, Any]) -> str:
    if any(each['kind'] in _DECLARED_KINDS for each in callbacks.values()):
        return (f'to judge it: mddag graph from-trace {path} --accept -o graph.yaml, then '
                f'mddag replay {path} graph.yaml')
    return ('there is nothing to judge: no timer, subscription or service of the nodes ran, and '
            'actions and parameters cannot be declared')


def _never_ran(result: dict[str, Any], reported: Collection[str]) -> Iterator[str]:
    """Yield lines about the declared callbacks that never ran, without the reported ones."""
    not_found = {key: question for key, question in result['not_found'].items()
                 if key not in reported}
    if not_found:
        found = counted(
            len(not_found), 'declared callback was', 'declared callbacks were')
        yield f'{found} found in no node: ' + listed(
            [key if question is None else f'{key} ({question})'
             for key, question in not_found.items()])
    never = [key for key in result['never_ran']
             if key not in reported and key not in result['not_found']]
    waited = {key: dropped for key in never if (dropped := result['dropped'].get(key))}
    for some, why in ((waited, 'all that was ready was dropped'), (
            [key for key in never if key not in waited], 'nothing started')):
        if some:
            yield (f'{counted(len(some), "declared callback")} never ran, as {why}'
                   f'{"" if some is waited else " it" if len(some) == 1 else " them"}: '
                   + listed([*some]))


def _early_lines(result: dict[str, Any]) -> Iterator[str]:
    """Yield a line about sinks that ran before the run was judged, and not later."""
    runs = {sink: result['callbacks'].get(sink.partition('@')[0])
            for sink in never_due(result['dags'])}
    early = [sink for sink, each in runs.items()
             if each is not None and each['ran'] > each['unattributed']]
    if early:
        yield ('ran only before all programs and processes were ready, which is not judged: '
               + listed(early))


def _absent(dags: dict[str, Any]) -> Iterator[str]:
    """Yield a line about the sinks that more than one job of their process did not reach."""
    absent = [
        f'{sink} {missing} of {dag["jobs"]}' for dag in dags.values()
        for sink, verdicts in dag['sinks'].items()
        if (missing := dag['jobs'] - counts(verdicts).due - counts(verdicts).not_due) > 1]
    if absent:
        yield ('jobs that did not come to their sinks, or whose process died with the count (a '
               f'replay of the traces shows why): {listed(absent)}')


def _measured_lines(measured: dict[str, Any]) -> Iterator[str]:
    yield (
        f'measured by the nodes, {measured["window_ns"] / 1e9:.1f} s after a warm-up of '
        f'{measured["warm_up_ns"] / 1e9:g} s: {measured["sink_jobs_due"]} due, '
        f'{measured["on_time"]} in time ({percent(measured["on_time"], measured["sink_jobs_due"])}'
        f'), {measured["late"]} late, {measured["missing"]} missing')
    cpu_us = measured['cpu_us_per_callback']
    cpu = '-' if cpu_us is None else f'{cpu_us:.0f}'
    yield (
        f'utilisation {measured["utilisation"]:.3f} planned (seed {measured["seed"]}), '
        f'{measured["utilisation_taken"]:.3f} by measured times; '
        f'{measured["callbacks_per_s"]:.0f} callbacks a second, {cpu} us of CPU each')


def _numbers(callbacks: dict[str, Any], count: str) -> dict[str, int]:
    return {name: each[count] for name, each in callbacks.items() if each[count]}
