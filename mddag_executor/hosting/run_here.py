# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Run nodes in this process: real ones, or those made from the declaration.

All modules that the end of a run needs are imported at the top, before a program starts: a Ctrl-C
that interrupts an import in a program may keep the lock of the imported module for ever.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext, redirect_stdout
from dataclasses import asdict, dataclass
import faulthandler
from functools import partial
import signal
from typing import Any, NoReturn, Protocol, TextIO

from mddag_executor import defaults
from mddag_executor.errors import MddagError, UserCodeError
from mddag_executor.executor import current_job
from mddag_executor.executor.executor import MultiDeadlineExecutor
from mddag_executor.executor.session import Session, SessionError
from mddag_executor.executor.watch import Watch
from mddag_executor.hosting.guest import Guest
from mddag_executor.hosting.host import Host
from mddag_executor.hosting.initialised import initialised
from mddag_executor.hosting.loading import (
    describe,
    MainFailed,
    Program,
    ProgramFailed,
    ros_arguments,
)
from mddag_executor.hosting.processes import Part
from mddag_executor.hosting.run_options import RunOptions
from mddag_executor.hosting.run_result import ProgramEnd, RunResult
from mddag_executor.hosting.signals import Signals
from mddag_executor.output_rules import remove_recording, version_of
from mddag_executor.synthetic.measure import ExecutionPlan, Ledger, measure
from mddag_executor.synthetic.workload import SyntheticWorkload
from mddag_executor.text import listed
from msg_graph import TaskSet

STUCK_S = 40.0
"""
An end that takes longer than this writes the stack of each thread.

It is well above the duration of an end with slow callbacks, middleware and disk.
"""
_PART_ENDS_S = 60
"""A part ends at last, whatever its nodes do."""
# How long nodes of several processes wait for each other, once the programs have started: if the
# run has started all of them, and if it is unknown whether the others will come.
_MEET_S, _ALONE_S = 10.0, 4.0
SIGNAL = 128
"""A shell adds the number of the signal that has ended a program."""


class Progress(Protocol):
    """Shows how far a run is."""

    def update(self, done: float) -> None:
        """Show how many seconds have passed."""


class _NoProgress:
    def update(self, done: float) -> None:
        pass


@dataclass(frozen=True)
class Display:
    """
    What a run shows while it runs.

    :ivar warn: receives warnings, a line each.
    :ivar progress: shows the progress of an activity with a name and, perhaps, a duration (s).
    :ivar output: gets what the nodes print; None: it stays where it goes.
    :ivar is_quiet: whether processes of the run are to show errors only.
    :ivar leave: ends the process, if a program keeps the main thread at the end of the run; gets
        what returns the result, or raises its exception.  None: the run waits for the program.
    """

    warn: Callable[[str], None]
    progress: Callable[[str, float | None], AbstractContextManager[Progress]] = (
        lambda what, seconds: nullcontext(_NoProgress()))
    output: TextIO | None = None
    is_quiet: bool = False
    leave: Callable[[Callable[[], RunResult]], NoReturn] | None = None


def warn_of(plan: ExecutionPlan, warn: Callable[[str], None], n_processes: int = 1) -> None:
    """Warn of what the draw makes impossible."""
    for sink in plan.infeasible():
        warn(f'{sink.vertex}: no scheduler can keep its deadline of '
             f'{sink.deadline_ns / 1e6:.1f} ms: with seed {plan.seed} its critical path takes '
             f'{sink.critical_path_ns / 1e6:.1f} ms')
    if plan.mode == 'spin' and plan.utilisation * plan.workers > 0.9 * n_processes:
        warn('spinning callbacks share the interpreter lock, and so one core for each process; '
             f'these need {plan.utilisation * plan.workers:.2f} cores: lower --utilisation, give '
             'more --processes, or use --synthetic sleep')


