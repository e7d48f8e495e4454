# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The executor: rclpy's contract on top of intake, core and workers.

Theory of operation
-------------------
``spin`` starts the intake threads and lets the workers run; the calling thread then only looks
after the executor: it takes note of entities that come and go, resumes what cannot say when it
is ready, and ends the spin on an exception, a shutdown, a done future or a time-out.

``spin_once`` uses no thread at all: one wait set over everything hands over what is ready, and the
calling thread runs the one callback that the core puts first.

Whatever has been taken and not run yet stays with the core and runs with the next spin.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
import gc
import os
import threading
import time
from typing import Any, TYPE_CHECKING

from mddag_executor.clocks import TraceClock
from mddag_executor.core import DEFAULT_DEADLINE_NS, EXPIRE_AFTER_NS, MAX_ACTIVE_JOBS
from mddag_executor.core.policies import policy as find_policy
from mddag_executor.live import hooks, settings
from mddag_executor.live.alarm import Bell
from mddag_executor.live.announcements import Announcements
from mddag_executor.live.compat import (
    BareExecutor,
    is_called_by_spin,
    RCL_ERRORS,
    TASKS_NEWEST_FIRST,
)
from mddag_executor.live.cpu_order import CpuOrder, why_not
from mddag_executor.live.deadline_watch import MissLog
from mddag_executor.live.diagnostics import Diagnostics
from mddag_executor.live.engine import Engine
from mddag_executor.live.entity import Entity, TASK
from mddag_executor.live.groups import Groups
from mddag_executor.live.intake.events import EventsIntake
from mddag_executor.live.intake.waitset import ALL_KINDS, WaitSetIntake
from mddag_executor.live.interpreter import short_switch_interval
from mddag_executor.live.miss_notifier import MissNotifier
from mddag_executor.live.name_check import NameCheck
from mddag_executor.live.pool import Pool
from mddag_executor.live.rates import RateWatch
from mddag_executor.live.receiver import Receiver
from mddag_executor.live.recorder import Recorder
from mddag_executor.live.registry import Registry, Upkeep
from mddag_executor.live.seat import current
from mddag_executor.live.settings import Thresholds
from mddag_executor.live.shutdown import call_at_shutdown, halt_at_exit, is_over
from mddag_executor.live.statistics import statistics
from mddag_executor.live.statistics_types import Statistics
from mddag_executor.live.stop_watch import StopWatch
from mddag_executor.live.tasks import make_task, Unclaimed
from mddag_executor.live.verdicts import DeadlineMiss
from mddag_executor.live.work import QuickCallback, Work
from msg_graph import TaskSet
from rclpy.duration import Duration
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, TimeoutObject
from rclpy.logging import get_logger
from rclpy.task import Future, Task

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup
    from rclpy.context import Context
    from rclpy.node import Node
    from typing_extensions import Self

LOOK_AFTER_S = 0.1
"""How often ``spin`` looks whether the context is still there (signals only end the context)."""

SETTLE_TURNS = 20
"""So many milliseconds after a future is done its action's callbacks may still take."""
SETTLED_TURNS = 3


def deadline_of(timeout_sec: float | None) -> float | None:
    """
    Return the monotonic time at which a time-out is over; None for never.

    :param timeout_sec: seconds; None or negative: for ever.
    :raises TypeError: when it is no number.
    """
    if timeout_sec is None or timeout_sec < 0:
        return None
    return time.monotonic() + timeout_sec


