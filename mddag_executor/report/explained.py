# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The causes of missed deadlines, as tables and lines of text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TYPE_CHECKING

from mddag_executor.analysis.causes import REMEDIES
from mddag_executor.report.tables import percent, short_names
from mddag_executor.report.text import Cell, format_ns, listed, printable, table
from mddag_executor.text import counted

if TYPE_CHECKING:
    from mddag_executor.results.replays import Stall

MOST_STALLS = 10


def causes_line(misses: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line with the causes of all misses, if there are any."""
    causes = [f'{n} {cause}' for cause, n in _most_first(misses)]
    if causes:
        yield f'{counted(misses["missed"], "miss", "misses")}: {", ".join(causes)}'


def _most_first(misses: Mapping[str, Any]) -> list[tuple[str, int]]:
    return sorted(((cause, n) for cause, n in misses['causes'].items() if n),
                  key=lambda item: -item[1])


def causes_table(misses: Mapping[str, Any]) -> str:
    """Return a table of the causes, with remedies."""
    return table(('cause', 'misses', 'share', 'what to do'), [
        [cause, n, percent(n, misses['missed']), REMEDIES[cause]]
        for cause, n in _most_first(misses)])


def assumed_line(misses: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line about the misses of which the cause is assumed, if there are any."""
    if 'interpreter_assumed' in misses:
        yield (f'{misses["interpreter_assumed"]} of {misses["causes"]["interpreter"]} misses by '
               'the interpreter are assumed: this recording does not say whether the callbacks '
               'that ran meanwhile held it')


def sinks_table(mostly: Sequence[Mapping[str, Any]]) -> str:
    """Return a table of the causes of each sink, and where most of that time went."""
    names = short_names({name for each in mostly for name in (
        each['sink'], each['vertex'], each['behind']) if name is not None})
    return table(('sink', 'cause', 'misses', 'mean', 'mostly at', 'mostly behind'), ([
        names[each['sink']], each['cause'], each['missed'],
        format_ns(each['ns'], 3) if each['ns'] else None,
        *(names.get(each[key]) for key in ('vertex', 'behind'))] for each in mostly), grouped=1)


def stalls_table(stalls: Sequence[Stall], start: int) -> str:
    """Return a table of the longest stalls, in order; times since the start of the run."""
    longest = sorted(stalls, key=lambda stall: -stall['length_ns'])[:MOST_STALLS]
    return table(('stop of the machine at', 'length', 'misses'), [
        [f'{(stall["at_ns"] - start) / 1e9:.3f} s', format_ns(stall['length_ns'], 3),
         stall['misses']] for stall in sorted(longest, key=lambda stall: stall['at_ns'])])


def paths_tables(late: Mapping[str, Any]) -> Iterator[str]:
    """Yield tables of where the time of late reactions and data ages went."""
    for path, required in late.items():
        for what, found in required.items():
            line = f'Path {printable(path)}, {what}: ' + listed([
                text for n, text in ((found['late'], f'{found["late"]} late'), (
                    found['unanswered'], f'{found["unanswered"]} without output')) if n])
            parts = found['parts']
            yield line + (', on average and in the worst case:' if parts else '')
            if parts:
                names = short_names(part['callback'] for part in parts)
                yield table(('callback', 'what', 'mean', 'worst'), [
                    [names[part['callback']], part['part'], format_ns(part['mean_ns'], 3),
                     format_ns(part['worst_ns'], 3)] for part in parts], grouped=1)


def job_lines(job: Mapping[str, Any]) -> Iterator[str]:
    """Yield the fate of a job, and the parts of its time."""
    late = job['verdict'] if job['late_ns'] is None else f'late by {format_ns(job["late_ns"], 3)}'
    allowed = job['deadline_ns'] - job['release_ns']
    parts = job['parts']
    names = short_names({job['sink']} | {part['vertex'] for part in parts} | {
        each['callback'] for part in parts for each in part['behind']})
    yield (f'Job {job["job"]} of {printable(names[job["sink"]])}: {late} (deadline '
           f'{format_ns(allowed)} after its release): {job["cause"]}')
    rows: list[list[Cell]] = []
    for part, before in zip(parts, [None, *parts]):
        same = before is not None and before['vertex'] == part['vertex']
        first: list[Cell] = [
            '' if same else names[part['vertex']], _what(part), format_ns(part['ns'], 3)]
        for each in part['behind'] or [None]:
            rows.append([*first, *([None, None] if each is None else [
                names[each['callback']], format_ns(each['ns'], 3)])])
            first = ['', '', '']
    if any(part['behind'] for part in parts):
        yield table(('callback', 'what', 'time', 'behind', 'ran for'), rows)
    else:
        yield table(('callback', 'what', 'time'), [row[:3] for row in rows])


def _what(part: Mapping[str, Any]) -> str:
    text: str = part['cause']
    if 'waiting_job' in part:
        return f'{text}: job {part["waiting_job"]} had not started'
    return f'{text}: {listed(part["topics"])}' if part.get('topics') else text
