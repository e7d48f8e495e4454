# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The threads of the worker pool: their states, and how one runs an execution."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from enum import Enum
import threading
from time import monotonic_ns
from typing import Any, Protocol

from mddag_executor.clocks import TraceClock
from mddag_executor.errors import from_user_code
from mddag_executor.executor.attribution import PublisherState
from mddag_executor.executor.bounds import SHORT_CALLBACK_NS
from mddag_executor.executor.engine import Engine
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.forks import end_copy
from mddag_executor.executor.gil import Measurement
from mddag_executor.executor.pausing import Pause
from mddag_executor.executor.work import Refused, Work


class ThreadState(Enum):
    """
    What a thread does; it changes under the engine's lock only.

    ::

                  called, or looks, and finds an execution
            ┌───────────────────────────────────────────────▶┐
          PARKED ◀──────────────────────────────────────── RUNNING ──▶ OUT
            │ ▲   nothing to run: others wait or compute     ▲ │ ▲       │
            │ │                                              │ │ └───────┘ answer, and its turn
            ▼ │                                    an event, │ │
          WAITING ◀──────────────────────────────────────────┴─┘ nothing to run

    A thread of the pool begins and ends as PARKED, that of ``spin_once`` as RUNNING.

    :ivar next: the states that may follow; a thread that stays in one does not change.
    """

    next: tuple[ThreadState, ...]

    PARKED = 'parked'       # waits to be called, or for the time of a look
    WAITING = 'waiting'     # waits for events
    RUNNING = 'running'     # runs a callback
    OUT = 'out'             # its callback has lent its worker: waits for the answer, then for one


for _state, _next in (
    (ThreadState.PARKED, (ThreadState.WAITING, ThreadState.RUNNING)),
    (ThreadState.WAITING, (ThreadState.PARKED, ThreadState.RUNNING)),
    (ThreadState.RUNNING, (ThreadState.PARKED, ThreadState.WAITING, ThreadState.OUT)),
    (ThreadState.OUT, (ThreadState.RUNNING, ThreadState.PARKED, ThreadState.WAITING)),
):
    _state.next = _next


class Lending(Protocol):
    """Lends workers: see ``lending.Lending``."""

    def lend(self, me: WorkerThread, waits_for: str) -> AbstractContextManager[None]:
        """Lend the worker of a running callback to other threads."""


class Pool(Protocol):
    """
    The worker pool, to its threads: see ``workers.WorkerPool``.

    :ivar offset: of the trace's clock.
    :ivar is_recorded: whether executions are recorded, with their CPU times.
    """

    engine: Engine
    clock: TraceClock
    offset: int
    now: int
    is_current: bool
    is_recorded: bool
    callback_ended: Callable[[Any, BaseException | None, int], bool] | None
    outer_groups: Any

    @property
    def lending(self) -> Lending:
        """Return what lends workers."""

    def note_eager(self, entity: Entity) -> None:
        """Note whether a thread must wait for an entity's messages or requests, at any time."""


RUNS = object()
"""The outcome of an execution that has begun, and whose callback has not returned."""


