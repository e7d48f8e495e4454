# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The flows along paths that the compiled replay finds: its table of steps, kept small.

Theory of operation
-------------------
Compiled code adds steps to a table and refers to them by their numbers (see ``fast_paths``): from
what happened last at each place, and from the rows of the last jobs.  When the table is full,
flows that are over are counted (see ``path_forest``), and the table and all that refers to it are
renumbered.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mddag_executor.replay import fast_work as fw
from mddag_executor.replay.path_forest import (
    Bounds,
    bounds,
    Column,
    FlowColumns,
    HAS_CHILD,
    NEVER,
    NONE,
    settle,
    Settled,
    Steps,
)
from mddag_executor.replay.path_stream import PathFigures
from mddag_executor.replay.paths import Hop, LAG_NS
from mddag_executor.replay.spread import KEEP_EXACT
from msg_graph import Path
import numpy as np


class Flows:
    """
    Counts the flows along all paths.

    :ivar paths: the declared paths; ``hops`` the hops of each.
    :param first_place: by path, its first place, and at last the number of places.
    :param step_columns: by DAG, which columns of a job's row hold steps.
    """

    def __init__(
        self, paths: Sequence[Path], hops: list[list[Hop]], first_place: Sequence[int],
        step_columns: Sequence[Column], keep: int = KEEP_EXACT,
    ) -> None:
        self.paths = list(paths)
        self.hops = hops
        self._first = np.array(first_place, dtype=np.int64)
        self._step_columns = step_columns
        self._figures = [PathFigures(keep) for _ in self.paths]
        #: Of the steps that stayed: what is known of children that are gone.
        self._marks = np.zeros(0, dtype=np.uint8)

    def make_room(self, work: fw.Work) -> None:
        """Count the flows that are over, and forget their steps, where the table is full."""
        n = int(work.scalars[fw.N_STEPS])
        if n + 8 * len(work.place_done) + 8 > len(work.steps):
            self._tidy(work, n)

    def _tidy(self, work: fw.Work, n: int) -> None:
        steps, run_end = self._steps(work, n)
        held = np.zeros(n, dtype=np.bool_)
        referring = self._referring(work)
        for array, places in referring:
            numbers = array[places]
            held[numbers[numbers != NONE]] = True
        found = settle(steps, held)
        now = max(0, int(max(steps.time.max(), steps.end.max())) - LAG_NS)
        self._add(self._figures, found.flows, bounds(steps, found.keep, now))
        # the second row of an execution goes with its first
        keep = found.keep.copy()
        keep[run_end] = keep[run_end - 1]
        found = Settled(keep, found.marks, found.flows)
        renumbered = np.r_[found.numbers(), NONE]       # the last is of no step
        parent = renumbered[steps.parent[keep]]
        rest = work.steps[:n][keep]
        what = rest[:, fw.X_WHAT] & ((1 << fw.X_PARENT) - 1)
        rest[:, fw.X_WHAT] = (parent + 1) << fw.X_PARENT | what
        work.steps[:len(rest)] = rest
        work.scalars[fw.N_STEPS] = len(rest)
        self._marks = found.marks[keep]
        for array, places in referring:
            array[places] = renumbered[array[places]]
        if 2 * len(rest) > len(work.steps):
            work.steps.resize((2 * len(work.steps), fw.N_STEP), refcheck=False)

    def _add(self, figures: list[PathFigures], flows: FlowColumns, to_come: list[Bounds]) -> None:
        for number, one in enumerate(figures):
            chosen = flows.path == number
            if chosen.any() or number < len(to_come):
                least = to_come[number] if number < len(to_come) else Bounds(0, 0, 0)
                one.add(FlowColumns(*(column[chosen] for column in flows)), least)

    def _steps(self, work: fw.Work, n: int) -> tuple[Steps, Any]:
        """Return the steps as columns, and the numbers of the rows with ends of executions."""
        time, what = work.steps[:n].T.copy()    # the table may move
        place = (what >> fw.X_PLACE) & 0xFFFF
        kind = what & 0xFF
        run_end = np.flatnonzero(kind == fw.RUN_END)
        end = np.full(n, NONE, dtype=np.int64)
        end[run_end - 1] = time[run_end]
        path = np.searchsorted(self._first, place, side='right') - 1
        marks = np.zeros(n, dtype=np.uint8)
        marks[:len(self._marks)] = self._marks
        # a row with an end is no step: it is above and below nothing, and no leaf
        marks[run_end] = HAS_CHILD
        return Steps(
            (what >> fw.X_PARENT) - 1, path, (work.place_position[place] == 0) & (
                kind != fw.RUN_END), (work.place_last[place] != 0) & (kind != fw.RUN_END),
            kind == 1, time, end, marks), run_end

    def _referring(self, work: fw.Work) -> list[tuple[Any, Any]]:
        """Return arrays that refer to steps, and where in them."""
        found: list[tuple[Any, Any]] = [
            (each, slice(None))
            for each in (work.place_started, work.place_done, work.place_published)]
        used = min(int(work.scalars[fw.N_JOBS]), fw.KEEP_JOBS)
        dags = work.job_ring[:used, 0]
        for dag, columns in enumerate(self._step_columns):
            found.append((work.jobs, np.ix_(np.flatnonzero(dags == dag), columns)))
        return found

    def finish(self, work: fw.Work) -> None:
        """Take in what is left in the table, at the end of the run."""
        steps, run_end = self._steps(work, int(work.scalars[fw.N_STEPS]))
        flows = settle(steps, np.zeros(len(steps.parent), dtype=np.bool_)).flows
        self._add(self._figures, flows, [Bounds(NEVER, NEVER, NEVER)] * len(self.paths))

    def figures(self) -> list[dict[str, Any]]:
        """Return the figures of each path, once it has finished."""
        return [each.result() for each in self._figures]
