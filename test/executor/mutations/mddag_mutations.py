# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A plugin of pytest that breaks the executor on purpose, and notes how the tests noticed.

MDDAG_MUTATION names the mutation ('': none).  The file MDDAG_MUTATION_REPORT gets a line of JSON
when a test begins, and one for each phase of it that fails and for the end of its call.  So a test
that never ended shows as well: it has only begun.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
import json
import os
from pathlib import Path
import threading
import time
from typing import Any

from mddag_executor.core import policies, tally
from mddag_executor.core.state import COMPLETED, IDLE, JOB_END, LATE, OPEN
from mddag_executor.executor import compat, executor
from mddag_executor.executor.compat import BareTask
from mddag_executor.executor.due import Muting
from mddag_executor.executor.engine import Engine
from mddag_executor.executor.entity import Entity, TASK
from mddag_executor.executor.jobs import Jobs, Origin
from mddag_executor.executor.loop import EventLoop
from mddag_executor.executor.sources import Source
from mddag_executor.executor.timers import TimerQueue, TimerSource
from mddag_executor.executor.waitables import WaitableSource, WaitSetThread
from mddag_executor.executor.work import TaskWork, Work
from mddag_executor.executor.workers import WorkerPool
import pytest
from rclpy.task import Future

MUTATIONS: dict[str, Callable[[], None]] = {}
MEANING: dict[str, str] = {}

silent = threading.local()
"""``silent.on``: what the calling thread does wakes no spinning thread."""


def mutation(meaning: str) -> Callable[[Callable[[], None]], Callable[[], None]]:
    def enter(function):
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
    def make(init):
        def broken(self, *args):
            init(self, *args)
            self.group = -1
        return broken
    replace(Entity, '__init__', make)


@mutation('Callbacks run in the order of becoming ready, whatever their deadlines.')
def rad_is_fifo() -> None:
    policies.POLICIES['rad'] = policies.POLICIES['rad']._replace(key=policies.key_fifo)


@mutation("All messages wait that come, however many the queue's depth allows.")
def depth_not_kept() -> None:
    def make(message):
        def broken(self, work, *args):
            work.entity.depth = 0
            message(self, work, *args)
        return broken
    replace(Engine, 'arrived', make)
    replace(Engine, 'ready', make)


@mutation('Of each kind of entity every twentieth callback does not run, and counts as run.')
def every_twentieth_lost() -> None:
    seen: Counter[str] = Counter()

    def make(step):
        def broken(self, *args):
            if self.coroutine is None:
                seen[self.entity.kind] += 1
                if seen[self.entity.kind] % 20 == 0:
                    return None
            return step(self, *args)
        return broken
    replace(Work, 'step', make)
    replace(TaskWork, 'step', make)


@mutation('Every twentieth response does not complete its future.')
def every_twentieth_response_lost() -> None:
    count = 0

    def make(complete):
        def broken(*args):
            nonlocal count
            count += 1
            if count % 20:
                complete(*args)
        return broken
    replace(compat, 'complete_request', make)


@mutation('What was left in the middleware since enough waits is never collected.')
def rest_not_collected() -> None:
    def make(collect):
        def broken(self, left=0):
            collect(self, left)
            self.entity.collect_more = None
        return broken
    replace(Source, 'collect', make)


@mutation('Subscriptions that publishing threads have taken from announce nothing any more.')
def held_subscriptions_not_released() -> None:
    replace(EventLoop, 'release', lambda release: lambda self, sources: None)
    # which would register them again
    replace(Muting, 'classify', lambda classify: lambda self, source: None)


@mutation('A timer that is reset is not looked at.')
def resets_of_timers_not_noticed() -> None:
    replace(TimerSource, 'collect', lambda collect: lambda self: None)


# --- what is woken -------------------------------------------------------------------------------


@mutation('While one worker runs something, no other one waits for what arrives.')
def one_worker_at_a_time() -> None:
    def make(admit):
        def broken(self):
            if len(self._parked) == len(self._threads) or self._closed:
                admit(self)
        return broken
    replace(WorkerPool, '_admit', make)


@mutation('What was muted while a callback computed stays muted.')
def muted_for_ever() -> None:
    replace(EventLoop, 'unmute', lambda unmute: lambda self: [])


@mutation('While a callback computes, threads wake for what cannot start.')
def nothing_muted() -> None:
    replace(EventLoop, 'mute', lambda mute: lambda self, bound: None)


@mutation('While a callback computes, no thread wakes for what holds the GIL, however urgent.')
def urgent_ones_muted() -> None:
    replace(EventLoop, 'mute', lambda mute: lambda self, bound: mute(self, 0))


# --- coroutines, exceptions, waking, the end -----------------------------------------------------


@mutation('A coroutine that has been suspended never goes on.')
def coroutines_not_resumed() -> None:
    replace(Engine, 'resume', lambda resume: lambda self, work: None)


