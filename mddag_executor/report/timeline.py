# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What ran when, kept for pictures: every execution while there is room, and sums of all of them.

Theory of operation
-------------------
``Timeline`` gets what the judge of a replay gets, and needs as much memory however long the
run was:

1. *Detail.*  Executions, releases and verdicts go into blocks of ``BLOCK`` executions, in the
   order in which they ended.  When there are more than ``most`` executions, whole blocks go: first
   those with the fewest missed deadlines, and of equal ones every second, then every second of the
   rest, and so on.  So the misses stay, and what stays of the rest is spread over the run.
2. *Sums.*  How busy the workers were and when deadlines were missed is added up in few steps
   (``PoolUse``).

A *row* says which line of a picture an execution belongs to: the global vertex of the declaration,
or -1-k for the k-th undeclared callback.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from typing import NamedTuple

from mddag_executor.core.jobs import is_miss
from mddag_executor.core.state import (
    Decision,
    DROP,
    JOB_END,
    SINK_ABORTED,
    SINK_EXPIRED,
    SINK_FAILED,
    SINK_IN_TIME,
    SINK_LATE,
    SINK_MISSED,
)
from mddag_executor.replay.happenings import Batch, Observer, RAN, RELEASED
from mddag_executor.replay.usage import PoolUse
import numpy as np
import numpy.typing as npt

MOST_EXECUTIONS = 30_000
BLOCK = 512
MOST_UNDECLARED = 200
OTHERS = 'other undeclared callbacks'

# What came of a sink's job, as the pictures and exports call it.
DONE, OVERDUE, EXPIRED, ABORTED, FAILED = range(5)
_KINDS = {
    SINK_IN_TIME: DONE, SINK_LATE: DONE, SINK_MISSED: OVERDUE, SINK_EXPIRED: EXPIRED,
    SINK_ABORTED: ABORTED, SINK_FAILED: FAILED}

_FIRST_STEP = 1 << 16       # of the sums, ns
_ADDRESS = 2 ** 64 - 1
# Columns of a piece.
CALLBACK, _, VERTEX, DONE_FOR, WORKED_BY, BECAME_READY, STARTED, ENDED = range(8)

Ints = npt.NDArray[np.int64]


def no_names(callback: int) -> str:
    """Stand for all undeclared callbacks, where a run was computed."""
    return 'undeclared callbacks'


class Columns(NamedTuple):
    """
    The detail that was kept; times in ns on the trace's clock.

    ``executions`` has the rows ROW, JOB, WORKER, READY, START, END (indices below), in order of
    start; ``releases`` DAG, job, release; ``verdicts`` global vertex, job, deadline, completion
    (-1: never), kind.
    """

    executions: Ints
    releases: Ints
    verdicts: Ints


ROW, JOB, WORKER, READY, START, END = range(6)


class _Block:
    """A stretch of the run."""

    __slots__ = ('executions', 'releases', 'verdicts', 'number', 'missed')

    def __init__(self, number: int) -> None:
        self.number = number
        self.executions = array('q')
        self.releases = array('q')
        self.verdicts = array('q')
        self.missed = 0

    def worth(self) -> tuple[int, int]:
        """Return what blocks are chosen by: misses, then how even the number is."""
        return self.missed, self.number & -self.number if self.number else 1 << 62


