# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Traces for the replay tests: declarations, a live-like run in virtual time, simulated runs.

`VirtualRun` drives the real scheduler core as the live executor does (intake, workers, messages
that arrive late or never, coroutines, drops, undeclared callbacks), and records what the executor
records, in the order in which it does: what a thread ran only when it has run.
"""

from collections import Counter, defaultdict
from dataclasses import dataclass, field
from functools import partial
from heapq import heappop, heappush
from itertools import count
from pathlib import Path
import random
from typing import NamedTuple

from hypothesis import strategies as st
from mddag_executor.core import legs_of, Scheduler, Tables, Tally
from mddag_executor.core.driven import Awaiting
from mddag_executor.core.state import (
    DROP,
    EXPIRED,
    FAILED,
    IDLE,
    JOB_END,
    OPEN,
    SINK_COMPLETED,
    SINK_IN_TIME,
    SINK_NOT_DUE,
)
from mddag_executor.trace import TraceFile
from msg_graph import loads, TaskSet
from msg_graph.model import optional_edges

START_TIME = 1_732_166_766_000_000_000
MS = 1_000_000
US = 1_000
VPID = 77

SMALL = """\
mddag: 1
workers: 2
nodes:
  - node: /camera
    callbacks:
      - {name: grab, timer: 20ms, publishes: [/image, /info], execution_time: 1ms}
  - node: /left
    callbacks:
      - {name: detect, subscription: /image, publishes: [/boxes], execution_time: 2ms}
  - node: /right
    callbacks:
      - {name: rectify, subscription: /info, publishes: [/flat], execution_time: 3ms}
      - {name: watch, subscription: /info, deadline: 12ms, execution_time: 1ms}
  - node: /fuse
    callbacks:
      - {name: join, sync: [/boxes, /flat], deadline: 18ms, execution_time: 2ms}
  - node: /imu
    callbacks:
      - {name: tick, timer: 10ms, publishes: [/twist], execution_time: 1ms}
      - {name: use, subscription: /twist, deadline: 8ms, execution_time: 1ms}
"""
PATHS = """\
paths:
  - {name: a, callbacks: ['/camera:grab', '/left:detect', '/fuse:join']}
  - {name: b, callbacks: ['/camera:grab', '/right:rectify', '/fuse:join']}
  - {name: c, callbacks: ['/imu:tick', '/imu:use']}
