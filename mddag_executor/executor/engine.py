# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The engine of a live run: the core, and the work that waits in it.

Theory of operation
-------------------
The engine receives events with their times, and decides what to run.  It has no thread, lock or
clock and does not use rclpy; ``workers`` has all of these, and calls the engine under its lock, so
that times never decrease.  The engine and ``other_processes`` change the core's state, and
``registry`` adds and removes groups; nothing else does.

1.  *Ready work* (``timer_due``, ``arrived``, ``ready``) belongs to a job of a declared DAG, or to
    none.  Messages of known publications go to the job of these (``attribution``), others may
    enter from another process (``other_processes``), and all others run as undeclared.
2.  *Queue depth.*  A queue retains as many messages as its QoS allows; beyond that the oldest are
    dropped and counted.  With ``DEMOTE``, late messages after it are dropped as well: otherwise
    each message in a queue that stays full would wait for as many periods as the queue is deep.
    The queue keeps the place of a dropped message (``core.queues``), so a queue that overflows
    permanently gets its turn.
    Messages of the other topics of a driven sync belong to no job.  The execution that they start
    may complete the vertex of one (``answers``).
3.  *The core decides* what to run, and handles the ends of executions (``finished``,
    ``suspended``, ``refused``, …): see ``core.rules``.  After all events of a turn are reported,
    ``step`` returns instructions: what to run, and how long others may wait for it.  Then
    ``may_start_more`` says whether another thread may start something.  What else is read from
    outside is ``interpreter``.
4.  *The bypass.*  While nothing is waiting, running or owning a callback group in the core, short
    undeclared callbacks run past it, as it would choose the same (``bypass``).
5.  *Further decisions* of the core (verdicts, ends of jobs, executions dropped for newer ones) are
    counted, recorded and reported to the user (``verdicts``).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from threading import get_native_id
from typing import Any, Protocol, TYPE_CHECKING

from mddag_executor.core import NEVER, Scheduler, Tables
from mddag_executor.core.deadlines import Deadlines
from mddag_executor.core.driven import ANSWERED, GUESSED
from mddag_executor.core.estimates import Estimates
from mddag_executor.core.jobs import is_judged, judge_from
from mddag_executor.core.overload import admit, is_late
from mddag_executor.core.queues import has_place
from mddag_executor.core.state import (
    EXPIRED,
    IDLE,
    JUDGE_FROM,
    N_IDLE,
    OPEN,
    OTHER_KEYS,
    SUSPENDED,
    WAITING,
)
from mddag_executor.core.tables import MOST_SKIPPED
from mddag_executor.executor.answers import Answers, open_release
from mddag_executor.executor.attribution import (
    Announced,
    Attribution,
    new_origin,
    NO_ORIGIN,
    Origin,
    PublisherState,
)
from mddag_executor.executor.bounds import NET_NS, SHORT_CALLBACK_NS
from mddag_executor.executor.bypass import Bypass
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.interpreter import has_waiting, Interpreter
from mddag_executor.executor.optional_topics import OptionalTopics
from mddag_executor.executor.other_processes import OtherProcesses
from mddag_executor.executor.outer_places import OuterPlaces
from mddag_executor.executor.path_watch import PathWatch
from mddag_executor.executor.run_records import RunRecords
from mddag_executor.executor.sent_requests import Heritage, SentRequests
from mddag_executor.executor.spin_gaps import SpinGaps
from mddag_executor.executor.unfinished import Unfinished
from mddag_executor.executor.verdicts import DeadlineMiss, Record, Verdicts
from msg_graph import TaskSet

if TYPE_CHECKING:
    from mddag_executor.executor.work import Work

KEEP_STEPS = 100


def _release_of(entity: Entity, due: int, now: int) -> int:
    """Return the release of a job: neither to come, nor before its entity was managed."""
    # CPython calls min() and max() slowly
    release = due if due < now else now
    return release if release > entity.since else entity.since


class PublisherRecorder(Protocol):
    """
    Records publishers: see ``recorder.Recorder``.

    :ivar number: its own, from 1 up.
    """

    number: int

    def publisher(self, publisher: Any, state: PublisherState) -> None:
        """Record a publisher, unless that has been done."""


class Step:
    """
    What the threads are to do, as the engine answers; valid until the next call of the engine.

    :ivar work: the execution to run; None: there is none.
    :ivar is_short: whether it usually ends soon; this and what follows only if there is one:
    :ivar patience_ns: how long what waits, or may come, may wait for a short execution to end.
    :ivar n_idle: how many workers run nothing.
    :ivar overtaken: the executions that are to pause; this one always.
    """

    __slots__ = ('work', 'is_short', 'overtaken', 'n_idle', 'patience_ns')

    def __init__(self, is_short: bool = False, n_idle: int = 0) -> None:
        self.work: Work | None = None
        self.is_short = is_short
        self.patience_ns = NET_NS
        self.n_idle = n_idle
        self.overtaken: Sequence[Work] = ()


