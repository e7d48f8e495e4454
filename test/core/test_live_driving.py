# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Random driving of the scheduler as the live executor does it, in parallel with a model.

The model remembers every execution that was made ready, under an identity of its own, and what
became of it; it knows nothing of slots, heaps and keys but what the scheduler's interface shows.
"""

from collections import Counter
from dataclasses import dataclass
from operator import attrgetter, methodcaller

from hypothesis import strategies as st
from hypothesis.stateful import initialize, invariant, precondition, rule, RuleBasedStateMachine
from mddag_executor.core import legs_of, POLICIES, Scheduler, Tables
from mddag_executor.core.state import (
    ABORTED,
    COMPLETED,
    DROP,
    EXPIRED,
    FREE,
    IDLE,
    JOB_END,
    LATE,
    OPEN,
    SINK_ABORTED,
    SINK_COMPLETED,
    SINK_DEMOTED,
    SINK_DROPPED,
    SINK_EXPIRED,
)

from ..conftest import examples
from .live_helpers import undeclared
from .task_sets import task_sets, TICK

WAITING, RUNNING, SUSPENDED, DONE, DROPPED = 'waiting', 'running', 'suspended', 'done', 'dropped'
REFUSED = 'refused'
MAX_ACTIVE = 3
EXPIRE_AFTER = 20 * TICK


@dataclass(eq=False)
class Run:
    """One execution; ``job`` is (DAG, index), the undeclared DAG's for undeclared ones."""

    x: int
    job: tuple[int, int]
    vertex: int
    leg: int
    group: int
    key: int
    began: bool = False
    owns: bool = False
    lent: bool = False
    fate: str = WAITING


@dataclass(eq=False)
class Job:
    """A declared job: its slot, what of it completed, its verdicts."""

    dag: int
    index: int
    slot: int
    release: int
    end: int | None = None


# No lambdas: older versions of hypothesis read the source of one whenever they call it.
MESSAGES, OPEN_JOBS = attrgetter('messages'), methodcaller('open_jobs')


