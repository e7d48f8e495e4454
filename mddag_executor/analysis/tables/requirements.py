# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The result table `requirements`."""

from __future__ import annotations

from mddag_executor.analysis.requirements import RESULTS
from mddag_executor.analysis.result_table import Column, Replayed, ResultTable, VERDICT_NAMES
from mddag_executor.core.state import SINK_NOT_DUE
from mddag_executor.recording.columns import concatenate, rows, Table
import numpy as np

_NAMES = tuple('not_due' if kind == SINK_NOT_DUE else VERDICT_NAMES[kind] if kind < len(
    VERDICT_NAMES) else '' for kind in range(max(SINK_NOT_DUE + 1, len(VERDICT_NAMES))))


def _make(replay: Replayed) -> Table:
    found = replay.requirements
    tables = [_named(rows(RESULTS), '', '')]
    tables += [_named(table, found.paths[number].name, what)
               for (number, what), table in found.results.items()]
    return concatenate(tables)


def _named(table: Table, path: str, what: str) -> Table:
    return Table({
        'path': np.full(len(table), path, dtype=object),
        'requirement': np.full(len(table), what, dtype=object), 'verdict': table['kind'],
        'count': table['count'],
        'since': table['since'], 'end': table['end'],
        'time': np.where(table['end'] >= 0, table['end'] - table['since'], -1)})


TABLE = ResultTable('requirements', 'judged reaction or data age of each path', {
    'path': Column('the path'),
    'requirement': Column('`reaction` or `age`'),
    'verdict': Column('`in_time`, `late`, `overdue` or `not_due`', names=_NAMES),
    'count': Column('number of such results: all outputs that did not come are one row'),
    'since': Column('the input of the output or, for an external change, the one before it', 'ns'),
    'end': Column('end of the output; unknown: there was none', 'ns', unknown=-1),
    'time': Column('the reaction time or data age', 'ns', unknown=-1)}, _make)