class Timeline(Observer):
    """
    Collects what ran when.

    :param most: how many executions are kept at most.
    :param names: returns the names of callbacks that are not declared.
    :ivar n_executions: how many there were; ``n_missed`` the deadlines missed.
    :ivar busy_over_time: how busy the workers were over time, without the threads beside them; in
        ``missed_over_time`` each missed deadline is one nanosecond.
    """

    def __init__(self, most: int = MOST_EXECUTIONS, block: int = BLOCK,
                 names: Callable[[int], str] = no_names) -> None:
        self.busy_over_time, self.missed_over_time = PoolUse(_FIRST_STEP), PoolUse(_FIRST_STEP)
        self.n_executions = 0
        self.n_missed = 0
        self.workers: set[int] = set()
        self._block_size = block
        self._most_blocks = max(2, most // block)
        self._open = _Block(0)
        self._blocks: list[_Block] = [self._open]
        self._undeclared: dict[int, int] = {}
        self._name_of = names

    # --- input -----------------------------------------------------------------------------------

    def take(self, batch: Batch) -> None:
        """Keep what happened in a stretch of the run."""
        pieces = batch.columns(RAN)
        executions = self._rows_of(pieces)
        by_workers = pieces[pieces[:, WORKED_BY] >= 0]
        self.busy_over_time.add(by_workers[:, STARTED], by_workers[:, ENDED])
        missed = np.array([max(time, deadline) for kind, *_, deadline, time in batch.decisions
                           if is_miss(kind)], dtype=np.int64)
        self.missed_over_time.add(missed, missed + 1)
        self.workers.update(np.unique(pieces[:, WORKED_BY]).tolist())
        # how many executions had ended says in which block something belongs
        ran = np.arange(len(pieces)) + self.n_executions
        ended = np.cumsum(batch.order == RAN) + self.n_executions
        released = ended[batch.places(RELEASED)]
        decided_at = np.array(batch.decided_at, dtype=np.int64)
        decided = ended[decided_at] if len(ended) else decided_at + self.n_executions
        releases = batch.columns(RELEASED)[:, :3]
        self.n_executions += len(pieces)
        for number in range(self._open.number, self.n_executions // self._block_size + 1):
            if number > self._open.number:
                self._next_block(number)
            first = number * self._block_size
            in_ran, in_released, in_decided = (
                slice(*np.searchsorted(ended_by, (first, first + self._block_size)))
                for ended_by in (ran, released, decided))
            self._open.executions.frombytes(executions[in_ran].tobytes())
            self._open.releases.frombytes(releases[in_released].tobytes())
            for filled, decision in zip(
                    (decided[in_decided] - first).tolist(), batch.decisions[in_decided]):
                self._decided(decision, filled)

    def _decided(self, decision: Decision, filled: int) -> None:
        """Keep a verdict; so many executions were in the open block then."""
        kind, _, vertex, job, deadline, time = decision
        if kind == JOB_END or kind == DROP:
            return
        self._open.verdicts.extend((vertex, job, deadline, time, _KINDS[kind]))
        if kind != SINK_IN_TIME:
            self._open.missed += 1
            if 6 * filled < self._block_size and len(self._blocks) > 1:
                self._blocks[-2].missed += 1    # where much of the job ran
            self.n_missed += 1

    def _rows_of(self, pieces: Ints) -> Ints:
        """Return executions as they are kept: ROW, JOB, WORKER, READY, START, END."""
        row, job = pieces[:, VERTEX].copy(), pieces[:, DONE_FOR].copy()
        undeclared = row < 0
        if undeclared.any():
            callbacks = pieces[undeclared, CALLBACK]
            different, first, which = np.unique(
                callbacks, return_index=True, return_inverse=True)
            rows = np.zeros(len(different), dtype=np.int64)
            for k in np.argsort(first).tolist():    # in the order in which they came
                rows[k] = self._undeclared_row(int(different[k]) & _ADDRESS)
            row[undeclared], job[undeclared] = rows[which], -1
        return np.column_stack((row, job, pieces[:, WORKED_BY], pieces[:, BECAME_READY],
                                pieces[:, STARTED], pieces[:, ENDED]))

    def _undeclared_row(self, callback: int) -> int:
        row = self._undeclared.get(callback)
        if row is None:
            if len(self._undeclared) >= MOST_UNDECLARED:
                callback = -1       # all others are one
                row = self._undeclared.get(callback)
            if row is None:
                row = self._undeclared[callback] = -1 - len(self._undeclared)
        return row

    def _next_block(self, number: int) -> None:
        if len(self._blocks) >= self._most_blocks:
            self._blocks.remove(min(self._blocks, key=_Block.worth))
        self._open = _Block(number)
        self._blocks.append(self._open)

    # --- what is asked ---------------------------------------------------------------------------

    @property
    def kept(self) -> int:
        """Return of how many executions there is detail."""
        return sum(len(block.executions) for block in self._blocks) // 6

    def undeclared_names(self) -> list[str]:
        """Return the names of undeclared callbacks: of row -1, of row -2, and so on."""
        return [OTHERS if callback == -1 and place == MOST_UNDECLARED else self._name_of(callback)
                for place, callback in enumerate(self._undeclared)]

    def columns(self) -> Columns:
        """Return the detail that was kept."""
        executions = self._gather('executions', 6)
        return Columns(
            executions[:, np.argsort(executions[START], kind='stable')],
            self._gather('releases', 3), self._gather('verdicts', 5))

    def gaps(self) -> list[tuple[int, int]]:
        """Return the stretches of time (ns) without detail: between blocks that are not next."""
        found = []
        before: _Block | None = None
        for block in self._blocks:
            if not block.executions:
                continue
            if before is not None and block.number != before.number + 1:
                found.append((before.executions[-1], block.executions[5]))
            before = block
        return found

    def _gather(self, name: str, width: int) -> Ints:
        parts = [np.frombuffer(getattr(block, name), dtype=np.int64) for block in self._blocks]
        return np.concatenate(parts).reshape(-1, width).T
