# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What recorded executions would have taken alone, without others that compute beside them.

Theory of operation
-------------------
An execution that computed for ``cpu`` of its ``took`` waited for the rest: for something of its
own, for the interpreter, or for a CPU.  What it waited for others is taken back; what nobody else
explains is its own.

* One that *holds the interpreter* cannot compute while others do.  What they computed meanwhile is
  known, if not when: an execution is taken to have computed evenly.  At most so much of its
  waiting was for the interpreter.
* One that *waits* needs the interpreter when it goes on, and publishes.  If somebody held it all
  the time until then it had to wait for a switch interval, or since that one had begun.
* One that *computes without the lock* shared the CPUs with all that computed, if they were more.
"""

from __future__ import annotations

from typing import Any

from mddag_executor.replay.happenings import Ints
from mddag_executor.simulate.machine import BRIEF_NS, SWITCH_NS
import numpy as np


def alone(start: Ints, took: Ints, cpu: Ints, held: Ints, cpus: int) -> Ints:
    """
    Return what executions would have taken alone, ns.

    :param took: how long they took, all in all.
    :param cpu: their CPU time, -1 where it is not known: they took what they would have.
    :param held: whether they held the interpreter.
    :param cpus: of the machine; 0: not known.
    """
    known = cpu >= 0
    cpu = np.minimum(cpu, took)
    waited = np.where(known, took - cpu, 0)
    holds = known & (held != 0)
    result = took.copy()
    end = start + took
    if holds.any():
        others = _computed(start[holds], end[holds], cpu[holds])
        beside = others(end) - others(start)
        mine = np.minimum(waited, np.maximum(0, beside - cpu))
        result[holds] -= mine[holds]
        _take_back_last_wait(result, known & ~holds, end, cpu, waited, start[holds], end[holds])
    native = known & ~holds & (2 * cpu >= took)
    if cpus > 0 and native.any():
        others = _computed(start[known], end[known], cpu[known])
        computing = (others(end) - others(start)) / np.maximum(took, 1)
        alone_share = np.minimum(1.0, cpus / np.maximum(computing, 1e-9))
        shared = np.rint(took * (1 - alone_share)).astype(np.int64)
        mine = np.minimum(result - cpu, np.maximum(0, shared))
        result[native] -= np.maximum(0, mine)[native]
    return result


def _computed(start: Ints, end: Ints, cpu: Ints) -> Any:
    """Return a function of the time until which these computed so much, evenly."""
    rate = cpu / np.maximum(end - start, 1)
    times = np.concatenate([start, end])
    order = np.argsort(times, kind='stable')
    times = times[order]
    slope = np.cumsum(np.concatenate([rate, -rate])[order])
    total = np.concatenate([[0.0], np.cumsum(slope[:-1] * np.diff(times))])

    def until(when: Ints) -> Any:
        return np.rint(np.interp(when - times[0], times - times[0], total)).astype(np.int64)

    return until


def _take_back_last_wait(
    result: Ints, which: Any, end: Ints, cpu: Ints, waited: Ints, begins: Ints, ends: Ints
) -> None:
    """Take back from some executions what they waited for the interpreter before they went on."""
    order = np.argsort(begins, kind='stable')
    begins, ends = begins[order], np.maximum.accumulate(ends[order])
    first = np.r_[True, begins[1:] > ends[:-1]]     # of each time without a pause
    begins = begins[first]
    ends = ends[np.r_[np.flatnonzero(first)[1:] - 1, len(first) - 1]]
    after = np.where(cpu >= waited, np.minimum(cpu, BRIEF_NS), cpu - cpu // 4)
    goes_on = end - after
    place = np.searchsorted(begins, goes_on, 'left') - 1
    inside = which & (place >= 0) & (ends[place] >= goes_on)
    since = np.where(inside, goes_on - begins[place], 0)
    result -= np.minimum(np.minimum(since, SWITCH_NS), waited)
