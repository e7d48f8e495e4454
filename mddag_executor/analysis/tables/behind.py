# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The result table `behind`."""

from __future__ import annotations

from mddag_executor.analysis.result_table import Column, Replayed, ResultTable
from mddag_executor.recording.columns import Table
import numpy as np


def _make(replay: Replayed) -> Table:
    found = [(part, name, time) for part, waits in replay.explanation.behind().items()
             for name, time in waits]
    return Table({
        'part': np.array([part for part, _, _ in found], dtype=np.int64),
        'callback': np.array([name for _, name, _ in found], dtype=object),
        'time': np.array([time for _, _, time in found], dtype=np.int64)})


TABLE = ResultTable('behind', 'callback that ran while a part of a missed job waited', {
    'part': Column('row of `miss_parts`'),
    'callback': Column('the callback that ran'),
    'time': Column('how long it ran during that part', 'ns')}, _make)