class MultiDeadlineExecutor(BareExecutor):
    """
    Run callbacks in the order that their deadlines need, on a bounded pool of workers.

    What works with ``rclpy.executors.MultiThreadedExecutor`` works with it.  Callbacks of declared
    DAG tasks get the priority RAD, the reference absolute deadline of the multi-deadline DAG
    model (Yano and Azumi, RTSS 2024 WiP); others that of ``default_deadline`` after they became
    ready.

    :param graph: a declaration (path of a YAML file), a ``msg_graph.TaskSet``, or None.
    :param num_workers: threads of the pool; by default what the declaration says, else seven.
    :param policy: ``rad`` or another of ``mddag_executor.core.POLICIES``.
    :param context: the context that the executor belongs to, or None for the default one.
    :param trace: path of an MCAP file to record to, or None. A file that is there already is kept:
        the constructor raises, unless ``overwrite`` is true.
    :param on_deadline_miss: called with each ``DeadlineMiss``, in a thread of its own; what it
        raises comes out of the spin.  If it takes too long, misses are counted and not reported
        (``unreported_misses`` in ``statistics()``).
    :param default_deadline: relative deadline of undeclared callbacks: ns, text as ``100ms``, or
        an rclpy ``Duration``.
    :param intake: ``events``, ``waitset`` or ``auto`` (events where this rclpy has them).
    :param worker_policy: real-time policy of the workers, ``SCHED_FIFO`` or ``SCHED_RR``.
    :param worker_priority: their priority under it.
    :param worker_cpus: the CPUs that they may use.
    :param freeze_gc: when the first spin begins, collect garbage and have the collector leave
        alone what there is by then (``gc.freeze``): for programs that make their nodes first.
    :param diagnostics_period: how often to publish on ``/diagnostics`` while it spins: as
        ``default_deadline``; None or 0: not at all.
    :param thresholds: what makes a status of the diagnostics worse than OK.
    :param process: which of the declared ``processes`` this is; what runs in the others is not
        counted as missing.
    :param cpu_order: whether workers are less nice the more urgent what they run is (see
        ``live.cpu_order``); off, and said in the log, where the user may not.
    :param preempt: whether callbacks that compute in Python pause for more urgent ones (Python
        3.12 and newer; ``statistics()['preemption']`` says whether they do).
    :param num_threads: ``num_workers`` under the name that ``MultiThreadedExecutor`` has for it.
    :param overwrite: whether ``trace`` may replace a file.
    :raises msg_graph.GraphError: when the declaration is not right.
    :raises mddag_executor.errors.MddagError: on an unknown policy, intake or thread setting, a
        value of the wrong kind, and when the trace cannot be written.
    :raises rclpy.exceptions.NotInitializedException: when ``rclpy.init`` was not called before.
    """

    def __init__(
        self,
        graph: str | os.PathLike[str] | TaskSet | None = None,
        num_workers: int | None = None,
        *,
        policy: str = 'rad',
        context: Context | None = None,
        trace: str | os.PathLike[str] | None = None,
        on_deadline_miss: Callable[[DeadlineMiss], None] | None = None,
        default_deadline: int | str | Duration = DEFAULT_DEADLINE_NS,
        intake: str = 'auto',
        max_active_jobs: int = MAX_ACTIVE_JOBS,
        worker_policy: str | None = None,
        worker_priority: int | None = None,
        worker_cpus: Iterable[int] | None = None,
        freeze_gc: bool = False,
        diagnostics_period: int | str | Duration | None = None,
        thresholds: Thresholds | None = None,
        process: str | None = None,
        preempt: bool = False,
        cpu_order: bool = False,
        num_threads: int | None = None,
        overwrite: bool = False,
    ) -> None:
        task_set, num_workers, deadline_ns = settings.resolve(
            graph, num_workers, default_deadline, intake, num_threads)
        prepare = settings.thread_setting(worker_policy, worker_priority, worker_cpus)
        every_ns = settings.diagnostics_period_ns(diagnostics_period)
        max_active_jobs = settings.whole_number(
            'max_active_jobs', max_active_jobs, settings.MOST_JOBS)
        settings.check_callable('on_deadline_miss', on_deadline_miss)
        find_policy(policy)
        settings.check_context(context)
        settings.check_process(process, task_set)
        thresholds = settings.check_thresholds(thresholds)
        # All is checked by now: nothing below leaves a trace or a thread of what can't be made.
        hooks.install()
        self._trace_clock = TraceClock()
        self._recorder = None if trace is None else Recorder(
            os.fspath(trace), task_set, policy, num_workers, deadline_ns, max_active_jobs,
            self._trace_clock, overwrite=overwrite)
        self._errors: deque[BaseException] = deque()
        self._process = process
        self._unclaimed = Unclaimed(self._fail)
        self._attention = Bell()
        self._spinning = threading.Lock()
        self._finished = False
        self._ended_by_callback = False
        # reentrant: a signal's handler may end the run in the thread that ends it
        self._ending = threading.RLock()
        self._freeze_gc = freeze_gc
        self._notifier = None if on_deadline_miss is None else MissNotifier(
            on_deadline_miss, self._fail)
        self._engine = Engine(
            task_set, num_workers, policy, default_deadline=deadline_ns,
            max_active_jobs=max_active_jobs, expire_after=EXPIRE_AFTER_NS,
            record=self._recorder.record if self._recorder else None,
            on_miss=None if self._notifier is None else self._notifier.post, process=process)
        self._pool = Pool(
            self._engine, self._trace_clock, self._fail, self._context_ended, prepare,
            bool(preempt))
        if cpu_order:
            reason = why_not()
            if reason is None:
                self._pool.cpu_order = CpuOrder(self._engine)
            else:
                get_logger('mddag_executor').warning(f'cpu_order: it is off: {reason}')
        if self._pool.preemption is not None and self._pool.preemption.reason:
            get_logger('mddag_executor').warning(
                f'preempt: it is off: {self._pool.preemption.reason}')
        self._pool.pump = self._pump
        self._miss_log = MissLog(self._engine.verdicts)
        self._pool.after_judging = self._miss_log.write
        self._pool.relieve_intake = self._relieve_intake
        self._stop_watch = StopWatch(
            self._attention, self._stopped, look=self._look_at_late)
        self._registry = Registry(task_set, self._engine, self._pool.leave_group)
        self._receiver = Receiver(
            self._pool, self._registry, self, self._fail, self._recorder)
        self._new_tasks: deque[Work] = deque()
        self._task_entity = Entity(TASK, None, '', None, -1, 0, '')
        if self._recorder is not None:
            self._recorder.entities((), [self._task_entity])
        self._rates = RateWatch(self._registry)
        self._names = NameCheck(task_set, self._registry, process)
        self._groups = Groups(self, self.wake, self._hand_over)
        self._announcements: Announcements | None = None
        self._upkeep = Upkeep(
            self._nodes_to_look_after, self._registry, self._pool, self._recorder)
        self._intake: EventsIntake | WaitSetIntake | None = None
        self._stepping: WaitSetIntake | None = None
        super().__init__(context=context)
        self._diagnostics: Diagnostics | None = None
        if every_ns is not None:
            self._diagnostics = Diagnostics(
                self.context, task_set, self._pool, self._registry, self._recorder, every_ns,
                thresholds, process, self._notifier)
        if process is not None and task_set is not None and (
                self._engine.other_processes is not None
                and self._engine.other_processes.announces):
            self._announcements = Announcements(
                task_set, process, self.context, self._engine, self._pool.lock,
                self._trace_clock, self._receiver.give)
            self._receiver.announcements = self._announcements
            self._registry.own = {*self._announcements.subscriptions}
        self._intake_kind = intake
        # What is ready still would run before the spin notices.
        call_at_shutdown(self.context, self._pool.start_no_more)
        call_at_shutdown(self.context, self._context_ends)
        halt_at_exit(self)

    def _nodes_to_look_after(self) -> list[Any]:
        nodes = self._groups.served_nodes()
        return nodes if self._announcements is None else [*nodes, self._announcements.node]

    def _context_ended(self) -> bool:
        return is_over(self.context)

    def _context_ends(self) -> None:
        """Note whether a callback of this executor ends the context."""
        running = current.running
        self._ended_by_callback = (
            running is not None and running.engine is self._engine
            or self._notifier is not None and self._notifier.is_calling())
        self.wake()

    # --- nodes and callback groups ---------------------------------------------------------------

    def add_node(self, node: Node) -> bool:
        """
        Add a node whose callbacks this executor runs; False when it has it already.

        :raises TypeError: when it is no node.
        :raises RuntimeError: when the executor was shut down.
        """
        if not hasattr(node, 'executor'):
            raise TypeError(f'{node!r} is no node: add an rclpy.node.Node')
        if self.is_gone():
            raise RuntimeError('The executor was shut down: add the node to a new one')
        added: bool = super().add_node(node)
        if added:
            self.wake()
        return added

    def remove_node(self, node: Node) -> None:
        """
        Stop running a node's callbacks; another executor may then have it.

        While somebody spins, what was taken of its messages and not run yet is dropped.
        """
        super().remove_node(node)
        if self._pool.running:
            self._hand_over()
        else:
            self.wake()

    def add_callback_group(self, group: CallbackGroup, node: Node) -> None:
        """
        Run the callbacks of one group of a node, and of those that will be created in it.

        The executor that the node was added to, if there is one, runs the others.

        :raises RuntimeError: when the group has been added to an executor already, or rclpy's own
            executor has the node, which would run the group too.
        """
        self._groups.add(group, node)

    def remove_callback_group(self, group: CallbackGroup) -> None:
        """
        Stop running a group that was added by itself; who has its node runs it again.

        :raises RuntimeError: when it was not added to this executor.
        """
        self._groups.remove(group)

    def get_manually_added_callback_groups(self) -> list[CallbackGroup]:
        """Return the groups that were added one by one."""
        return self._groups.one_by_one()

    def get_automatically_added_callback_groups_from_nodes(self) -> list[CallbackGroup]:
        """Return the groups that came with their nodes."""
        return self._groups.from_nodes()

    def get_all_callback_groups(self) -> list[CallbackGroup]:
        """Return all groups that this executor runs."""
        return [*self._groups.one_by_one(), *self._groups.from_nodes()]

    def wake(self) -> None:
        """Take note of entities that were created or destroyed, or of a change of state."""
        self._upkeep.change()
        self._ring()

    def _ring(self) -> None:
        """End the wait of the thread that spins."""
        self._attention.ring()
        self.ring()

    def _hand_over(self) -> None:
        self._upkeep.hand_over()

    # --- tasks -----------------------------------------------------------------------------------

    def create_task(self, callback: Any, *args: Any, **kwargs: Any) -> Task:
        """Run a function or coroutine in this executor; return its task, which is a future."""
        if type(callback) is QuickCallback:
            task = Task(callback, args, kwargs)
            task()
            return task
        task, work = make_task(
            self._task_entity, self, self._pool.resume, self._unclaimed, callback, args, kwargs)
        is_spinning = self._spinning.locked()
        if is_spinning:
            self._pool.report(self._engine.ready, work)
        else:
            self._new_tasks.append(work)
        if not (is_spinning and self._pool.running):  # a spin that has just begun may not look
            self._ring()
        return task

    def _submit_tasks(self) -> None:
        """Have the tasks run that were created while nobody spun, in rclpy's order."""
        take = self._new_tasks.pop if TASKS_NEWEST_FIRST else self._new_tasks.popleft
        while self._new_tasks:
            self._pool.report(self._engine.ready, take())

    # --- what a host of programs needs -----------------------------------------------------------

    def on_callback_ended(
        self, listener: Callable[[Any, BaseException | None], bool]
    ) -> None:
        """
        Have a function called after each callback, in its thread.

        :param listener: gets rclpy's entity (None: a task), and what its callback raised, or None;
            returns whether it takes care of that, so that it does not end ``spin``.
        """
        self._pool.callback_ended = listener

    def lend(self) -> AbstractContextManager[None]:
        """Return what lends the worker of the calling callback, if it is one, while entered."""
        running = current.running
        return nullcontext() if running is None else running.lend()

    # --- spinning --------------------------------------------------------------------------------

    @property
    def is_spinning(self) -> bool:
        """Return whether somebody spins (rclpy from 7.1.9 on)."""
        return self._spinning.locked()

    def spin(self) -> None:
        """
        Run callbacks on the pool until shutdown.

        It returns also when a callback ends the context (``rclpy.shutdown``), and at once when
        that has ended before.

        :raises ExternalShutdownException: when something else ends the context.
        :raises RuntimeError: when the executor spins already.
        :raises Exception: what a callback raised.
        """
        with short_switch_interval(self._engine.preempts):
            self._spin(lambda: False, None)
        self._raise_error()  # of the callback that has ended the context, after that

    def spin_until_future_complete(
        self, future: Future, timeout_sec: float | None = None
    ) -> None:
        """Run callbacks on the pool until a future is done or the time is over."""
        future.add_done_callback(QuickCallback(self._attention.ring))
        try:
            with short_switch_interval(self._engine.preempts):
                self._spin(lambda: future.done() or future.cancelled(), timeout_sec)
        except ExternalShutdownException:
            pass

    def _spin(self, done: Callable[[], bool], timeout_sec: float | None) -> None:
        deadline = deadline_of(timeout_sec)
        if not self._spinning.acquire(blocking=False):
            raise RuntimeError('Executor is already spinning')
        try:
            if self.is_ending() or is_over(self.context):
                return
            if self._freeze_gc:
                self._freeze_gc = False
                gc.collect()
                gc.freeze()
            self._submit_tasks()  # as in rclpy, before what else is ready
            self._start_intake()
            self._pool.interpreter.looks_late = True
            if self._engine.dag_names:
                self._pool.watch.start()
            self._pool.start()
            self._stop_watch.start()
            while not self.is_ending():
                self._raise_error()
                if done():
                    self._settle()
                    self._raise_error()  # of what ran before it was done
                    return
                if self._was_ended():
                    return
                self._look_after()
                rest = self._upkeep.rest_s()
                if rest == 0.0:
                    self._upkeep.refresh()
                    rest = None
                left = min(LOOK_AFTER_S if rest is None else rest, self._pool.look_around())
                if deadline is not None:
                    left = min(left, deadline - time.monotonic())
                    if left <= 0:
                        return
                self._stop_watch.wait(left)
            self._raise_error()
        except RCL_ERRORS:
            if not self._was_ended():
                raise
        finally:
            self._pool.interpreter.looks_late = False
            self._pool.pause()
            self._stop_intake()
            if is_over(self.context):
                self._pool.close(0.5)
                self._end_run()
                if self._notifier is not None:
                    self._notifier.stop()
            self._spinning.release()

    def _settle(self) -> None:
        """
        Let run what belongs to a completed future's action, where there are any: its feedback.

        With one thread that was published before the answer which completed the future; with
        several it may take a moment longer.  So wait until nothing has been to do for a while.
        """
        if not self._upkeep.entities.waitables:
            return
        quiet = 0
        for _ in range(SETTLE_TURNS):
            quiet = quiet + 1 if self._pool.is_idle() else 0
            if quiet >= SETTLED_TURNS:
                return
            time.sleep(0.001)

    def _look_after(self) -> None:
        """Do what is to be done now and then while somebody spins."""
        self._submit_tasks()
        if self._rates.look() and self._registry.is_stale():
            self._upkeep.change()
        if self._announcements is not None:
            self._announcements.look()
        if self._diagnostics is not None:
            self._diagnostics.start()
        if self._notifier is not None:
            self._notifier.start()
        self._miss_log.write()
        self._names.check(self._engine.is_judging)

    def _was_ended(self) -> bool:
        """
        Return whether a callback has ended the context.

        :raises ExternalShutdownException: when something else has.
        """
        if not is_over(self.context):
            return False
        with suppress(InvalidHandle):
            self.context.ok()  # waits for the thread that is just ending it
        if not self._ended_by_callback:
            raise ExternalShutdownException()
        return True

    def _check_context(self) -> None:
        if is_over(self.context):
            raise ExternalShutdownException()

    def _start_intake(self) -> None:
        kind = self._intake_kind
        if kind == 'auto':
            kind = 'events' if EventsIntake.available() else 'waitset'
        intake: EventsIntake | WaitSetIntake
        if kind == 'events':
            intake = EventsIntake(
                self.context, self._receiver, on_shutdown=self._attention.ring,
                serve_here=self._pool.serve_here)
        else:
            intake = WaitSetIntake(
                self.context, self._receiver, self.guards(), on_shutdown=self._attention.ring)
        self._intake = intake
        self._upkeep.add_intake(intake)
        self._upkeep.refresh()
        intake.start()

    def _stop_intake(self) -> None:
        intake, self._intake = self._intake, None
        if intake is not None:
            intake.stop()
            self._upkeep.remove_intake(intake)

    def _relieve_intake(self, relieved: bool) -> None:
        intake = self._intake
        if isinstance(intake, EventsIntake):
            intake.relieve(relieved)

    def _look_at_late(self) -> None:
        """Look whether a callback has taken longer than expected; every 20 ms while it spins."""
        self._pool.relieve_late_intakes()
        self._pool.interpreter.look_at_late()

    def _stopped(self, begin: int, end: int) -> None:
        """Take note that no thread of the process ran from ``begin`` to ``end`` (monotonic)."""
        with self._pool.lock:
            self._engine.verdicts.stopped(
                begin + self._trace_clock.offset_ns, end + self._trace_clock.offset_ns)

    def _fail(self, error: BaseException) -> None:
        """Take an exception from a worker or the intake; it comes out of the spin."""
        self._errors.append(error)
        self._ring()

    def _raise_error(self) -> None:
        self._unclaimed.look()
        while self._errors:
            error = self._errors.popleft()
            # what others raised just because a callback has ended their context
            if not (self._ended_by_callback and isinstance(error, RCL_ERRORS)):
                raise error

    @contextmanager
    def _pump(self) -> Iterator[None]:
        """Let intake and workers run while the callback of a ``spin_once`` waits."""
        self._start_intake()
        self._pool.start()
        try:
            yield
        finally:
            self._pool.pause()
            self._stop_intake()

    # --- one callback at a time ------------------------------------------------------------------

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """
        Wait for one callback and run it in the calling thread.

        Called by ``rclpy.spin``, which would otherwise run one callback at a time, it does what
        ``spin`` does.

        :param timeout_sec: seconds to wait; None or negative: for ever; 0: do not wait.
        """
        if timeout_sec is None and is_called_by_spin():
            self.spin()
            return
        self._spin_once(timeout_sec, lambda: False)

    def spin_once_until_future_complete(
        self, future: Future, timeout_sec: float | TimeoutObject | None = None
    ) -> None:
        """Wait for one callback, or until a future is done, and run it."""
        seconds = timeout_sec.timeout if isinstance(timeout_sec, TimeoutObject) else timeout_sec
        future.add_done_callback(QuickCallback(self.wake))
        self._spin_once(seconds, lambda: future.done() or future.cancelled())

    def _spin_once(self, timeout_sec: float | None, done: Callable[[], bool]) -> None:
        deadline = deadline_of(timeout_sec)
        if not self._spinning.acquire(blocking=False):
            raise RuntimeError('Executor is already spinning')
        try:
            while not self.is_ending():
                self._check_context()
                self._look_after()
                self._raise_error()
                self._pool.stopped_at = 0
                ran = self._step(deadline, done)
                self._raise_error()
                if ran or done():
                    return
                if deadline is not None and time.monotonic() >= deadline:
                    return
        except RCL_ERRORS:
            self._check_context()
            raise
        finally:
            self._spinning.release()

    def _step(self, deadline: float | None, done: Callable[[], bool]) -> bool:
        """
        Handle what is ready, waiting where nothing is; run one callback if there is one.

        :param deadline: when to wait no longer (monotonic, s); None: never.
        :param done: whether there is nothing to wait for any more.
        :return: whether one ran.
        """
        if self._stepping is None:
            self._stepping = WaitSetIntake(
                self.context, self._receiver, self.guards(), ALL_KINDS)
            self._upkeep.add_intake(self._stepping)
        self._upkeep.refresh()
        self._pool.look_around()
        self._pool.judge_overdue()
        self._stepping.poll(0.0)
        self._submit_tasks()
        if self._pool.run_one():
            return True
        if done():  # what it woke up for has just been polled away
            return False
        self._stepping.poll(None if deadline is None else max(0.0, deadline - time.monotonic()))
        self._upkeep.refresh()
        self._submit_tasks()
        return self._pool.run_one()

    # --- the end ---------------------------------------------------------------------------------

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """
        Stop running callbacks and wait for those that run.

        :param timeout_sec: seconds to wait; None or negative: for ever; 0: do not wait.
        :return: whether everything has finished.
        """
        if timeout_sec is not None and timeout_sec < 0:
            timeout_sec = None
        self.begin_end()
        self.wake()
        self._pool.pause()
        if self._stepping is not None and self._spinning.acquire(blocking=False):
            self._stepping.stop()
            self._upkeep.remove_intake(self._stepping)
            self._stepping = None
            self._spinning.release()
        if not self._pool.close(timeout_sec):
            return False
        self._end_run()
        reported = self._notifier is None or self._notifier.stop(timeout_sec)
        finished: bool = super().shutdown(timeout_sec)
        return finished and reported

    def _end_run(self) -> None:
        """Judge what is open and close the trace, once; a second thread waits for that."""
        with self._ending:
            if not self._finished:
                self._finished = True
                self._judge_and_close()

    def _judge_and_close(self) -> None:
        if self._diagnostics is not None:
            self._diagnostics.stop()
        self._groups.release()
        if self._announcements is not None:
            self._announcements.close()
        with self._pool.lock:
            now = self._pool.tick()
            end = min(now, self._pool.stopped_at or now)
            self._engine.finish(now, end)
        if self._recorder is not None:
            self._recorder.close(now, end)

    def halt(self) -> None:
        """Start nothing more, since the interpreter ends; see ``wait_halted``."""
        self.begin_end()
        self._pool.pause()
        self.wake()

    def wait_halted(self, seconds: float) -> None:
        """Wait until what runs has ended and nobody spins, at most for a time."""
        end = time.monotonic() + seconds
        self._pool.close(seconds)
        # Not by taking the lock: a thread that steps once more meanwhile would get an exception.
        while self._spinning.locked() and time.monotonic() < end:
            time.sleep(0.001)

    def set_judging(self, judging: bool, since: int | None = None) -> None:
        """
        Give verdicts about jobs that are released from now on, or about none until called again.

        :param since: a time to judge from (monotonic ns), if that is not now.
        """
        if since is not None:
            since += self._trace_clock.offset_ns
        self._pool.report(self._engine.set_judging, judging, since)

    def unmatched(self) -> list[str]:
        """Return the topics on which it has not met the other processes of its DAGs yet."""
        self._upkeep.refresh()
        found = [] if self._announcements is None else self._announcements.unmatched()
        others = self._engine.other_processes
        try:
            if others is not None:
                found += others.unmatched(
                    [*self._registry.subscriptions()], self._groups.served_nodes())
        except InvalidHandle:
            pass  # destroyed meanwhile
        return found

    def __enter__(self) -> Self:
        """Return the executor; it is shut down at the end of the block."""
        super().__enter__()
        return self

    def statistics(self) -> Statistics:
        """Return a snapshot of what has happened so far: see ``Statistics`` for its keys."""
        return statistics(
            self._pool, self._registry, self._recorder, self._process, self._notifier)