@mutation("A coroutine never goes on that yields without awaiting one of rclpy's futures.")
def unknown_waits_not_resumed() -> None:
    def mutant(settle):
        def settle_end(self, work, outcome):
            if isinstance(outcome, (type(None), BaseException, Future)):
                settle(self, work, outcome)

        return settle_end

    replace(WorkerPool, '_settle_end', mutant)


@mutation('A task of rclpy 7.1.9 goes on by itself as well, so it does so twice.')
def tasks_go_on_by_themselves() -> None:
    del BareTask._add_resume_callback


@mutation('What a callback raises does not come out of spin.')
def exceptions_swallowed() -> None:
    def broken(self, error):
        self._at_once.ring()
    executor.MultiDeadlineExecutor._fail = broken  # type: ignore[method-assign]


@mutation('What fails while something is taken does not come out of spin.')
def exceptions_of_takes_swallowed() -> None:
    def make(init):
        def broken(self, *args):
            init(self, *args[:-1], lambda error: None)
        return broken
    for kind in (Source, WaitableSource, WaitSetThread):
        replace(kind, '__init__', make)


@mutation('A task of a spinning executor is there, and no thread notices.')
def create_task_does_not_wake_workers() -> None:
    def make(report):
        def broken(self, event, *args):
            if event == self.engine.ready and args[0].entity.kind == TASK:
                with self.lock:
                    event(*args, self.tick())
            else:
                report(self, event, *args)
        return broken
    replace(WorkerPool, 'report', make)


@mutation('A task does not end the wait of a spin_once.')
def create_task_does_not_wake_spin_once() -> None:
    _wakes_no_thread(executor.MultiDeadlineExecutor, 'create_task')


@mutation('A node that is added is noted, and the spinning thread does not notice.')
def add_node_does_not_wake() -> None:
    _wakes_no_thread(executor.MultiDeadlineExecutor, 'add_node')


def _wakes_no_thread(owner: Any, name: str) -> None:
    def make_deaf(wake):
        return lambda self: None if getattr(silent, 'on', False) else wake(self)

    def make(method):
        def broken(*args, **kwargs):
            before, silent.on = getattr(silent, 'on', False), True
            try:
                return method(*args, **kwargs)
            finally:
                silent.on = before  # rclpy calls add_node in add_node
        return broken
    replace(EventLoop, 'wake', make_deaf)
    replace(owner, name, make)


@mutation('A shutdown ends no worker thread, and says that it has.')
def shutdown_leaves_workers() -> None:
    def broken(self, timeout):
        self.pause()
        return True
    WorkerPool.close = broken  # type: ignore[method-assign]


@mutation('The thread that waits in a wait set goes on when the spin has ended.')
def shutdown_leaves_wait_set() -> None:
    replace(WaitSetThread, 'stop', lambda stop: lambda self: None)


# --- jobs and verdicts ---------------------------------------------------------------------------


@mutation("A job's release is when its timer was looked at, and not when it was due.")
def release_is_when_noticed() -> None:
    def make(fire):
        def broken(self):
            for work, _, *missed in fire(self):
                yield work, time.monotonic_ns(), *missed
        return broken
    replace(TimerQueue, 'fire', make)


@mutation('A message belongs to the oldest open job that still waits for one like it.')
def messages_go_to_the_oldest_job() -> None:
    def make(start):
        def broken(self, work, origin, now):
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
    def make(publish):
        before: dict[str, Origin] = {}

        def broken(self, send, publisher, msg, state, topic, origin):
            origin, before[state.topic] = before.get(state.topic, origin), origin
            return publish(
                self, send, publisher, msg, state, topic, origin)
        return broken
    replace(Jobs, 'publish', make)


@mutation('A sink that completes after its deadline counts as completed only.')
def late_sinks_counted_in_time() -> None:
    def make(done):
        def broken(self, response, late):
            done(self, response, False)
        return broken
    replace(tally.SinkTally, 'done', make)


@mutation('A job of which a sink was late counts as one that completed in time.')
def late_jobs_counted_in_time() -> None:
    def make(add):
        def broken(self, decisions):
            add(self, [
                (kind, dag, vertex, job, COMPLETED if kind == JOB_END and end == LATE else end,
                 when) for kind, dag, vertex, job, end, when in decisions])
        return broken
    replace(tally.Tally, 'add', make)


# --- what pytest calls ---------------------------------------------------------------------------




def pytest_configure() -> None:
    if name := os.environ['MDDAG_MUTATION']:
        MUTATIONS[name]()


def note(**what: Any) -> None:
    with Path(os.environ['MDDAG_MUTATION_REPORT']).open('a', encoding='utf-8') as lines:
        lines.write(json.dumps(what) + '\n')


def pytest_runtest_logstart(nodeid: str) -> None:
    note(test=nodeid, outcome='begun')


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
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
