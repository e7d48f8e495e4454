# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verdicts of a recording by the scheduler core itself, fed event by event."""

from collections import defaultdict

from mddag_executor.core import NEVER, Scheduler, Tables, Tally
from mddag_executor.core import state as core
from mddag_executor.core.jobs import is_judged, judge_from
from mddag_executor.core.rules import complete
from mddag_executor.core.state import DONE, IDLE, JOB_END, OPEN, SKIP
from mddag_executor.core.tables import CONTINUE, DRIVEN
from mddag_executor.recording.tables import ABORTED, ALL_LEGS, EXPIRED, FAILED, VERTEX

from ..sources.helpers import withhold

ENDS = {EXPIRED: core.EXPIRED, ABORTED: core.ABORTED, FAILED: core.FAILED}
_KINDS = ('released', 'completed', 'ended', 'hosted', 'finished')


class Oracle:
    """Feeds a core what a recording says, in order; its bounds are lifted."""

    def __init__(self, recording, skip=0):
        task_set = recording.task_set
        tables = Tables.build(task_set, legs=True)
        n = tables.n_dags + 1
        self.tables = tables._replace(
            max_active_jobs=[NEVER] * n, expire_after=[NEVER] * n, on_late=[CONTINUE] * n)
        self.tally = Tally(task_set, self.tables)
        self.decisions = []
        self.scheduler = Scheduler(self.tables, 1)
        self.scheduler.state.scalars[SKIP] = skip
        if recording.run.judge_from > -NEVER:
            judge_from(self.scheduler.state, recording.run.judge_from)
        self.slots = {}
        self.task_set = task_set
        self.published = defaultdict(set)
        self.published_by = defaultdict(set)
        sent, publishers = recording.publications, recording.names.publishers
        for publisher, by in sent[['publisher', 'execution']].tolist():
            if by >= 0 and publisher in publishers:
                ran = recording.executions[by]
                topic = publishers[publisher].topic
                self.published[int(ran['vertex']), int(ran['job'])].add(topic)
                self.published_by[int(ran['order'])].add(topic)
        events = [(order, 0, (dag, job, release, noticed)) for _, dag, job, release, noticed, order
                  in recording.releases.tolist()]
        #: By driven sync and job when its driving message was received.
        self.received = {}
        for v, job, start in recording.executions[['vertex', 'job', 'start']].tolist():
            if v >= 0 and start >= 0 and task_set.vertices[v].callback.driven_by is not None:
                self.received[v, job] = min(start, self.received.get((v, job), NEVER))
        columns = ('order', 'dag', 'vertex', 'job', 'leg', 'end', 'completes')
        done = recording.executions[
            (recording.executions['completes'] > 0) & (recording.executions['vertex'] >= 0)]
        events += [(order, 1, (*row, order)) for order, *row in done[list(columns)].tolist()]
        events += [(order, 2, (dag, job, time, reason)) for _, dag, _, job, time, reason, order
                   in recording.job_ends.tolist()]
        events += [(order, 3, (dag, here)) for order, dag, here in recording.run.hosted]
        if recording.run.judged:
            events.append((recording.run.judged_order, 4, (recording.run.judged_until,)))
        for _, kind, what in sorted(events, key=lambda event: event[0]):
            getattr(self, _KINDS[kind])(*what)
            decided = self.scheduler.decisions()
            for each in decided:
                if each[0] == JOB_END:
                    self.slots.pop((each[1], each[3]), None)
            self.decisions += decided
        self.tally.add(self.decisions)

    def released(self, dag, job, release, now):
        slot = self.slots[dag, job] = self.scheduler.release(dag, job, release, now)
        if is_judged(self.scheduler.state, slot):
            self.tally.released(dag)

    def completed(self, dag, vertex, job, leg, end, completes, order):
        state, tables = self.scheduler.state, self.tables
        legs = range(tables.n_legs[vertex]) if leg == ALL_LEGS else [leg]
        if tables.driven[vertex] & DRIVEN:
            if completes == VERTEX:
                self.answered(dag, vertex, job, end, order)
            return
        for each in legs:
            slot = self.slots.get((dag, job))
            if slot is None or state.job_state[slot] != OPEN:
                return
            x = self.scheduler.execution(slot, vertex, each)
            if state.x_state[x] == IDLE:
                state.job_active[slot] += 1     # without ready queue, group and workers
                withhold(self.task_set, self.scheduler, slot, vertex,
                         self.published[vertex, job], end)
                complete(tables, state, self.scheduler.policy.key, x, end)

    def answered(self, dag, vertex, job, end, order):
        """Complete a driven sync in a job, and in those of earlier driving messages."""
        slot = self.slots.get((dag, job))
        if slot is None or self.scheduler.state.job_state[slot] != OPEN:
            return
        x = self.scheduler.execution(slot, vertex)
        if self.scheduler.state.x_pending[x] < 0:
            return
        self.scheduler.state.x_state[x] = DONE
        received = self.received[vertex, job]
        before = [self.slots[dag, other] for (v, other), at in self.received.items()
                  if v == vertex and at < received and (dag, other) in self.slots]
        for each in (slot, *before):
            x = self.scheduler.execution(each, vertex)
            if self.scheduler.state.x_pending[x] >= 0:
                withhold(
                    self.task_set, self.scheduler, each, vertex, self.published_by[order], end)
        for each in (slot, *before):
            self.scheduler.answer(each, vertex, slot, end)

    def ended(self, dag, job, time, reason):
        slot = self.slots.get((dag, job))
        if slot is None:
            return
        if reason in ENDS:
            self.scheduler.give_up(slot, ENDS[reason], time)
        else:
            decisions = self.scheduler.state.decisions
            before = len(decisions)
            self.scheduler.give_up(slot, core.EXPIRED, time)
            del decisions[before:]  # its end is not known
            del self.slots[dag, job]

    def hosted(self, dag, here):
        first, last = self.tables.first_vertex[dag:dag + 2]
        self.scheduler.expect(dag, [int(v in here) for v in range(first, last)])

    def finished(self, now):
        self.scheduler.finish(now)
