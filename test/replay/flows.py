# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The flows along a path, one by one."""

from typing import NamedTuple

from mddag_executor.replay.paths import leaves


class Flow(NamedTuple):
    """By position the time of the publication and the start; begin and end of the whole."""

    columns: list[tuple[int | None, int | None]]
    begin: int | None
    end: int | None


def flows(paths):
    """Return the flows along the first path."""
    steps = paths.steps(0)
    last = len(paths.paths[0].callbacks) - 1
    found = []
    for leaf in leaves(steps, last).tolist():
        columns = [(None, None)] * (last + 1)
        begin = end = None
        while leaf != -1:
            parent, position, is_run, time, ended = steps[leaf].item()
            sent, start = columns[position]
            columns[position] = (sent, time) if is_run else (time, start)
            if is_run and position == last and ended != -1:
                end = ended
            if is_run and position == 0:
                begin = time
            leaf = parent
        found.append(Flow(columns, begin, end))
    return sorted(found, key=lambda flow: [time or 0 for each in flow.columns for time in each])
