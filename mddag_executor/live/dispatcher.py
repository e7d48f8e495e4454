# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The core under one lock: what became ready goes in, what is to run comes out.

Theory of operation
-------------------
The intake threads say what became ready, the workers (``pool``) what they have completed; both
tell the core under ``lock`` and carry out what it decides.

Times given to the core never decrease: where two threads read the clock in one order and get the
lock in the other, the later gets the earlier one's time.  So the order of a trace's mddag events
is the order in which the core saw them.
"""

from __future__ import annotations

from collections.abc import Callable
import threading
from time import monotonic_ns
from typing import Protocol

from mddag_executor.core import NEVER, Scheduler, Tables
from mddag_executor.core.jobs import is_judged, judge_from
from mddag_executor.core.rules import complete, fail, make_ready
from mddag_executor.core.state import IDLE, OPEN, SUSPENDED
from mddag_executor.live.attribution import Attribution, Origin
from mddag_executor.live.crossings import Crossings
from mddag_executor.live.dropping import Dropping
from mddag_executor.live.entries import Entry, TIMER, Work
from mddag_executor.live.hooks import current
from mddag_executor.live.verdicts import DeadlineMiss, NO_ORIGIN, Record, Verdicts
from mddag_executor.trace.groups import EXECUTION
from msg_graph import TaskSet

MOST_MISSED = 1000
"""After a long stop (a suspended machine) at most so many releases are judged one by one."""


class Seat(Protocol):
    """A worker's place (see ``pool``)."""

    worker: int
    vtid: int


