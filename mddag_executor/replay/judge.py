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

from collections.abc import Iterator
from typing import Any, NamedTuple

from mddag_executor.core import NEVER, Scheduler, Tables
from mddag_executor.core.jobs import is_judged, judge_from
from mddag_executor.core.rules import record
from mddag_executor.core.state import (
    DROP,
    IDLE,
    JOB_END,
    JUDGE_FROM,
    SINK_COMPLETED,
    SINK_IN_TIME,
    SINK_LATE,
    SKIP,
)
from mddag_executor.core.tables import CONTINUE
from mddag_executor.replay.chains import Chains
from mddag_executor.replay.happenings import (
    Batch,
    COMPLETED,
    ENDED,
    FAILED,
    MISSED,
    Observer,
    RAN,
    RELEASED,
    STARTED,
    WITHDRAWN,
)
from mddag_executor.replay.tolerances import MissTally
from mddag_executor.replay.usage import GroupWaits
from mddag_executor.text import counted
from msg_graph import TaskSet
import numpy as np

KEEP_RESPONSES = 1_000_000
"""How many response times are kept for each sink: beyond that, quantiles are of the last ones."""

_HALF = 1 << 63


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
    :param waits: knows what was waited for; comes before.
    :param skip: how long after the first release jobs are not judged, ns.
    :param judge_from: jobs released before are not judged.
    """

    def __init__(
        self, task_set: TaskSet, compare: bool, waits: GroupWaits | None = None, skip: int = 0,
        judge_from: int = -NEVER,
    ) -> None:
        self._waits = waits
        # by DAG, vertex, job and ready time: how long an execution waited for its group, ns
        self._waited: dict[tuple[int, ...], int] = {}
        tables = Tables.build(task_set, legs=True, groups=False)
        n = tables.n_dags + 1
        self.tables = tables._replace(
            max_active_jobs=[NEVER] * n, expire_after=[NEVER] * n, on_miss=[CONTINUE] * n)
        self.tally = MissTally(task_set, self.tables, KEEP_RESPONSES)
        self.chains = Chains(task_set, self.tables)
        #: Events that contradict those before them.
        self.contradictions = 0
        self._scheduler = Scheduler(self.tables, 1, propagate=False)
        self._scheduler.state.scalars[SKIP] = self.skip = skip
        self._scheduler.state.scalars[JUDGE_FROM] = judge_from
        self._key = self._scheduler.policy.key
        # by open job, as one number: where its executions begin
        self._bases: dict[int, int] = {}
        self._region = np.array(tables.region_offset, dtype=np.int64)
        self._others: dict[int, Any] = {
            RELEASED: self._released, ENDED: self._ended, WITHDRAWN: self._withdrawn,
            FAILED: self._failed, MISSED: self._missed}
        self._newest: dict[int, int] = {}
        #: Whether recorded misses must equal those found.
        self.compare = compare
        # misses that only one side has seen so far: found here (+1) or recorded (-1)
        self._open_misses: dict[Miss, int] = {}
        #: How many misses were recorded.
        self.n_recorded = 0
        self._now = 0

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

    def take(self, batch: Batch) -> None:
        """Feed the core what happened."""
        self._keep_waits(batch)
        self.chains.begin_batch(batch)
        links, ready, newest = self.chains.links, self.chains.ready, self._newest
        t, state, key_of = self.tables, self._scheduler.state, self._key
        x_state, decided, bases, n_dags = state.x_state, state.decisions, self._bases, t.n_dags
        others = {kind: iter(batch.rows(kind)) for kind in self._others}
        for place, kind, key, head, leg, now, link in self._feed(batch):
            if kind == COMPLETED:
                base = bases.get(key, -1)
                waited = self._take_waited(batch, link) if link >= 0 and self._waited else 0
                if base < 0:
                    # unless of a job that has ended
                    self.contradictions += key > newest.get(key % n_dags, -1)
                    continue
                head += base
                if x_state[head + leg] != IDLE:
                    self.contradictions += 1
                    continue
                if record(t, state, key_of, head + leg, now) and link >= 0:
                    links[head] = link
                    if waited:
                        self.chains.waited[link] = waited
            elif kind == STARTED:
                base = bases.get(key, -1)
                if base >= 0:
                    before = links[base + head]
                    if before < 0 or ready[before] != ready[link]:
                        links[base + head] = link
                continue
            else:
                base = self._others[kind](*next(others[kind]))
            if decided:
                self._decided(batch, place, base)
        self.chains.end_batch()
        self.tally.add(batch.decisions)

    def _feed(self, batch: Batch) -> Iterator[tuple[int, ...]]:
        """
        Yield the place and the kind of what concerns the core.

        Of what completed and started also the job as one number, the place of its vertex among
        the executions of a job, the leg, the time, and its link; -1 without one.
        """
        places = np.flatnonzero(batch.order < RAN)
        kinds = batch.order[places]
        table = np.zeros((5, len(places)), dtype=np.int64)
        for kind, link in ((COMPLETED, self.chains.first), (STARTED, self.chains.first_started)):
            mine, rows = np.flatnonzero(kinds == kind), batch.columns(kind)
            table[0, mine] = rows[:, 2] * self.tables.n_dags + rows[:, 0]
            table[1, mine] = self._region[rows[:, 1]]
            table[4, mine] = np.arange(link, link + len(rows))
            if kind == COMPLETED:
                table[2:4, mine] = rows[:, (3, 5)].T
                table[4, mine[rows[:, 10] < 0]] = -1
        return zip(places.tolist(), kinds.tolist(), *table.tolist())

    def _keep_waits(self, batch: Batch) -> None:
        """Keep what pieces waited for their groups."""
        waits = self._waits.found if self._waits is not None else np.empty(0)
        if waits.any():
            pieces = batch.columns(RAN)
            chosen = np.flatnonzero((waits != 0) & (pieces[:, 2] >= 0))
            for key, waited in zip(
                    pieces[chosen][:, (1, 2, 3, 5)].tolist(), waits[chosen].tolist()):
                self._waited[tuple(key)] = waited

    def _take_waited(self, batch: Batch, link: int) -> int:
        """Return what an execution waited for its group, but only once."""
        dag, vertex, job, _, _, _, ready, *_ = batch.rows(COMPLETED)[link - self.chains.first]
        return self._waited.pop((dag, vertex, job, ready), 0)

    def _key_of_job(self, dag: int, job: int) -> int:
        key = job * self.tables.n_dags + dag
        return (key + _HALF) % (2 * _HALF) - _HALF      # as numpy has it: job may be damaged

    def _released(self, dag: int, job: int, release: int, now: int) -> int:
        """Open the job."""
        state = self._scheduler.state
        slot = self._scheduler.release(dag, job, release, now)
        key = self._newest[dag] = self._key_of_job(dag, job)
        base = self._bases[key] = state.job_base[slot]
        if is_judged(state, slot):
            self.tally.released(dag)
        self.chains.begin(base, dag)
        return base

    def _base_and_slot(self, dag: int, job: int) -> tuple[int, int]:
        """Return where the executions of an open job begin, and its slot; -1 where it is not."""
        base = self._bases.get(self._key_of_job(dag, job), -1)
        return base, -1 if base < 0 else self._scheduler.state.x_slot[base]

    def _ended(self, dag: int, job: int, aborted: bool, now: int) -> int:
        """End an open job as it was recorded."""
        base, slot = self._base_and_slot(dag, job)
        self._now = now
        if slot < 0:
            # under another declaration it may have completed before
            self.contradictions += self.compare
        elif aborted:
            self._scheduler.abort(slot, now)
        else:
            self._scheduler.expire(slot, now)
        return base

    def _withdrawn(self, dag: int, job: int) -> int:
        """Close a job that is open without a verdict."""
        _, slot = self._base_and_slot(dag, job)
        if slot >= 0:
            del self._bases[self._key_of_job(dag, job)]
            self._scheduler.withdraw(slot)
        return -1

    def _failed(self, dag: int, vertex: int, job: int, now: int) -> int:
        """Fail an open job."""
        base, slot = self._base_and_slot(dag, job)
        self._now = now
        if slot >= 0:
            self._scheduler.fail_open(slot, now)
        return base

    def _missed(self, dag: int, vertex: int, job: int, deadline: int, completed: int) -> int:
        """Compare a recorded miss."""
        if self.compare:
            self.n_recorded += 1
            self.differ(Miss(dag, vertex, job, deadline, completed), -1)
        return -1

    def finished(self, now: int, batch: Batch) -> None:
        """Judge what is open."""
        self._scheduler.finish(now)
        if self._scheduler.state.decisions:
            self._now = now
            self.chains.begin_batch(batch)
            self._decided(batch, 0, -1)

    def _decided(self, batch: Batch, place: int, base: int) -> None:
        """Keep what the core has decided (about a job's executions, except at the end)."""
        decisions, deadlines, chains = (
            self._scheduler.state.decisions, self.tables.sink_deadline, self.chains)
        batch.decisions += decisions
        batch.decided_at += [place] * len(decisions)
        for kind, dag, vertex, job, deadline, time in decisions:
            if kind == JOB_END:
                del self._bases[self._key_of_job(dag, job)]
                continue
            assert kind != DROP, 'nothing waits in this core, so nothing can be dropped'
            release = deadline - deadlines[vertex]
            if kind in SINK_COMPLETED:
                chains.sink(base, vertex, job, release, time)
            if kind != SINK_IN_TIME:
                of = base if base >= 0 else self._bases[self._key_of_job(dag, job)]
                chains.missed(kind, of, vertex, job, release,
                              time if kind == SINK_LATE else self._now)
                if self.compare:
                    self.differ(Miss(dag, vertex, job, deadline, time), 1)
        decisions.clear()

    def differ(self, miss: Miss, side: int) -> None:
        """Count a miss that was found here (side 1) or recorded (-1) against the other side."""
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
