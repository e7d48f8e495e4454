# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""CPUs and the interpreter in virtual time: by hand, and against a model that goes by ticks."""

from dataclasses import dataclass, field

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.core import queues, Tables
from mddag_executor.simulate import (
    END,
    engine,
    machine,
    schedule,
    Settings,
    START,
    Workload,
)
import pytest

from ..conftest import examples
from ..core.task_sets import declaration, single

MS = 1_000_000
LOCK, CPU, NOTHING = 'lock', 'cpu', 'nothing'


@dataclass(eq=False)
class Job:
    """One job of a DAG of its own; ``cpu`` is its CPU time, -1: not known."""

    release: int
    deadline: int
    cost: int
    holds: bool = False
    cpu: int | None = None
    interpreter: int = 1
    left: int = 0
    start: int = -1
    end: int = -1


def times(jobs, workers, cpus=None, python=False, preemptive=False, second=0):
    """Return when each job starts first, and when it ends."""
    task_set = declaration([
        single(f'd{n}', 10 ** 9, job.deadline) for n, job in enumerate(jobs)])
    tables = Tables.build(task_set)._replace(
        rad_offset=[job.deadline for job in jobs] + [0],
        process=[*(job.interpreter for job in jobs), 1])
    order = sorted(range(len(jobs)), key=lambda n: (jobs[n].release, n))
    n = len(jobs)
    load = Workload([jobs[i].release for i in order], order, [0] * n, [job.cost for job in jobs],
                list(range(n)), [0] * n, holds=[job.interpreter * job.holds for job in jobs],
                computed=[job.cost if job.cpu is None else job.cpu for job in jobs])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine, 'needs_python', lambda load: python)
        log = schedule(
            tables, load, Settings(
                'rad', (workers, second) if second else (workers,), 10 ** 12, preemptive,
                cpus=cpus), log=True, compiled=False).log
    found = [(-1, -1)] * n
    for now, kind, _, dag, _, _ in log:
        if kind == START and found[dag][0] < 0:
            found[dag] = now, -1
        elif kind == END:
            found[dag] = found[dag][0], now
    return found


def in_ms(found):
    return [(start / MS, end / MS) for start, end in found]


def test_one_that_is_more_urgent_overtakes_and_they_take_turns():
    """It starts at 2, has the lock from 3 to 4, 5 to 6 and 7 to 8; the other one meanwhile."""
    jobs = [Job(0, 100 * MS, 10 * MS, True), Job(2 * MS, 16 * MS, 3 * MS, True)]
    assert in_ms(times(jobs, 2)) == [(0, 13), (2, 8)]
    # with one worker it waits; where it takes the worker, the other one does
    assert in_ms(times(jobs, 1)) == [(0, 10), (10, 13)]
    assert in_ms(times(jobs, 1, preemptive=True)) == [(0, 13), (2, 5)]
    # where it has time enough for that, it waits for the 8 ms
    jobs[1].deadline = 17 * MS
    assert in_ms(times(jobs, 2)) == [(0, 10), (10, 13)]


# --- a model that goes by ticks ------------------------------------------------------------------

SWITCH, SLICE, TAIL, TURN = 3, 5, 2, 2


@dataclass(eq=False)
class Lock:
    """An interpreter's; ``left`` is for how many ticks who has it keeps it."""

    queue: list[Job] = field(default_factory=list)
    left: int = 0

    def pass_on(self, wanted, now):
        goes_on = [job for job in wanted if job.start == now]
        if self.queue and self.queue[0].end == now and goes_on:
            self.queue[0] = goes_on[0]
        had, several = self.queue[:1], len(self.queue) > 1
        self.queue = [job for job in self.queue if job in wanted]
        self.queue += [job for job in wanted if job not in self.queue]
        if not several or self.queue[:1] != had:
            self.left = SWITCH
        elif self.left == 0:
            self.queue = self.queue[1:] + self.queue[:1]
            self.left = SWITCH
        self.left -= 1


