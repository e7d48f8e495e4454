# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Tables of sinks for live runs, simulations and replays.

The numbers are those of the result format: ``completed`` counts all completions, ``late`` those
after the deadline and the overdue jobs that were open when the run ended. In tables *due* counts
the results that got a verdict, and *in time* those that completed by their deadline.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from mddag_executor.core.policies import SIMULATED_ONLY
from mddag_executor.core.requirements import as_dags, Requirements
from mddag_executor.core.tally import Counts, counts, is_kept, never_due, total
from mddag_executor.report.text import Cell, format_ns, listed, printable, table
from mddag_executor.text import counted

MOST_LINES = 12     # of drift


def short_names(names: Iterable[str]) -> dict[str, str]:
    """Return the names of vertices with only the necessary last parts of their node's name."""
    left = list(dict.fromkeys(names))
    short: dict[str, str] = {}
    parts = 1
    while left:
        ends = {name: _last_parts(name, parts) for name in left}
        used = Counter(ends.values())
        short.update((name, end) for name, end in ends.items() if used[end] == 1 or end == name)
        left = [name for name in left if name not in short]
        parts += 1
    return short


def _last_parts(name: str, parts: int) -> str:
    node, colon, rest = name.partition(':')
    return '/'.join(node.split('/')[-parts:]) + colon + rest


class Sink(NamedTuple):
    """A sink in a table, where it has its ``shown_name``."""

    dag: str
    name: str
    shown_name: str
    result: Mapping[str, Any]


def each_sink(dags: Mapping[str, Any]) -> Iterator[Sink]:
    """Yield the sinks of all DAGs, in the order of a table's rows."""
    short = short_names(name for dag in dags.values() for name in dag['sinks'])
    for dag_name, dag in dags.items():
        for name, result in dag['sinks'].items():
            yield Sink(dag_name, name, short[name], result)


def sink_table(dags: Mapping[str, Any]) -> str:
    """
    Return a table for a terminal with a row for each sink; most misses first.

    It has counts, and response times by the deadline. If the declaration tolerates misses of a
    sink, `tolerates` and `worst` say how many, and how many missed in the worst window. Rows with
    misses that are not tolerated are red on a terminal.
    """
    header, cells = sink_columns(dags)
    found = worst_first(dags)
    return table(('DAG', 'sink', *header),
                 ([sink.dag, sink.shown_name, *cells(sink)] for sink in found),
                 marked=[not is_kept(sink.result) for sink in found], grouped=1)


def bounds_table(required: Mapping[str, Any]) -> str:
    """Return a table of requirements, and how long each takes at most if sinks are in time."""
    return table(('path', '', 'required', 'if all sinks are in time'), ([
        name, what, format_ns(each['required_ns']),
        f'not bounded: {each["why_unbounded"]}' if each['bound_ns'] is None else format_ns(
            each['bound_ns'])]
        for name, every in required.items() for what, each in every.items()), grouped=1)


def requirement_table(requirements: Requirements) -> str:
    """Return a table with a row for each requirement of a path; most misses first."""
    header, cells = requirement_columns(requirements)
    found = worst_first(as_dags(requirements))
    return table(header, map(cells, found), marked=[not is_kept(each.result) for each in found])


def requirement_columns(
    requirements: Requirements
) -> tuple[list[str], Callable[[Sink], list[Cell]]]:
    """Return the titles of the columns of requirements, and what gives their cells."""
    header, cells = sink_columns(as_dags(requirements))
    return (['path', *(('required' if title == 'deadline' else title) for title in header)],
            lambda each: [each.name, *cells(each)])


class SinkColumn(NamedTuple):
    """
    A column of the table of sinks.

    :ivar cell: returns the cell of a sink's result.
    :ivar needed: whether a sink needs the column: it is shown if any does; None: always.
    """

    title: str
    cell: Callable[[Mapping[str, Any]], Cell]
    needed: Callable[[Mapping[str, Any]], bool] | None = None


def _counted(name: str) -> SinkColumn:
    """Return a column of counts that is only shown if some are not 0."""
    def count(sink: Mapping[str, Any]) -> int:
        number: int = getattr(counts(sink), name)
        return number

    return SinkColumn(name.replace('_', ' '), count, lambda sink: bool(count(sink)))


def _in_time(sink: Mapping[str, Any]) -> str:
    verdicts = counts(sink)
    return percent(verdicts.in_time, verdicts.due)


def _tolerates(sink: Mapping[str, Any]) -> str:
    limit = sink.get('tolerate')
    return '' if limit is None else f'{limit["misses"]} of {limit["of"]}'


def _response_time(name: str) -> SinkColumn:
    return SinkColumn(name, lambda sink: times(sink['response_ns'], name)[0])


RARE = 'failed', 'aborted', 'dropped', 'demoted', 'not_due'
"""Counts that are only shown if they are not 0."""
SINK_COLUMNS = (
    SinkColumn('due', lambda sink: counts(sink).due),
    SinkColumn('in time', _in_time),
    SinkColumn('late', lambda sink: counts(sink).late),
    *map(_counted, ('expired', *RARE)),
    *map(_response_time, ('median', 'p99', 'max')),
    SinkColumn('deadline', lambda sink: format_ns(sink['relative_deadline_ns'])),
    SinkColumn('tolerates', _tolerates, lambda sink: 'tolerate' in sink),
    SinkColumn('worst', lambda sink: sink['tolerate']['worst'] if 'tolerate' in sink else '',
               lambda sink: 'tolerate' in sink))
"""The columns of the table of sinks, after the names of the DAG and the sink."""


