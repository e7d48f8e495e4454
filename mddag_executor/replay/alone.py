# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What recorded executions would have taken alone, without others that compute beside them.

Theory of operation
-------------------
An execution that computed for ``cpu`` of its ``took`` waited for the rest: for something of its
own, for the interpreter, or for a CPU.  What it waited for others is taken back; what none of them
explains is its own.

* One that *holds the interpreter* cannot compute while others do.  What they computed meanwhile is
  known, if not when: an execution is taken to have computed evenly.  At most so much of its
  waiting was for the interpreter.  The rest is its own (or the machine had no CPU for it); where
  several held the interpreter at a time, all of them waited then, and each is left its part.
* One that *waits* needs the interpreter when it goes on, and publishes.  If somebody held it all
  the time until then it had to wait for a switch interval, or since that one had begun.
* One that *computes without the lock* waited for a CPU if hardly any of them was idle meanwhile.
"""

from __future__ import annotations

from typing import Any

from mddag_executor.replay.happenings import Ints
from mddag_executor.simulate.machine import BRIEF_NS, SWITCH_NS
import numpy as np

FULL = 0.9
"""CPUs that are busy for so much of a time have nothing left."""


def alone(
    start: Ints, took: Ints, cpu: Ints, held: Ints, interpreter: Ints, cpus: int
) -> Ints:
    """
    Return what executions would have taken alone, ns.

    :param took: how long they took, all in all.
    :param cpu: their CPU time, -1 where it is not known: they took what they would have.
    :param held: whether they held the interpreter, and ``interpreter``: which one.
    :param cpus: of the machine; 0: not known.
    """
    known = cpu >= 0
    cpu = np.minimum(cpu, took)
    waited = np.where(known, took - cpu, 0)
    holds = known & (held != 0)
    result = took.copy()
    end = start + took
    after = np.where(cpu >= waited, np.minimum(cpu, BRIEF_NS), cpu - cpu // 4)
    for number in np.unique(interpreter[holds]).tolist():
        here = interpreter == number
        mine = holds & here
        others = _computed(start[mine], end[mine], cpu[mine])
        beside = others(end) - others(start)
        for_it = np.minimum(waited, np.maximum(0, beside - cpu))
        last = np.minimum(held_for(end - after, start[mine], end[mine]), SWITCH_NS)
        together = _computed(start[mine], end[mine], took[mine])
        several = np.maximum(1.0, (together(end) - together(start)) / np.maximum(took, 1))
        own = np.rint((waited - for_it) / several).astype(np.int64)
        result[mine] = (cpu + own)[mine]
        waits = known & ~holds & here
        result[waits] -= np.minimum(last, waited)[waits]
    native = known & ~holds & (2 * cpu >= took)
    if cpus > 0 and native.any():
        others = _computed(start[known], end[known], cpu[known])
        native &= others(end) - others(start) >= FULL * cpus * took
        result[native] = cpu[native]
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


def held_for(when: Ints, begins: Ints, ends: Ints) -> Ints:
    """
    Return for how long somebody had held the interpreter without a pause, 0 where nobody did.

    :param begins: of the executions that hold it; ``ends``: of the same.
    """
    order = np.argsort(begins, kind='stable')
    begins, ends = begins[order], np.maximum.accumulate(ends[order])
    first = np.r_[True, begins[1:] > ends[:-1]]     # of each time without a pause
    begins = begins[first]
    ends = ends[np.r_[np.flatnonzero(first)[1:] - 1, len(first) - 1]]
    place = np.searchsorted(begins, when, 'left') - 1
    inside = (place >= 0) & (ends[place] >= when)
    return np.where(inside, when - begins[place], 0)
