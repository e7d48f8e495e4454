# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The result table `verdicts`."""

from __future__ import annotations

from mddag_executor.analysis.result_table import (
    Column,
    DAG,
    Replayed,
    ResultTable,
    VERDICT_NAMES,
    VERTEX,
)
from mddag_executor.recording.columns import Table


def _make(replay: Replayed) -> Table:
    verdicts = replay.judged.verdicts
    return Table({
        'verdict': verdicts['kind'],
        **{name: verdicts[name] for name in (
            'dag', 'sink', 'job', 'release', 'deadline', 'completed', 'until')}})


TABLE = ResultTable('verdicts', 'judged job at each sink, in the order in which it was judged', {
    'dag': Column('the DAG', names=DAG),
    'sink': Column('the sink', names=VERTEX),
    'job': Column('number of the job'),
    'release': Column('when the job was released', 'ns'),
    'deadline': Column('when the sink had to be completed', 'ns'),
    'completed': Column('when the sink was completed; unknown: never', 'ns', unknown=-1),
    'until': Column('when the sink was completed or the job ended', 'ns'),
    'verdict': Column('`in_time`, `late`, `overdue`, `expired`, `failed`, `dropped` or `aborted`',
                      names=VERDICT_NAMES)}, _make)