"""


def small():
    return loads(SMALL, 'small.yaml')


@st.composite
def declarations(draw):
    """Return the text of a declaration: random DAGs, some of which share a callback."""
    shared, lines = draw(st.booleans()), ['mddag: 1', 'nodes:']

    def add(name, about):
        lines.append(
            f'  - {{node: {name}, callbacks: [{{name: cb, {about}, execution_time: 1ms}}]}}')

    for d in range(draw(st.integers(1, 3))):
        n = draw(st.integers(1, 6))
        # a sync of all, after one of different rates, would depend on which leg is not published
        driven = draw(st.booleans())
        most = 1 if driven else 3
        before = [[], *(sorted(draw(st.sets(st.integers(0, i - 1), min_size=1, max_size=most)))
                        for i in range(1, n))]
        publishing = {p for row in before for p in row}
        publisher = draw(st.integers(0, n - 1)) if shared else -1
        for i in range(n):
            topics = [f'/d{d}t{i}'] * (i in publishing) + ['/shared'] * (i == publisher)
            heard = ', '.join(f'/d{d}t{p}' for p in before[i])
            start = f'sync: [{heard}]' if len(before[i]) > 1 else f'subscription: {heard}'
            if i and driven and draw(st.booleans()):
                start = f'sync: {{topics: [/outside, {heard}], driven_by: {heard}}}'
            if i == 0:
                start = f'timer: 10ms, dag: dag{d}' + (
                    ', max_active_jobs: 2' if draw(st.booleans()) else '')
            end = f'deadline: {draw(st.sampled_from([*range(3, 31), None]))}ms'.replace(
                'Nonems', 'none')
            if topics:
                key = draw(st.sampled_from(['publishes', 'publishes', 'may_publish']))
                end = f'{key}: [{", ".join(topics)}]'
            add(f'/d{d}n{i}', f'{start}, {end}')
    if shared:
        add('/common', 'subscription: /shared, deadline: 9ms')
    return '\n'.join(lines) + '\n'


def legs_to(task_set, tables):
    """Return for each global vertex the vertices and legs that its messages start."""
    found = {}
    for dag in task_set.dags:
        first = tables.first_vertex[dag.index]
        for vertex in dag.vertices:
            found[first + vertex.index] = targets = []
            for after in vertex.successors:
                for leg, (_, before) in enumerate(legs_of(dag.vertices[after], dag.vertices)):
                    if before == vertex.index:
                        targets.append((first + after, leg))
    return found


def withhold(task_set, scheduler, slot, vertex, published, now):
    """Leave out of a job what a vertex that completes with this leg has not started."""
    state, dag = scheduler.state, task_set.vertices[vertex].dag
    if state.x_pending[scheduler.execution(slot, vertex)] in (0, 1):
        first = scheduler.tables.first_vertex[dag]
        for after, topic in optional_edges(
                task_set.vertices[vertex], task_set.dags[dag].vertices):
            if topic not in published:
                scheduler.withhold(slot, vertex, first + after, now)


def ns(ms):
    """Return a time, ns, of ms since `START_TIME`."""
    return START_TIME + round(ms * MS)


class Written:
    """A trace of this executor written by hand; times are ms since `START_TIME`."""

    def __init__(
        self, path, declaration, workers=1, policy='rad', cpus=0, name='g.yaml', on_late=0
    ):
        self.path, self.file = path, TraceFile(path, overwrite=True)
        self.add('task_set', 0, declaration, name, policy, workers, 100 * MS, 64, False, cpus,
                 on_late)

    def add(self, event, at, *fields, thread=1):
        self.file.add(event, ns(at), 1, thread, *fields)

    def release(self, dag, job, at, noticed=None):
        self.add('job_release', at if noticed is None else noticed, dag, job, ns(at))

    def piece(
            self, dag, vertex, job, start, end, *, ready=None, worker=0, thread=None, computed=()):
        """
        Run a piece of an execution; without `ready` it has not waited.

        `computed`: if it has no job, its CPU time and whether it held the interpreter.
        """
        thread, address = 10 + worker if thread is None else thread, 1000 + 100 * dag + vertex
        self.add('dispatch', start, address, dag, vertex, job, worker,
                 ns(start if ready is None else ready), 0, *([0, *computed] if computed else ()),
                 thread=thread)
        self.add('callback_start', start, address, False, thread=thread)
        self.add('callback_end', end, address, thread=thread)
        return thread, address

    def run(self, dag, vertex, job, start, end, *, leg=0, whole=True, computed=(), **more):
        """Run an execution; `computed`: its CPU time and whether it held the interpreter."""
        thread, address = self.piece(dag, vertex, job, start, end, **more)
        self.add('complete', end, address, dag, vertex, job, whole, ns(end), leg, *computed,
                 thread=thread)

    def group(self, kind, *addresses):
        """Put callbacks (of timers: vertex v of DAG d is 1000 + 100 * d + v) into a group."""
        self.add('add_callback_group', 0, 1, 900, kind)
        self._timers(addresses)
        for address in addresses:
            self.add('callback_group_add_timer', 0, 900, address)

    def program(self, number, *addresses):
        """Let callbacks belong to a program that runs one at a time."""
        self._timers(addresses)
        for address in addresses:
            self.add('program', 0, address, number)

    def _timers(self, addresses):
        for address in addresses:
            self.add('rcl_timer_init', 0, address, 100 * MS)
            self.add('rclcpp_timer_callback_added', 0, address, address)

    def end(self, at):
        self.add('shutdown', at, ns(at))
        self.file.finish()
        return self.path


@dataclass
class Chances:
    """How often things go wrong in a virtual run, 0 to 1."""

    lost: float = 0.05
    dropped: float = 0.03
    skipped: float = 0.03
    coroutine: float = 0.1
    undeclared: float = 0.2
    early_message: float = 0.3
    failed: float = 0.05
    silent: float = 0.3


class _Job(NamedTuple):
    slot: int
    dag: int
    job: int
    vertex: int


@dataclass
class _Execution:
    x: int
    vertex: int
    leg: int
    slot: int
    dag: int
    job: int
    ready: int
    pieces: int = 1
    silent: frozenset[str] | None = None
    sync: str | None = None     # of a driven sync: its callback
    answers: _Job | None = None


@dataclass
class VirtualRun:
    """A run in virtual time, recorded to a file; `tally` has what the driver counted."""

    path: Path
    task_set: TaskSet
    seed: int = 0
    workers: int = 2
    policy: str = 'rad'
    duration: int = 300 * MS
    longest: int = 8 * MS
    chances: Chances = field(default_factory=Chances)
    shut_down: bool = True
    flush_every: int = 40

    def __post_init__(self):
        self.random = random.Random(self.seed)
        self.tables = Tables.build(
            self.task_set, legs=True, max_active_jobs=3, expire_after=20 * MS)
        self.scheduler = Scheduler(self.tables, self.workers, self.policy)
        self.tally = Tally(self.task_set, self.tables)
        self.executions, self.busy, self.waited = Counter(), Counter(), Counter()
        self.undeclared_runs = 0
        self.responses = []
        self._targets = legs_to(self.task_set, self.tables)
        self._queue, self._order = [], count()
        self._waiting, self._running = {}, {}
        self._published = defaultdict(set)
        self._optional = {topic: 9000 + place for place, topic in enumerate(sorted(
            {topic for each in self.task_set.callbacks for topic in each.may_publish}))}
        self._awaiting = {each.key: Awaiting(each) for each in self.task_set.callbacks
                          if each.driven_by is not None}
        self._jobs = [0] * self.tables.n_dags
        self._events = self.drops = 0
        self.file = TraceFile(self.path, overwrite=True)
        self._run()

    def _run(self):
        self.record('task_set', START_TIME, 1, self.task_set.text, self.task_set.file, self.policy,
                    self.workers, 100 * MS, 3, False)
        for topic, handle in self._optional.items():
            self.record('rcl_publisher_init', START_TIME, 1, handle, 0, handle, topic, 10)
        end = START_TIME + self.duration
        for dag in self.task_set.dags:
            for k in range(self.duration // dag.period_ns):
                release = START_TIME + (k + 1) * dag.period_ns
                self._at(release + self.random.randrange(MS), self._release(dag.index, release))
        for key in self._awaiting:
            for _ in range(self.random.choice([0, 3, 30])):
                self._at(START_TIME + self.random.randrange(self.duration),
                         partial(self._undeclared, sync=key))
        if self.random.random() < self.chances.undeclared:
            for _ in range(20):
                self._at(START_TIME + self.random.randrange(self.duration), self._undeclared)
        while self._queue and self._queue[0][0] <= end:
            now, _, action = heappop(self._queue)
            action(now)
            self._dispatch(now)
        for work, worker, start in self._running.values():  # as the executor does: they go on
            if work.vertex >= 0 and work.sync is not None:
                self._record_dispatch(work, worker, start)
        if self.shut_down:
            self.scheduler.expire_idle(end)
            self.decided(end)
            self.scheduler.finish(end)
            self.decided(end)
            self.record('shutdown', end, 1, end)
        self.file.finish()

    def _at(self, time, action):
        heappush(self._queue, (time, next(self._order), action))

    def record(self, event, timestamp, vtid, *fields):
        """Record an event; now and then a chunk is written."""
        self.file.add(event, timestamp, VPID, vtid, *fields)
        self._events += 1
        if self._events % self.flush_every == 0:
            self.file.flush()

    def _release(self, dag, release):
        def action(now):
            job = self._jobs[dag]
            self._jobs[dag] += 1
            slot = self.scheduler.release(dag, job, release, now)
            self.decided(now)
            self.tally.released(dag)
            self.record('job_release', now, 2, dag, job, release)
            if self.random.random() < self.chances.skipped:
                self.scheduler.give_up(slot, EXPIRED, now)
                self.decided(now)
                return
            self._ready(slot, dag, job, self.tables.source[dag], 0, now)
        return action

    def _ready(self, slot, dag, job, vertex, leg, now):
        x = self.scheduler.execution(slot, vertex, leg)
        self.scheduler.ready(x, now)
        self._waiting[x] = _Execution(x, vertex, leg, slot, dag, job, now)
        if self.random.random() < self.chances.dropped:
            self._waiting.pop(x)
            self.scheduler.drop(x, now)
            self._record_drop(vertex, dag, job, 'qos_depth', now)
            self.decided(now)

    def _record_drop(self, vertex, dag, job, reason, now):
        self.record('drop', now, 2, self._address(vertex), dag,
                    self.tables.index_in_dag[vertex], job, reason)
        self.drops += 1

    def _undeclared(self, now, sync=None):
        self.undeclared_runs += 1
        x = self.scheduler.ready_undeclared(self.undeclared_runs, -1, 0, -1, now)
        self._waiting[x] = _Execution(x, -1, 0, -1, -1, -1, now, sync=sync)

    def _is_open(self, job):
        state = self.scheduler.state
        return (state.job_dag[job.slot] == job.dag and state.job_index[job.slot] == job.job
                and state.job_state[job.slot] == OPEN)

    def _message(self, slot, dag, job, vertex, leg):
        def action(now):
            state = self.scheduler.state
            if (state.job_dag[slot] != dag or state.job_index[slot] != job
                    or state.job_state[slot] != OPEN):
                self._undeclared(now)
            elif state.x_state[self.scheduler.execution(slot, vertex, leg)] != IDLE:
                self._undeclared(now)
            else:
                self._ready(slot, dag, job, vertex, leg, now)
        return action

    def _dispatch(self, now):
        workers = self.scheduler.state.worker_x
        while -1 in workers:
            worker = workers.index(-1)
            x = self.scheduler.take(worker, now)
            self.decided(now)
            if x < 0:
                return
            self._start(self._waiting.pop(x), worker, now)

    def _start(self, work, worker, now):
        start = now + self.random.randrange(50_000)
        end = start + self.random.randrange(1, self.longest)
        self._at(end + self.random.choice((0, 0, 1, 30_000)),
                 lambda locked: self._end(work, worker, start, end, locked))
        self._running[work.x] = work, worker, start
        by = work
        if work.vertex >= 0 and work.silent is None:
            callback = self.task_set.vertices[work.vertex].callback
            work.sync = callback.key if callback.driven_by else None
            work.silent = frozenset(
                topic for topic in (callback.publishes if work.sync else callback.may_publish)
                if self.random.random() < self.chances.silent)
        if work.sync is not None and work.pieces == 1:
            awaiting, callback = self._awaiting[work.sync], self.task_set.callback(work.sync)
            awaiting.hear(callback.driven_by if work.vertex >= 0 else '/outside')
            if work.vertex >= 0:
                work.answers = _Job(work.slot, work.dag, work.job, work.vertex)
                awaiting.receive(work.answers)
            else:
                work.answers = awaiting.newest(self._is_open)
                work.silent = frozenset(t for t in callback.publishes
                                        if self.random.random() < self.chances.silent)
        if work.sync is not None:
            by = work.answers
        if by is not None and by.vertex >= 0:
            for vertex, leg in self._targets[by.vertex]:
                if self._topic(vertex, leg) in work.silent:
                    continue
                if self.random.random() >= self.chances.lost:
                    early = self.random.random() < self.chances.early_message
                    arrival = self.random.randrange(start, end + 1) if early \
                        else end + 100_000 + self.random.randrange(2 * MS)
                    self._at(arrival, self._message(by.slot, by.dag, by.job, vertex, leg))

    def _answered(self, work, fails):
        """Return the jobs that an execution of a driven sync completes, as the engine does."""
        awaiting = self._awaiting[work.sync]
        published = {*self.task_set.callback(work.sync).publishes} - work.silent
        if fails or work.answers is None or not (
                self._is_open(work.answers) and awaiting.is_answer(published)):
            return []
        return [each for each in awaiting.answer(work.answers) if self._is_open(each)]

    def _end(self, work, worker, start, end, now):
        vtid = 100 + worker
        fails, completes = False, []
        if work.sync is not None:
            fails = work.vertex >= 0 and self.random.random() < self.chances.failed
            completes = self._answered(work, fails)
        x = work.x
        del self._running[x]
        if completes and work.vertex < 0:
            work.slot, work.dag, work.job, work.vertex = completes[0]
        declared = work.vertex >= 0
        address = self._address(work.vertex)
        vertex = self.tables.index_in_dag[work.vertex] if declared else -1
        self._record_dispatch(work, worker, start)
        self.record('callback_start', start, vtid, address, False)
        if declared:
            published = self._published[work.dag, work.job, work.vertex]
            if work.sync is not None:
                published = set()
            for topic in self.task_set.vertices[work.vertex].callback.may_publish:
                if topic not in work.silent:
                    published.add(topic)
                    self.record('rclcpp_publish', start, vtid, self._optional[topic], 0, 0)
        self.record('callback_end', end, vtid, address)
        if declared:
            key = self.task_set.vertices[work.vertex].callback.key
            self.busy[key] += end - start
            if work.pieces == 1:
                self.waited[key] += start - work.ready
        if declared and work.sync is None and self.random.random() < self.chances.coroutine:
            self.scheduler.suspend(work.x)
            self._at(now + self.random.randrange(MS), lambda later: self._resume(work, later))
            return
        if work.sync is None:
            fails = declared and self.random.random() < self.chances.failed
        if fails:
            self.scheduler.give_up(work.slot, FAILED, end)
            self.record('fail', now, vtid, work.dag, vertex, work.job)
        elif work.sync is not None:
            for each in completes:
                withhold(self.task_set, self.scheduler, each.slot, each.vertex, published, end)
        elif declared:
            withhold(self.task_set, self.scheduler, work.slot, work.vertex, published, end)
        whole = self.scheduler.complete(x, end)
        if work.sync is not None:
            whole = bool(completes)
            for each in completes:
                self.scheduler.answer(each.slot, each.vertex, completes[0].slot, end)
        if declared:
            self.executions[key] += 1
            self.record('complete', now, vtid, address, work.dag, vertex, work.job, whole, end,
                        work.leg)
        self.decided(now)

    def _record_dispatch(self, work, worker, start):
        vertex = self.tables.index_in_dag[work.vertex] if work.vertex >= 0 else -1
        self.record('dispatch', start, 100 + worker, self._address(work.vertex), work.dag, vertex,
                    work.job, worker, work.ready, 0)

    def _topic(self, vertex, leg):
        vertex = self.task_set.vertices[vertex]
        place, _ = legs_of(vertex, self.task_set.dags[vertex.dag].vertices)[leg]
        return vertex.callback.topics[place]

    def _resume(self, work, now):
        work.pieces += 1
        self.scheduler.resume(work.x, 0, 0, now)
        self._waiting[work.x] = work

    def _address(self, vertex):
        return 5000 if vertex < 0 else 1000 + self.task_set.callbacks.index(
            self.task_set.vertices[vertex].callback)

    def decided(self, now):
        """Count and record what the core has decided, as the live executor does."""
        decisions = self.scheduler.decisions()
        self.tally.add(decisions)
        for kind, dag, vertex, job, deadline, time in decisions:
            if kind == JOB_END:
                if deadline == EXPIRED:
                    self.record('expire', now, 2, dag, job)
            elif kind not in (DROP, SINK_NOT_DUE):
                if kind in SINK_COMPLETED:
                    self.responses.append(time - deadline + self.tables.sink_deadline[vertex])
                if kind != SINK_IN_TIME:
                    self.record('deadline', now, 2, dag, self.tables.index_in_dag[vertex], job,
                                deadline, time)
