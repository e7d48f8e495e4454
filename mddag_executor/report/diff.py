# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Compares two runs, sink by sink and callback by callback.

Sinks and callbacks are matched by name. If only one run has them, the other side is empty. A sink
is *worse* in the second run if it missed a larger share of its deadlines, if none of its jobs was
due in contrast to the first run or, with a tolerance, if its p99 response time grew by more.  A
sink of a DAG that is released only when needed (``sporadic``, ``once``) may be not due.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any, TYPE_CHECKING

from mddag_executor.core.requirements import as_dags
from mddag_executor.core.tally import Counts, counts, total
from mddag_executor.report.tables import (
    percent,
    short_names,
    times,
    verdicts_text,
    with_means,
)
from mddag_executor.report.text import Cell, format_ns, printable, table
from mddag_executor.text import counted

if TYPE_CHECKING:
    from mddag_executor.results.comparisons import (
        CallbackSide,
        ComparedCallback,
        ComparedDag,
        ComparedRun,
        ComparedSink,
        DiffResult,
        DiffResultRare,
        SinkSide,
        TimesChange,
        VerdictCounts,
    )
    from mddag_executor.results.replays import CallbackUse
    from mddag_executor.results.sinks import ResponseTimes

_HEADER = (
    'sink', 'due A', 'due B', 'in time A', 'in time B', 'p99 A', 'p99 B', 'p99 B-A', '')


def compare(
    before: Mapping[str, Any], after: Mapping[str, Any], tolerance: float | None = None,
    when_needed: Collection[str] = (),
) -> DiffResult:
    """
    Compare the results of two replays.

    :param tolerance: allowed growth of a p99 response time, as a share (0.1 is 10 %).
    :param before: results of ``Replay`` or ``Reschedule``, as is ``after``.
    :param when_needed: names of the DAGs that are released only when needed.
    :returns: for JSON: ``sinks`` by DAG and name with both sides (``a``, ``b``; null if missing),
        ``change_ns`` and ``change`` (share) of response times and ``worse``; ``requirements`` of
        paths in the same format; ``callbacks`` with
        both sides' executions and mean times; ``worse`` of the whole; ``compared``, the number of
        sinks due in both.
    """
    dags = compare_sinks(before['dags'], after['dags'], tolerance, when_needed)
    requirements = compare_requirements(before, after, tolerance)
    every = [sink for each in (dags, requirements) for dag in each.values()
             for sink in dag['sinks'].values()]
    took: list[Mapping[str, Any]] = [side.get('callbacks', {}) for side in (before, after)]
    callbacks: dict[str, ComparedCallback] = {
        key: {'a': _callback(took[0].get(key)), 'b': _callback(took[1].get(key))}
        for key in _union(*took)}
    more: DiffResultRare = {'requirements': requirements} if requirements else {}
    return {
        'a': _run(before), 'b': _run(after), 'tolerance': tolerance,
        'worse': any(sink['worse'] for sink in every),
        'compared': sum(sink['a'] is not None and sink['b'] is not None
                        and min(sink['a']['due'], sink['b']['due']) > 0 for sink in every),
        'dags': dags, **more, 'callbacks': callbacks}


def compare_sinks(
    before: Mapping[str, Any], after: Mapping[str, Any], tolerance: float | None = None,
    when_needed: Collection[str] = (),
) -> dict[str, ComparedDag]:
    """Compare the ``dags`` of two results (see ``compare``); return those of the difference."""
    dags: dict[str, ComparedDag] = {}
    for name in _union(before, after):
        sides = [side.get(name, {'sinks': {}})['sinks'] for side in (before, after)]
        dags[name] = {'sinks': {
            sink: _sink(sides[0].get(sink), sides[1].get(sink), tolerance,
                        must_be_due=name not in when_needed)
            for sink in _union(*sides)}}
    return dags


