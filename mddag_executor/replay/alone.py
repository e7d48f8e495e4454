# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What recorded executions would have taken alone, without others that compute beside them.

Theory of operation
-------------------
An execution that computed for ``cpu`` of its ``took`` waited for the rest: for something of its
own, for Python's lock, or for a CPU.

* A callback *computes* if its executions that wait least wait for less than it computes.  It can
  have waited for the lock only while at least two ran that compute with it, and for a CPU only
  while as many computed as there are CPUs: the executor's own threads need one, too.
* One that *waits* needs the lock and a CPU when it goes on, and publishes.  If others computed
  then, it had to wait for a switch interval at most.
* What a callback waits for itself is told by its executions that nobody can have disturbed: their
  median; where there are none, by those that waited least beyond what others explain.  What an
  execution waited for more than that is taken back, as far as others explain it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from mddag_executor.replay.happenings import Ints
from mddag_executor.simulate.machine import BRIEF_NS, SWITCH_NS
import numpy as np
import numpy.typing as npt

LEAST = 0.05
"""So many of a callback's executions are those that wait least."""

Flags = npt.NDArray[np.bool_]


def computing(callback: Ints, took: Ints, cpu: Ints) -> Flags:
    """
    Return by execution whether its callback computes.

    :param callback: a number by execution; ``cpu`` is -1 where it is not known.
    """
    computes = np.zeros(len(took), dtype=np.bool_)
    for which in _by_callback(callback, cpu):
        waited = np.quantile(np.maximum(0, took[which] - cpu[which]), LEAST)
        computes[which] = waited <= np.median(cpu[which])
    return computes


def _by_callback(callback: Ints, cpu: Ints) -> Iterator[Ints]:
    """Yield the executions of each callback of which the CPU time is known."""
    known = np.flatnonzero(cpu >= 0)
    known = known[np.argsort(callback[known], kind='stable')]
    for which in np.split(known, np.flatnonzero(np.diff(callback[known])) + 1):
        if len(which):
            yield which


def alone(
    start: Ints, took: Ints, cpu: Ints, callback: Ints, locks: Flags, interpreter: Ints, cpus: int
) -> Ints:
    """
    Return what executions would have taken alone, ns.

    :param took: how long they took, all in all.
    :param cpu: their CPU time, -1 where it is not known: they took what they would have.
    :param callback: the number of their callback.
    :param locks: whether they compute with Python's lock, and ``interpreter``: which one.
    :param cpus: of the machine; 0: not known.
    """
    computes = computing(callback, took, cpu)
    computed = np.minimum(cpu, took)
    waited = np.where(cpu >= 0, took - computed, 0)
    for_others = np.minimum(
        waited, _for_others(start, took, computed, computes, locks, interpreter, cpus))
    result = took.copy()
    for which in _by_callback(callback, cpu):
        own = waited[which] - for_others[which]
        undisturbed = own[for_others[which] == 0]
        usual = int(np.median(undisturbed) if len(undisturbed) else np.quantile(own, LEAST))
        result[which] -= np.minimum(np.maximum(0, waited[which] - usual), for_others[which])
    return result


def _for_others(
    start: Ints, took: Ints, computed: Ints, computes: Flags, locks: Flags, interpreter: Ints,
    cpus: int,
) -> Ints:
    """Return for how long executions can have waited for others, at most."""
    end = start + took
    after = np.where(
        2 * computed >= took, np.minimum(computed, BRIEF_NS), computed - computed // 4)
    last = np.maximum(start, end - after - SWITCH_NS)   # of one that waits
    waits = (computed >= 0) & ~computes
    found = np.zeros(len(took), dtype=np.int64)
    if cpus > 0:
        for which, begin, most in (
                (computes, start, max(1, cpus - 1)), (waits, last, cpus - 1)):
            busy = time_of(start[computes], end[computes], most)
            found[which] += (busy(end) - busy(begin))[which]
    for number in np.unique(interpreter[locks]).tolist():
        mine = locks & (interpreter == number)
        here = waits & ~mine & (interpreter == number)
        for which, begin, most in ((mine, start, 1), (here, last, 0)):
            held = time_of(start[mine], end[mine], most)
            found[which] += (held(end) - held(begin))[which]
    return found


def time_of(begins: Ints, ends: Ints, more_than: int) -> Callable[[Ints], Ints]:
    """Return a function of a time: how long, until then, more than so many ran at once."""
    times = np.concatenate([begins, ends])
    order = np.argsort(times, kind='stable')
    times = times[order]
    count = np.cumsum(np.repeat([1, -1], len(begins))[order])
    total = np.concatenate([[0], np.cumsum(np.diff(times) * (count[:-1] > more_than))])

    def until(when: Ints) -> Ints:
        if not len(times):
            return np.zeros(len(when), dtype=np.int64)
        passed: Ints = np.rint(np.interp(when - times[0], times - times[0], total)).astype(
            np.int64)
        return passed

    return until
