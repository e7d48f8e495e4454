# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The executor: rclpy's contract on top of engine and workers.

Theory of operation
-------------------
``spin`` lets the workers wait for events and run callbacks (``workers``).  Meanwhile the calling
thread waits for the end of the spin (an exception, a shutdown, a done future, a timeout), for new
and destroyed entities (``upkeep``), and for arrivals that are handled at once (``at_once``).

``spin_once`` is one turn of a worker in the calling thread.

Collected messages that have not run yet stay in the core and run with the next spin.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
import math
import os
import select
import threading
import time
from typing import Any, TYPE_CHECKING
import weakref

from mddag_executor.clocks import TraceClock
from mddag_executor.core import DEFAULT_DEADLINE_NS, EXPIRE_AFTER_NS, MAX_ACTIVE_JOBS
from mddag_executor.core.policies import policy as find_policy
from mddag_executor.executor import publishing, settings
from mddag_executor.executor.announcements import Announcements
from mddag_executor.executor.at_once import AtOnce, SignalPipe
from mddag_executor.executor.compat import (
    BareExecutor,
    heritage_of_response,
    is_called_by_spin,
    is_quick,
    QuickCallback,
    RCL_ERRORS,
    set_done,
    TASKS_NEWEST_FIRST,
)
from mddag_executor.executor.diagnostics import Diagnostics
from mddag_executor.executor.ending import Ending
from mddag_executor.executor.engine import Engine
from mddag_executor.executor.gil import short_switch_interval
from mddag_executor.executor.interrupts import InterruptsDeferred, wait_readable
from mddag_executor.executor.loop import raise_limit
from mddag_executor.executor.misses import MissNotifier
from mddag_executor.executor.outer_groups import outer_here, OuterGroup
from mddag_executor.executor.outside import Outside, Outsiders
from mddag_executor.executor.recorder import Recorder
from mddag_executor.executor.registry import Registry
from mddag_executor.executor.sent_requests import Heritage
from mddag_executor.executor.settings import Thresholds
from mddag_executor.executor.shutdown import (
    call_at_shutdown,
    halt_at_exit,
    is_over,
)
from mddag_executor.executor.silences import may_be_silent, Silences
from mddag_executor.executor.sources import SubscriptionEntity
from mddag_executor.executor.spin_gaps import EXECUTOR
from mddag_executor.executor.statistics import statistics
from mddag_executor.executor.tasks import make_task, TaskEntities, Unclaimed, watched
from mddag_executor.executor.unfinished import LongRuns
from mddag_executor.executor.upkeep import Upkeep
from mddag_executor.executor.verdicts import DeadlineMiss
from mddag_executor.executor.waitables import WaitSetThread
from mddag_executor.executor.weakly import weakly
from mddag_executor.executor.work import current, Work
from mddag_executor.executor.workers import WorkerPool
from mddag_executor.output_rules import remove_recording, version_of
from mddag_executor.results.runs import Statistics
from msg_graph import TaskSet
from rclpy.duration import Duration
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, TimeoutObject
from rclpy.task import Future, Task

if TYPE_CHECKING:
    from asyncio import AbstractEventLoop

    from rclpy.context import Context
    from rclpy.node import Node
    from typing_extensions import Self

LONGEST_WAIT_S = 3600.0
"""One wait of the spinning thread: system calls refuse times beyond 24 days."""
_ANSWER_S = 1.0
"""How long callbacks that wait for a service may still get its response at the end."""
SETTLE_S = 0.1
"""How long to check whether the callback that completed a future has ended."""


def deadline_of(timeout_sec: float | None) -> float | None:
    """
    Return the monotonic time (s) at which a timeout expires; None: never.

    :param timeout_sec: seconds; None, negative or above ``TIMEOUT_MAX`` (292 years): for ever.
    :raises TypeError: when it is not a number; ``ValueError``: when it is NaN.
    """
    if timeout_sec is None or timeout_sec < 0 or timeout_sec >= threading.TIMEOUT_MAX:
        return None
    if math.isnan(timeout_sec):
        raise ValueError('timeout_sec is NaN: it must be a number of seconds, or None')
    return time.monotonic() + timeout_sec


