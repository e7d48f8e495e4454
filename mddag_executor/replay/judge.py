# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verdicts of a recorded run: its events through the scheduler core, once more.

Theory of operation
-------------------
The core is fed what the executor fed its own: releases, completions, and, because they depend on
settings and on messages that are not in the trace, the expiries, aborts and failures as they were
recorded.
The bounds that would decide about them anew are lifted.  So each sink has the verdicts that the
executor counted, or, under another declaration, those that it would have counted had the callbacks
run at the same times.

The misses that the executor recorded must be the ones found here; where they are not, something is
missing in the trace or wrong in this program, and ``differences`` says so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from mddag_executor.core import NEVER, Scheduler, Tables
from mddag_executor.core.jobs import is_judged, judge_from
from mddag_executor.core.state import (
    Decision,
    DROP,
    IDLE,
    JOB_END,
    JUDGE_FROM,
    SINK_ABORTED,
    SINK_COMPLETED,
    SINK_EXPIRED,
    SINK_FAILED,
    SINK_LATE,
    SINK_MISSED,
    SKIP,
)
from mddag_executor.core.tables import CONTINUE
from mddag_executor.replay.chains import Chains
from mddag_executor.replay.follower import Execution, Observer, Piece
from mddag_executor.replay.tolerances import MissTally
from mddag_executor.replay.waits import GroupWaits
from mddag_executor.text import counted
from msg_graph import TaskSet

KEEP_RESPONSES = 1_000_000
"""How many response times are kept for each sink: beyond that, quantiles are of the last ones."""

_KEEP_WAITED = 4096
_MISSES = {SINK_MISSED, SINK_ABORTED, SINK_EXPIRED, SINK_FAILED}


class Miss(NamedTuple):
    """A missed deadline: DAG, global vertex, job, absolute deadline, completion (-1: never)."""

    dag: int
    vertex: int
    job: int
    deadline: int
    completed: int