@dataclass(eq=False)
class Ticks:
    """The machine, tick by tick; written from its theory of operation."""

    jobs: list[Job]
    workers: int
    cpus: int
    python: bool
    second: int     # workers of the second process, 0: there is one
    on: list[Job | None] = field(default_factory=list)
    waiting: list[Job] = field(default_factory=list)
    locks: dict[int, Lock] = field(default_factory=dict)
    computing: list[Job] = field(default_factory=list)
    slice_left: int | None = None

    def times(self):
        self.on = [None] * (self.workers + self.second)
        now = 0
        while any(job.end < 0 for job in self.jobs):
            self._instant(now)
            now += 1
        return [(job.start, job.end) for job in self.jobs]

    def _instant(self, now):
        for worker, job in enumerate(self.on):
            if job is not None and job.left == 0:
                job.end, self.on[worker] = now, None
        self.waiting += [job for job in self.jobs if job.release == now]
        while self._start_one(now):
            pass
        wanted = {LOCK: [], CPU: [], NOTHING: []}
        for job in filter(None, self.on):
            wanted[self._needs(job)].append(job)
        having = []
        for number in (1, 2):
            lock = self.locks.setdefault(number, Lock())
            lock.pass_on([job for job in wanted[LOCK] if job.interpreter == number], now)
            having += lock.queue[:1]
        self._pass_cpus(wanted[CPU] + having)
        for job in wanted[NOTHING] + self.computing[:self.cpus]:
            job.left -= 1
        self.slice_left = None if self.slice_left is None else self.slice_left - 1

    def _start_one(self, now):
        waiting = sorted(self.waiting, key=lambda j: j.release + j.deadline)
        for job in waiting:
            idle = [w for w, other in enumerate(self.on) if other is None and (
                not self.second or 1 + (w >= self.workers) == job.interpreter)]
            if not idle:
                continue
            first = next(each for each in waiting if each.interpreter == job.interpreter)
            pays = self._overtaking_pays(first, now)
            holders = self._holders(job) if job.holds else []
            if all(pays and other.release + other.deadline > job.release + job.deadline
                   for other in holders):
                self.waiting.remove(job)
                self.on[idle[0]] = job
                job.start, job.left = now, job.cost
                return True
        return False

    def _holders(self, job):
        return [other for other in self.on if other is not None and other.holds
                and other.interpreter == job.interpreter]

    def _overtaking_pays(self, first, now):
        """Tell whether twice the wait for who began last is longer than the deadline."""
        holders = self._holders(first) if first.holds else []
        if not holders:
            return True
        last = max(holders, key=lambda job: (job.start, self.on.index(job)))
        held = now - last.start
        left = abs(last.cost - held)
        return left >= TURN and 2 * left >= first.deadline

    def _needs(self, job):
        cpu = job.cost if job.cpu is None else job.cpu
        waits = job.cost - cpu
        if job.holds:
            if waits * 8 <= cpu:
                return LOCK
            parts = [LOCK] * (cpu // 2) + [NOTHING] * waits + [LOCK] * (cpu - cpu // 2)
        elif not self.python:
            parts = [CPU] * cpu + [NOTHING] * waits
        elif cpu >= waits:
            brief = min(cpu, TAIL)
            parts = [CPU] * (cpu - brief) + [NOTHING] * waits + [LOCK] * brief
        else:
            parts = [LOCK] * (cpu // 4) + [NOTHING] * waits + [LOCK] * (cpu - cpu // 4)
        return parts[job.cost - job.left]

    def _pass_cpus(self, wanted):
        had = self.computing[:self.cpus]
        old = [job for job in self.computing if job in wanted]
        self.computing = [job for job in wanted if job not in old] + old
        if len(self.computing) <= self.cpus:
            self.slice_left = None
        elif self.slice_left is None:
            self.slice_left = SLICE
        elif self.slice_left == 0:
            self.computing.sort(key=lambda job: job in had)
            self.slice_left = SLICE


@st.composite
def some_jobs(draw):
    jobs = []
    n = draw(st.integers(1, 6))
    urgencies = draw(st.permutations(range(40, 40 + n)))
    for urgency in urgencies:
        release, cost = draw(st.integers(0, 20)), draw(st.integers(1, 25))
        jobs.append(Job(release, urgency - release, cost, draw(st.booleans()),
                        draw(st.one_of(st.none(), st.integers(0, cost))),
                        draw(st.integers(1, 2))))
    return jobs


@examples(200)
@given(some_jobs(), st.integers(1, 4), st.integers(1, 4), st.booleans(), st.integers(0, 3))
def test_as_the_model_that_goes_by_ticks(jobs, workers, cpus, python, second):
    for job in jobs:  # processes with a pool of their own have an interpreter of their own
        job.interpreter = job.interpreter if second else 1
    with pytest.MonkeyPatch.context() as patch:
        for name, ticks in (('SWITCH_NS', SWITCH), ('SLICE_NS', SLICE), ('TAIL_NS', TAIL)):
            patch.setattr(machine, name, ticks)
        patch.setattr(queues, 'TURN_NS', TURN)
        found = times(jobs, workers, cpus, python, second=second)
    assert found == Ticks(jobs, workers, cpus, python, second).times()
