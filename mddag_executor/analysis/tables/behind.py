# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The result table `behind`."""

from __future__ import annotations

from mddag_executor.analysis.result_table import Column, Replayed, ResultTable
from mddag_executor.recording.columns import Table
import numpy as np


def _make(replay: Replayed) -> Table:
    found = replay.explanation.behind
    return Table({
        'part': found['part'],
        'callback': np.array(replay.explanation.names_of(found['callback']), dtype=object),
        'time': found['ns']})


TABLE = ResultTable('behind', 'callback that ran while a part of a missed job waited', {
    'part': Column('row of `miss_parts`'),
    'callback': Column('the callback that ran'),
    'time': Column('how long it ran during that part', 'ns')}, _make)