class Judge(Observer):
    """
    Feeds a core and counts its verdicts.

    :param task_set: the declaration that judges.
    :param compare: whether recorded misses must equal those found.
    :param waits: knows what was waited for; told before.
    :param skip: how long after the first release jobs are not judged, ns.
    :param judge_from: jobs released before are not judged.
    """

    def __init__(
        self, task_set: TaskSet, compare: bool, waits: GroupWaits | None = None, skip: int = 0,
        judge_from: int = -NEVER,
    ) -> None:
        self._waits = waits
        # by DAG, vertex, job and ready time: how long an execution waited for its group, ns
        self._waited: dict[tuple[int, int, int, int], int] = {}
        tables = Tables.build(task_set, legs=True, groups=False)
        n = tables.n_dags + 1
        self.tables = tables._replace(
            max_active_jobs=[NEVER] * n, expire_after=[NEVER] * n, on_miss=[CONTINUE] * n)
        self.tally = MissTally(task_set, self.tables, KEEP_RESPONSES)
        self.chains = Chains(task_set, self.tables)
        #: Events that contradict those before them.
        self.contradictions = 0
        #: Who else is told what the core decides.
        self.listeners: list[Callable[[Sequence[Decision]], None]] = []
        self._scheduler = Scheduler(self.tables, 1, propagate=False)
        self._scheduler.state.scalars[SKIP] = self.skip = skip
        self._scheduler.state.scalars[JUDGE_FROM] = judge_from
        self._slots: dict[tuple[int, int], int] = {}
        self._newest: dict[int, int] = {}
        #: Whether recorded misses must equal those found.
        self.compare = compare
        # misses that only one side has seen so far: found here (+1) or recorded (-1)
        self._open_misses: dict[Miss, int] = {}
        #: How many misses were recorded.
        self.n_recorded = 0

    def hosted(self, dag: int, vertices: set[int]) -> None:
        """Expect nothing of a DAG that other processes run."""
        first, last = self.tables.first_vertex[dag:dag + 2]
        self._scheduler.expect(dag, [int(v in vertices) for v in range(first, last)])

    def judging(self, release: int) -> None:
        """Judge only jobs that are released then or later."""
        judge_from(self._scheduler.state, release)

    @property
    def judge_from(self) -> int:
        """Return the first release that is judged."""
        return self._scheduler.state.scalars[JUDGE_FROM]

    @property
    def expected(self) -> dict[str, list[int]]:
        """Return the columns of the core's state that tell what is expected here."""
        state = self._scheduler.state
        return {'partial': state.partial, 'expected': state.expected}

    def released(self, dag: int, job: int, release: int, now: int) -> None:
        """Open the job."""
        self._newest[dag] = job
        slot = self._scheduler.release(dag, job, release, now)
        self._slots[(dag, job)] = slot
        if is_judged(self._scheduler.state, slot):
            self.tally.released(dag)
        self.chains.begin(slot, release)

    def started(self, dag: int, vertex: int, job: int, ready: int, start: int) -> None:
        """Note that a vertex of an open job runs."""
        slot = self._slots.get((dag, job))
        if slot is not None:
            self.chains.started(slot, vertex, ready, start)

    def ran(self, piece: Piece) -> None:
        """Keep what a piece waited for."""
        if self._waits is not None and piece.vertex >= 0 and self._waits.last:
            self._waited[(piece.dag, piece.vertex, piece.job, piece.ready)] = self._waits.last
            if len(self._waited) > _KEEP_WAITED:
                del self._waited[next(iter(self._waited))]

    def completed(
        self, dag: int, vertex: int, job: int, leg: int, whole: bool, end: int,
        execution: Execution | None,
    ) -> None:
        """Complete an execution of an open job; later ones are not judged."""
        waited = 0
        if execution is not None and self._waited:
            waited = self._waited.pop((dag, vertex, job, execution.ready), 0)
        slot = self._slots.get((dag, job))
        if slot is None:
            if job > self._newest.get(dag, -1):
                self.contradictions += 1
            return
        scheduler = self._scheduler
        x = scheduler.execution(slot, vertex, leg)
        if scheduler.state.x_state[x] != IDLE:
            self.contradictions += 1
            return
        scheduler.admit(x, end)
        if scheduler.complete(x, end) and execution is not None:
            self.chains.completed(slot, vertex, leg, execution, waited)
        self._decided(slot)

    def ended(self, dag: int, job: int, aborted: bool, now: int) -> None:
        """End an open job as it was recorded."""
        slot = self._slots.get((dag, job))
        if slot is None:
            # under another declaration it may have completed before
            self.contradictions += self.compare
        elif aborted:
            self._scheduler.abort(slot, now)
            self._decided(slot)
        else:
            self._scheduler.expire(slot, now)
            self._decided(slot)

    def withdrawn(self, dag: int, job: int) -> None:
        """Close a job that is open without a verdict."""
        slot = self._slots.pop((dag, job), None)
        if slot is not None:
            self._scheduler.withdraw(slot)

    def failed(self, dag: int, vertex: int, job: int, now: int) -> None:
        """Fail an open job."""
        slot = self._slots.get((dag, job))
        if slot is not None:
            self._scheduler.fail_open(slot, now)
            self._decided(slot)

    def missed(self, dag: int, vertex: int, job: int, deadline: int, completed: int) -> None:
        """Compare a recorded miss."""
        if self.compare:
            self.n_recorded += 1
            self.differ(Miss(dag, vertex, job, deadline, completed), -1)

    def finished(self, now: int) -> None:
        """Judge what is open."""
        self._scheduler.finish(now)
        self._decided(-1)

    def _decided(self, slot: int) -> None:
        """Count what the core has decided (about the job in a slot, except at the end)."""
        if not self._scheduler.state.decisions:
            return
        decisions = self._scheduler.decisions()
        self.tally.add(decisions)
        for listener in self.listeners:
            listener(decisions)
        for kind, dag, vertex, job, deadline, time in decisions:
            if kind == JOB_END:
                del self._slots[(dag, job)]
            elif kind in SINK_COMPLETED:
                self.chains.sink(slot, vertex, job, time)
                if kind == SINK_LATE and self.compare:
                    self.differ(Miss(dag, vertex, job, deadline, time), 1)
            elif kind in _MISSES and self.compare:
                self.differ(Miss(dag, vertex, job, deadline, time), 1)
            else:
                assert kind != DROP, 'nothing waits in this core, so nothing can be dropped'

    def differ(self, miss: Miss, side: int) -> None:
        """Take in a miss that was found here (side 1) or recorded (-1)."""
        if self.skip:
            return  # what was recorded is of all jobs
        difference = self._open_misses.pop(miss, 0) + side
        if difference:
            self._open_misses[miss] = difference

    def differences(self) -> str | None:
        """
        Return how the recorded misses differ from those found, None where they do not.

        Only of use when the end of the run is recorded: elsewhere the trace may be cut between a
        completion and its verdict.
        """
        found = [miss for miss, side in self._open_misses.items() if side > 0]
        recorded = [miss for miss, side in self._open_misses.items() if side < 0]
        if not found and not recorded:
            return None
        example = min(found + recorded, key=lambda miss: miss.deadline)
        name = 'an undeclared vertex' if example.vertex < 0 \
            else self.tally.vertex_name(example.vertex)
        recorded_misses = counted(self.n_recorded, 'recorded miss', 'recorded misses')
        return (f'the replay does not find {len(recorded)} of {recorded_misses}, and it finds '
                f'{len(found)} that were not recorded: the first is job {example.job} at {name}')
