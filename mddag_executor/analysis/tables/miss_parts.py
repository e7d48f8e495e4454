# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The result table `miss_parts`."""

from __future__ import annotations

from mddag_executor.analysis.causes import PARTS
from mddag_executor.analysis.result_table import Column, DAG, Replayed, ResultTable, VERTEX
from mddag_executor.recording.columns import Table
import numpy as np


def _make(replay: Replayed) -> Table:
    found = replay.explanation.found
    parts, sink = found.parts, found.misses['sink'][found.parts['miss']]
    return Table({
        'dag': np.array([*replay.judged.tables.dag_of, -1])[sink], 'sink': sink,
        'job': found.misses['job'][parts['miss']], 'vertex': parts['vertex'],
        'cause': parts['cause'], 'begin': parts['begin'], 'end': parts['end'],
        'time': parts['ns']})


TABLE = ResultTable('miss_parts', 'part of the time of each missed deadline, in their order', {
    'dag': Column('the DAG', names=DAG),
    'sink': Column('the sink that missed its deadline', names=VERTEX),
    'job': Column('number of the job'),
    'vertex': Column('the vertex at which the time went', names=VERTEX),
    'cause': Column('the cause, or `ran` or `unknown` for time that needs no cause', names=PARTS),
    'begin': Column('begin of the span that has this part', 'ns'),
    'end': Column('end of that span', 'ns'),
    'time': Column('how much of the span has this cause', 'ns')}, _make)
