# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The result table `causes`."""

from __future__ import annotations

from mddag_executor.analysis.causes import CAUSES
from mddag_executor.analysis.result_table import (
    Column,
    DAG,
    Replayed,
    ResultTable,
    VERDICT_NAMES,
    VERTEX,
)
from mddag_executor.core.state import SINK_LATE
from mddag_executor.recording.columns import Table
import numpy as np


def _make(replay: Replayed) -> Table:
    found = replay.explanation.found
    missed, tables = found.misses, replay.judged.tables
    sink = missed['sink']
    deadline = np.array([*tables.sink_deadline, 0], dtype=np.int64)[sink]
    return Table({
        'dag': np.array([*tables.dag_of, -1])[sink], 'sink': sink, 'job': missed['job'],
        'verdict': missed['kind'], 'cause': found.causes, 'late': np.where(
            missed['kind'] == SINK_LATE, missed['until'] - missed['release'] - deadline, -1),
        'reached': missed['at'],
        'behind': np.array(replay.explanation.longest_behind(), dtype=object)})


TABLE = ResultTable('causes', 'missed deadline, in the order of deadlines', {
    'dag': Column('the DAG', names=DAG),
    'sink': Column('the sink', names=VERTEX),
    'job': Column('number of the job'),
    'verdict': Column('`late`, `overdue`, `expired`, `failed`, `dropped` or `aborted`',
                      names=VERDICT_NAMES),
    'cause': Column('the cause of the miss', names=CAUSES),
    'late': Column('how late the sink was; unknown: it was never completed', 'ns', unknown=-1),
    'reached': Column('the vertex that the job reached', names=VERTEX, unknown=-1),
    'behind': Column('the callback that the job waited for longest; unknown: it did not wait')},
    _make)
