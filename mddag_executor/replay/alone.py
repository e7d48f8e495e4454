# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What recorded executions would have taken alone, without others that compute beside them.

Theory of operation
-------------------
An execution takes the time from when it could have started to its end: dispatch and callback.  In
that it stood still while it waited for Python's lock, or for a CPU.  How long, the model of the
machine tells (``simulate.machine``) that predictions are made with: executions that are started
when the recorded ones could have, and take what these would have alone, must end when these did.
So the times are sought with which they do: first each takes what was recorded; what it then ends
too late is taken off, down to its CPU time, and so on.  Of ``TURNS`` tries the best one counts.
What the model does not explain stays in the time, so that a schedule like the recorded one gives
the recorded response times.  A long recording goes window by window, each with its best try.

That is right where as many run beside one another as in the recording.  Where fewer do, what the
model leaves over has to be told apart.  The part ``LEAST`` of a callback's executions wait hardly
for others: what each of them waits, every one waits for itself.  What one waits for beyond that,
no longer than others ran, is *theirs*.  It is taken off in proportion to the time in which more
ran than can: with one worker none of it is left.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from mddag_executor.core import NEVER, Tables
from mddag_executor.recording.tables import Ints
from mddag_executor.simulate import END, Load, schedule, Settings
from mddag_executor.simulate.schedule import prepare
import numpy as np
import numpy.typing as npt

ENOUGH = 5
"""So many executions are enough to say what is usual."""
LEAST = 0.2
"""So many of a callback's executions wait for nothing but what it waits for itself."""
TURNS = 8
WINDOW = 50_000
"""So many executions the model runs at once, and more until nothing runs: up to as many again."""

Flags = npt.NDArray[np.bool_]


class Recorded(NamedTuple):
    """
    Recorded executions, by columns, ns.

    ``could`` says when they could have started, and ``took`` what they took from then on;
    ``cpu`` is -1 where it is not known; ``locks`` says whether they compute with Python's lock,
    ``interpreter`` which one that is, from 1; ``callback`` is a number.
    """

    could: Ints
    took: Ints
    cpu: Ints
    locks: Flags
    interpreter: Ints
    callback: Ints
    warm: Flags

    @property
    def least(self) -> Ints:
        """Return what they took at least, alone, too: their CPU time."""
        least: Ints = np.minimum(np.maximum(0, self.cpu), self.took)
        return least

    def of(self, which: Flags | Ints) -> Recorded:
        """Return some of them."""
        return Recorded(
            self.could[which], self.took[which], self.cpu[which], self.locks[which],
            self.interpreter[which], self.callback[which], self.warm[which])

    def beside(self, others: Recorded) -> Recorded:
        """Return these with others behind them."""
        columns: Any = map(np.concatenate, zip(self, others))
        return Recorded(*columns)


def alone(ran: Recorded, cpus: int = 0, workers: int = NEVER) -> Ints:
    """
    Return what executions would have taken alone.

    :param cpus: of the machine; 0: not known.
    :param workers: how many each process is to have, if that is fewer than in the recording.
    """
    took = ran.took.copy()
    at_once = workers * int(ran.interpreter.max(initial=1)) if workers < NEVER else NEVER
    some, more = (np.zeros(len(took) * (workers < NEVER), dtype=np.int64) for _ in range(2))
    for which in _windows(ran):
        window = ran.of(which)
        ends = window.could + window.took
        beside = _beside(window.could, ends)
        if workers < NEVER:
            some[which], more[which] = beside, _beside(window.could, ends, at_once)
        disturbed = which[beside > 0]
        if len(disturbed):
            took[disturbed] = _explained(
                ran.of(disturbed), cpus, TURNS * len(took) // len(disturbed))
    if workers < NEVER:
        took -= np.rint(
            _theirs(ran, took, some) * more / np.maximum(1, some)).astype(np.int64)
    return took


def _windows(ran: Recorded) -> Iterator[Ints]:
    """Yield executions in the order in which they could start, parted where the fewest ran."""
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


def colder(callback: Ints, warm: Flags, took: Ints) -> Ints:
    """
    Return what executions take more than if their workers had not slept, or would if they had.

    Those take more: a thread has to be woken, and finds cold caches.  It is the difference of the
    medians of a callback, or where that is not known the median one; below 0 for what was warm.
    """
    found = np.full(len(took), -1)
    for which in _by_callback(callback, np.ones(len(took), dtype=np.bool_)):
        times = [took[which][warm[which] == how] for how in (True, False)]
        if min(map(len, times)) >= ENOUGH:
            found[which] = max(0, np.median(times[1]) - np.median(times[0]))
    known = found[found >= 0]
    found[found < 0] = np.median(known) if len(known) else 0
    more: Ints = np.where(warm, -found, np.minimum(found, took // 2))
    return more


def _by_callback(callback: Ints, those: Flags) -> Iterator[Ints]:
    """Yield some executions of each callback."""
    places = np.flatnonzero(those)
    places = places[np.argsort(callback[places], kind='stable')]
    for which in np.split(places, np.flatnonzero(np.diff(callback[places])) + 1):
        if len(which):
            yield which


def _explained(ran: Recorded, cpus: int, runs: int) -> Ints:
    """
    Return the times with which the model ends executions when they ended.

    :param ran: in the order of ``could``.
    :param runs: how many of as many executions there are to be in all.
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
    """Return when the model ends executions that take so long alone; see ``_explained``."""
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
    # those that stand still are more than those that ran
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
    """Return tables with a DAG of one vertex, of which nothing is declared, in each process."""
    one = Tables.build(None)
    columns: dict[str, Any] = {
        name: value * n for name, value in one._asdict().items() if isinstance(value, list)}
    numbers = list(range(n))
    return one._replace(**columns)._replace(
        n_dags=n - 1, n_vertices=n - 1, dag_of=numbers, source=numbers, first_vertex=numbers,
        process=[number + 1 for number in numbers],
        first_sink=[0] * (n + 1), first_successor=[0] * (n + 1))


def _theirs(ran: Recorded, took: Ints, beside: Ints) -> Ints:
    """Return what executions that take so long waited for others, which ran ``beside`` them."""
    waited = took - ran.least
    theirs = np.zeros_like(took)
    for which in _by_callback(ran.callback, ran.cpu >= 0):
        theirs[which] = waited[which] - np.quantile(waited[which], LEAST)
    lost: Ints = np.clip(theirs, 0, beside)
    return lost


def _beside(begins: Ints, ends: Ints, others: int = 1) -> Ints:
    """Return by interval for how long there were at least so many others."""
    times = np.concatenate([begins, ends])
    order = np.argsort(times, kind='stable')
    passed = np.diff(times[order])
    passed[np.cumsum(np.where(order < len(begins), 1, -1))[:-1] <= others] = 0
    total = np.zeros_like(times)
    total[order[1:]] = np.cumsum(passed)
    beside: Ints = total[len(begins):] - total[:len(begins)]
    return beside
