# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The result table `flows`."""

from __future__ import annotations

from mddag_executor.analysis.result_table import Column, Replayed, ResultTable
from mddag_executor.recording.columns import concatenate, Table
import numpy as np

_TIMES = 'first', 'arrival', 'begin', 'end'


def _make(replay: Replayed) -> Table:
    paths = replay.paths
    none = Table({'path': np.empty(0, dtype=object), **{
        name: np.empty(0, dtype=np.int64) for name in _TIMES}})
    return concatenate([none, *(
        Table({'path': np.full(len(flows.first), path.name, dtype=object),
               **{name: getattr(flows, name) for name in _TIMES}})
        for path, flows in ((path, paths.flows(number))
                            for number, path in enumerate(paths.paths)))])


TABLE = ResultTable('flows', 'flow along each declared path: the way of an input', {
    'path': Column('the path'),
    'first': Column('the first publication', 'ns', unknown=-1),
    'arrival': Column('start of the last callback; unknown: the flow did not arrive', 'ns',
                      unknown=-1),
    'begin': Column('start of the first callback', 'ns', unknown=-1),
    'end': Column('end of the last callback; unknown: it did not end', 'ns', unknown=-1)}, _make)