class MultiDeadlineExecutor(BareExecutor):
    """
    Run callbacks in the order of their deadlines, on a bounded pool of workers.

    It replaces ``rclpy.executors.MultiThreadedExecutor``.  Callbacks of declared DAG tasks get the
    priority RAD, the reference absolute deadline of the multi-deadline DAG model (Yano and Azumi,
    RTSS 2024 WiP).  Other callbacks get that of ``default_deadline`` after they became ready.

    :param graph: a declaration (path of a YAML file), a ``msg_graph.TaskSet``, or None.
    :param num_workers: threads of the pool; by default the declared number, else seven.
    :param policy: ``rad`` or another of ``mddag_executor.core.POLICIES``.
    :param on_late: the treatment of late jobs of a DAG that does not declare it: ``continue``
        or ``demote``.
    :param context: the context of the executor, or None for the default one.
    :param trace: path of an MCAP file to record to, or None. If the file exists, the constructor
        raises, unless ``overwrite`` is true.
    :param on_deadline_miss: called with each ``DeadlineMiss``, in a separate thread; its
        exceptions come out of the spin.  If it is too slow, misses are counted but not reported
        (``unreported_misses`` in ``statistics()``).
    :param default_deadline: relative deadline of undeclared callbacks: ns, text such as ``100ms``,
        or an rclpy ``Duration``.
    :param max_active_jobs: how many jobs of a DAG that declares no number itself may be open at a
        time; the oldest one expires when another one is released.
    :param worker_policy: real-time policy of the workers, ``SCHED_FIFO`` or ``SCHED_RR``.
    :param worker_priority: their priority under it.
    :param worker_cpus: the CPUs that they may use.
    :param freeze_gc: when the first spin begins, collect garbage and exempt all existing objects
        from later collections (``gc.freeze``) until the executor ends, which unfreezes what the
        program itself has frozen as well: for programs that make their nodes first.
    :param diagnostics_period: how often to publish on ``/diagnostics`` during a spin: as
        ``default_deadline``; None or 0: never.
    :param thresholds: the limits beyond which a status of the diagnostics is worse than OK.
    :param process: the declared process (of ``processes``) that this is; callbacks of the others
        are not reported as missing.
    :param num_threads: the name of ``num_workers`` in ``MultiThreadedExecutor``.
    :param overwrite: whether ``trace`` may replace a file.
    :raises msg_graph.GraphError: when the declaration is invalid.
    :raises mddag_executor.errors.MddagError: on an unknown policy or thread setting, a number out
        of range, and when the trace cannot be written.
    :raises rclpy.exceptions.NotInitializedException: when ``rclpy.init`` was not called before.
    """

    _ending: Any = None
    _must_shut_down = False

    def __init__(
        self,
        graph: str | os.PathLike[str] | TaskSet | None = None,
        num_workers: int | None = None,
        *,
        policy: str = 'rad',
        on_late: str = 'demote',
        context: Context | None = None,
        trace: str | os.PathLike[str] | None = None,
        on_deadline_miss: Callable[[DeadlineMiss], None] | None = None,
        default_deadline: int | str | Duration = DEFAULT_DEADLINE_NS,
        max_active_jobs: int = MAX_ACTIVE_JOBS,
        worker_policy: str | None = None,
        worker_priority: int | None = None,
        worker_cpus: Iterable[int] | None = None,
        freeze_gc: bool = False,
        diagnostics_period: int | str | Duration | None = None,
        thresholds: Thresholds | None = None,
        process: str | None = None,
        num_threads: int | None = None,
        overwrite: bool = False,
    ) -> None:
        task_set, num_workers, deadline_ns = settings.resolve(
            graph, num_workers, default_deadline, num_threads)
        prepare = settings.thread_setting(worker_policy, worker_priority, worker_cpus)
        every_ns = settings.diagnostics_period_ns(diagnostics_period)
        max_active_jobs = settings.whole_number(
            'max_active_jobs', max_active_jobs, settings.MOST_JOBS)
        find_policy(policy)
        settings.check_on_late(on_late)
        settings.check_handler(on_deadline_miss)
        settings.check_thresholds(thresholds)
        settings.check_context(context)
        settings.check_process(process, task_set)
        # All parameters are checked by now: an error leaves no trace and no thread behind.
        publishing.install()
        raise_limit()
        fail = weakly(self._fail)
        self._trace_clock = TraceClock()
        earlier = None if trace is None else version_of(os.fspath(trace))
        self._recorder = None if trace is None else Recorder(
            os.fspath(trace), task_set, policy, num_workers, deadline_ns, max_active_jobs,
            self._trace_clock, overwrite=overwrite, on_late=on_late)
        self._errors: deque[BaseException] = deque()
        self._process = process
        self._spinning = threading.Lock()
        self._ended_by_callback = False
        self._freeze_gc = freeze_gc
        self._notifier = None if on_deadline_miss is None else MissNotifier(
            on_deadline_miss, fail)
        self._engine = Engine(
            task_set, num_workers, policy, default_deadline=deadline_ns,
            max_active_jobs=max_active_jobs, expire_after=EXPIRE_AFTER_NS,
            on_late=on_late, record=self._recorder.record if self._recorder else None,
            on_miss=None if self._notifier is None else self._notifier.post, process=process)
        try:
            self._pool = WorkerPool(self._engine, self._trace_clock, fail, prepare)
            if self._recorder is not None:
                self._engine.recorder = self._recorder
                self._recorder.writer.before_write = LongRuns(self._pool).note
            self._at_once = AtOnce(self._pool)
            self._signals = SignalPipe()
            self._at_once.loop.add_own(self._signals)
            self._unclaimed = Unclaimed(fail, self._at_once.ring)
            self._ending = Ending(
                self._pool, self._at_once, self._signals, self._recorder, self._notifier)
            self._complete(context, task_set, every_ns, thresholds or Thresholds())
        except BaseException:  # too many open files, or the context has ended
            if self._ending is not None:
                self._ending.undo()
            if self._recorder is not None:
                self._recorder.close(self._trace_clock.now())
                remove_recording(self._recorder.path, earlier)
            raise

    def _complete(
        self, context: Context | None, task_set: TaskSet | None, every_ns: int | None,
        thresholds: Thresholds,
    ) -> None:
        """Make the parts that need the context."""
        process = self._process
        self._registry = Registry(
            task_set, self._engine, self._pool.leave_group, self._recorder)
        self._new_tasks: deque[Work] = deque()
        self._task_entities = TaskEntities(self._recorder)
        self._announcements: Announcements | None = None
        self._check_at: list[float] = []  # when to check again whether the context has ended
        super().__init__(context=context)
        self._pool.attach(self)
        self._wait_sets = self._ending.wait_sets = WaitSetThread(
            self._pool, self.signal_guard(), weakly(self._signalled), weakly(self._has_failed))
        self._upkeep = self._ending.upkeep = Upkeep(
            weakly(self._nodes_to_serve), self._registry, self._pool, self._at_once,
            self._wait_sets)
        if task_set is not None:
            self._pool.outside = Outside(task_set, weakly(self._nodes_to_serve))
            publishing.watch(self._pool)
        self._diagnostics: Diagnostics | None = None
        if every_ns is not None:
            self._diagnostics = self._ending.diagnostics = Diagnostics(
                task_set, self._pool, self._registry, self._recorder, every_ns,
                thresholds, process, self._notifier)
        if process is not None and task_set is not None and (
                self._engine.other_processes is not None
                and self._engine.other_processes.announces):
            self._announcements = Announcements(task_set, process, self._pool)
            self._ending.announcements.append(self._announcements)
            self._pool.announcements = self._announcements
        if task_set is not None and may_be_silent(task_set, process):
            self._ending.announcements.append(Silences(task_set, self._pool))
        self._registry.own = {
            each for several in self._ending.announcements for each in several.subscriptions}
        # Otherwise ready callbacks would run before the spin notices.
        call_at_shutdown(self.context, self._pool.start_no_more)
        call_at_shutdown(self.context, self._context_ends)
        halt_at_exit(self)

    def _nodes_to_serve(self) -> list[Any]:
        return [*self.get_nodes(), *(each.node for each in self._ending.announcements)]

    def _context_ends(self) -> None:
        """Note whether a callback of this executor ends the context."""
        running = current.running
        is_ours = (running is not None and running.work is not None
                   and running.engine is self._engine)
        self._ended_by_callback = is_ours or (
            self._notifier is not None and self._notifier.is_calling())
        self.wake()
        if self._spinning.acquire(blocking=False):  # else the spin ends, and does the rest
            try:
                self._ending.abandon()
            finally:
                self._spinning.release()

    # --- nodes -----------------------------------------------------------------------------------

    def add_node(self, node: Node) -> bool:
        """
        Add a node, whose callbacks this executor runs; return False if it was added before.

        :raises TypeError: when it is not a node.
        :raises RuntimeError: when the executor was shut down.
        """
        if not hasattr(node, 'executor'):
            raise TypeError(f'{node!r} is not a node: add an rclpy.node.Node')
        if self.is_gone():
            raise RuntimeError('The executor was shut down: add the node to a new one')
        added: bool = super().add_node(node)
        if added:
            self.wake()
        return added

    def remove_node(self, node: Node) -> None:
        """
        Stop running a node's callbacks; another executor may run them then.

        The next executor of the node runs what was collected but has not run yet, if it is a
        ``MultiDeadlineExecutor``; here, this counts as dropped: without a spin, not before the
        next spin, because the node may have been added again (``rclpy.spin_once``).
        """
        super().remove_node(node)
        self._upkeep.change()
        if self._pool.running:
            self._upkeep.refresh()
        else:
            self._upkeep.stop_listening()

    def wake(self) -> None:
        """Note that entities were created or destroyed, or that a state has changed."""
        self._upkeep.change()
        self._wait_sets.ask_again()
        self._at_once.ring()

    def _signalled(self) -> None:
        """
        Note that rclpy has received a signal: the context ends soon.

        rclpy first wakes all waiting threads; another thread shuts the contexts down later.
        """
        now = time.monotonic()
        self._check_at = [now + delay for delay in (0.005, 0.025, 0.1, 0.4)]
        self._at_once.ring()

    # --- tasks -----------------------------------------------------------------------------------

    def create_task(self, callback: Any, *args: Any, **kwargs: Any) -> Task:
        """Run a function or coroutine in this executor; return its task, which is a future."""
        return self.create_task_in(outer_here(), callback, *args, **kwargs)

    def create_task_in(self, outer: int, callback: Any, *args: Any, **kwargs: Any) -> Task:
        """Do the same for an outer group, given by its number; -1: none."""
        # A callback that ends a Client.call needs no worker: all workers may wait in such calls.
        if type(callback) is QuickCallback or is_quick(callback):
            task = Task(callback, args, kwargs)
            task()
            return task
        task, work = make_task(
            self._task_entities.of(callback, args, outer), self, self._pool.resume,
            self._unclaimed, self._pool.loops, callback, args, kwargs)
        task.outer_group = self._pool.outer_groups.get(outer)
        work.heritage = self._heritage(args)
        is_spinning = self._spinning.locked()
        if is_spinning:
            self._pool.report(self._engine.posted, work)
        else:
            self._new_tasks.append(work)
        if not (is_spinning and self._pool.running):  # a spin that has just begun may not check
            self._at_once.ring()
        return task

    def _heritage(self, args: tuple[Any, ...]) -> Heritage | None:
        """Return what a task inherits: of the request whose response it handles, or its maker."""
        found, running = heritage_of_response(args), current.running
        if found is not None or running is None or running.pool is not self._pool or (
                running.work is None):
            return found
        return self._engine.heritage_of_task(running.work)

    def _submit_tasks(self) -> None:
        """Post the tasks that were created outside of a spin, in rclpy's order."""
        take = self._new_tasks.pop if TASKS_NEWEST_FIRST else self._new_tasks.popleft
        while self._new_tasks:
            self._pool.report(self._engine.posted, take())

    # --- interface for a host of programs --- ----------------------------------------------------

    def new_outer_group(self, is_single: bool = False) -> OuterGroup:
        """
        Return a new outer group, which is closed: none of its callbacks starts.

        :param is_single: at most one of its callbacks will run at a time; a trace says so.
        """
        return OuterGroup(self._pool, weakref.WeakMethod(self.create_task_in), is_single)

    def put(self, node: Node, group: OuterGroup | None) -> None:
        """Let the callbacks of a node belong to an outer group; None: to none."""
        groups = self._registry.outer_groups
        if groups.get(node) is not group:
            groups[node] = group
            self._upkeep.change()
            if self._pool.running:
                self._upkeep.refresh()

    def on_callback_ended(
        self, listener: Callable[[Any, BaseException | None, int], bool]
    ) -> None:
        """
        Call a function after each callback, and each piece of a coroutine, in its thread.

        It is also called after a response that is handled at once (``at_once``), in the thread
        that has taken it.

        :param listener: receives rclpy's entity (None: a task), the exception of its callback, or
            None, and the number of the outer group in which it ran, or -1; returns whether it
            handles the exception, which then does not end ``spin``.
        """
        self._pool.callback_ended = listener

    def lend(self) -> AbstractContextManager[None]:
        """Return a context manager that lends the worker of the calling callback, if it is one."""
        running = current.running
        return nullcontext() if running is None else running.lend()

    def finish_callbacks(self, is_patient: Callable[[], bool]) -> bool:
        """
        Start no more callbacks, and wait for the running ones; the executor still spins.

        So responses still arrive, and what sleeps with a Rate goes on.  Callbacks that only wait
        for a service are not waited for long: it may be one whose callback does not start.

        :param is_patient: whether to wait any longer.
        :return: whether no callback runs.
        """
        self._pool.pause()
        served = time.monotonic() + _ANSWER_S
        while self._pool.n_running(time.monotonic() < served):
            if not is_patient():
                return False
            time.sleep(0.005)
            if self._pool.n_running(False):
                served = time.monotonic() + _ANSWER_S
        return True

    # --- spinning --------------------------------------------------------------------------------

    @property
    def is_spinning(self) -> bool:
        """Return whether a thread spins (rclpy from 7.1.9 on)."""
        return self._spinning.locked()

    def spin(self) -> None:
        """
        Run callbacks on the pool until shutdown.

        It also returns when a callback ends the context (``rclpy.shutdown``), and at once when the
        context has already ended.

        :raises ExternalShutdownException: when anything else ends the context.
        :raises RuntimeError: when the executor spins already.
        :raises Exception: the exception of a callback.
        """
        self._spin(lambda: False, None)
        self._raise_error()  # of the callback that has ended the context, raised after that

    def spin_until_future_complete(
        self, future: Future, timeout_sec: float | None = None
    ) -> None:
        """
        Run callbacks on the pool until a future is done or the timeout is over.

        The callback that completes the future has ended on return, unless it takes much longer.
        No callback starts after that, unless actions were handled: feedback may still come then.

        :param timeout_sec: seconds; None or negative: for ever; 0: run one callback at most.
        :raises Exception: the exception of a callback, or of the future if it is a task that has
            failed and no other code handles that.
        """
        if timeout_sec == 0:
            with suppress(ExternalShutdownException):
                if not (future.done() or future.cancelled()):
                    self.spin_once_until_future_complete(future, 0)
            return
        completed_by: list[tuple[Any, Work | None] | None] = []
        handled = self._upkeep.handled_waitables()

        def note() -> None:
            running = current.running
            work = None if running is None or running.pool is not self._pool else running.work
            completed_by.append(None if work is None else (running, work))
            if self._upkeep.handled_waitables() == handled:  # else see ``_settle``
                self._pool.start_no_more()
            self._at_once.ring()

        def is_done() -> bool:
            if not (future.done() or future.cancelled()):
                return False
            self._settle(completed_by, handled)
            return True

        with watched(future, note), suppress(ExternalShutdownException):
            self._spin(is_done, timeout_sec)

    def _spin(self, done: Callable[[], bool], timeout_sec: float | None) -> None:
        deadline = deadline_of(timeout_sec)
        with InterruptsDeferred():
            self._spin_deferred(done, deadline)

    def _spin_deferred(self, done: Callable[[], bool], deadline: float | None) -> None:
        self._begin_spin()
        try:
            with short_switch_interval(), self._signals.watch():
                self._spin_until(done, deadline)
        except RCL_ERRORS:
            if not self._was_ended():
                raise
        finally:
            try:  # a second interrupt may come here
                self._pool.pause()
                if is_over(self.context):
                    self._pool.close(0.5)
                    self._ending.end_run()
                    if self._notifier is not None:
                        self._notifier.stop()
            finally:
                self._end_spin()

    def _begin_spin(self) -> None:
        if not self._spinning.acquire(blocking=False):
            raise RuntimeError('Executor is already spinning')
        self._engine.spin_gaps.end(EXECUTOR, self._trace_clock.now())

    def _end_spin(self) -> None:
        """Let another thread spin, or end the executor if ``shutdown`` could not."""
        self._engine.spin_gaps.begin(EXECUTOR, self._trace_clock.now())
        self._spinning.release()
        self._close_unless_spinning()   # another thread may have ended the run meanwhile
        if self._must_shut_down:
            self.shutdown()

    def _spin_until(self, done: Callable[[], bool], deadline: float | None) -> None:
        if self.is_ending() or is_over(self.context):
            return
        if self._freeze_gc:
            self._freeze_gc = False
            self._ending.freeze_objects()
        self._submit_tasks()  # as in rclpy, before other ready callbacks
        self._upkeep.refresh()
        self._start_threads()
        self._pool.start()
        while not self.is_ending():
            self._raise_error()
            if done():
                self._raise_error()  # of callbacks that ran before the future was done
                return
            if self._was_ended():
                return
            self._submit_tasks()
            self._registry.bindings.check(
                self._registry.by_id, self._engine.is_judging, self._process)
            rest = self._upkeep.rest_s()
            if rest == 0.0:
                self._upkeep.refresh()
                rest = None
            left = self._rest_s(deadline, rest)
            if left is not None and left <= 0 and rest is None:
                return
            wait_readable(self._at_once.loop.fd, left)
            self._at_once.handle(self._at_once.loop.wait(0))
        self._raise_error()

    def _start_threads(self) -> None:
        """Start all threads but the workers; further calls do nothing."""
        for each in (self._wait_sets, self._diagnostics, self._notifier):
            if each is not None:
                each.start()

    def _rest_s(self, deadline: float | None, rest: float | None) -> float | None:
        """Return for how long the spinning thread waits at most; None: until a wake-up."""
        now = time.monotonic()
        times = [rest, self._unclaimed.rest_s(), self._registry.bindings.rest_s()]
        times += [at - now for at in self._check_at if at > now]
        if deadline is not None:
            times.append(min(max(0.0, deadline - now), LONGEST_WAIT_S))
        return min((each for each in times if each is not None), default=None)

    def _settle(
        self, completed_by: list[tuple[Any, Work | None] | None], handled: int
    ) -> None:
        """
        Wait briefly for callbacks that a single thread would have ended before the future is done.

        These are the callback that has completed the future, and the feedback of an action: it was
        published before the result, but may arrive later.  If actions were handled, it waits for 3
        idle milliseconds, and for 20 at most.

        :param completed_by: holds the pool's thread in which the future was completed, with its
            execution, or None for another thread; possibly only some time after the future is
            done.
        :param handled: ``Upkeep.handled_waitables`` when the spin began.
        """
        end = time.monotonic() + SETTLE_S
        while time.monotonic() < end and (
                not completed_by
                or any(each is not None and each[0].work is each[1] for each in completed_by)):
            time.sleep(0.00005)
        if self._upkeep.handled_waitables() == handled:
            return
        quiet = 0
        for _ in range(20):
            quiet = quiet + 1 if self._pool.is_idle() else 0
            if quiet == 3:
                return
            time.sleep(0.001)

    def _was_ended(self) -> bool:
        """Return whether a callback ended the context, or raise ExternalShutdownException."""
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

    def _fail(self, error: BaseException) -> None:
        """Store an exception of another thread; the spin raises it."""
        self._errors.append(error)
        self._at_once.ring()

    def _has_failed(self) -> bool:
        """Return whether the next spin raises an exception of another thread."""
        return bool(self._errors)

    def _raise_error(self) -> None:
        self._unclaimed.check()
        while self._errors:
            error = self._errors.popleft()
            # else it was raised only because a callback has ended the context
            if not (self._ended_by_callback and isinstance(error, RCL_ERRORS)):
                raise error

    @contextmanager
    def serve_meanwhile(self) -> Iterator[None]:
        """Let other threads do all work while the callback of a ``spin_once`` waits."""
        ended = False

        def serve() -> None:
            while not ended and not self.is_ending() and not is_over(self.context):
                self._at_once.handle(self._at_once.loop.wait())
                self._upkeep.refresh()

        thread = threading.Thread(target=serve, name='mddag-serve-meanwhile', daemon=True)
        self._pool.start()
        try:
            thread.start()
        except BaseException:  # too many threads
            self._pool.pause()
            self._pool.resume_spin_once()
            raise
        try:
            yield
        finally:
            ended = True
            self._at_once.ring()
            thread.join()
            self._pool.pause()
            self._pool.resume_spin_once()

    # --- one callback at a time ------------------------------------------------------------------

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """
        Wait for one callback and run it in the calling thread.

        If ``rclpy.spin`` calls this method, which would run one callback at a time, it does the
        same as ``spin``.

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
        with watched(future, self._at_once.ring):
            self._spin_once(seconds, lambda: future.done() or future.cancelled())

    def _spin_once(self, timeout_sec: float | None, done: Callable[[], bool]) -> None:
        deadline = deadline_of(timeout_sec)
        with InterruptsDeferred():
            self._spin_once_deferred(deadline, done)

    def _spin_once_deferred(self, deadline: float | None, done: Callable[[], bool]) -> None:
        self._begin_spin()
        try:
            with self._pool.in_spin_once(), self._signals.watch():
                while not self.is_ending():
                    self._check_context()
                    self._raise_error()
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
            self._end_spin()

    def _step(self, deadline: float | None, done: Callable[[], bool]) -> bool:
        """
        Handle ready events, waiting for one if there is none; run one callback if there is one.

        :param deadline: when to stop waiting (monotonic, s); None: never.
        :param done: whether to stop waiting.
        :return: whether a callback ran.
        """
        self._start_threads()
        if self._handle_once():
            return True
        if done():  # the event that woke it has just been handled
            return False
        wait_readable(self._spin_once_epoll().fileno(), self._rest_s(
            deadline, self._upkeep.rest_s()))
        return self._handle_once()

    def _spin_once_epoll(self) -> select.epoll:
        """Return the epoll in which a spin in the calling thread waits."""
        epoll: select.epoll | None = self._ending.spin_once_epoll
        if epoll is None:
            epoll = self._ending.spin_once_epoll = select.epoll()
            epoll.register(self._pool.loop.fd, select.EPOLLIN)
            epoll.register(self._at_once.loop.fd, select.EPOLLIN)
        return epoll

    def _handle_once(self) -> bool:
        """Handle ready events; run one callback if there is one, and return whether one ran."""
        self._upkeep.refresh()
        ran = self._at_once.handle(self._at_once.loop.wait(0))
        self._wait_sets.poll()
        self._submit_tasks()
        return self._pool.run_one(self._pool.loop.wait(0)) or ran

    async def spin_async(self) -> None:
        """
        Run callbacks in the running event loop, one at a time, until shutdown.

        Callbacks and other coroutines of the loop share its thread, so none of them may block.
        Coroutines of callbacks use this loop.  If it is cancelled, the executor may spin again.

        :raises ExternalShutdownException: when something else than a callback ends the context.
        :raises RuntimeError: when the executor spins already.
        :raises Exception: the exception of a callback.
        """
        import asyncio  # rclpy does without it
        loop = asyncio.get_running_loop()
        self._begin_spin()
        try:
            with self._pool.in_spin_once(), self._signals.watch():
                while not self.is_ending() and not self._was_ended():
                    with InterruptsDeferred():
                        self._raise_error()
                        self._start_threads()
                        ran = self._handle_once()
                        self._raise_error()
                    if ran:
                        await asyncio.sleep(0)  # other coroutines of the loop
                    elif not (self.is_ending() or is_over(self.context)):
                        await self._readable(loop)
        except RCL_ERRORS:
            if not self._was_ended():
                raise
        finally:
            self._end_spin()
        self._raise_error()  # of the callback that has ended the context, raised after that

    async def _readable(self, loop: AbstractEventLoop) -> None:
        """Let the event loop run until there is an arrival or a due time."""
        fd, event = self._spin_once_epoll().fileno(), loop.create_future()
        loop.add_reader(fd, set_done, event)
        left = self._rest_s(None, self._upkeep.rest_s())
        timer = None if left is None else loop.call_later(left, set_done, event)
        try:
            await event
        finally:
            loop.remove_reader(fd)
            if timer is not None:
                timer.cancel()

    # --- the end ---------------------------------------------------------------------------------

    def shutdown(
        self, timeout_sec: float | None = None, *, wait_for_threads: bool = False
    ) -> bool:
        """
        Start no more callbacks and wait for the running ones.

        In a signal handler that has interrupted the executor itself, it returns at once, and the
        spin ends and does the rest.

        :param timeout_sec: seconds to wait; None or negative: for ever; 0: do not wait.
        :param wait_for_threads: whether to wait for the threads of the pool even longer than that,
            as Kilted's ``MultiThreadedExecutor`` does by default.
        :return: whether all callbacks have finished before the timeout.
        """
        if timeout_sec is not None and not 0 <= timeout_sec < threading.TIMEOUT_MAX:
            timeout_sec = None
        with InterruptsDeferred():  # a further call does what an interrupted one has left
            return self._shut_down(timeout_sec, wait_for_threads)

    def _shut_down(self, timeout_sec: float | None, wait_for_threads: bool) -> bool:
        self.begin_end()
        self._must_shut_down = self._pool.is_inside()
        if self._must_shut_down:
            self._pool.start_no_more()
            self.wake()
            return False
        self.wake()
        self._pool.pause()
        in_time = self._pool.close(timeout_sec)
        if not in_time:
            if not wait_for_threads:
                return False
            self._pool.close(None)
        self._ending.end_run()
        reported = self._notifier is None or self._notifier.stop(timeout_sec)
        finished: bool = super().shutdown(timeout_sec)
        self._close_unless_spinning()
        return finished and reported and in_time

    def _close_unless_spinning(self) -> None:
        """Close the descriptors, once the run has ended; a spin does that after its end."""
        if self._spinning.acquire(blocking=False):
            self._ending.close()
            self._spinning.release()

    def abandon_callbacks(self) -> None:
        """After ``shutdown``, judge open jobs and complete the trace, though callbacks run."""
        self._ending.end_run()
        self._close_unless_spinning()

    def begin_end(self) -> None:
        """Ask the executor to end."""
        super().begin_end()
        self._ending.is_asked = True

    def __del__(self) -> None:
        """End an executor that was never shut down: its threads and descriptors are freed."""
        if self._ending is not None:  # else its construction has failed
            self._ending.abandon()
        with suppress(InvalidHandle):  # its context has ended before
            super().__del__()  # type: ignore[no-untyped-call]

    def halt(self) -> None:
        """Start no more callbacks, as the interpreter ends; see ``wait_halted``."""
        self.begin_end()
        self._pool.pause()
        self.wake()

    def wait_halted(self, seconds: float) -> None:
        """Wait until no callback runs and no thread spins, at most ``seconds``."""
        end = time.monotonic() + seconds
        self._pool.close(seconds)
        # Without taking the lock: a thread that steps once more meanwhile would get an exception.
        while self._spinning.locked() and time.monotonic() < end:
            time.sleep(0.001)

    def set_judging(self, judging: bool, since: int | None = None) -> None:
        """
        Judge jobs that are released from now on, or none until the next call.

        All entities that its nodes have by then are known when that begins.

        :param since: the time to judge from (monotonic ns); None: now.
        """
        if since is not None:
            since += self._trace_clock.offset_ns
        if judging:
            self._upkeep.refresh()
        self._pool.report(self._engine.set_judging, judging, since)

    def unmatched(self) -> list[str]:
        """Return the topics on which other processes of its DAGs have not been discovered."""
        self._upkeep.refresh()
        found = [] if self._announcements is None else self._announcements.unmatched()
        others = self._engine.other_processes
        try:
            if others is not None:
                found += others.unmatched(
                    self._registry.of_kind(SubscriptionEntity), self.get_nodes())
        except InvalidHandle:
            pass  # destroyed meanwhile
        return found

    def __enter__(self) -> Self:
        """Return the executor; it is shut down at the end of the block."""
        super().__enter__()
        return self

    def published_outside(self) -> Outsiders:
        """Return how many messages no declared callback has published (``outside``)."""
        outside = self._pool.outside
        return () if outside is None else outside.counts()

    def statistics(self) -> Statistics:
        """Return a snapshot of the counts so far: see ``Statistics`` for its keys."""
        return statistics(
            self._pool, self._registry, self._recorder, self._process, self._notifier)
