# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A plugin of pytest that breaks the executor on purpose, and notes how the tests noticed.

It is applied in a process of its own (see ``driver``), before any test is collected.  ``report``
gets a line of JSON when a test begins, and one for each phase of it that fails and for the end of
its call.  So a test that never ended shows as well: it has only begun.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
import json
from pathlib import Path
import threading
import time
from typing import Any

from mddag_executor.core import policies, tally
from mddag_executor.core.state import COMPLETED, IDLE, JOB_END, LATE, OPEN
from mddag_executor.executor import executor
from mddag_executor.executor.compat import BareTask
from mddag_executor.executor.engine import Engine
from mddag_executor.executor.entity import Entity, TASK
from mddag_executor.executor.intake.events import EventsIntake
from mddag_executor.executor.intake.sources import ClientSource
from mddag_executor.executor.intake.waitset import WaitSetIntake
from mddag_executor.executor.jobs import Jobs, Origin
from mddag_executor.executor.pool import Pool
from mddag_executor.executor.receiver import Receiver
from mddag_executor.executor.work import TaskWork, Work
import pytest

MUTATIONS: dict[str, Callable[[], None]] = {}
MEANING: dict[str, str] = {}

silent = threading.local()
"""``silent.on``: what the calling thread does wakes nobody who spins."""


def mutation(meaning: str) -> Callable[[Callable[[], None]], Callable[[], None]]:
    def enter(function: Callable[[], None]) -> Callable[[], None]:
        MUTATIONS[function.__name__] = function
        MEANING[function.__name__] = meaning
        return function
    return enter


def replace(owner: Any, name: str, make: Callable[[Any], Any]) -> None:
    """Replace a method by what ``make`` makes of it."""
    setattr(owner, name, make(getattr(owner, name)))


# --- which callback, and when --------------------------------------------------------------------


@mutation('Callbacks of one mutually exclusive group run at once.')
def groups_ignored() -> None:
    def make(init: Any) -> Any:
        def broken(self: Entity, *args: Any) -> None:
            init(self, *args)
            self.group = -1
        return broken
    replace(Entity, '__init__', make)


@mutation('Callbacks run in the order of becoming ready, whatever their deadlines.')
def rad_is_fifo() -> None:
    policies.POLICIES['rad'] = policies.POLICIES['rad']._replace(key=policies.key_fifo)


@mutation("All messages wait that come, however many the queue's depth allows.")
def depth_not_kept() -> None:
    def make(message: Any) -> Any:
        def broken(self: Engine, work: Work, *args: Any) -> None:
            work.entity.depth = 0
            message(self, work, *args)
        return broken
    replace(Engine, 'arrived', make)


@mutation('Of each kind of entity every twentieth callback does not run, and counts as run.')
def every_twentieth_lost() -> None:
    seen: Counter[str] = Counter()

    def make(step: Any) -> Any:
        def broken(self: Work) -> Any:
            if self.coroutine is None:
                seen[self.entity.kind] += 1
                if seen[self.entity.kind] % 20 == 0:
                    return None
            return step(self)
        return broken
    replace(Work, 'step', make)
    replace(TaskWork, 'step', make)


@mutation('Every twentieth response does not complete its future.')
def every_twentieth_response_lost() -> None:
    count = 0

    def make(arrived: Any) -> Any:
        def broken(*args: Any) -> None:
            nonlocal count
            count += 1
            if count % 20:
                arrived(*args)
        return broken
    replace(ClientSource, 'arrived', make)


# --- coroutines, exceptions, waking, the end -----------------------------------------------------


@mutation('A coroutine that has been suspended never goes on.')
def coroutines_not_resumed() -> None:
    replace(Engine, 'resume', lambda resume: lambda self, work: None)


@mutation("A coroutine never goes on that awaits something other than one of rclpy's futures.")
def unknown_waits_not_resumed() -> None:
    def make(look_around: Any) -> Any:
        def broken(self: Pool) -> Any:
            self._polled.clear()
            return look_around(self)
        return broken
    replace(Pool, 'look_around', make)


@mutation('A task of rclpy 7.1.9 goes on by itself as well, so it does so twice.')
def tasks_go_on_by_themselves() -> None:
    del BareTask._add_resume_callback


@mutation('What a callback raises does not come out of spin.')
def exceptions_swallowed() -> None:
    def broken(self: Any, error: BaseException) -> None:
        self._ring()
    executor.MultiDeadlineExecutor._fail = broken  # type: ignore[method-assign]


@mutation('What fails while something is taken does not come out of spin.')
def exceptions_of_the_intake_swallowed() -> None:
    replace(Receiver, 'on_intake_error', lambda on_error: lambda self, error: None)


@mutation('A task of a spinning executor is there, and nobody notices.')
def create_task_does_not_wake_workers() -> None:
    def make(report: Any) -> Any:
        def broken(self: Pool, event: Any, *args: Any) -> None:
            if event == self.engine.ready and args[0].entity.kind == TASK:
                with self.lock:
                    event(*args, self.tick())
            else:
                report(self, event, *args)
        return broken
    replace(Pool, 'report', make)