def _union(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    return list(dict.fromkeys([*one, *other]))


def _run(result: Mapping[str, Any]) -> ComparedRun:
    every = total(result['dags'])
    return {
        'trace': result['recording']['trace'], 'policy': result['policy'],
        'workers': result['workers'], 'duration_ns': result['duration_ns'],
        'utilisation': result['utilisation'], 'imported': 'recorded_callbacks' in result,
        'rescheduled': result['rescheduled'], 'skip_ns': result['skip_ns'], **_verdicts(every)}


def _verdicts(every: Counts) -> VerdictCounts:
    return {
        'due': every.due, 'in_time': every.in_time, 'late': every.late, 'expired': every.expired,
        'aborted': every.aborted, 'failed': every.failed, 'dropped': every.dropped,
        'demoted': every.demoted, 'not_due': every.not_due}


def _side(sink: Mapping[str, Any] | None) -> SinkSide | None:
    if sink is None:
        return None
    return {'relative_deadline_ns': sink['relative_deadline_ns'], **_verdicts(counts(sink)),
            'response_ns': sink['response_ns']}


def _sink(
    before: Mapping[str, Any] | None, after: Mapping[str, Any] | None, tolerance: float | None,
    must_be_due: bool,
) -> ComparedSink:
    a, b = _side(before), _side(after)
    change_ns: ResponseTimes | None = None
    change: TimesChange | None = None
    worse = False
    if a is not None and b is not None:
        worse = (b['due'] - b['in_time']) * a['due'] > (a['due'] - a['in_time']) * b['due'] \
            or (a['due'] == 0 and b['in_time'] < b['due']) or (
                must_be_due and b['due'] == 0 and a['due'] > 0)
        if a['response_ns'] is not None and b['response_ns'] is not None:
            old, new = a['response_ns'], b['response_ns']
            change_ns = {'min': new['min'] - old['min'], 'median': new['median'] - old['median'],
                         'p99': new['p99'] - old['p99'], 'max': new['max'] - old['max']}
            change = {
                'min': _share(change_ns['min'], old['min']),
                'median': _share(change_ns['median'], old['median']),
                'p99': _share(change_ns['p99'], old['p99']),
                'max': _share(change_ns['max'], old['max'])}
            if tolerance is not None:
                worse |= change_ns['p99'] > tolerance * a['response_ns']['p99']
    return {'a': a, 'b': b, 'change_ns': change_ns, 'change': change, 'worse': worse}


def _share(grown: int, before: int) -> float | None:
    return grown / before if before else None


def _callback(use: CallbackUse | None) -> CallbackSide | None:
    if use is None:
        return None
    found = with_means(use)
    return {'executions': use['executions'], 'mean_ns': found['mean_ns'],
            'longest_ns': use['longest_ns'], 'mean_wait_ns': found['mean_wait_ns']}


def compare_requirements(
    before: Mapping[str, Any], after: Mapping[str, Any], tolerance: float | None = None
) -> dict[str, ComparedDag]:
    """Compare the requirements of paths in two results; return them as sinks of DAGs."""
    first, second = (as_dags(side.get('requirements', {})) for side in (before, after))
    return compare_sinks(first, second, tolerance)


def sinks_table(dags: Mapping[str, Any], what: str = 'sink') -> str:
    """Return the table of a difference's sinks; those that are worse in run B come first."""
    sinks = [(name, sink) for dag in dags.values() for name, sink in dag['sinks'].items()]
    short = short_names(name for name, _ in sinks)
    sinks.sort(key=lambda item: _order(item[1]))
    rows: list[list[Cell]] = []
    for name, sink in sinks:
        pairs = zip(_cells(sink['a']), _cells(sink['b']))
        share = None if sink['change'] is None else sink['change']['p99']
        rows.append([short[name], *(cell for pair in pairs for cell in pair),
                     None if share is None else f'{100 * share:+.1f} %', _remark(sink)])
    return table((what, *_HEADER[1:]), rows, marked=[sink['worse'] for _, sink in sinks])


def _cells(side: Mapping[str, Any] | None) -> list[Cell]:
    if side is None:
        return [None] * 3
    return [side['due'], percent(side['in_time'], side['due']), *times(side['response_ns'], 'p99')]


def _order(sink: Mapping[str, Any]) -> tuple[bool, float]:
    """Return the sort key of sinks: worse ones, then the largest share of misses in B."""
    b = sink['b']
    missed = 0 if b is None else (b['due'] - b['in_time']) / max(1, b['due'])
    return not sink['worse'], -missed


def _remark(sink: Mapping[str, Any]) -> str:
    if sink['a'] is None:
        return 'only in B'
    if sink['b'] is None:
        return 'only in A'
    due = [bool(sink[side]['due']) for side in 'ab']
    remarks = ['worse'] if sink['worse'] else []
    if not all(due):
        remarks.append('never due' + ('' if not any(due) else ' in B' if due[0] else ' in A'))
    if sink['a']['relative_deadline_ns'] != sink['b']['relative_deadline_ns']:
        remarks.append(f'deadline in B {format_ns(sink["b"]["relative_deadline_ns"])}')
    return ', '.join(remarks)


def callbacks_table(difference: Mapping[str, Any]) -> str:
    """Return a table of the callbacks' executions and times in both runs."""
    rows: list[list[Cell]] = []
    short = short_names(difference['callbacks'])
    for key, both in difference['callbacks'].items():
        sides = [both[side] for side in 'ab']
        rows.append([short[key], *(side and side['executions'] for side in sides), *(
            cell for what in ('mean_ns', 'longest_ns', 'mean_wait_ns')
            for side in sides for cell in times(side, what))])
    return table(('callback', 'ran A', 'ran B', 'mean A', 'mean B', 'longest A', 'longest B',
                  'wait A', 'wait B'), rows)


def lines(difference: Mapping[str, Any], callbacks: bool) -> Iterator[str]:
    """Yield the tables (callbacks optionally), a line for each run, and the verdict."""
    yield sinks_table(difference['dags'])
    required = difference.get('requirements', {})
    if required:
        yield sinks_table(required, 'path')
    if callbacks:
        yield callbacks_table(difference)
    for mark in ('a', 'b'):
        run = difference[mark]
        pool = f'imported, {counted(run["workers"], "thread")}' if run['imported'] else (
            f'policy {printable(run["policy"])}, ' + counted(run['workers'], 'worker'))
        yield (f'{mark.upper()}: {printable(run["trace"])}: '
               + verdicts_text(Counts(*(run[name] for name in Counts._fields))) + '; '
               + f'{pool}, {format_ns(run["duration_ns"])}')
    if difference['a']['skip_ns']:
        yield ('left out in both: jobs released in the first '
               + format_ns(difference['a']['skip_ns']))
    worse = [sum(sink['worse'] for dag in dags.values() for sink in dag['sinks'].values())
             for dags in (difference['dags'], required)]
    yield f'worse in B: {counted(worse[0], "sink")}' + (
        f', {counted(worse[1], "requirement")} of paths' if required else '')
