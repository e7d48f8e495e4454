# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Selects executions for pictures: those around missed deadlines, and samples of the rest.

Executions are in blocks of ``BLOCK``, in the order in which they ended. If there are more than
``most`` executions, the blocks in which most jobs with missed deadlines were released or ended are
shown, and of the others every second, fourth, eighth, and so on: the misses are shown, and the
rest is spread over the run.
"""

from __future__ import annotations

from mddag_executor.analysis.deadlines import Judged
from mddag_executor.analysis.usage import PoolUse, ran, worker_spans
from mddag_executor.recording.columns import Ints
from mddag_executor.recording.recording import Recording
import numpy as np

MOST_EXECUTIONS = 20_000
BLOCK = 512

_FIRST_STEP = 1 << 16       # of the sums, ns


class Timeline:
    """
    The shown part of a recording.

    :param most: maximum number of shown executions.
    :ivar rows: the shown rows of ``executions``, in the order of their ends.
    :ivar verdicts: the shown rows of ``Judged.verdicts``.
    :ivar gaps: the hidden time ranges between shown blocks, ns.
    :ivar n_executions: number of executions; ``n_missed``: of missed deadlines.
    :ivar busy_over_time: load of the workers over time, without spare threads; in
        ``missed_over_time`` each missed deadline is one nanosecond.
    """

    def __init__(
        self, recording: Recording, judged: Judged, most: int = MOST_EXECUTIONS,
        block: int = BLOCK,
    ) -> None:
        table = recording.executions
        rows = ran(table)
        self.busy_over_time = PoolUse(
            worker_spans(recording, recording.run.begin, recording.end).values(), _FIRST_STEP)
        missed = np.maximum(judged.missed['completed'], judged.missed['deadline'])
        self.missed_over_time = PoolUse([(missed, missed + 1)], _FIRST_STEP)
        self.n_executions, self.n_missed = len(rows), len(missed)

        end, verdicts = table['end'][rows], judged.verdicts
        n_blocks = -(-max(1, len(rows)) // block)

        def block_of(times: Ints) -> Ints:
            return np.minimum(np.searchsorted(end, times, 'right') // block, n_blocks - 1)

        shown = np.arange(n_blocks)
        if n_blocks > max(2, most // block):
            n_missed = np.bincount(np.concatenate([
                block_of(judged.missed[time]) for time in ('release', 'until')]),
                minlength=n_blocks)
            even = np.where(shown == 0, 1 << 62, shown & -shown)
            shown = np.sort(np.lexsort((-even, -n_missed))[:max(2, most // block)])
        self.rows = rows[np.isin(np.arange(len(rows)) // block, shown)]
        self.verdicts = verdicts[np.isin(block_of(verdicts['until']), shown)]
        self.gaps = [(int(end[(before + 1) * block - 1]), int(end[after * block]))
                     for before, after in zip(shown[:-1].tolist(), shown[1:].tolist())
                     if after != before + 1]
