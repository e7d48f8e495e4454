# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The result table `response_parts`."""

from __future__ import annotations

from mddag_executor.analysis.result_table import Column, DAG, Replayed, ResultTable, VERTEX
from mddag_executor.recording.columns import Table


def _make(replay: Replayed) -> Table:
    return replay.chains.response_parts()


TABLE = ResultTable('response_parts', 'completed job at each sink: where its response time went', {
    'dag': Column('the DAG', names=DAG),
    'sink': Column('the sink', names=VERTEX),
    'job': Column('number of the job'),
    'release': Column('when the job was released', 'ns'),
    'completed': Column('when the sink was completed', 'ns'),
    'release_lag': Column('from the release until the source was ready', 'ns'),
    'waiting': Column('ready callbacks waited for a worker, for their callback group, or for '
                      'their program', 'ns'),
    'executing': Column('callbacks ran, until they published or ended', 'ns'),
    'suspended': Column('coroutines waited within their executions', 'ns'),
    'transport': Column('from the end of a callback until the next one was ready', 'ns'),
    'unknown': Column('before the first callback of the chain that is recorded', 'ns'),
    'waiting_group': Column('part of `waiting`: another callback of the group ran', 'ns'),
    'waiting_program': Column('part of `waiting`: another callback of a program ran that runs one '
                              'at a time, or the program did not spin', 'ns')}, _make)