class Engine:
    """
    Converts ready work to executions of the core, and the core's decisions to work.

    All times are ns on the trace's clock and do not decrease from call to call.

    :param on_late: the treatment of late jobs of a DAG that does not declare it.
    :param record: receives trace events; None: they are not recorded.
    :param on_miss: receives every miss (see ``Verdicts``).
    :param process: the declared process that this is.
    """

    # more attributes than CPython reads quickly from a dictionary; the most used are first
    __slots__ = (
        '_bypass', '_ready', '_deferred', '_scalars', '_holders', '_state', 'tables', 'scheduler',
        'no_step', '_step', '_past_core', 'interpreter', 'n_workers', '_take', '_complete',
        '_make_ready', '_note_time', '_work', '_is_plain', '_is_watched', '_records',
        '_to_ask_again', '_finished', '_may_bypass', 'outer', 'other_processes', 'deadlines',
        'verdicts', '_next_job', 'notes_publications', 'attribution', '_undeclared',
        'sent_requests', 'path_watch', 'optional_topics', 'answers', 'dag_names', 'record',
        'recorder', 'on_late', 'clock_steps', '_ended', 'spin_gaps', '_keys_are_times',
        '_default_deadline')

    def __init__(
        self, task_set: TaskSet | None, n_workers: int, policy: str, *, default_deadline: int,
        max_active_jobs: int, expire_after: int, on_late: str = 'demote',
        record: Record | None = None, on_miss: Callable[[DeadlineMiss], None] | None = None,
        process: str | None = None,
    ) -> None:
        self.scheduler = Scheduler(Tables.build(
            task_set, legs=True, default_deadline=default_deadline,
            max_active_jobs=max_active_jobs, expire_after=expire_after, on_late=on_late),
            n_workers, policy)
        self.tables = self.scheduler.tables  # attributes: those of a named tuple are slower
        self.deadlines = Deadlines(self.tables, self.scheduler.state)
        self._note_time = Estimates(self.tables, self.scheduler.state).note
        self.verdicts = Verdicts(task_set, self.tables, record, on_miss)
        self.attribution = Attribution(task_set)
        self.sent_requests = SentRequests()
        #: Judges what is required of paths; None: nothing is.
        self.path_watch = PathWatch(task_set, process) if task_set is not None and any(
            path.requirements for path in task_set.paths) else None
        self.optional_topics = OptionalTopics(task_set, self.scheduler)
        self.answers = Answers(task_set, self.tables, self.scheduler.state)
        admit(self.tables, self.scheduler.state)
        self.other_processes = OtherProcesses.of(
            task_set, self.tables, self.scheduler, self.attribution, process,
            self.release_job)
        self.dag_names = [d.name for d in task_set.dags] if task_set else []
        self.n_workers = n_workers
        self.record = record
        #: Records publishers that are used before they were noticed; None: nothing is recorded.
        self.recorder: PublisherRecorder | None = None
        self._records = None if record is None else RunRecords(
            record, self.tables, self.scheduler.state)
        self.on_late = on_late
        self._undeclared = 0
        #: The last steps of the system clock: when, and by how much it was set forward.
        self.clock_steps: deque[tuple[int, int]] = deque(maxlen=KEEP_STEPS)
        # entities whose executions a callback group has refused
        self._to_ask_again: list[Entity] = []
        self._state = self.scheduler.state
        self._bypass = Bypass()
        self._may_bypass = False
        self._ready, self._deferred = self._state.ready, self._state.deferred
        self._scalars = self._state.scalars
        self._make_ready = self.scheduler.ready
        self._complete = self.scheduler.complete
        self._take = self.scheduler.take
        self._work: dict[int, Work] = {}
        self.spin_gaps = SpinGaps(record)
        self.outer = OuterPlaces(self.scheduler, self._end_bypass, self._work, self.spin_gaps)
        self._next_job = [0] * self.tables.n_dags
        self._finished = False
        self._ended = NEVER
        self.interpreter = Interpreter(self.tables, self._state)
        self._holders = self.interpreter.holders
        self._step = Step()
        #: what ``step`` returns if nothing waits
        self.no_step = Step()
        self._past_core = Step(is_short=True, n_idle=n_workers - 1)
        urgency = self.scheduler.policy.urgency
        self._keys_are_times = urgency != OTHER_KEYS
        # whether the ends of most executions only matter to the core
        self._is_plain = (
            record is None and self.path_watch is None and not self.optional_topics.edges)
        # whether the begin of an execution is to be noted
        self._is_watched = bool(self.answers.awaiting) or self.path_watch is not None
        #: whether ``publishes`` is to be called
        self.notes_publications = record is not None or self.path_watch is not None
        self._default_deadline = default_deadline

    # --- ready work ------------------------------------------------------------------------------

    def message_taken(
        self, entity: Entity, message: Any, source_timestamp: int, number: int | None, now: int
    ) -> None:
        """Record that a message was taken, while ``record`` is set (see ``RunRecords``)."""
        assert self._records is not None
        self._records.message_taken(entity, message, source_timestamp, number, now)

    def messages_lost(self, entity: Entity, count: int, now: int) -> None:
        """Note that the middleware dropped messages (see ``gaps``), as the next one shows."""
        if entity.is_own:
            return
        entity.lost += count
        if self._records is not None:
            self._records.messages_lost(entity, count, now)

    def timer_due(self, work: Work, due: int, now: int) -> None:
        """Handle a timer that became due at ``due``."""
        entity = work.entity
        if entity.removed or self._finished:
            entity.leave([work])
            return
        release = _release_of(entity, due, now)
        if work.was_reset and entity.waiting:
            self._drop_withdrawn(work, now)
        if entity.depth and len(entity.waiting) >= entity.depth:
            entity.skipped += 1
            if entity.source >= 0:
                self._skip_job(entity, release, now)
        elif entity.source >= 0 and not self._is_over(self.tables.dag_of[entity.source]):
            self._start_job(work, release, now)
        else:
            work.due_ns = release
            self.ready(work, now)

    def _drop_withdrawn(self, newest: Work, now: int) -> None:
        """Drop what waits of a timer that was reset since: else it would be in the way."""
        self._end_bypass()
        for x in list(newest.entity.waiting):
            if self._work[x].n_resets != newest.n_resets:
                self._drop(newest.entity, x, 'withdrawn', now)

    def _is_over(self, dag: int) -> bool:
        """
        Return whether a one-shot timer has released its job already.

        It fires again if the callback that cancels it has not run yet.
        """
        return self.tables.period[dag] == NEVER and self._next_job[dag] > 0

    def timer_missed(self, entity: Entity, due: int, period: int, count: int, now: int) -> None:
        """
        Note that ``count`` periods after that of ``due`` were missed: they are late.

        Periods before the executor began to manage the timer are not counted.
        """
        if entity.removed or self._finished:
            return
        early = min(count, max(0, (entity.since - due - 1) // period))
        due, count = due + early * period, count - early
        entity.skipped += count
        if entity.source >= 0:
            for i in range(max(1, count - MOST_SKIPPED + 1), count + 1):
                self._skip_job(entity, min(due + i * period, now), now)

    def arrived(
        self, work: Work, origin: Origin | Announced | None, release: int, stamp: int, now: int
    ) -> None:
        """
        Handle a message.

        :param origin: its publication, if found.
        :param release: the release of the job that it starts or enters with, if any.
        :param stamp: of its header if that identifies the job, else -1.
        """
        entity = work.entity
        if entity.may_answer:
            self.ready(work, now)
            return
        if entity.removed or self._finished:
            entity.leave([work])
            return
        if entity.source >= 0:
            self._start_job(work, _release_of(entity, release, now), now)
            if stamp >= 0 and self.other_processes is not None and work.origin is not None:
                self.other_processes.note(stamp, work.origin)
            if 0 < entity.depth < len(entity.waiting):
                self._drop_oldest(entity, now)
            return
        if isinstance(origin, Announced):
            origin = self._enter(origin, min(release, now), now)
        elif origin is None and stamp >= 0 and self.other_processes is not None:
            origin = self.other_processes.enter_at(entity, stamp, min(release, now), now)
        if origin is None or not self._start_successor(work, origin, now):
            if entity.callback is not None:
                entity.unattributed += 1
            self.ready(work, now)

    def ready(self, work: Work, now: int) -> None:
        """Handle undeclared work: a message, request, guard condition, waitable or task."""
        entity = work.entity
        if entity.removed or self._finished:
            entity.leave([work])
            if not self._finished:  # a waitable's data are taken without the engine's lock
                entity.ready += 1
                self.verdicts.dropped(entity, NO_ORIGIN, 'destroyed', now)
            return
        work.ready_ns = now
        waiting, bypass = entity.waiting, self._bypass
        if entity.may_answer:
            self._end_bypass()
        else:
            if entity.outer >= 0 and not self.outer.is_open(entity.outer):
                self._end_bypass()
            elif bypass.is_open or self._opens_bypass():
                if waiting and 0 < entity.depth <= len(waiting):
                    bypass.enter_full(work)
                    self.verdicts.dropped(entity, NO_ORIGIN, 'qos_depth', now)
                else:
                    bypass.enter(work)
                return
            self._undeclared += 1
        self._enqueue(work, now)
        entity.ready += 1
        if 0 < entity.depth < len(waiting):
            self._drop_oldest(entity, now)

    def posted(self, work: Work, now: int) -> None:
        """Handle undeclared work that may inherit (``core.rules``, rule 15); see ``ready``."""
        self.ready(work, now)
        if work.heritage is not None and work.x != -1:
            self._end_bypass().inherit(work.x, *work.heritage)

    def heritage(self, work: Work) -> Heritage | None:
        """Return what the requests of a running execution inherit; without the lock."""
        return None if work.x < 0 else self.scheduler.heritage(work.x)

    def heritage_of_task(self, work: Work) -> Heritage | None:
        """Return what the tasks of a running execution inherit; without the lock."""
        return self.heritage(work) if work.origin is None else None

    def _enqueue(self, work: Work, since: int) -> None:
        entity = work.entity
        if entity.queue < 0:
            entity.queue = self.scheduler.new_queue()
        if entity.may_answer and entity.callback is not None and self._keys_are_times:
            # it is ordered by the job that it may answer
            since = self.answers.due(entity.callback.key, since) - self._default_deadline
        if entity.callback is not None and entity.waiting and self._keys_are_times:
            # It belongs to no job, but comes after the messages that wait already.  Only the last
            # one, and the last one without a job, are compared: there may be many.
            state, last = self._state, next(reversed(entity.waiting))
            since = max(since, entity.last_since)
            if last >= 0:
                after = state.x_key[last][0]
                if state.x_state[last] == WAITING:  # its queue may be late
                    after = max(after, state.queue_key[state.x_queue[last]][0])
                since = max(since, after + 1 - self._default_deadline)
        entity.last_since = since
        x = work.x = self.scheduler.ready_undeclared(
            entity.ready, entity.group, entity.habit.holds, entity.queue, since)
        self._state.x_outer[x] = entity.outer
        entity.waiting[x] = None
        self._work[x] = work

    def allow_bypass(self) -> None:
        """Let undeclared executions bypass the core, if the policy runs them as they come."""
        policy, undeclared = self.scheduler.policy, self.tables.n_vertices
        self._may_bypass = policy.key(
            self.tables, undeclared, 0, 1, 0) < policy.key(self.tables, undeclared, 0, 0, 1)

    def _opens_bypass(self) -> bool:
        """Open the bypass if undeclared executions may use it now; return whether they may."""
        bypass = self._bypass
        bypass.is_open = self._may_bypass and self._is_core_empty()
        return bypass.is_open

    def _is_core_empty(self) -> bool:
        """
        Return whether nothing in the core waits, runs on a worker, or owns a group.

        An execution that has lent its worker may still have a place in its outer group.
        """
        state = self._state
        return not (has_waiting(state) or state.scalars[N_IDLE] < self.n_workers
                    or max(state.group_owner, default=-1) >= 0
                    or max(state.outer_running, default=0) > 0)

    def _end_bypass(self) -> Scheduler:
        """End the bypass: report everything to the core; return the core."""
        if self._bypass.is_open:
            running, since, waiting = self._bypass.close()
            if running is not None:
                self._enqueue(running, running.ready_ns)
                self._start_next(running.worker, since)
            for work in waiting:
                self._enqueue(work, min(work.place_ns, work.ready_ns))
        return self.scheduler

    @property
    def undeclared(self) -> int:
        """Return the number of executions of no job that have become ready."""
        return self._undeclared + self._bypass.n_entered

    def ran_at_once(self, entity: Entity) -> None:
        """Count an undeclared callback that was handled at once."""
        entity.ready += 1
        entity.ran += 1
        self._undeclared += 1

    def _start_job(self, work: Work, release: int, now: int) -> None:
        dag = self.tables.dag_of[work.entity.source]
        slot, state, source = self.release_job(dag, release, now), self._state, work.entity.source
        work.origin = new_origin((slot, dag, state.job_index[slot], source))
        self._start(work, state.job_base[slot] + self.tables.region_offset[source], now)

    def _enter(self, job: Announced, release: int, now: int) -> Origin | None:
        """Find or start an announced job."""
        if self.other_processes is None or job.dag < 0:
            return None
        return self.other_processes.enter(job.dag, job.name, job.vertex, release, now)

    def open_release(self, origin: Origin) -> int | None:
        """Return the release of an open job, None if the job has ended."""
        return open_release(self._state, origin)

    def _skip_job(self, entity: Entity, release: int, now: int) -> None:
        """Account for a release whose source does not run: the job expires at once."""
        dag = self.tables.dag_of[entity.source]
        if self._is_over(dag):
            return
        slot = self.release_job(dag, release, now)
        self.scheduler.give_up(slot, EXPIRED, now)
        self._decided(now)

    def release_job(self, dag: int, release: int, now: int) -> int:
        """Release the next job of a DAG; return its slot."""
        job = self._next_job[dag]
        self._next_job[dag] = job + 1
        slot = self.scheduler.release(dag, job, release, now)
        if self._state.decisions:
            self._decided(now)
        self.deadlines.watch(slot)
        if self.other_processes is not None:
            self.other_processes.released(dag, job, release)
        self.verdicts.released(dag, job, release, now, is_judged(self._state, slot))
        return slot

    def _start_successor(self, work: Work, origin: Origin, now: int) -> bool:
        """Make the vertex ready that a message of a known publication starts."""
        entity, state = work.entity, self._state
        slot, dag, job, before = origin
        target = entity.targets.get(before)
        if target is None or state.job_index[slot] != job or state.job_state[slot] != OPEN or (
                state.job_dag[slot] != dag):
            return False
        vertex, leg = target
        x = state.job_base[slot] + self.tables.region_offset[vertex] + leg
        if state.x_state[x] != IDLE:
            return False  # a second message for the same vertex of the same job
        work.origin = new_origin((slot, dag, job, vertex))
        self._start(work, x, now)
        if 0 < entity.depth < len(entity.waiting):
            self._drop_oldest(entity, now)
        return True

    def _start(self, work: Work, x: int, now: int) -> None:
        entity, state = work.entity, self._state
        state.x_group[x] = entity.group
        state.x_outer[x] = entity.outer
        state.x_holds[x] = entity.habit.holds
        if self._bypass.is_open:
            self._end_bypass()
        self._make_ready(x, now)
        work.x = x
        work.ready_ns = now
        entity.ready += 1
        entity.waiting[x] = None
        self._work[x] = work
        if state.decisions:
            self._decided(now)  # it replaced an older one, which was dropped

    # --- dropped work ----------------------------------------------------------------------------

    def _drop(self, entity: Entity, x: int, reason: str, now: int) -> None:
        del entity.waiting[x]
        work = self._work.pop(x)
        work.x = -1
        self.scheduler.drop(x, now)
        self.verdicts.dropped(entity, work.origin or NO_ORIGIN, reason, now)
        self._decided(now)

    def _drop_oldest(self, entity: Entity, now: int) -> None:
        """Drop the oldest message of a queue with one too many, and late ones after it."""
        self._end_bypass()
        waiting = entity.waiting
        self._drop(entity, next(iter(waiting)), 'qos_depth', now)
        while len(waiting) > 1:
            x = next(iter(waiting))
            if self._work[x].origin is None or not is_late(self.tables, self._state, x, now):
                break
            self._drop(entity, x, 'qos_depth', now)

    def remove(self, entity: Entity, now: int) -> None:
        """Forget a removed entity: its waiting executions do not run here any more."""
        entity.may_be_gone = True
        self.leave_waiting(entity)
        for x in list(entity.waiting):
            self._drop(entity, x, 'destroyed', now)
        if entity.queue >= 0:
            self.scheduler.free_queue(entity.queue)
            entity.queue = -1

    def leave_waiting(self, entity: Entity) -> None:
        """
        Leave the waiting executions of an entity to the next executor of its node, if any.

        Later ones are left as well.
        """
        self._end_bypass()
        entity.removed = True
        entity.leave([self._work[x] for x in entity.waiting])

    # --- dispatch --------------------------------------------------------------------------------

    @property
    def queue_length(self) -> int:
        """Return the number of executions that wait, for a worker or for their group."""
        return len(self._bypass.queue) + self.scheduler.queue_length

    @property
    def idle_workers(self) -> int:
        """Return the number of workers that run nothing."""
        return self._scalars[N_IDLE] - (self._bypass.running is not None)

    @property
    def is_busy(self) -> bool:
        """Return whether any execution runs on a worker."""
        return self.idle_workers < self.n_workers

    @property
    def has_waiting(self) -> bool:
        """Return whether any execution waits, except for its callback group."""
        return bool(self._bypass.queue) or has_waiting(self._state)

    def step(self, worker: int, now: int) -> Step:
        """
        Choose the next execution for a worker that runs nothing, after all events up to now.

        :param worker: the worker to use if it is idle; else the lowest idle one is used.
        """
        bypass = self._bypass
        if bypass.queue:
            work = bypass.start(worker, now)
            if work is not None:
                if work.entity.collect_more is not None:
                    self._collect_more(work.entity)
                step = self._past_core
                step.work = work
                step.patience_ns = self.interpreter.patience() if bypass.queue else NET_NS
                return step
        elif not (self._ready or self._deferred):  # nearly every second time
            return self.no_step
        if bypass.is_open:
            self._end_bypass()
        step, state = self._step, self._state
        if state.worker_x[worker] >= 0:
            worker = state.worker_x.index(-1) if self._scalars[N_IDLE] else -1
        work = None
        if worker >= 0:
            if self._holders:
                state.overtaking[1] = self.interpreter.may_be_overtaken(now)
            work = self._start_next(worker, now)
        step.work = work
        step.overtaken = ()
        step.n_idle = self._scalars[N_IDLE]  # nothing runs past the core any more
        if work is not None:
            step.is_short = work.entity.wall_ns <= SHORT_CALLBACK_NS
            if work.entity.outer in self.outer.once:
                self.outer.started(work.entity.outer, now)
        if len(self._holders) > 1:
            self.interpreter.reorder()
            if self.interpreter.pauses:
                step.overtaken = self.interpreter.overtaken
        waits = self._ready or self._deferred
        step.patience_ns = self.interpreter.patience() if waits else NET_NS
        return step

    def patience(self) -> int:
        """
        Return how long what waits, or may come, may wait for a short execution to end, ns.

        NEVER: no worker is idle.
        """
        if self.idle_workers < 1:
            return NEVER
        waits = self._ready or self._deferred or self._bypass.queue
        patience = self.interpreter.patience() if waits else NET_NS
        # it is not known yet whether a holder really computes: half the time
        return patience // 2 if self._holders else patience

    @staticmethod
    def _collect_more(entity: Entity) -> None:
        """Let the rest of its arrivals be collected, as one of its executions has started."""
        collect, entity.collect_more = entity.collect_more, None
        if collect is not None:
            collect()

    def _start_next(self, worker: int, now: int) -> Work | None:
        """Start the execution that the core chooses for an idle worker; None: there is none."""
        state = self._state
        x = self._take(worker, now)
        if state.decisions:
            self._decided(now)
        if x < 0:
            return None
        work = self._work.pop(x)
        entity = work.entity
        entity.waiting.pop(x, None)  # one that goes on was removed before
        work.worker = worker
        if state.x_holds[x]:
            work.paused_ns = 0
            self._holders.append(work)
        if self._is_watched:
            self._begin_watched(work, now)
        if entity.collect_more is not None:
            self._collect_more(entity)
        return work

    def _begin_watched(self, work: Work, now: int) -> None:
        """Note the start of an execution that may answer, or belongs to a path."""
        self.answers.begin(work)
        if self.path_watch is not None:
            begun = work.origin or work.answers
            if begun is not None:
                self.path_watch.begun(work, begun.vertex, now)

    def origin_of(self, work: Work) -> Origin | None:
        """Return the job of what an execution publishes; None: it has none."""
        origin = work.origin or work.answers
        return None if origin is NO_ORIGIN else origin

    def relative_deadline(self, entity: Entity) -> int:
        """Return the least time (ns) from an arrival at an entity to its deadline, or a guess."""
        rad_offset = self.tables.rad_offset
        if entity.callback is None:
            return rad_offset[self.tables.n_vertices]
        if entity.source >= 0:
            deadline = rad_offset[entity.source]
            if entity.is_due_at_release or self.attribution.is_released_at_arrival(
                    self.tables.dag_of[entity.source]):
                return deadline
        else:
            deadline = min((
                rad_offset[vertex] for vertex, _ in entity.targets.values()), default=0)
        return deadline // 2  # its job was released before it arrived

    def may_start_more(self, now: int) -> bool:
        """Return whether another thread may start an execution now; True if in doubt."""
        if self._bypass.is_open:
            if self._bypass.running is None or not self._bypass.queue:
                return bool(self._bypass.queue)
            self._end_bypass()
        return self.interpreter.may_start_more(now)

    # --- executions that run ---------------------------------------------------------------------

    def _let_go(self, work: Work) -> None:
        if work in self._holders:
            self._holders.remove(work)

    def stop_holding(self, work: Work) -> None:
        """Release the interpreter for an execution that does not need it now."""
        self._let_go(work)
        self.scheduler.stop_holding(work.x)

    def lend(self, work: Work) -> None:
        """Free the worker of an execution that continues without one."""
        core = self._end_bypass()
        self._let_go(work)
        core.lend(work.x)

    def resume(self, work: Work, now: int) -> None:
        """Make a suspended execution ready again; does nothing if it is not suspended."""
        if work.x >= 0 and self._state.x_state[work.x] == SUSPENDED:
            self._resume(work, now)

    def _resume(self, work: Work, now: int) -> None:
        entity = work.entity
        self._end_bypass().resume(work.x, entity.ready, entity.habit.holds, now)

    def waits_for_place(self, work: Work) -> bool:
        """Return whether an execution that is to go on waits for others of its outer group."""
        return not has_place(self._state, work.x)

    def rejoin(self, work: Work, now: int) -> bool:
        """
        Make an execution that has lent its worker ready to go on: ``step`` returns it.

        :return: whether nothing else waited.
        """
        entity = work.entity
        is_first = not self.has_waiting
        self._work[work.x] = work
        self._end_bypass().rejoin(work.x, entity.ready, entity.habit.holds, now)
        return is_first

    def go_on_without(self, work: Work) -> None:
        """Let an execution go on that waits for a worker after ``rejoin``, without one."""
        del self._work[work.x]
        self._end_bypass().go_on_without(work.x)

    def begun(self) -> list[Work]:
        """Return the coroutines that have begun, and are suspended or wait to go on."""
        return [work for work in list(self._work.values())
                if work.coroutine is not None and self._state.x_started[work.x] >= 0]

    def leave_group(self, work: Work) -> None:
        """Note that an execution's callback group has let it run (see ``work``)."""
        self.scheduler.leave_group(work.x)

    def ask_again(self) -> None:
        """Make executions ready again that a callback group has refused; also at each end."""
        refused, self._to_ask_again = self._to_ask_again, []
        for entity in refused:
            x = next(iter(entity.waiting), -1)
            if x >= 0 and self._state.x_state[x] == SUSPENDED:
                self.scheduler.ask_again(x)

    # --- ends of executions ----------------------------------------------------------------------

    def finished(
        self, work: Work, start: int, end: int, now: int, vtid: int, worker: int,
        failed: bool = False,
    ) -> None:
        """
        End an execution that ran from ``start`` to ``end``; ``now`` is not before these.

        :param vtid: the thread that it ran in; ``worker`` is -1 if that has lent its worker.
        :param failed: whether its callback has raised an exception.
        """
        entity = work.entity
        entity.ran += 1
        entity.busy_ns += end - start
        if work is self._bypass.running:
            self._bypass.running = None
            if failed:
                entity.failed += 1
            if self._records is not None:
                self._records.run(work, -1, start, end, vtid, worker)
            return
        holders = self._holders
        if holders:
            if holders[-1] is work:
                holders.pop()
            else:
                self._let_go(work)
        if self._is_plain and not failed and entity.awaiting is None:
            x, work.x = work.x, -1
            origin = work.origin
            if self._complete(x, end) and origin is not None:
                habit = entity.habit
                self._note_time(origin.vertex, habit.needs_ns, habit.holds, now)
        else:
            self._finished_watched(work, start, end, now, vtid, worker, failed)
        if self._state.decisions:
            self._decided(now)
        if self._to_ask_again:
            self.ask_again()

    def _finished_watched(
        self, work: Work, start: int, end: int, now: int, vtid: int, worker: int, failed: bool
    ) -> None:
        """End an execution that failed, may answer, or is recorded or watched (``finished``)."""
        entity = work.entity
        x, work.x = work.x, -1
        origin, records = work.origin, self._records
        entity.failed += failed
        completes = [] if origin is None else [origin]
        is_guess = False
        if entity.awaiting is not None:
            is_guess = origin is None and work.answers is not None and (
                entity.awaiting.is_guess(work.answers))
            completes = [] if failed else self.answers.completed_by(work)
            origin = completes[0] if completes else origin
        published: dict[Origin, set[str]] = {}
        optional = self.optional_topics
        for each in completes:
            if each.vertex in optional.edges and optional.completes(each):
                topics = self.attribution.published(each)
                published[each] = topics if entity.awaiting is None else set(work.published)
                if not failed:
                    optional.withhold(each, published[each], end)
        whole = (self.scheduler.fail if failed else self._complete)(x, end)
        if entity.awaiting is not None:
            whole = bool(completes)
            for each in completes:
                self.scheduler.answer(each.slot, each.vertex, completes[0].slot, end)
        if origin is not None:
            tables, state = self.tables, self._state
            slot, dag, job, vertex = origin
            if self.path_watch is not None and (whole or tables.n_legs[vertex] == 1):
                for each in completes:
                    if each.vertex in self.path_watch.vertices:
                        self.path_watch.ended(
                            work, each.vertex, each.job, start, end, work.sent,
                            None if failed else published.get(each), state.scalars[JUDGE_FROM])
            leg = x - state.job_base[slot] - tables.region_offset[vertex]
            if entity.may_answer:
                leg = GUESSED if is_guess else ANSWERED
                entity.guessed += is_guess
            if records is not None:
                records.execution(
                    work, origin, x, leg, start, end, now, vtid, worker, whole=whole,
                    failed=failed)
            if whole:  # other messages of a sync take less
                self._note_time(vertex, entity.habit.needs_ns, entity.habit.holds, now)
        elif records is not None:
            records.run(work, x, start, end, vtid, worker)
        if self.path_watch is not None:
            self.path_watch.left(work)

    def hear_published(self, job: Announced, topic: str, now: int) -> None:
        """Open the job of a message of another process, which may be lost on its way."""
        others = self.other_processes
        if not self._finished and others is not None and others.enters(job.vertex, topic):
            self._enter(job, min(job.release, now), now)

    def hear_ended(self, job: Announced, end: int, now: int) -> None:
        """End a job that has ended early in another process."""
        others = self.other_processes
        if self._finished or others is None or not others.is_here(job.dag):
            return
        origin = self._enter(job, min(job.release, now), now)
        if origin is not None and self.open_release(origin) is not None:
            self.scheduler.give_up(origin.slot, end, now)
        self._decided(now)

    def hear_silent(self, job: Announced, topic: str, now: int) -> None:
        """Leave out of a job what an execution in another process has not started."""
        others = self.other_processes
        if self._finished or others is None or not others.is_here(job.dag) or (
                not self.optional_topics.is_heard(job.dag, job.vertex, topic)):
            return
        origin = self._enter(job, min(job.release, now), now)
        if origin is not None and self.open_release(origin) is not None:
            self.optional_topics.withhold_heard(origin, topic, now)
        if origin is not None:
            self._decided(now)

    def suspended(self, work: Work, start: int, end: int, vtid: int, worker: int) -> None:
        """Take a running execution off its worker until ``resume``."""
        self._end_bypass()
        work.entity.busy_ns += end - start
        work.suspended_ns = end
        if self._records is not None:
            self._records.run(work, work.x, start, end, vtid, worker, goes_on=True)
        if self.path_watch is not None:
            _, _, job, vertex = work.origin or work.answers or NO_ORIGIN
            self.path_watch.paused(work, vertex, job, start, end, work.sent)
        self._let_go(work)
        self.scheduler.suspend(work.x)
        self._work[work.x] = work
        self.ask_again()

    def refused(self, work: Work, now: int) -> None:
        """Put an execution back that its callback group has refused (see ``work``)."""
        self._end_bypass()
        entity, x = work.entity, work.x
        if entity.removed:
            entity.leave([work])
            self.destroyed(work, now)
            return
        self._let_go(work)
        self.scheduler.refuse(x)
        if self.path_watch is not None:
            self.path_watch.left(work)
        work.answers = None
        self._work[x] = work
        entity.waiting = {x: None, **entity.waiting}
        self._to_ask_again.append(entity)
        if 0 < entity.depth < len(entity.waiting) and not entity.keeps_oldest:
            self._drop(entity, x, 'qos_depth', now)  # a newer one has arrived meanwhile

    def left_open(
        self, work: Work, start: int, end: int, vtid: int, worker: int, ran: bool
    ) -> None:
        """Free the worker of an execution that could not finish because its context has ended."""
        if ran:
            work.entity.busy_ns += end - start
            if self._records is not None:
                self._records.run(work, work.x, start, end, vtid, worker)
        self.lend(work)
        if self.path_watch is not None:
            self.path_watch.left(work)
        work.x = -1
        work.entity.ran += ran
        work.entity.dropped += not ran
        self.ask_again()

    def destroyed(self, work: Work, now: int, reason: str = 'destroyed') -> None:
        """
        End a dispatched execution that must not run: its job cannot complete any more.

        :param reason: that of ``Destroyed``.
        """
        self._end_bypass()
        x, work.x = work.x, -1
        self._let_go(work)
        if work.origin is not None:
            self.scheduler.give_up(work.origin.slot, EXPIRED, now)
        self._complete(x, now)
        if self.path_watch is not None:
            self.path_watch.left(work)
        self.verdicts.dropped(work.entity, work.origin or NO_ORIGIN, reason, now)
        self._decided(now)
        self.ask_again()

    def publishes(
        self, work: Work | None, publisher: Any, state: PublisherState, message: Any, now: int,
        vtid: int, is_on_behalf: bool = False,
    ) -> None:
        """
        Note that a callback publishes, while ``notes_publications``; without the lock.

        :param work: the execution; None: a thread of the program's own publishes.
        :param is_on_behalf: whether other code publishes on behalf of the execution.
        """
        if self._records is not None:
            if self.recorder is not None and state.recorded_by != self.recorder.number:
                self.recorder.publisher(publisher, state)
            if is_on_behalf and work is not None:
                self.record_on_behalf(work, now, vtid)
            self._records.publication(state.address, message, now, vtid)
        topic, watch = state.topic, self.path_watch
        if work is not None and watch is not None and topic in watch.topics:
            work.sent += (topic, now),

    def record_on_behalf(self, work: Work, now: int, vtid: int) -> None:
        """Record on behalf of which execution a thread publishes next."""
        if self._records is not None:
            self._records.on_behalf(work, self.origin_of(work) or NO_ORIGIN, now, vtid)

    def job_of(self, work: Work) -> tuple[str, int, int] | None:
        """Return DAG, index and release of the job of a running execution; None: no job."""
        origin = work.origin
        return None if origin is None else (
            self.dag_names[origin.dag], origin.job, self.release_of(work))

    def release_of(self, work: Work) -> int:
        """Return the release of the job of a declared execution; the job must not have ended."""
        assert work.origin is not None
        return self._state.job_release[work.origin.slot]

    def _decided(self, now: int) -> None:
        """Carry out the core's decisions since the last call."""
        decisions = self.scheduler.decisions()
        if self._finished:  # the run was judged already, and the trace is closed
            return
        for x in self.verdicts.add(decisions, now):
            work = self._work.pop(x, None)
            if work is not None:  # dropped by the core for a newer one
                work.entity.waiting.pop(x, None)
                work.x = -1
                self.verdicts.dropped(work.entity, work.origin or NO_ORIGIN, 'newer', now)

    @property
    def is_judging(self) -> bool:
        """Return whether jobs that are released now are judged."""
        return self._state.scalars[JUDGE_FROM] < NEVER

    def set_judging(self, judging: bool, since: int | None, now: int) -> None:
        """Judge jobs released from now (or a time) on, or none for now."""
        release = NEVER if not judging else now if since is None else since
        judge_from(self._state, release)
        if self._records is not None:
            self._records.judge_from(release, now)

    def requirements(self, now: int) -> dict[str, Any]:
        """Return the results of the requirements of paths, see ``PathWatch.result``."""
        return {} if self.path_watch is None else self.path_watch.result(
            min(now, self._ended), self._state.scalars[JUDGE_FROM])

    def machine_stopped(self, begin: int, end: int) -> None:
        """Note that the machine stood still."""
        self.verdicts.machine_stopped(begin, end)

    def clock_was_set(self, step: int, now: int) -> None:
        """Note that the system clock was set forward by so much."""
        self.clock_steps.append((now, step))
        if self.record is not None:
            self.record('clock_step', now, get_native_id(), step)

    def judge_overdue(self, now: int, reporting: Iterable[Work] = ()) -> None:
        """
        Report the sinks whose deadlines are over and which have not completed.

        :param reporting: executions that have perhaps ended, and are reported in a moment: their
            jobs are judged later.
        """
        if self._finished:
            return
        several = [work.origin or work.answers for work in reporting]
        self.deadlines.judge(now, [each.slot for each in several if each is not None])
        if self._state.decisions:
            self._decided(now)

    # --- the end ---------------------------------------------------------------------------------

    def note_unfinished(self, several: Iterable[Unfinished], now: int) -> None:
        """Record executions that have not ended, if they are recorded (see ``unfinished``)."""
        if self._records is not None and not self._finished:
            self._records.unfinished(several, now)

    def finish(
        self, now: int, end: int | None = None, unfinished: Iterable[Unfinished] = ()
    ) -> None:
        """
        Judge open jobs, once, when the run ends.

        :param end: when executions stopped starting, if that was before now: running ones have
            ended since, but later deadlines are not judged.
        :param unfinished: the executions that have not ended.
        """
        end = now if end is None else end
        self._ended = end
        self.spin_gaps.finish(now)
        if self._records is not None:
            self._records.waiting(self._work.values(), now)
            self._records.unfinished(unfinished, now)
        self.scheduler.expire_idle(end)
        self._decided(now)
        self.scheduler.finish(end)
        self._decided(now)
        self._finished = True