def run_here(
    options: RunOptions, task_set: TaskSet, display: Display, part: Part | None = None
) -> RunResult:
    """
    Run nodes in this process until the run ends.

    :param part: of a run of several processes, if this is one.
    :return: the result; it has what a node raised.
    :raises MddagError: when the run cannot begin.
    """
    trace = options.check_trace()
    plan = plan_of(options, task_set)
    with ExitStack() as stack:
        stack.callback(faulthandler.cancel_dump_traceback_later)
        signals = stack.enter_context(Signals(ends_process=display.leave is not None))
        stack.enter_context(initialised(options.ros_args))
        programs: list[Program] = []
        host: Host | None = None
        if plan is None:
            host = stack.enter_context(Host(
                signals, [*task_set.concurrent, *(
                    f'/{name.lstrip("/")}' for name in options.concurrent)]))
            programs = host.load(options.nodes, ros_arguments(options.ros_args))
        earlier = None if trace is None else version_of(str(trace))
        begins = False
        try:
            executor = MultiDeadlineExecutor(
                task_set, num_workers=defaults.workers(options.workers, task_set),
                policy=options.policy, on_late=options.on_late, trace=trace, freeze_gc=True,
                diagnostics_period=options.diagnostics, process=options.process,
                overwrite=options.overwrite)
            run = _Run(options, task_set, executor, display, part)
            signals.end_of(run.session)
            begins = True
            with nullcontext() if display.output is None else redirect_stdout(display.output):
                if host is not None:  # without progress: programs also use the terminal
                    return host.run(
                        partial(run.run_programs, host, programs, signals), display.leave)
                assert plan is not None
                return run.run_synthetic(plan)
        except (MddagError, SystemExit, KeyboardInterrupt) as error:
            # nothing ran: leave no empty trace behind
            if trace is not None and not (begins and isinstance(error, KeyboardInterrupt)):
                remove_recording(str(trace), earlier)
            raise


def plan_of(options: RunOptions, task_set: TaskSet) -> ExecutionPlan | None:
    """Return the execution times of synthetic nodes; None: there are none."""
    if options.synthetic is None:
        return None
    mode: Any = options.synthetic
    return ExecutionPlan(task_set, options.seed, options.utilisation,
                         defaults.workers(options.workers, task_set), mode)