class LiveDriver(RuleBasedStateMachine):
    """Messages arrive late or never, threads take, complete, lend and suspend in any order."""

    @initialize(task_set=task_sets(max_dags=2, max_callbacks=4, groups=False),
                workers=st.integers(1, 3), policy=st.sampled_from(sorted(POLICIES)))
    def start(self, task_set, workers, policy):
        self.task_set = task_set
        self.tables = Tables.build(
            task_set, legs=True, groups=False, max_active_jobs=MAX_ACTIVE,
            expire_after=EXPIRE_AFTER, default_deadline=10 * TICK)
        self.scheduler = Scheduler(self.tables, workers, policy)
        self.state = self.scheduler.state
        self.workers = workers
        self.groups = [-1, self.scheduler.new_group(), self.scheduler.new_group()]
        self.now = 0
        self.runs = []
        self.by_x = {}
        self.jobs = []
        self.messages = []
        self.counter = Counter[str]()
        self.sinks = Counter()
        self.completed_sinks = Counter()
        self.legs_done = Counter()

    # --- what happens ----------------------------------------------------------------------------

    @rule(ticks=st.integers(0, 12))
    def time_passes(self, ticks):
        self.now += ticks * TICK

    @rule(data=st.data(), age=st.integers(0, 3), group=st.integers(0, 2))
    def release(self, data, age, group):
        dag = data.draw(st.sampled_from(self.task_set.dags)).index
        index = self.counter[f'dag {dag}']
        self.counter[f'dag {dag}'] += 1
        release = max(0, self.now - age * TICK)
        over = self.over()
        others = [job for job in self.open_jobs() if job.dag == dag and job not in over]
        slot = self.scheduler.release(dag, index, release, self.now)
        self.settle()
        assert all(job.end == EXPIRED for job in over if job.dag == dag)
        made_room = [job for job in others if job.end is not None]
        assert made_room in ([], others[:1]), 'only the oldest makes room'
        assert slot not in [job.slot for job in self.open_jobs()]
        assert all(run.x not in self.region(dag, slot) for run in self.alive()), (
            'the slot of a job of which something is still to run')
        job = Job(dag, index, slot, release)
        self.jobs.append(job)
        self.make_ready(job, self.tables.source[dag], 0, self.groups[group])

    @precondition(MESSAGES)
    @rule(data=st.data(), group=st.integers(0, 2))
    def message_arrives(self, data, group):
        place = data.draw(st.integers(0, len(self.messages) - 1))
        job, vertex, leg = self.messages.pop(place)
        open_still = (self.state.job_state[job.slot] == OPEN
                      and self.state.job_dag[job.slot] == job.dag
                      and self.state.job_index[job.slot] == job.index)
        assert open_still == (job.end is None)
        if open_still and self.state.x_state[self.scheduler.execution(
                job.slot, vertex, leg)] == IDLE:
            self.make_ready(job, vertex, leg, self.groups[group])
        else:
            self.undeclared(group)

    @rule(group=st.integers(0, 2))
    def undeclared(self, group):
        self.counter['undeclared'] += 1
        index = self.counter['undeclared']
        x = undeclared(self.scheduler, index, self.groups[group], self.now)
        self.note(Run(x, (self.tables.n_dags, index), self.tables.n_vertices, 0,
                      self.groups[group], self.state.x_key[x][0]))

    def make_ready(self, job, vertex, leg, group):
        x = self.scheduler.execution(job.slot, vertex, leg)
        self.state.x_group[x] = group
        self.scheduler.ready(x, self.now)
        self.note(Run(x, (job.dag, job.index), vertex, leg, group, self.state.x_key[x][0]))
        self.settle()  # it may have replaced a late one

    def note(self, run):
        assert run.x not in self.by_x, 'an execution that is still alive'
        self.by_x[run.x] = run
        self.runs.append(run)

    @rule(worker=st.integers(0, 2))
    def dispatch(self, worker):
        idle = [w for w in range(self.workers) if self.state.worker_x[w] == -1]
        if not idle:
            return
        waiting = [run for run in self.alive() if run.fate == WAITING]
        x = self.scheduler.take(idle[worker % len(idle)], self.now)
        self.settle()
        able = [run for run in waiting if run.fate == WAITING and not self.blocked(run)]
        if x < 0:
            assert not (idle and self.polled(able)), 'a worker idles while something may run'
            return
        run = self.by_x[x]
        assert run in able
        if not self.scheduler.policy.polling:  # what waits for the next poll may be smaller
            keys = self.state.x_key  # those that were demoted have others now
            assert keys[run.x] == min(keys[other.x] for other in able), 'a smaller key waits'
        run.fate, run.began, run.owns = RUNNING, True, True
        worker = self.state.x_worker[x]
        assert worker in idle
        assert self.state.worker_x[worker] == x

    @precondition(methodcaller('with_fate', RUNNING))
    @rule(data=st.data())
    def complete(self, data):
        self.complete_one(data.draw(st.sampled_from(self.with_fate(RUNNING))))

    def complete_one(self, run):
        key = (*run.job, run.vertex)
        self.legs_done[key] += 1
        legs = self.tables.n_legs[run.vertex]
        whole = self.scheduler.complete(run.x, self.now)
        assert whole == (self.legs_done[key] == legs)
        run.fate = DONE
        del self.by_x[run.x]
        job = next((job for job in self.jobs if (job.dag, job.index) == run.job), None)
        if whole and job is not None:
            self.publish(job, run.vertex)
        self.settle()

    def publish(self, job, vertex):
        first = self.tables.first_vertex[job.dag]
        dag = self.task_set.dags[job.dag]
        me = dag.vertices[vertex - first]
        for after in me.successors:
            self.messages += [
                (job, first + after, leg) for leg, (_, before)
                in enumerate(legs_of(dag.vertices[after], dag.vertices)) if before == me.index]

    @rule(data=st.data())
    def drop(self, data):
        fresh = [run for run in self.alive()
                 if run.fate in (WAITING, REFUSED) and not run.began]
        if fresh:
            self.scheduler.drop(data.draw(st.sampled_from(fresh)).x, self.now)
            self.settle()

    @precondition(methodcaller('with_fate', RUNNING))
    @rule(data=st.data())
    def lend(self, data):
        run = data.draw(st.sampled_from(self.with_fate(RUNNING)))
        self.scheduler.lend(run.x)
        run.lent = True

    @precondition(methodcaller('with_fate', RUNNING))
    @rule(data=st.data())
    def suspend(self, data):
        run = data.draw(st.sampled_from(self.with_fate(RUNNING)))
        self.scheduler.suspend(run.x)
        run.fate, run.lent = SUSPENDED, False

    @precondition(methodcaller('owners'))
    @rule(data=st.data(), may=st.booleans())
    def ask(self, data, may):
        run = data.draw(st.sampled_from(self.owners()))
        if may:
            self.scheduler.leave_group(run.x)
            run.group = -1
        else:
            self.scheduler.refuse(run.x)
            run.fate, run.began, run.lent = REFUSED, False, False

    def owners(self):
        return [run for run in self.with_fate(RUNNING) if run.group >= 0]

    @rule(data=st.data())
    def resume(self, data):
        away = self.with_fate(SUSPENDED) + self.with_fate(REFUSED)
        if not away:
            return
        run = data.draw(st.sampled_from(away))
        self.scheduler.resume(run.x)
        run.fate = WAITING

    @rule()
    def expire_idle(self):
        self.scheduler.expire_idle(self.now)
        self.settle()
        assert self.over() == []

    @precondition(OPEN_JOBS)
    @rule(data=st.data(), abort=st.booleans())
    def end_job(self, data, abort):
        job = data.draw(st.sampled_from(self.open_jobs()))
        end = ABORTED if abort else EXPIRED
        self.scheduler.give_up(job.slot, end, self.now)
        self.settle()
        assert job.end == end

    # --- decisions -------------------------------------------------------------------------------

    def settle(self):
        """Carry out what was decided, as the live executor does, before anything else happens."""
        for decision in self.scheduler.decisions():
            kind = decision[0]
            if kind == DROP:
                self.dropped(decision)
            elif kind == JOB_END:
                self.ended(decision)
            elif kind != SINK_DEMOTED:
                _, dag, vertex, job, _, _ = decision
                self.sinks[dag, vertex, job] += 1
                assert self.sinks[dag, vertex, job] == 1, 'two verdicts'
                self.completed_sinks[dag, job] += kind in SINK_COMPLETED
                assert kind in (*SINK_COMPLETED, SINK_ABORTED, SINK_EXPIRED, SINK_DROPPED)

    def dropped(self, decision):
        _, dag, vertex, job, x, now = decision
        run = self.by_x.pop(x)
        assert (run.vertex, now) == (vertex, self.now)
        assert run.job == (dag, job) or dag == self.tables.n_dags
        assert run.fate in (WAITING, REFUSED) and not run.began
        run.fate = DROPPED

    def ended(self, decision):
        _, dag, _, index, end, now = decision
        job = next(job for job in self.jobs if (job.dag, job.index) == (dag, index))
        assert job.end is None, 'ended twice'
        assert now == self.now
        job.end = end
        sinks = self.task_set.dags[dag].sinks
        if end in (COMPLETED, LATE):
            assert self.completed_sinks[dag, index] == len(sinks)
        else:
            assert self.completed_sinks[dag, index] < len(sinks)
        first = self.tables.first_vertex[dag]
        assert all(self.sinks[dag, first + sink, index] == 1 for sink in sinks)

    # --- what must hold --------------------------------------------------------------------------

    def alive(self):
        return list(self.by_x.values())

    def with_fate(self, fate):
        return [run for run in self.alive() if run.fate == fate]

    def over(self):
        """Return the open jobs that can no longer complete."""
        active = {self.state.x_slot[run.x] for run in self.alive()}
        return [
            job for job in self.open_jobs() if job.slot not in active
            and self.now > job.release + self.tables.dag_deadline[job.dag] + EXPIRE_AFTER]

    def open_jobs(self):
        return [job for job in self.jobs if job.end is None]

    def blocked(self, run):
        return run.group >= 0 and any(
            other is not run and other.owns and other.group == run.group
            for other in self.alive())

    def polled(self, runs):
        """Return those that a poll would find: not what waits behind another one of its entity."""
        if not self.scheduler.policy.polling:
            return runs
        waiting = [run for run in self.runs if run.fate == WAITING]
        return [
            run for run in runs if run.vertex == self.tables.n_vertices or not any(
                self.subscription(other) == self.subscription(run)
                for other in waiting[:waiting.index(run)])]

    def subscription(self, run):
        """Return the entity of the message that started a run."""
        tables = self.tables
        return tables.entity[run.vertex] + tables.leg_topic[tables.first_leg[run.vertex] + run.leg]

    def region(self, dag, slot):
        base = self.state.job_base[slot]
        return range(base, base + self.tables.n_region[dag])

    @invariant()
    def counts_agree(self):
        waiting = self.with_fate(WAITING) + self.with_fate(REFUSED)
        assert self.scheduler.queue_length == len(waiting)
        placed = [run for run in self.with_fate(RUNNING) if not run.lent]
        assert self.state.worker_x.count(-1) == self.workers - len(placed)
        assert sorted(x for x in self.state.worker_x if x >= 0) == sorted(r.x for r in placed)

    @invariant()
    def groups_are_exclusive(self):
        for group in self.groups[1:]:
            holders = [run.x for run in self.alive() if run.owns and run.group == group]
            assert len(holders) <= 1
            assert self.state.group_owner[group] == (holders[0] if holders else -1)

    @invariant()
    def slots_are_accounted_for(self):
        state = self.state
        active = Counter(state.x_slot[run.x] for run in self.alive())
        open_slots = {job.slot for job in self.open_jobs()}
        assert len(open_slots) == len(self.open_jobs())
        for slot in range(len(state.job_dag)):
            if state.job_dag[slot] == self.tables.n_dags:
                continue
            assert state.job_active[slot] == active[slot]
            assert (state.job_state[slot] == OPEN) == (slot in open_slots)
            if slot not in open_slots and not active[slot]:
                assert state.job_state[slot] == FREE, 'a slot has leaked'
        free = 0
        for slot in state.free_slot:
            while slot >= 0:
                assert state.job_state[slot] == FREE
                free += 1
                slot = state.job_next[slot]
        assert free == sum(job_state == FREE for job_state in state.job_state)

    @invariant()
    def open_jobs_are_bounded(self):
        for dag in self.task_set.dags:
            mine = [job for job in self.open_jobs() if job.dag == dag.index]
            assert len(mine) == self.state.n_open[dag.index]
            assert len(mine) <= (dag.max_active_jobs or MAX_ACTIVE)

    def teardown(self):
        """Let all that is left happen; then nothing may be left."""
        if not hasattr(self, 'scheduler'):
            return
        for _ in range(10 * len(self.runs) + 10):
            for run in self.with_fate(SUSPENDED) + self.with_fate(REFUSED):
                self.scheduler.resume(run.x)
                run.fate = WAITING
            for run in self.with_fate(RUNNING):
                self.complete_one(run)
            self.dispatch(0)
            if not self.alive():
                break
        assert self.alive() == []
        assert {run.fate for run in self.runs} <= {DONE, DROPPED}
        for job in self.open_jobs():
            self.scheduler.give_up(job.slot, EXPIRED, self.now)
        self.settle()
        assert self.open_jobs() == []
        assert all(state == FREE or dag == self.tables.n_dags
                   for dag, state in zip(self.state.job_dag, self.state.job_state))
        self.counts_agree()
        self.groups_are_exclusive()
        self.slots_are_accounted_for()


TestLiveDriver = LiveDriver.TestCase
TestLiveDriver.settings = examples(150)
