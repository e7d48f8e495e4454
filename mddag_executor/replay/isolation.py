# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Estimates isolated execution times: without other executions that compute in parallel.

Theory of operation
-------------------
The recorded time of an execution is from when it could start to its end: dispatch and callback. It
includes pauses in which the execution waited for the GIL or for a CPU.  The machine model of
predictions (``simulate.machine``) says how long these pauses are.  Wanted are isolated times for
which the model, with the recorded starts, gives the recorded ends.

1. Begin with the recorded times.  Whatever the model ends too late is subtracted, down to the CPU
   time of the execution.  Of ``TURNS`` iterations the best one counts.
2. Pauses that the model does not explain remain in the time.  So a schedule like the recorded one
   has the recorded response times.
3. Long recordings are split into windows; each window uses its own best iteration.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from mddag_executor.core import Tables
from mddag_executor.recording.tables import Ints
from mddag_executor.simulate import END, Load, schedule, Settings
from mddag_executor.simulate.schedule import prepare
import numpy as np
import numpy.typing as npt

ENOUGH = 5
"""Minimum number of executions for a median."""
TURNS = 8
WINDOW = 50_000
"""
Minimum number of executions in a window; it ends where the fewest run, before twice this number.
"""

Flags = npt.NDArray[np.bool_]


class Recorded(NamedTuple):
    """
    Recorded executions, by columns, ns.

    ``could`` is when they could have started, ``took`` the time from then to the end, ``cpu`` the
    CPU time (-1: unknown), ``locks`` whether they hold the GIL while they compute, and
    ``interpreter`` the number of the process's interpreter, from 1.
    """

    could: Ints
    took: Ints
    cpu: Ints
    locks: Flags
    interpreter: Ints

    @property
    def least(self) -> Ints:
        """Return the lower bound of the isolated time: the CPU time."""
        least: Ints = np.minimum(np.maximum(0, self.cpu), self.took)
        return least

    def of(self, which: Flags | Ints) -> Recorded:
        """Return the chosen executions."""
        return Recorded(
            self.could[which], self.took[which], self.cpu[which], self.locks[which],
            self.interpreter[which])

    def followed_by(self, others: Recorded) -> Recorded:
        """Return these executions, followed by others."""
        columns: Any = map(np.concatenate, zip(self, others))
        return Recorded(*columns)


def isolated_times(ran: Recorded, cpus: int = 0) -> Ints:
    """
    Return isolated execution times.

    :param cpus: CPUs of the machine; 0: unknown.
    """
    took = ran.took.copy()
    for which in _windows(ran):
        window = ran.of(which)
        disturbed = which[_overlaps(window.could, window.could + window.took)]
        if len(disturbed):
            took[disturbed] = _explained(
                ran.of(disturbed), cpus, TURNS * len(took) // len(disturbed))
    return took


def _windows(ran: Recorded) -> Iterator[Ints]:
    """Yield windows of executions by possible start, split where the fewest executions run."""
    order = np.argsort(ran.could, kind='stable')
    while len(order):
        which = order[:2 * WINDOW]
        could = ran.could[which]
        running = np.arange(len(which)) - np.searchsorted(
            np.sort(could + ran.took[which]), could, 'right')
        window = len(order)
        if len(order) > WINDOW:
            window = WINDOW + int(running[WINDOW:].argmin())
        yield order[:window]
        order = order[window:]


def _explained(ran: Recorded, cpus: int, runs: int) -> Ints:
    """
    Return the isolated times for which the model gives the recorded ends.

    :param ran: in the order of ``could``.
    :param runs: how often the model will run on as many executions: decides whether it is
        compiled.
    """
    found, took, least_wrong = ran.took, ran.took, -1
    for _ in range(TURNS):
        wrong = ran.could + ran.took - _ends(ran, took, cpus, runs)
        total = int(np.abs(wrong).sum())
        if least_wrong < 0 or total < least_wrong:
            found, least_wrong = took, total
        if not total:
            break
        took = np.clip(took + wrong, ran.least, ran.took)
    return found


def _ends(ran: Recorded, took: Ints, cpus: int, runs: int) -> Ints:
    """Return the ends that the model gives for isolated times; see ``_explained``."""
    count = len(took)
    ended = np.searchsorted(np.sort(ran.could + took), ran.could, 'right')
    most = int((np.arange(1, count + 1) - ended).max(initial=1))
    n = int(ran.interpreter.max(initial=1))
    columns: dict[str, Any] = {
        'times': ran.could, 'dags': ran.interpreter - 1, 'jobs': np.arange(count), 'costs': took,
        'computed': ran.cpu, 'holds': np.zeros(count * int(ran.locks.any()), dtype=np.int64),
        'locks': ran.locks.astype(np.int64)}
    load = Load(cost_base=[0] * n, cost_stride=[1] * n, **columns)
    tables = _interpreters(n)
    # at most this many pause in addition to those that run
    settings = Settings('fifo', 2 * most + 2, cpus=cpus or count + 1,
                        duration_ns=int(ran.could[-1] + took.sum() + 1))
    log = np.asarray(schedule(
        tables, load, settings, log=True, compiled=prepare(tables, load, settings, runs)).log,
        dtype=np.int64).reshape(-1, 6)
    log = log[log[:, 1] == END]
    ends = np.zeros(count, dtype=np.int64)
    ends[log[:, 5]] = log[:, 0]
    return ends


def _interpreters(n: int) -> Tables:
    """Return tables of one process per DAG, each DAG with one undeclared vertex."""
    one = Tables.build(None)
    columns: dict[str, Any] = {
        name: value * n for name, value in one._asdict().items() if isinstance(value, list)}
    numbers = list(range(n))
    return one._replace(**columns)._replace(
        n_dags=n - 1, n_vertices=n - 1, dag_of=numbers, source=numbers, first_vertex=numbers,
        process=[number + 1 for number in numbers],
        first_sink=[0] * (n + 1), first_successor=[0] * (n + 1))


def _overlaps(begins: Ints, ends: Ints) -> Flags:
    """Return which intervals overlap others; they are in the order of their begins."""
    later = np.maximum.accumulate(ends)[:-1] > begins[1:]
    earlier = begins[1:] < ends[:-1]
    found: Flags = np.append(False, later) | np.append(earlier, False)
    return found