class _Run:
    """One run in this process, from a spinning executor to its result."""

    def __init__(
        self, options: RunOptions, task_set: TaskSet, executor: MultiDeadlineExecutor,
        display: Display, part: Part | None,
    ) -> None:
        self.session = Session(executor, on_end=self._end_begins)
        self._options = options
        self._task_set = task_set
        self._executor = executor
        self._display = display
        self._part = part
        self._watch = Watch(executor, task_set)
        self._warnings: list[str] = []
        self._has_started = True

    def _warn(self, line: str) -> None:
        self._warnings.append(line)
        self._display.warn(line)

    def _end_begins(self) -> None:
        self._watch.stop()
        # a native thread writes the stacks, even if the thread that holds the GIL is stuck
        faulthandler.dump_traceback_later(STUCK_S, file=2)
        if self._part is not None:
            signal.alarm(_PART_ENDS_S)

    # --- programs --------------------------------------------------------------------------------

    def run_programs(self, host: Host, programs: list[Program], signals: Signals) -> RunResult:
        """Run programs until the run ends; called in a thread of its own (``Host.run``)."""
        session, executor = self.session, self._executor
        executor.set_judging(False)
        try:
            with session:
                host.start(executor, programs, ros_arguments(self._options.ros_args),
                           session.stop, lambda: session.stopped)
                if signals.ended_by is not None:
                    if not any(guest.has_begun for guest in host.guests):
                        raise SystemExit(SIGNAL + signals.ended_by)  # as if it had come before
                    self._has_started = False
                executor.set_judging(True, self._begin_of_several())
                self._watch.restart()
                host.time_is_over = not session.wait(self._options.seconds)
        except MddagError as error:
            # The exception of a callback says more than that its program failed to start.
            if session.error is None:
                if isinstance(error, ProgramFailed):
                    error.status = MainFailed.status
                elif self._part is not None:  # its exit status is not that of the run
                    error.status = MddagError.status
                raise
        left = host.end(session.is_patient)
        for guest in left:
            self._warn(f'--node {guest.program.spec}: its main() has not ended in time and is '
                       'abandoned: let it return when rclpy.ok() is False')
        if left:
            host.interrupt()
        errors = [guest.error for guest in host.guests
                  if guest.error is not None and not (
                      guest in left and isinstance(guest.error, KeyboardInterrupt))]
        # the error says more than that the run was interrupted
        errors.sort(key=lambda error: isinstance(error, KeyboardInterrupt))
        return self._result(
            session.error or next(iter(errors), None), guests=host.guests,
            exclusion=host.exclusion())

    def _begin_of_several(self) -> int | None:
        """Wait for the nodes of other processes; return when their common run has begun."""
        if self._options.process is None:
            return None
        try:  # messages that are lost until then do not count
            return self._begin()(self.session, self._executor.unmatched,
                                 _ALONE_S if self._part is None else _MEET_S)
        except SessionError as error:
            self._warn(f'{error}; messages that are lost meanwhile count as missed')
            return None

    def _begin(self) -> Callable[..., int | None]:
        """Return what waits until endpoints have discovered each other, and for processes."""
        if self._part is None:
            return Session.wait_until_matched
        return partial(self._part.start_together, self._options.process or '',
                       [process.name for process in self._task_set.processes])

    # --- synthetic nodes -------------------------------------------------------------------------

    def run_synthetic(self, plan: ExecutionPlan) -> RunResult:
        """Run nodes made from the declaration."""
        seconds = self._options.seconds
        with self._display.progress('running', seconds) as progress:
            if self._part is None:
                warn_of(plan, self._warn)
            ledger = self._run_workload(plan, progress)
        return self._result(self.session.error, ledger=ledger, plan=plan)

    def _run_workload(self, plan: ExecutionPlan, progress: Progress) -> Ledger | None:
        process = self._options.process
        workload = SyntheticWorkload(
            self._task_set, plan, current_job=current_job, process=process)
        for node in workload.nodes:
            self._executor.add_node(node)
        try:
            with self.session:
                measured = workload.run(
                    self.session, self._options.seconds, progress.update, begin=self._begin())
                # The jobs of one process of several begin or end in others.
                return workload.ledger if measured and process is None else None
        finally:
            # Processes that destroy hundreds of entities while their peers do so may wait for each
            # other within the middleware; a process of several ends without that.
            if self._part is None:
                workload.destroy()

    # --- the result ------------------------------------------------------------------------------

    def _result(
        self, error: BaseException | None, *, guests: Sequence[Guest] = (),
        exclusion: Sequence[dict[str, Any]] = (), ledger: Ledger | None = None,
        plan: ExecutionPlan | None = None,
    ) -> RunResult:
        """Return the result of a run that has ended."""
        options = self._options
        counts = self._executor.statistics()
        if counts['trace'] is not None:
            counts['trace']['path'] = str(options.trace)
        values: dict[str, Any] = {
            'file': self._task_set.file or None, 'nodes': options.specs,
            'synthetic': options.synthetic, **counts,
            'measured': None if ledger is None or plan is None else measure(ledger, plan),
            'exclusion': [*exclusion],
            'drift': [each.result() for each in self._watch.drift(counts)]}
        if not self.session.clean:
            self._warn('a callback has not ended in time and is abandoned: let it return when '
                       'rclpy.ok() is False')
        return RunResult(
            values, tuple(_end_of(guest) for guest in guests), tuple(self._warnings),
            _with_place(error, values, guests),
            None if self._part is None else asdict(self._watch.observed(counts)),
            self._has_started)


def _end_of(guest: Guest) -> ProgramEnd:
    """Return how a program has ended."""
    spec, error = guest.program.spec, guest.error
    if not guest.done.is_set():
        return ProgramEnd(spec, None)
    if isinstance(error, SystemExit):
        return ProgramEnd(spec, error.code, '') if isinstance(error.code, int) else (
            ProgramEnd(spec, 1, str(error.code)))
    if isinstance(error, KeyboardInterrupt):
        return ProgramEnd(spec, SIGNAL + signal.SIGINT)
    return ProgramEnd(spec, 0 if error is None else 1, '' if error is None else describe(error))


def _with_place(
    error: BaseException | None, values: dict[str, Any], guests: Sequence[Guest],
) -> BaseException | None:
    """Return what a node raised, with the callbacks or the program that raised it."""
    if error is None or isinstance(error, (KeyboardInterrupt, SystemExit)):
        return error
    of_mains = [f'--node {guest.program.spec}' for guest in guests if guest.error is error]
    places = [name for name, each in values['callbacks'].items() if each['failed']] or of_mains
    if not places and isinstance(error, OSError) and error.filename is None:
        return error  # of this program: too many open files
    failed = (MainFailed if of_mains else UserCodeError)(
        f'{listed(places) or "mddag run"}: it raised {describe(error)}: correct it, or see its '
        'traceback')
    failed.__cause__ = error
    return failed