def sink_columns(dags: Mapping[str, Any]) -> tuple[list[str], Callable[[Sink], list[Cell]]]:
    """Return the titles of a sink's columns after its name, and what gives its cells."""
    sinks = [sink for dag in dags.values() for sink in dag['sinks'].values()]
    shown = [each for each in SINK_COLUMNS if each.needed is None or any(map(each.needed, sinks))]
    return ([each.title for each in shown],
            lambda sink: [each.cell(sink.result) for each in shown])


def worst_first(dags: Mapping[str, Any]) -> list[Sink]:
    """Return the sinks, those that missed the largest share of their deadlines first."""
    return sorted(each_sink(dags), key=lambda sink: -missed_share(counts(sink.result)))


def missed_share(verdicts: Counts) -> float:
    """Return the missed share of the due deadlines."""
    return (verdicts.due - verdicts.in_time) / max(1, verdicts.due)


def rare_ends(every: Counts) -> list[str]:
    """Return the counts that are only shown if they are not 0."""
    return [name for name in RARE if getattr(every, name)]


def times(values: Mapping[str, Any] | None, *keys: str) -> list[Cell]:
    """Return cells with some of the values, times in ns; empty ones for unknown values."""
    return [None if values is None or values[key] is None else format_ns(values[key], 3)
            for key in keys]


def with_means(use: Mapping[str, Any]) -> dict[str, int | None]:
    """Return the usage of a callback, with ``mean_ns`` and ``mean_wait_ns`` of its executions."""
    n = use['executions']
    return {**use, 'mean_ns': use['busy_ns'] // n if n else None,
            'mean_wait_ns': use['waiting_ns'] // n if n and 'waiting_ns' in use else None}


def percent(part: int, whole: int) -> str:
    """Return a share as text; never rounded up to 100 % or down to 0 %."""
    if not whole:
        return '-'
    share = 100 * part / whole
    if part not in (0, whole):
        share = min(99.99, max(0.01, share))
    return f'{share:.2f} %'


def verdicts_line(dags: Mapping[str, Any]) -> str:
    """Return the line below a table of sinks: the verdicts about all of them."""
    return verdicts_text(total(dags))


def verdicts_text(every: Counts) -> str:
    """Return verdicts as a text."""
    return (f'{counted(every.due, "result")} due, {every.in_time} in time '
            f'({percent(every.in_time, every.due)}), {every.late} late, {every.expired} expired'
            + ''.join(f', {getattr(every, name)} {name.replace("_", " ")}'
                      for name in rare_ends(every)))


def never_due_lines(dags: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line about the sinks without due jobs, if any."""
    never = never_due(dags)
    if never:
        yield f'never due, so not judged: {counted(len(never), "sink")}: {listed(never)}'


LONG_NS = 1_000_000_000
"""Executions that had run for less when the run ended are not worth a line."""


def guessed_lines(guessed: Mapping[str, int]) -> Iterator[str]:
    """Yield a line about results of syncs of two rates that may belong to another job, if any."""
    if guessed:
        yield (f'{counted(sum(guessed.values()), "result")} of a sync with driven_by counted for '
               'the newest of several messages that waited, as no header stamp says which one was '
               'used: ' + listed([f'{name} {n}' for name, n in guessed.items()]))


def unfinished_lines(unfinished: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield a line for each callback that has not ended for long, the longest first."""
    hangs = sorted((each for each in unfinished if each['for_ns'] >= LONG_NS),
                   key=lambda each: -each['for_ns'])
    for each in hangs[:MOST_LINES]:
        where = f' ({each["where"]})' if each['where'] else ''
        yield printable(f'{each["callback"]} has not ended: it has run for '
                        f'{each["for_ns"] / 1e9:.1f} s{where}')
    if len(hangs) > MOST_LINES:
        yield f'{len(hangs) - MOST_LINES} more executions have not ended'


def run_lines(result: Mapping[str, Any], more: str = '') -> Iterator[str]:
    """Yield the lines about a run, below a table of its sinks; ``more`` about its settings."""
    yield verdicts_line(result['dags']) if result['dags'] else (
        'no declaration was given, so no deadline was judged (mddag graph from-trace drafts one)')
    yield from never_due_lines(result['dags'])
    yield (f'{pool_text(result)}, {format_ns(result["duration_ns"])}, '
           f'utilisation {ratio(result["utilisation"])}{more}')
    miss = result['first_miss']
    if miss is not None:
        late = 'never completed' if miss['completed_ns'] is None else \
            f'{format_ns(miss["completed_ns"] - miss["deadline_ns"], 3)} late'
        yield f'first miss: {printable(miss["vertex"])}, job {miss["job"]}, {late}'


def pool_text(result: Mapping[str, Any]) -> str:
    """Return what ran the callbacks of a run."""
    if 'recorded_callbacks' in result and result['policy'] in SIMULATED_ONLY:
        return f'imported: {counted(result["workers"], "thread")} ran callbacks'
    several = counted(len(result.get('processes', ())), 'process', 'processes')
    return (f'policy {printable(result["policy"])}, {counted(result["workers"], "worker")}'
            + (f' in {several}' if result.get('processes') else '')
            + (', preemptive' if result['preemptive'] else ''))


def ratio(value: float | None) -> str:
    """Return a utilisation as text."""
    return '-' if value is None else f'{value:.3f}'


def drift_lines(found: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield a line for each difference between a run and its declaration (``drift``)."""
    if not found:
        return
    yield f'{counted(len(found), "difference")} between the run and the declaration:'
    for each in found[:MOST_LINES]:
        yield f'  {printable(each["text"])}'
    if len(found) > MOST_LINES:
        yield f'  … ({len(found) - MOST_LINES} more)'
