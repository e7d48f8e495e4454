# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The result table `processes`."""

from __future__ import annotations

from mddag_executor.analysis.result_table import Column, Replayed, ResultTable
from mddag_executor.recording.columns import Table
from mddag_executor.recording.joins import different, rows_by
from mddag_executor.recording.tables import UNKNOWN
import numpy as np


def _make(replay: Replayed) -> Table:
    recording = replay.recording
    runs, names = recording.executions, recording.names.process_names
    last = max(int(table['process'].max(initial=UNKNOWN)) for table in (
        runs, recording.publications, recording.releases))
    count = max(len(names), last + 1)
    ran = runs[runs['end'] >= 0]
    mine = rows_by(ran['process'], count)
    return Table({
        'process': np.arange(count),
        'name': np.array([names[each] if each < len(names) else ''
                          for each in range(count)], dtype=object),
        'threads': np.array([len(different(ran['thread'][each])[0]) for each in mine],
                            dtype=np.int64),
        'executions': np.array([int((ran['piece'][each] == 0).sum()) for each in mine],
                               dtype=np.int64),
        'busy': np.array([int((ran['end'] - ran['start'])[each].sum()) for each in mine],
                         dtype=np.int64)})


TABLE = ResultTable('processes', 'process of the run', {
    'process': Column('its number, as in the tables of the recording'),
    'name': Column('its name: the last word of the name of its trace, or that of the program; '
                   'unknown: the run has one process'),
    'threads': Column('number of threads that ran callbacks'),
    'executions': Column('executions of callbacks that ended'),
    'busy': Column('how long callbacks ran on its threads', 'ns')}, _make)
