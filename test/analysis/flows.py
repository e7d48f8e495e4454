# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The flows along a path, one by one, and CARET's definitions of response times, slowly."""

from typing import NamedTuple

from mddag_executor.analysis.paths import leaves


class Flow(NamedTuple):
    """By position the time of the publication and the start; begin and end of the whole."""

    columns: list[tuple[int | None, int | None]]
    begin: int | None
    end: int | None


def flows(paths):
    steps = paths.steps(0)
    last = len(paths.paths[0].callbacks) - 1
    found = []
    for leaf in leaves(steps, last).tolist():
        columns = [(None, None)] * (last + 1)
        begin = end = None
        while leaf != -1:
            parent, position, is_run, _, time, ended = steps[leaf].item()
            sent, start = columns[position]
            columns[position] = (sent, time) if is_run else (time, start)
            if is_run and position == last and ended != -1:
                end = ended
            if is_run and position == 0:
                begin = time
            leaf = parent
        found.append(Flow(columns, begin, end))
    return sorted(found, key=lambda flow: [time or 0 for each in flow.columns for time in each])


def slow_cases(records):
    """Return each case's inputs and response times, found by searching all records."""
    rows = sorted((row for row in records if row[1] is None or row[1] >= row[0]),
                  key=lambda row: row[0])
    ends = {}
    for start in {row[0] for row in rows}:
        own = [end for first, end in rows if first == start and end is not None]
        # results of later inputs, and its own results if one of its flows arrived nowhere
        later = [end for first, end in rows if first > start and end is not None]
        dropped = any(end is None for first, end in rows if first == start)
        choice = own + later if dropped else own
        if choice:
            ends[start] = min(choice)
    if not ends:
        return {case: [] for case in ('all', 'best', 'worst', 'worst_with_external_latency')}
    first_output = min(ends.values())
    starts = sorted(start for start, end in ends.items() if end != first_output)
    outputs = {ends[start] for start in starts}
    of = {end: [start for start in starts if ends[start] == end] for end in outputs}
    behind = {end: [i for i in range(1, len(starts)) if ends[starts[i]] == end] for end in outputs}
    return {
        'all': [(start, ends[start] - start) for start in starts],
        'best': sorted((max(of[end]), end - max(of[end])) for end in outputs),
        'worst': sorted((min(of[end]), end - min(of[end])) for end in outputs),
        'worst_with_external_latency': sorted(
            (starts[min(behind[end]) - 1], end - starts[min(behind[end]) - 1])
            for end in outputs if behind[end])}
