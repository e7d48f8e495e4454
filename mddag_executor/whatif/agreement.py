# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether a recorded load, rescheduled with its recorded pool, gives what was recorded.

Theory of operation
-------------------
A schedule in virtual time has no machine: other processes take no CPU, nothing stops, and a
callback that waits for Python's lock outside of the executor's control waits for nothing.  If the
machine was busy, the prediction is better than the run was, for the recorded pool and for each
other one.  The recorded pool is the one whose truth is known, so it says how far predictions from
this recording can be trusted.
"""

from __future__ import annotations

from mddag_executor.analysis.as_recorded import Replay
from mddag_executor.core.tally import Counts, total
from mddag_executor.whatif.reschedule import Reschedule

POINTS = 5
"""A difference of at most this many percentage points is not reported."""
LEAST_DUE = 50


def disagreement(as_recorded: Reschedule) -> str | None:
    """
    Return how far a schedule with the recorded pool is from the recorded verdicts.

    :return: None: not far, or there are too few results.
    """
    recorded = as_recorded.recorded
    if recorded is None:
        return None
    predicted, found = (
        total(each.tally.result()['dags']) for each in (as_recorded, recorded))
    if min(predicted.due, found.due) < LEAST_DUE:
        return None
    difference = _percent(predicted) - _percent(found)
    if abs(difference) <= POINTS:
        return None
    text = (f'{recorded.recording.run.name}: with the recorded pool the prediction has '
            f'{_percent(predicted):.1f} % of the results in time, but {_percent(found):.1f} % '
            'were: predictions for other pools are off by as much, or more')
    share, run = _computing(recorded), recorded.recording.run
    if not (run.declared or run.imported):
        return (f'{text}: the recorded run had no declaration, so its callbacks did not run in '
                'the order of their deadlines: record it with the declaration')
    if difference > 0 and share is not None:
        text += (": they do not include other load of the machine and waits for Python's lock "
                 f'(callbacks that compute ran on a CPU for {share:.0f} % of their time)')
    return text


def _percent(counts: Counts) -> float:
    return 100 * counts.in_time / counts.due


def _computing(recorded: Replay) -> float | None:
    """Return for how many percent of their time computing callbacks had a CPU; None: unknown."""
    table = recorded.recording.executions
    which = table['holds_gil'] & (table['cpu'] >= 0) & (table['busy'] > 0)
    busy = int(table['busy'][which].sum())
    return 100 * min(1.0, int(table['cpu'][which].sum()) / busy) if busy else None
