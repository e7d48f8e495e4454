# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The result table `usage`."""

from __future__ import annotations

from mddag_executor.analysis.result_table import Column, Replayed, ResultTable
from mddag_executor.recording.columns import Table
import numpy as np


def _make(replay: Replayed) -> Table:
    usage, names = replay.usage.table, [*replay.usage.callbacks(), 'undeclared']
    return Table({'callback': np.array(names, dtype=object),
                  **{name.removesuffix('_ns'): usage[name] for name in usage.names}})


TABLE = ResultTable('usage', 'declared callback; the last row is for all undeclared ones', {
    'callback': Column('the callback, or `undeclared`'),
    'executions': Column('completed executions; of undeclared callbacks all executions'),
    'busy': Column('how long it ran, without the waiting of a coroutine', 'ns'),
    'longest': Column('its longest execution', 'ns'),
    'waiting': Column('how long it was ready and had not started', 'ns'),
    'longest_wait': Column('the longest such time', 'ns'),
    'waiting_group': Column('part of `waiting`: another callback of its group ran', 'ns'),
    'waiting_program': Column('part of `waiting`: another callback of its program ran, which runs '
                              'one at a time, or the program did not spin', 'ns'),
    'measured': Column('executions of which the CPU time is known'),
    'measured_busy': Column('how long these ran', 'ns'),
    'cpu': Column('their CPU time', 'ns'),
    'held_interpreter': Column('how many of these held the interpreter')}, _make)
