# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Selects executions for pictures: those around missed deadlines, and samples of the rest.

Theory of operation
-------------------
Executions are in blocks of ``BLOCK``, in the order in which they ended. If there are more than
``most`` executions, the blocks with the most missed deadlines are shown, and of the others every
second, fourth, eighth, and so on: the misses are shown, and the rest is spread over the run.

A *row* is the line of a picture that an execution belongs to: the global vertex of the
declaration, or -1-k for the k-th undeclared callback.
"""

from __future__ import annotations

from typing import NamedTuple

from mddag_executor.recording.tables import Ints, Recording, Table
from mddag_executor.replay.deadlines import Judged
from mddag_executor.replay.usage import PoolUse, ran
import numpy as np

MOST_EXECUTIONS = 20_000
BLOCK = 512
MOST_UNDECLARED = 200
OTHERS = 'other undeclared callbacks'

_FIRST_STEP = 1 << 16       # of the sums, ns


class Shown(NamedTuple):
    """
    The shown data; times in ns on the recording's clock.

    :ivar executions: rows of the recording's table, in order of start; ``row`` the row of each.
    :ivar releases: rows of the recording's table.
    :ivar verdicts: rows of ``Judged.verdicts``.
    """

    executions: Table
    row: Ints
    releases: Table
    verdicts: Table


class Timeline:
    """
    The shown part of a recording.

    :param most: maximum number of shown executions.
    :ivar n_executions: number of executions; ``n_missed``: of missed deadlines.
    :ivar busy_over_time: load of the workers over time, without spare threads; in
        ``missed_over_time`` each missed deadline is one nanosecond.
    """

    def __init__(
        self, recording: Recording, judged: Judged, most: int = MOST_EXECUTIONS,
        block: int = BLOCK,
    ) -> None:
        table, rows = recording.executions, ran(recording)
        self._recording, self._judged, self._rows, self._block = recording, judged, rows, block
        on_workers = rows[table['worker'][rows] >= 0]
        self.busy_over_time = PoolUse(
            table['start'][on_workers], table['end'][on_workers], _FIRST_STEP)
        missed = np.maximum(judged.missed['completed'], judged.missed['deadline'])
        self.missed_over_time = PoolUse(missed, missed + 1, _FIRST_STEP)
        self.n_executions, self.n_missed = len(rows), len(missed)
        self.workers = set(np.unique(table['worker'][rows]).tolist())
        self._row = self._rows_of()
        self._end = table['end'][rows]
        self._blocks = self._chosen(max(2, most // block))

    def _chosen(self, most: int) -> Ints:
        """Return the numbers of the shown blocks, ascending."""
        count = -(-max(1, self.n_executions) // self._block)
        if count <= most:
            return np.arange(count)
        at = np.searchsorted(self._end, self._judged.missed['until'], 'right')
        number = np.minimum(at // self._block, count - 1)
        missed = np.bincount(number, minlength=count)
        # much of such a job ran in the previous block
        early = number[(6 * (at % self._block) < self._block) & (number > 0)] - 1
        missed += np.bincount(early, minlength=count)
        numbers = np.arange(count)
        even = np.where(numbers == 0, 1 << 62, numbers & -numbers)
        return np.sort(np.lexsort((-even, -missed))[:most])

    def _rows_of(self) -> Ints:
        """Return the line of each execution; note the undeclared callbacks."""
        table = self._recording.executions
        row = table['vertex'][self._rows].astype(np.int64)
        undeclared = np.flatnonzero(row < 0)
        different, first, which = np.unique(
            table['callback'][self._rows[undeclared]], return_index=True, return_inverse=True)
        order = np.argsort(first, kind='stable')    # in the order of their first executions
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.minimum(np.arange(len(order)), MOST_UNDECLARED)
        row[undeclared] = -1 - place[which]
        self._undeclared: list[int] = different[order].tolist()
        return row

    @property
    def kept(self) -> int:
        """Return the number of shown executions."""
        return len(self._shown())

    def undeclared_names(self) -> list[str]:
        """Return the names of undeclared callbacks: of row -1, of row -2, and so on."""
        names = [self._recording.who.name(each) for each in self._undeclared[:MOST_UNDECLARED]]
        return names + [OTHERS] * (len(self._undeclared) > MOST_UNDECLARED)

    def _shown(self) -> Ints:
        """Return the indices of the shown executions."""
        blocks = np.zeros(-(-max(1, self.n_executions) // self._block), dtype=np.bool_)
        blocks[self._blocks] = True
        return np.flatnonzero(blocks[np.arange(self.n_executions) // self._block])

    def _shows(self, times: Ints) -> Ints:
        """Return the indices of times within shown blocks."""
        number = np.minimum(np.searchsorted(self._end, times, 'right') // self._block,
                            max(0, self.n_executions - 1) // self._block)
        return np.flatnonzero(np.isin(number, self._blocks))

    def shown(self) -> Shown:
        """Return the shown data."""
        chosen = self._shown()
        table, row = self._recording.executions[self._rows[chosen]], self._row[chosen]
        order = np.argsort(table['start'], kind='stable')
        releases, verdicts = self._recording.releases, self._judged.verdicts
        return Shown(table[order], row[order], releases[self._shows(releases['noticed'])],
                     verdicts[self._shows(verdicts['until'])])

    def gaps(self) -> list[tuple[int, int]]:
        """Return the hidden time ranges between shown blocks, ns."""
        before, after = self._blocks[:-1], self._blocks[1:]
        return [(int(self._end[(b + 1) * self._block - 1]), int(self._end[a * self._block]))
                for b, a in zip(before.tolist(), after.tolist()) if a != b + 1]