class Dispatcher(Dropping):
    """
    Turns what became ready into executions of the core, and its decisions into actions.

    :param fail: told every exception that a callback lets out.
    :param record: where trace events go; None records nothing.
    :param on_miss: told every miss, from the thread that found it.
    """

    def __init__(
        self,
        task_set: TaskSet | None,
        n_workers: int,
        policy: str,
        *,
        default_deadline: int,
        max_active_jobs: int,
        expire_after: int,
        clock_offset: int,
        fail: Callable[[BaseException], None],
        record: Record | None = None,
        on_miss: Callable[[DeadlineMiss], None] | None = None,
    ) -> None:
        self.tables = Tables.build(
            task_set, legs=True, groups=False, default_deadline=default_deadline,
            max_active_jobs=max_active_jobs, expire_after=expire_after)
        self.scheduler = Scheduler(self.tables, n_workers, policy, propagate=False)
        self.verdicts = Verdicts(task_set, self.tables, record, on_miss, fail)
        topics = {t for c in task_set.callbacks for t in c.publishes} if task_set else set()
        self.attribution = Attribution(topics)
        self.crossings = Crossings.of(
            task_set, self.tables, self.scheduler, self.attribution)
        self.dag_names = [d.name for d in task_set.dags] if task_set else []
        self.lock = threading.Lock()
        self.clock_offset = clock_offset
        self.n_workers = n_workers
        self.undeclared = 0
        self.held = 0
        self.record = record
        self.fail = fail
        # told, under the lock, that something may be ready to be dispatched
        self.dispatch: Callable[[int], None] = lambda now: None
        self.context_ended: Callable[[], bool] = lambda: False
        self._key = self.scheduler.policy.key
        self._work: dict[int, Work] = {}
        # those of which the first that waits was refused (see ``gates``)
        self.refused: list[Entry] = []
        self.refusals = 0
        self._next_job = [0] * (self.tables.n_dags + 1)
        self._last = 0
        self._finished = False

    # --- time ------------------------------------------------------------------------------------

    def now(self) -> int:
        """Return the time on the trace's clock: ns since the epoch, steady during the run."""
        return monotonic_ns() + self.clock_offset

    def tick(self) -> int:
        """Return the core's time now; the caller holds the lock."""
        now = monotonic_ns() + self.clock_offset
        if now < self._last:
            return self._last
        self._last = now
        return now

    def core_time(self, now: int) -> int:
        """Return ``now``, or the time of the core's last event where that is later."""
        if now < self._last:
            return self._last
        self._last = now
        return now

    # --- what became ready -----------------------------------------------------------------------

    def hold(self) -> None:
        """
        Wake no idle worker until ``let_go``: more is going to become ready at this instant.

        Else the first of several would start though a more urgent one follows.
        """
        with self.lock:
            self.held += 1

    def let_go(self) -> None:
        """End one ``hold``."""
        with self.lock:
            self.held -= 1
            self.dispatch(self.tick())

    def timer_due(self, entry: Entry, work: Work, due: int) -> None:
        """Take in a timer that became due at ``due`` (trace's clock)."""
        with self.lock:
            if entry.removed or self._finished:
                return
            now = self.tick()
            if entry.depth and len(entry.waiting) >= entry.depth:
                entry.skipped += 1
                if entry.source >= 0:
                    self._skip_job(entry, due, now)
                return
            if entry.source >= 0:
                self._start_job(entry, work, max(entry.since, min(due, now)), now)
            else:
                self._start_undeclared(entry, work, now)
            self.dispatch(now)

    def timer_missed(self, entry: Entry, due: int, period: int, count: int) -> None:
        """
        Take in that ``count`` periods after that of ``due`` were missed: they are late.

        But not those before the executor began to look after the timer.
        """
        with self.lock:
            if entry.removed or self._finished:
                return
            early = min(count, max(0, (entry.since - due - 1) // period))
            due, count = due + early * period, count - early
            entry.skipped += count
            if entry.source >= 0:
                now = self.tick()
                for i in range(max(1, count - MOST_MISSED + 1), count + 1):
                    self._skip_job(entry, min(due + i * period, now), now)

    def message(
        self, entry: Entry, work: Work, origin: Origin | None, release: int | None,
        stamp: int = -1,
    ) -> None:
        """
        Take in a message.

        :param origin: the publication that it comes from, where one was found.
        :param release: where it starts a job, that job's release on the trace's clock.
        :param stamp: that of its header where it says which job it belongs to, else -1.
        """
        with self.lock:
            if entry.removed or self._finished:
                return
            now = self.tick()
            if entry.depth and len(entry.waiting) >= entry.depth:
                if entry.callback is None:
                    self._replace_oldest(entry, work, now)
                    self.dispatch(now)
                    return
                self._drop_oldest(entry, now)
            if entry.source >= 0 and release is not None:
                self._start_job(entry, work, max(entry.since, min(release, now)), now)
                if stamp >= 0 and self.crossings is not None and work.origin is not None:
                    self.crossings.note(stamp, work.origin)
                self.dispatch(now)
                return
            if origin is None and stamp >= 0 and release is not None:
                origin = self._enter(entry, stamp, min(release, now), now)
            if origin is None or not self._start_successor(entry, work, origin, now):
                if entry.callback is not None:
                    entry.unattributed += 1
                self._start_undeclared(entry, work, now)
            running = current.running
            if running is None or not running.ends_soon(self):
                self.dispatch(now)

    def undeclared_ready(self, entry: Entry, work: Work) -> None:
        """Take in anything that no DAG declares: requests, guard conditions, waitables, tasks."""
        with self.lock:
            if entry.removed or self._finished:
                return
            now = self.tick()
            self._start_undeclared(entry, work, now)
            self.dispatch(now)

    def ran_at_once(self, entry: Entry) -> None:
        """Count an undeclared callback that ran where it was taken."""
        with self.lock:
            entry.ready += 1
            entry.ran += 1
            self.undeclared += 1

    def _start_job(self, entry: Entry, work: Work, release: int, now: int) -> None:
        dag = self.tables.dag_of[entry.source]
        slot = self._release(dag, release, now)
        self._enqueue(entry, work, self.scheduler.source(slot), Origin(
            slot, dag, self.scheduler.state.job_index[slot], entry.source), now)

    def _enter(self, entry: Entry, stamp: int, release: int, now: int) -> Origin | None:
        """Find or start the job of a message from another process (see ``crossings``)."""
        if self.crossings is None or not entry.enters:
            return None
        dag = self.tables.dag_of[entry.enters[0]]
        job = self.crossings.find(dag, stamp)
        if job is None:
            slot = self._release(dag, release, now)
            job = Origin(slot, dag, self.scheduler.state.job_index[slot], entry.enters[0])
            self.crossings.note(stamp, job)
        # Of a sync: the first of its legs that nothing has come for yet.
        return job._replace(vertex=next(
            (v for v in entry.enters if self._is_idle(job, *entry.targets[v])), entry.enters[0]))

    def _is_idle(self, job: Origin, vertex: int, leg: int) -> bool:
        return self.scheduler.state.x_state[
            self.scheduler.execution(job.slot, vertex, leg)] == IDLE

    def _skip_job(self, entry: Entry, release: int, now: int) -> None:
        """Account for a release whose source does not run: the job expires at once."""
        slot = self._release(self.tables.dag_of[entry.source], release, now)
        self.scheduler.expire(slot, now)
        self.decided(now)

    def _release(self, dag: int, release: int, now: int) -> int:
        job = self._next_job[dag]
        self._next_job[dag] = job + 1
        slot = self.scheduler.release(dag, job, release, now)
        if self.scheduler.state.decisions:
            self.decided(now)
        if not self._finished:
            judged = is_judged(self.scheduler.state, slot)
            self.verdicts.released(dag, job, release, now, judged)
        return slot

    def _start_successor(self, entry: Entry, work: Work, origin: Origin, now: int) -> bool:
        """Make the vertex ready that a message of a known publication starts."""
        target = entry.targets.get(origin.vertex)
        if target is None:
            return False
        state = self.scheduler.state
        slot, dag, job, _ = origin
        if (state.job_dag[slot] != dag or state.job_index[slot] != job
                or state.job_state[slot] != OPEN):
            if not self.verdicts.was_aborted(dag, job):
                return False
            entry.ready += 1
            self.verdicts.note_drop(entry, Origin(slot, dag, job, target[0]), 'aborted', now)
            return True
        x = state.job_base[slot] + self.tables.region_offset[target[0]] + target[1]
        if state.x_state[x] != IDLE:
            return False  # a second message for the same vertex of the same job
        self._enqueue(entry, work, x, Origin(slot, dag, job, target[0]), now)
        return True

    def _start_undeclared(self, entry: Entry, work: Work, now: int) -> None:
        self.undeclared += 1
        self._note_ready(
            entry, work, self.scheduler.undeclared(
                entry.ready, entry.group, now, entry.habit.holds), now)

    def _enqueue(self, entry: Entry, work: Work, x: int, origin: Origin, now: int) -> None:
        state = self.scheduler.state
        state.x_group[x] = entry.group
        state.x_holds[x] = entry.habit.holds
        work.origin = origin
        make_ready(self.tables, state, self._key, x, now)
        self._note_ready(entry, work, x, now)

    def _note_ready(self, entry: Entry, work: Work, x: int, now: int) -> None:
        work.x = x
        work.ready_ns = now
        entry.ready += 1
        entry.waiting[x] = None
        self._work[x] = work

    def resume(self, work: Work) -> None:
        """Make a suspended execution ready to go on; nothing happens when it is not suspended."""
        with self.lock:
            if work.x >= 0 and self.scheduler.state.x_state[work.x] == SUSPENDED:
                self.scheduler.resume(work.x)
                self.dispatch(self.tick())

    def passed(self, work: Work) -> None:
        """Take in that an execution may run: its callback group has let it through."""
        with self.lock:
            self.scheduler.leave_group(work.x)
            self.dispatch(self.tick())

    def release_of(self, work: Work) -> int:
        """Return the release of the job that a declared execution belongs to; it is not over."""
        assert work.origin is not None
        return self.scheduler.state.job_release[work.origin.slot]

    # --- for the pool: all under the lock --------------------------------------------------------

    def take_work(self, x: int) -> Work:
        """Take the work of an execution that has been dispatched."""
        work = self._work.pop(x)
        work.entry.waiting.pop(x, None)
        return work

    def suspend(self, work: Work, start: int, end: int, seat: Seat) -> None:
        """Take a running execution off its worker until ``resume``."""
        if self.record is not None:
            self._record_run(work, start, end, seat)
        self.scheduler.suspend(work.x)
        self._work[work.x] = work

    def refuse(self, work: Work, now: int) -> None:
        """Put an execution back that its callback group does not let run now (see ``gates``)."""
        entry, x = work.entry, work.x
        if entry.removed:
            self.give_up(work, now)
            return
        self.scheduler.refuse(x)
        self._work[x] = work
        entry.waiting = {x: None, **entry.waiting}
        self.refused.append(entry)
        self.refusals += 1
        if 0 < entry.depth < len(entry.waiting) and entry.kind != TIMER:
            self._drop_oldest(entry, now)  # a newer one has come meanwhile

    def ask_again(self) -> None:
        """Make ready again what was refused."""
        refused, self.refused = self.refused, []
        for entry in refused:
            x = next(iter(entry.waiting), -1)
            if x >= 0 and self.scheduler.state.x_state[x] == SUSPENDED:
                self.scheduler.resume(x)

    def complete(
        self, work: Work, start: int, end: int, now: int, seat: Seat, failed: bool = False
    ) -> None:
        """
        End a running execution that ended at ``end``; ``now`` is the core's time.

        :param failed: whether its callback has let an exception out.
        """
        x = work.x
        work.x = -1
        work.entry.ran += 1
        state = self.scheduler.state
        origin = work.origin
        record = self.record
        end_it = fail if failed else complete
        work.entry.failed += failed
        if record is None:
            end_it(self.tables, state, self._key, x, end)
        elif origin is None:
            self._record_run(work, start, end, seat)
            end_it(self.tables, state, self._key, x, end)
        else:
            tables = self.tables
            slot, dag, job, vertex = origin
            deadline = state.job_release[slot] + tables.rad_offset[vertex]
            leg = x - state.job_base[slot] - tables.region_offset[vertex]
            whole = end_it(tables, state, self._key, x, end)
            if failed:  # told first, or its completion would count
                record('fail', now, seat.vtid, dag, tables.index_in_dag[vertex], job)
            record(
                EXECUTION, start, seat.vtid, work.entry.address, dag, tables.index_in_dag[vertex],
                job, seat.worker, work.ready_ns, deadline, end, now, whole, leg)
        if state.decisions:
            self.decided(now)

    def leave_open(self, work: Work, start: int, end: int, seat: Seat) -> None:
        """Take an execution off its worker that could not do its work: its context has ended."""
        if self.record is not None:
            self._record_run(work, start, end, seat)
        self.scheduler.lend(work.x)
        work.x = -1
        work.entry.ran += 1

    def _record_run(self, work: Work, start: int, end: int, seat: Seat) -> None:
        """Record that a callback has run which no DAG declares, or which goes on later."""
        record = self.record
        assert record is not None
        _, dag, job, vertex = work.origin or NO_ORIGIN
        index, deadline = -1, 0
        if dag >= 0:
            index = self.tables.index_in_dag[vertex]
            deadline = self.release_of(work) + self.tables.rad_offset[vertex]
        address = work.entry.address
        record(
            'dispatch', start, seat.vtid, address, dag, index, job, seat.worker, work.ready_ns,
            deadline)
        record('callback_start', start, seat.vtid, address, False)
        record('callback_end', end, seat.vtid, address)

    def give_up(self, work: Work, now: int) -> None:
        """End a dispatched execution that must not run: its job cannot complete any more."""
        x = work.x
        work.x = -1
        origin = work.origin
        if origin is not None:
            self.scheduler.expire_open(origin.slot, now)
        self.scheduler.complete(x, now)
        self.verdicts.note_drop(work.entry, origin or NO_ORIGIN, 'destroyed', now)
        self.decided(now)

    def decided(self, now: int) -> None:
        """Carry out what the core has decided since the last call."""
        if not self.scheduler.state.decisions:
            return
        if self._finished:  # it was judged already, and the trace is closed
            self.scheduler.decisions()
            return
        for x in self.verdicts.add(self.scheduler.decisions(), now):
            work = self._work.pop(x, None)
            if work is not None:  # the core dropped it: what is left of an aborted job
                work.entry.waiting.pop(x, None)
                work.x = -1
                self.verdicts.note_drop(work.entry, work.origin or NO_ORIGIN, 'aborted', now)

    def set_judging(self, judging: bool) -> None:
        """Give verdicts about jobs that are released from now on, or about none for now."""
        with self.lock:
            now = self.tick()
            release = now if judging else NEVER
            judge_from(self.scheduler.state, release)
            if self.record is not None:
                self.record('judge_from', now, threading.get_native_id(), release)

    def stopped(self, begin: int, end: int) -> None:
        """Take in that no thread of the process ran from ``begin`` to ``end`` (monotonic)."""
        with self.lock:
            self.verdicts.stops.stopped(begin + self.clock_offset, end + self.clock_offset)

    # --- the end ---------------------------------------------------------------------------------

    def finish(self) -> int:
        """Judge what is open, once, when the run ends; return the time on the trace's clock."""
        with self.lock:
            now = self.tick()
            self.scheduler.expire_idle(now)
            self.decided(now)
            self.scheduler.finish(now)
            self.decided(now)
            self._finished = True
        self.verdicts.tell()
        return now
