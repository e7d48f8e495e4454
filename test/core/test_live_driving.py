# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Random driving of the scheduler as the live executor does it, in parallel with a model.

The model remembers every execution that was made ready, under an identity of its own, and its
fate; it knows nothing of slots, heaps and keys but what the scheduler's interface shows.
"""

from collections import Counter
from dataclasses import dataclass, field
from operator import attrgetter, methodcaller

from hypothesis import strategies as st
from hypothesis.stateful import initialize, invariant, precondition, rule, RuleBasedStateMachine
from mddag_executor.core import legs_of, NEVER, POLICIES, Scheduler, Tables
from mddag_executor.core.deadlines import Deadlines
from mddag_executor.core.state import (
    COMPLETED,
    DROP,
    EXPIRED,
    FAILED,
    IDLE,
    JOB_END,
    LATE,
    OPEN,
    SINK_COMPLETED,
    SINK_DEMOTED,
    SINK_DROPPED,
    SINK_EXPIRED,
    SINK_FAILED,
    SINK_NOT_DUE,
    SINK_OVERDUE,
)

from ..conftest import examples
from ..invariants import broken_deadlines, broken_in_core
from .task_sets import declaration, live, task_sets, TICK

WAITING, RUNNING, SUSPENDED, REFUSED = 'waiting', 'running', 'suspended', 'refused'
DONE, DROPPED = 'done', 'dropped'
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
    holds: bool
    queue: tuple[int, int] | None = None  # of a callback, in which runs start in their order
    began: bool = False
    owns: bool = False
    lent: bool = False
    fate: str = WAITING


@dataclass(eq=False)
class Job:
    """One job: its slot, what of it completed, its verdicts."""

    dag: int
    index: int
    slot: int
    release: int
    end: int | None = None
    started: set[tuple[int, int]] = field(default_factory=set)


# No lambdas: older versions of hypothesis read the source of one whenever they call it.
MESSAGES, OPEN_JOBS = attrgetter('messages'), methodcaller('open_jobs')
ANY_GROUP, HOLDS = st.integers(0, 2), st.booleans()


class LiveDriver(RuleBasedStateMachine):
    """Messages arrive late or never, threads take, complete, lend and suspend in any order."""

    @initialize(task_set=task_sets(max_dags=2, max_callbacks=4, groups=False, optional=True),
                workers=st.integers(1, 3), policy=st.sampled_from(sorted(POLICIES)),
                on_late=st.sampled_from(['continue', 'demote']))
    def start(self, task_set, workers, policy, on_late):
        self.task_set = task_set
        self.tables = Tables.build(
            task_set, legs=True, max_active_jobs=MAX_ACTIVE,
            expire_after=EXPIRE_AFTER, default_deadline=10 * TICK, on_late=on_late)
        self.scheduler = Scheduler(self.tables, workers, policy)
        self.state = self.scheduler.state
        self.deadlines = Deadlines(self.scheduler.tables, self.state)
        self.workers = workers
        self.queues = [-1, self.scheduler.new_queue(), self.scheduler.new_queue()]
        self.groups = [-1, self.scheduler.new_group(), self.scheduler.new_group()]
        self.now = 0
        self.runs = []
        self.by_x = {}
        self.jobs = []
        self.messages = []
        self.counter = Counter[str]()
        self.sinks = {}
        self.overdue = set()
        self.legs_done = Counter()

    # --- what happens ----------------------------------------------------------------------------

    @rule(ticks=st.integers(0, 12), judged=st.booleans())
    def time_passes(self, ticks, judged):
        self.now += ticks * TICK
        if judged:
            self.judge()

    @precondition(OPEN_JOBS)
    @rule(data=st.data())
    def a_deadline_comes(self, data):
        coming = [deadline for deadline in self.due().values() if deadline >= self.now]
        if coming:
            self.now = data.draw(st.sampled_from(coming))
            self.judge()

    @rule(data=st.data(), age=st.integers(0, 3), group=ANY_GROUP, holds=HOLDS)
    def release(self, data, age, group, holds):
        dag = data.draw(st.sampled_from(self.task_set.dags)).index
        index = self.counter[f'dag {dag}']
        self.counter[f'dag {dag}'] += 1
        release = max(0, self.now - age * TICK)
        over = self.over()
        others = [job for job in self.open_jobs() if job.dag == dag and job not in over]
        slot = self.scheduler.release(dag, index, release, self.now)
        self.deadlines.watch(slot)
        self.settle()
        assert all(job.end == EXPIRED for job in over if job.dag == dag)
        made_room = [job for job in others if job.end is not None]
        assert made_room in ([], others[:1]), 'only the oldest makes room'
        assert slot not in [job.slot for job in self.open_jobs()]
        assert all(run.x not in self.region(dag, slot) for run in self.alive()), (
            'the slot of a job of which something is still to run')
        job = Job(dag, index, slot, release)
        self.jobs.append(job)
        self.make_ready(job, self.tables.source[dag], 0, group, holds)

    @precondition(MESSAGES)
    @rule(data=st.data(), group=ANY_GROUP, holds=HOLDS)
    def message_arrives(self, data, group, holds):
        place = data.draw(st.integers(0, len(self.messages) - 1))
        job, vertex, leg = self.messages.pop(place)
        open_still = (self.state.job_state[job.slot] == OPEN
                      and self.state.job_dag[job.slot] == job.dag
                      and self.state.job_index[job.slot] == job.index)
        assert open_still == (job.end is None)
        if open_still and self.state.x_state[self.scheduler.execution(
                job.slot, vertex, leg)] == IDLE:
            self.make_ready(job, vertex, leg, group, holds)
        else:
            self.undeclared(group, holds, 0)

    @rule(group=ANY_GROUP, holds=HOLDS, queue=st.integers(0, 2), inherits=st.integers(-2, 12))
    def requested(self, group, holds, queue, inherits):
        self.undeclared(group, holds, queue)
        self.scheduler.inherit(self.runs[-1].x, self.now + inherits * TICK, 0)

    @rule(group=ANY_GROUP, holds=HOLDS, queue=st.integers(0, 2))
    def undeclared(self, group, holds, queue):
        self.counter['undeclared'] += 1
        job = self.tables.n_dags, self.counter['undeclared']
        group = self.groups[group]
        queue = self.queues[queue]
        x = self.scheduler.ready_undeclared(job[1], group, int(holds), queue, self.now)
        self.note(Run(x, job, self.tables.n_vertices, 0, group, holds,
                      (-1, queue) if queue >= 0 else None))

    def make_ready(self, job, vertex, leg, group, holds):
        x = self.scheduler.execution(job.slot, vertex, leg)
        group = self.groups[group]
        self.state.x_group[x], self.state.x_holds[x] = group, int(holds)
        self.scheduler.ready(x, self.now)
        job.started.add((vertex, leg))
        self.note(Run(x, (job.dag, job.index), vertex, leg, group, holds, (vertex, leg)))
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
        holders = [run for run in self.with_worker() if run.holds]
        x = self.scheduler.take(idle[worker % len(idle)], self.now)
        self.settle()
        able = [run for run in waiting if run.fate == WAITING and self.is_head(run)
                and not self.blocked(run)
                and not (run.holds and any(self.key(holder)[0] <= self.key(run)[0]
                                           for holder in holders))]
        if x < 0:
            assert not able, 'a worker idles while something may run'
            return
        run = self.by_x[x]
        assert run in able
        # the queue that it has left may be late as well: it is checked when it comes first
        others = [other for other in able if other is run or other not in self.queue(run)]
        assert self.key(run) <= min(map(self.key, others)), 'a smaller key waits'
        run.fate, run.began, run.owns = RUNNING, True, True
        worker = self.state.x_worker[x]
        assert worker in idle
        assert self.state.worker_x[worker] == x

    @precondition(methodcaller('with_fate', RUNNING))
    @rule(data=st.data(), fails=st.sampled_from([False, False, False, True]),
          silent=st.booleans())
    def complete(self, data, fails, silent):
        self.complete_one(data.draw(st.sampled_from(self.with_fate(RUNNING))), fails, silent)

    def complete_one(self, run, fails=False, silent=False):
        key = (*run.job, run.vertex)
        self.legs_done[key] += 1
        legs = self.tables.n_legs[run.vertex]
        job = next((job for job in self.jobs if (job.dag, job.index) == run.job), None)
        was_open = job is not None and job.end is None
        if silent and not fails and job is not None and self.legs_done[key] == legs:
            for after, _ in self.optional(job.dag, run.vertex):
                self.scheduler.withhold(job.slot, run.vertex, after, self.now)
        end = self.scheduler.fail if fails else self.scheduler.complete
        whole = end(run.x, self.now)
        assert whole == (self.legs_done[key] == legs)
        run.fate = DONE
        del self.by_x[run.x]
        if whole and job is not None:
            self.publish(job, run.vertex, silent and not fails)
        self.settle()
        assert not (fails and was_open) or job.end == FAILED

    def optional(self, dag, vertex):
        """Return the vertices, with their legs, that a vertex starts only sometimes."""
        first, vertices = self.tables.first_vertex[dag], self.task_set.dags[dag].vertices
        me = vertices[vertex - first]
        return [(first + after, leg) for after in me.successors
                for leg, (topic, before) in enumerate(legs_of(vertices[after], vertices))
                if before == me.index
                and vertices[after].callback.topics[topic] in me.callback.may_publish]

    def publish(self, job, vertex, silent):
        first = self.tables.first_vertex[job.dag]
        dag = self.task_set.dags[job.dag]
        me = dag.vertices[vertex - first]
        for after in me.successors:
            self.messages += [
                (job, first + after, leg) for leg, (_, before)
                in enumerate(legs_of(dag.vertices[after], dag.vertices)) if before == me.index
                and not (silent and (first + after, leg) in self.optional(job.dag, vertex))]

    @rule(data=st.data())
    def drop(self, data):
        fresh = [run for run in self.alive()
                 if run.fate in (WAITING, REFUSED) and not run.began]
        if fresh:
            self.scheduler.drop(data.draw(st.sampled_from(fresh)).x, self.now)
            self.settle()

    @precondition(methodcaller('with_fate', RUNNING))
    @rule(data=st.data(), what=st.sampled_from(['lend', 'suspend', 'stop_holding']))
    def wait(self, data, what):
        run = data.draw(st.sampled_from(self.with_fate(RUNNING)))
        getattr(self.scheduler, what)(run.x)
        run.holds = run.holds and what != 'stop_holding'
        if what == 'suspend':
            run.fate, run.lent = SUSPENDED, False
        run.lent = run.lent or what == 'lend'

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
        away = self.with_fate(SUSPENDED, REFUSED)
        if away:
            self.go_on(data.draw(st.sampled_from(away)))

    def go_on(self, run):
        if run.fate == REFUSED:
            self.scheduler.ask_again(run.x)
        else:
            self.scheduler.resume(run.x, 0, int(run.holds), self.now)
        run.fate, run.lent = WAITING, False

    @rule(data=st.data())
    def rejoin(self, data):
        """One that has lent its worker needs one again, or continues without if none can come."""
        lent = [run for run in self.with_fate(RUNNING) if run.lent]
        waiting = [run for run in self.with_fate(WAITING) if run.began]
        if waiting and data.draw(st.booleans()):
            run = data.draw(st.sampled_from(waiting))
            self.scheduler.go_on_without(run.x)
            run.fate, run.lent = RUNNING, True
        elif lent:
            self.go_on(data.draw(st.sampled_from(lent)))

    @rule()
    def expire_idle(self):
        self.scheduler.expire_idle(self.now)
        self.settle()
        assert self.over() == []

    @precondition(OPEN_JOBS)
    @rule(data=st.data(), end=st.sampled_from([EXPIRED, FAILED]))
    def end_job(self, data, end):
        job = data.draw(st.sampled_from(self.open_jobs()))
        self.scheduler.give_up(job.slot, end, self.now)
        self.settle()
        assert job.end == end

    def judge(self):
        """Each overdue sink is found once, and a deadline to come is never forgotten."""
        due = self.due()
        passed = {sink for sink, deadline in due.items() if deadline < self.now} - self.overdue
        jobs = {(job.dag, job.index): job for job in self.open_jobs()}
        expected = {sink for sink in passed if self.is_certain(jobs[sink[0], sink[2]], sink[1])}
        assert (self.deadlines.first() < self.now) >= bool(expected)
        self.deadlines.judge(self.now)
        found = self.scheduler.decisions()
        assert {decision[0] for decision in found} <= {SINK_OVERDUE}
        assert sorted(decision[1:4] for decision in found) == sorted(expected)
        self.overdue |= passed  # a sink that may still not be due then is judged when it ends
        later = [deadline for deadline in due.values() if deadline >= self.now]
        if self.deadlines.first() < NEVER:  # what comes first is of a slot in use
            assert OPEN in self.state.job_state
        assert self.now <= self.deadlines.first() <= min(later, default=NEVER)
        assert not [*broken_deadlines(self.deadlines)]

    def due(self):
        """Return the deadlines of all sinks without a verdict."""
        vertices = [(job, self.tables.first_vertex[job.dag] + sink) for job in self.open_jobs()
                    for sink in self.task_set.dags[job.dag].sinks]
        return {(job.dag, vertex, job.index): job.release + self.tables.sink_deadline[vertex]
                for job, vertex in vertices if (job.dag, vertex, job.index) not in self.sinks}

    def is_certain(self, job, vertex):
        """Return whether nothing that is published only sometimes can keep a sink from running."""
        first = self.tables.first_vertex[job.dag]
        before = [first + each for each in
                  self.task_set.dags[job.dag].vertices[vertex - first].predecessors]
        return all(self.is_certain(job, each) and all(
            start in job.started for start in self.optional(job.dag, each) if start[0] == vertex)
            for each in before)

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
                sink = decision[1:4]
                assert sink not in self.sinks, 'two verdicts'
                self.sinks[sink] = kind
                assert kind in (
                    *SINK_COMPLETED, SINK_EXPIRED, SINK_FAILED, SINK_DROPPED,
                    SINK_NOT_DUE)

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
        first = self.tables.first_vertex[dag]
        kinds = [self.sinks[dag, first + sink, index] for sink in self.task_set.dags[dag].sinks]
        ended = all(kind in (*SINK_COMPLETED, SINK_NOT_DUE) for kind in kinds)
        assert ended >= (end in (COMPLETED, LATE))
        if len(kinds) == len([v for v in self.task_set.dags[dag].vertices if not v.successors]):
            assert ended == (end in (COMPLETED, LATE))

    # --- what must hold --------------------------------------------------------------------------

    def alive(self):
        return list(self.by_x.values())

    def with_fate(self, *fates):
        return [run for run in self.alive() if run.fate in fates]

    def with_worker(self):
        return [run for run in self.with_fate(RUNNING) if not run.lent]

    def over(self):
        """Return the open jobs that can no longer complete."""
        active = {self.state.x_slot[run.x] for run in self.alive()}
        return [
            job for job in self.open_jobs() if job.slot not in active
            and self.now > job.release + self.tables.dag_deadline[job.dag] + EXPIRE_AFTER]

    def open_jobs(self):
        return [job for job in self.jobs if job.end is None]

    def queue(self, run):
        """Return the others that wait in the queue of a run."""
        if run.began or run.queue is None or run.fate != WAITING:
            return []
        return [other for other in self.alive() if other is not run and other.fate == WAITING
                and not other.began and other.queue == run.queue]

    def is_head(self, run):
        """Return whether a run is the first in its queue, or one that it has just left."""
        return all(self.state.x_key[run.x] <= self.state.x_key[other.x]
                   for other in self.queue(run) if other.x not in self.state.worker_x) or (
                       run.x in self.state.worker_x)

    def key(self, run):
        """Return the four integers by which a run is ordered: those of its queue."""
        state = self.state
        if run.x in state.worker_x or state.x_key[run.x][4] < 0:
            return state.x_key[run.x][:4]
        return state.queue_key[state.x_queue[run.x]][:4]

    def blocked(self, run):
        return run.group >= 0 and any(
            other is not run and other.owns and other.group == run.group
            for other in self.alive())

    def region(self, dag, slot):
        base = self.state.job_base[slot]
        return range(base, base + self.tables.n_region[dag])

    @invariant()
    def counts_agree(self):
        assert self.scheduler.queue_length == len(self.with_fate(WAITING, REFUSED))
        assert self.state.worker_x.count(-1) == self.workers - len(self.with_worker())
        assert sorted(x for x in self.state.worker_x if x >= 0) == sorted(
            run.x for run in self.with_worker())
        for group in self.groups[1:]:
            holders = [run.x for run in self.alive() if run.owns and run.group == group]
            assert [self.state.group_owner[group]] == (holders or [-1])

    @invariant()
    def slots_are_accounted_for(self):
        assert not [*broken_in_core(self.tables, self.state)]
        open_slots = [job.slot for job in self.open_jobs()]
        assert sorted(open_slots) == [
            slot for slot, state in enumerate(self.state.job_state)
            if state == OPEN and self.state.job_dag[slot] < self.tables.n_dags]
        for dag in self.task_set.dags:
            mine = [job for job in self.open_jobs() if job.dag == dag.index]
            assert len(mine) <= (dag.max_active_jobs or MAX_ACTIVE)

    def teardown(self):
        """Let all that is left happen; then nothing may be left."""
        if not hasattr(self, 'scheduler'):
            return
        for _ in range(10 * len(self.runs) + 10):
            for run in self.with_fate(SUSPENDED, REFUSED):
                self.go_on(run)
            for run in self.with_fate(RUNNING):
                self.complete_one(run)
            self.dispatch(0)
            if not self.alive():
                break
        assert self.alive() == []
        for job in self.open_jobs():
            self.scheduler.give_up(job.slot, EXPIRED, self.now)
        self.settle()
        assert self.open_jobs() == []
        self.counts_agree()
        self.slots_are_accounted_for()


TestLiveDriver = LiveDriver.TestCase
TestLiveDriver.settings = examples(120)


def test_a_groups_number_is_used_again_once_nothing_of_it_runs_or_waits():
    scheduler = live(workers=1)
    first, second = scheduler.new_group(), scheduler.new_group()
    running = scheduler.ready_undeclared(0, second, 0, -1, 0)
    scheduler.take(0, 0)
    waiting = scheduler.ready_undeclared(1, second, 0, -1, 1)
    assert scheduler.take(0, 1) == -1
    scheduler.free_group(second)
    assert scheduler.new_group() not in (first, second), 'its owner runs'
    scheduler.complete(running, 2)
    assert scheduler.take(0, 2) == waiting
    scheduler.complete(waiting, 3)
    assert scheduler.new_group() == second
    for _ in range(50):
        scheduler.free_group(first)
        assert scheduler.new_group() == first


def test_dropped_executions_leave_the_queues():
    """Memory is bounded, and the length is right."""
    core = live(declaration([
        {'node': '/n', 'name': 'tick', 'timer': '10us', 'deadline': '10us'}]))
    kept = core.source(core.release(0, 0, 0, 0))
    queue = core.new_queue()
    for i in range(200):
        core.drop(core.ready_undeclared(i, -1, 0, queue if i % 2 else -1, 0), 0)
    core.ready(kept, 1)
    assert core.queue_length == len(core.state.ready) == 1
    assert core.take(0, 2) == kept
    core.complete(kept, 3)
    assert (core.take(0, 4), core.queue_length) == (-1, 0)


def test_the_place_of_a_dropped_execution_is_its_queues():
    """Also among those of a later deadline; the next one starts with the old one's key."""
    core = live(workers=1)
    queue, other = core.new_queue(), core.new_queue()
    first = core.ready_undeclared(0, -1, 0, queue, 0)
    second = core.ready_undeclared(0, -1, 0, other, 1)
    third = core.ready_undeclared(0, -1, 0, queue, 2)
    core.drop(first, 2)
    assert [core.take(0, 2), core.complete(third, 3) and core.take(0, 3)] == [third, second]