class WorkerThread:
    """
    A thread that runs callbacks.

    :ivar name: its name in the text of an ``InvariantError``.
    :ivar work: the running execution.
    :ivar worker: the number of its last worker in the core.
    :ivar state: what it does; only the pool changes it.
    :ivar permit: a lock, released to let its callback go on.
    :ivar has_lent: whether its callback has lent its worker at any time.
    :ivar is_out: whether its callback has no worker now.
    :ivar waits: whether its callback waits inside ``Client.call``, or spins.
    :ivar waits_for: what it waits for then; empty: it does not wait, or that is unknown.
    :ivar measurement: of its running callback; None: it is not measured.
    :ivar paused_ns: for how long the running callback has paused.
    :ivar pause: the pause of the callback that it has just overtaken.
    :ivar waits_since: since when it has waited in the epoll, on the trace's clock.
    :ivar is_copy: whether its callback has forked this process, which is the child.
    :ivar is_spare: whether its last callback has left the events to another thread.
    :ivar published: when the running callback first published (monotonic ns); 0: not yet.
    :ivar start: when its execution, or the one that has just ended, began, on the trace's clock.
    :ivar end: when it ended; 0: it runs.
    :ivar outcome: its exception, or the future that it waits for, if it goes on later; None: it
        has finished; ``RUNS``: it runs.
    """

    __slots__ = ('work', 'worker', 'permit', 'thread', 'vtid', 'ident', 'waits', 'published',
                 'state', 'is_spare', 'has_lent', 'pool', 'engine', 'start', 'end', 'outcome',
                 'waits_since', 'waits_for', 'is_out', 'measurement', 'pause', 'paused_ns',
                 'name', 'is_copy')

    def __init__(self, pool: Pool, thread: threading.Thread | None) -> None:
        self.pool = pool
        self.engine = pool.engine
        self.thread = thread
        self.name, self.waits_for = 'visitor', ''
        self.work: Work | None = None
        self.worker = 0
        self.permit = threading.Lock()
        self.permit.acquire()
        self.vtid = self.ident = 0
        self.waits = self.has_lent = self.is_out = False
        self.measurement: Measurement | None = None
        self.pause: Pause | None = None
        self.is_spare = self.is_copy = False
        self.state = ThreadState.RUNNING if thread is None else ThreadState.PARKED
        self.published = self.start = self.end = self.waits_since = self.paused_ns = 0
        self.outcome: Any = None

    def begin(self) -> None:
        """Note the ids of the calling thread."""
        self.vtid, self.ident = threading.get_native_id(), threading.get_ident()

    @property
    def since(self) -> int:
        """Return when the running execution began, on the trace's clock; 0: none runs."""
        return 0 if self.end else self.start

    def is_short(self) -> bool:
        """Return whether the thread runs a short callback that has its worker."""
        work = self.work
        return work is not None and not self.is_out and (
            work.entity.wall_ns <= SHORT_CALLBACK_NS
            or self.published > 0 and work.entity.tail_ns <= SHORT_CALLBACK_NS)

    def wait_for_pause(self) -> None:
        """Wait until the callback that this one has just overtaken has paused."""
        pause, self.pause = self.pause, None
        if pause is not None:
            pause.wait_for_it()

    def publishes(
        self, publisher: Any, state: PublisherState, msg: Any, of: Work | None = None
    ) -> None:
        """Note that the running callback publishes; ``of``: on behalf of this execution."""
        topic, work, engine = state.topic, of or self.work, self.engine
        if engine.notes_publications:
            engine.publishes(
                work, publisher, state, msg, self.pool.clock.now(), self.vtid, of is not None)
        if work is not None and topic not in work.entity.publishes:
            work.entity.publishes.add(topic)
        if not self.published:
            self.published = monotonic_ns()

    def lend(self, waits_for: str = '') -> Any:
        """
        Lend the worker while entered: the callback waits for a service, or spins.

        :param waits_for: what it waits for, in words.
        """
        work = self.work
        group = None if work is None else self.pool.outer_groups.get(work.entity.outer)
        lent = self.pool.lending.lend(self, waits_for)
        return lent if group is None else self._lend_in(group, lent)

    @contextmanager
    def _lend_in(self, group: Any, lent: AbstractContextManager[None]) -> Iterator[None]:
        with group.nested(), lent:
            yield

    @property
    def job(self) -> tuple[str, int, int] | None:
        """Return DAG, index and release of the job whose callback runs; None: no job."""
        return None if self.work is None else self.engine.job_of(self.work)

    def execute(self) -> None:
        """Run its execution until that ends or waits."""
        work: Any = self.work
        pool = self.pool
        entity = work.entity
        habit, gate, group = entity.habit, entity.gate, entity.exclusive
        must_check = not pool.is_current or (
            entity.may_be_gone and work.ready_ns != pool.now)  # else it was just checked
        measurement = None
        if habit.rests < 1 or pool.is_recorded:
            measurement = self.measurement = Measurement(habit)
        self.published = self.paused_ns = 0
        self.outcome = RUNS
        if self.pause is not None:
            self.wait_for_pause()
        start = self.start = monotonic_ns() + pool.offset
        self.end = 0
        try:
            if group is not None and work.coroutine is None and (
                    not group.beginning_execution(entity.rclpy_object)):
                raise Refused
            self.outcome = (
                work.run(must_check) if gate is None else gate(work, must_check))
        except Refused as error:
            self.outcome, self.end = error, start
            return
        except BaseException as error:
            self.outcome = from_user_code(error)
        if self.is_copy:
            end_copy(work, self.outcome)
        if group is not None and (
                self.outcome is None or isinstance(self.outcome, BaseException)):
            group.ending_execution(entity.rclpy_object)
        end = self.end = monotonic_ns() + pool.offset
        wall = end - start - self.paused_ns
        if measurement is None and wall <= SHORT_CALLBACK_NS >= entity.wall_ns:
            habit.rests -= 1  # an average of short executions stays short without a measurement
            if self.published:
                tail = end - pool.offset - self.published
                entity.tail_ns += (tail - entity.tail_ns) >> 3
        else:
            self._note_times(work, measurement, wall)
        if pool.callback_ended is not None and not isinstance(self.outcome, BaseException):
            pool.callback_ended(entity.rclpy_object, None, entity.outer)

    def _note_times(self, work: Work, measurement: Measurement | None, wall: int) -> None:
        """Note how long its execution took, and when that published."""
        entity = work.entity
        habit = entity.habit
        if measurement is None:
            habit.rests -= 1
        else:
            work.cpu_ns += measurement.end()
            self.measurement = None
        if wall > SHORT_CALLBACK_NS:
            if (measurement is None or not measurement.is_complete) and not self.has_lent:
                habit.waited(wall)
            habit.rest_less()
        entity.wall_ns += (wall - entity.wall_ns) >> 3 if entity.ran else wall - entity.wall_ns
        self.pool.note_eager(entity)
        if self.published:
            tail = self.end - self.pool.offset - self.published
            entity.tail_ns += (tail - entity.tail_ns) >> 3
