# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The result table `chains`."""

from __future__ import annotations

from mddag_executor.analysis.result_table import Column, DAG, Replayed, ResultTable, VERTEX
from mddag_executor.recording.columns import Table
import numpy as np


def _make(replay: Replayed) -> Table:
    links, verdicts = replay.chains.links(), replay.judged.verdicts
    ended, judged = links['leg'] >= 0, verdicts[['dag', 'sink', 'job']][links['of']]
    return Table({
        **{name: judged[name] for name in judged.names},
        'place': np.arange(len(links)) - np.searchsorted(links['of'], links['of']),
        **{name: links[name] for name in ('vertex', 'ready', 'start')},
        **{name: np.where(ended, links[name], -1) for name in ('end', 'busy')},
        'waiting_group': links['group'], 'waiting_program': links['program'],
        'cpu': links['cpu'], 'execution': links['row']})


TABLE = ResultTable('chains', 'callback on the critical chain of each verdict', {
    'dag': Column('the DAG', names=DAG),
    'sink': Column('the sink of the verdict', names=VERTEX),
    'job': Column('number of the job'),
    'place': Column('place of the callback on the chain: 0 is the first one'),
    'vertex': Column('the vertex as which the callback ran', names=VERTEX),
    'ready': Column('when it was ready to run', 'ns'),
    'start': Column('when it started', 'ns'),
    'end': Column('when it ended; unknown: it did not complete', 'ns', unknown=-1),
    'busy': Column('how long it ran, without the waiting of a coroutine', 'ns', unknown=-1),
    'waiting_group': Column('how long others of its group ran while it waited', 'ns'),
    'waiting_program': Column('how long others of its program, which runs one at a time, ran '
                              'while it waited, or the program did not spin', 'ns'),
    'cpu': Column('its CPU time, if it was recorded', 'ns', unknown=-1),
    'execution': Column('row of `executions`')}, _make)