@mutation('A task does not end the wait of a spin_once.')
def create_task_does_not_wake_spin_once() -> None:
    _wakes_nobody(executor.MultiDeadlineExecutor, 'create_task')


@mutation('A node that is added is noted, and whoever spins does not notice.')
def add_node_does_not_wake() -> None:
    _wakes_nobody(executor.MultiDeadlineExecutor, 'add_node')


def _wakes_nobody(owner: Any, name: str) -> None:
    def make_deaf(ring: Any) -> Any:
        return lambda self: None if getattr(silent, 'on', False) else ring(self)

    def make(method: Any) -> Any:
        def broken(*args: Any, **kwargs: Any) -> Any:
            before, silent.on = getattr(silent, 'on', False), True
            try:
                return method(*args, **kwargs)
            finally:
                silent.on = before  # rclpy calls add_node in add_node
        return broken
    replace(executor.MultiDeadlineExecutor, '_ring', make_deaf)
    replace(owner, name, make)


@mutation('A shutdown ends no worker thread, and says that it has.')
def shutdown_leaves_workers() -> None:
    def broken(self: Pool, timeout: float | None) -> bool:
        self.pause()
        return True
    Pool.close = broken  # type: ignore[method-assign]


@mutation('The threads of the intake go on when the spin has ended.')
def shutdown_leaves_intake() -> None:
    for kind in (EventsIntake, WaitSetIntake):
        replace(kind, 'stop', lambda stop: lambda self: None)


# --- jobs and verdicts ---------------------------------------------------------------------------


@mutation("A job's release is when its timer was looked at, and not when it was due.")
def release_is_when_noticed() -> None:
    def make(take_in: Any) -> Any:
        def broken(self: Receiver, arrivals: Sequence[Work]) -> None:
            for work in arrivals:
                if work.due is not None:
                    work.due = time.monotonic_ns()
            take_in(self, arrivals)
        return broken
    replace(Receiver, 'take_in', make)


@mutation('A message belongs to the oldest open job that still waits for one like it.')
def messages_go_to_the_oldest_job() -> None:
    def make(start: Any) -> Any:
        def broken(self: Engine, work: Work, origin: Origin, now: int) -> Any:
            target = work.entity.targets.get(origin.vertex)
            state = self.scheduler.state
            waits = []
            for slot in range(len(state.job_dag)) if target is not None else ():
                if state.job_dag[slot] == origin.dag and state.job_state[slot] == OPEN:
                    x = state.job_base[slot] + self.tables.region_offset[target[0]] + target[1]
                    if state.x_state[x] == IDLE:
                        waits.append((state.job_index[slot], slot))
            if waits:
                job, slot = min(waits)
                origin = Origin(slot, origin.dag, job, origin.vertex)
            return start(self, work, origin, now)
        return broken
    replace(Engine, '_start_successor', make)


@mutation('A message belongs to the job before that of its publication.')
def messages_go_to_the_job_before() -> None:
    def make(find: Any) -> Any:
        def broken(self: Jobs, *args: Any) -> Origin | None:
            origin = find(self, *args)
            broken.last, before = origin, broken.last  # type: ignore[attr-defined]
            return before if origin is not None and before is not None else origin
        broken.last = None  # type: ignore[attr-defined]
        return broken
    replace(Jobs, 'find', make)


@mutation('A sink that completes after its deadline counts as completed only.')
def late_sinks_counted_in_time() -> None:
    def make(done: Any) -> Any:
        def broken(self: tally.SinkTally, response: int, late: bool) -> None:
            done(self, response, False)
        return broken
    replace(tally.SinkTally, 'done', make)


@mutation('A job of which a sink was late counts as one that completed in time.')
def late_jobs_counted_in_time() -> None:
    def make(add: Any) -> Any:
        def broken(self: tally.Tally, decisions: Any) -> None:
            add(self, [
                (kind, dag, vertex, job, COMPLETED if kind == JOB_END and end == LATE else end,
                 when) for kind, dag, vertex, job, end, when in decisions])
        return broken
    replace(tally.Tally, 'add', make)


# --- what pytest calls ---------------------------------------------------------------------------


report = Path()


def note(**what: Any) -> None:
    with report.open('a', encoding='utf-8') as lines:
        lines.write(json.dumps(what) + '\n')


def pytest_runtest_logstart(nodeid: str) -> None:
    note(test=nodeid, outcome='begun')


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: Any) -> Iterator[Any]:
    phase = yield
    if phase.failed or phase.when == 'call':
        note(test=item.nodeid, when=phase.when, outcome=outcome_of(phase, call),
             seconds=round(phase.duration, 3))
    return phase


def outcome_of(phase: Any, call: Any) -> str:
    """Return ``passed``, ``assertion`` (of the test, or of a fixture's end) or ``error``."""
    if not phase.failed:
        return str(phase.outcome)
    judged = (AssertionError, pytest.fail.Exception)
    return 'assertion' if call.excinfo.errisinstance(judged) else 'error'
