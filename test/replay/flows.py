# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The flows that a path's steps are made of, one by one."""

from __future__ import annotations

from typing import NamedTuple

from mddag_executor.replay.paths import PathBook
import pytest


class Flow(NamedTuple):
    """By position the time of the publication and the start; begin and end of the whole."""

    columns: list[tuple[int | None, int | None]]
    begin: int | None
    end: int | None


def flows(book: PathBook) -> list[Flow]:
    """Return the flows along the first path, of which nothing has been forgotten."""
    book._round()
    steps = [row for row in book._forest.rows[:len(book._forest)].tolist() if row[1] == 0]
    parents = {row[0] for row in steps}
    every = book._forest.rows[:len(book._forest)].tolist()
    numbers = [i for i, row in enumerate(every) if row[1] == 0]
    table = dict(zip(numbers, steps))
    # executions that another one reads which went on
    went_on = {row[0] for i, row in table.items() if i in parents and row[3]}
    last = len(book.paths[0].callbacks) - 1
    found = []
    for leaf, row in table.items():
        dead = row[0] != -1 and row[3] and row[2] < last and row[0] in went_on
        if leaf in parents or dead:
            continue
        columns: list[tuple[int | None, int | None]] = [(None, None)] * (last + 1)
        begin = end = None
        while leaf != -1:
            parent, _, position, is_run, time, ended, _ = table[leaf]
            sent, start = columns[position]
            columns[position] = (sent, time) if is_run else (time, start)
            if is_run and position == last and ended != -1:
                end = ended
            if is_run and position == 0:
                begin = time
            leaf = parent
        found.append(Flow(columns, begin, end))
    return sorted(found, key=lambda flow: [time or 0 for each in flow.columns for time in each])


def note_steps(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return what will have how many steps stay each time when flows are forgotten."""
    left: list[int] = []
    settle = PathBook._settle

    def note(book: PathBook, at_end: bool) -> None:
        settle(book, at_end)
        if not at_end:
            left.append(len(book._forest))

    monkeypatch.setattr(PathBook, '_settle', note)
    return left
