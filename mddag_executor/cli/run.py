# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `run`: real nodes, or nodes made from the declaration, under the executor.

The whole command line is checked before a node starts: the declaration, the names of policy and
nodes, whether trace and result can be written.  A run ends after `--duration`, with Ctrl-C,
SIGTERM or SIGHUP, when a callback calls `rclpy.shutdown`, or when all programs have ended; its
summary is always printed.

A run of several processes (`run_processes`) starts this verb once for each of them, with `--part`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import ExitStack, redirect_stdout
from dataclasses import asdict, replace
import faulthandler
from functools import partial
import os
from pathlib import Path
import signal
import sys
import threading
from typing import Any, NoReturn, TYPE_CHECKING

from mddag_executor import defaults
from mddag_executor.cli import common, options, verdicts
from mddag_executor.cli.main import EXIT_SIGNAL, status_of
from mddag_executor.cli.text import Progress, set_quiet, warn
from mddag_executor.errors import from_user_code, MddagError, UsageError, UserCodeError
from mddag_executor.output_rules import remove_recording
from mddag_executor.report.live_runs import live_lines
from mddag_executor.report.text import listed
from msg_graph import EMPTY_TASK_SET, loads

if TYPE_CHECKING:
    from mddag_executor.executor.executor import MultiDeadlineExecutor
    from mddag_executor.executor.session import Session
    from mddag_executor.executor.watch import Watch
    from mddag_executor.hosting.guest import Guest
    from mddag_executor.hosting.host import Host
    from mddag_executor.hosting.loading import Program
    from mddag_executor.hosting.signals import Signals
    from mddag_executor.synthetic.measure import ExecutionPlan, Ledger
    from msg_graph import TaskSet

EXAMPLE = """\
mddag run graph.yaml --node my_package/driver --node my_package.filter:main --trace run.mcap
mddag run config/autoware.yaml --synthetic sleep --utilisation 0.6 --duration 20s
mddag run --node my_package/driver --node my_package/filter --trace run.mcap"""

# What a process of several does not get: it is of the run as a whole, or each process has its own.
_OF_THE_RUN = {'node', 'synthetic', 'graph', 'trace', 'process', 'processes', 'part', 'on_exit',
               'fail_on_miss', 'json', 'main'}
# An end that takes longer than this writes the stack of each thread: well above the duration of an
# end with slow callbacks, middleware and disk.
STUCK_S = 40.0
# A part ends at last, whatever its nodes do.
_PART_ENDS_S = 60
# How long nodes of several processes wait for each other, once the programs have started: if the
# run has started all of them, and if it is unknown whether the others will come.
_MEET_S, _ALONE_S = 10.0, 4.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument(
        '--node', metavar='SPEC', action='append', default=[],
        help='run this node: package/executable (unmodified, as ros2 run does), module:function '
        'or module:NodeClass; arguments for it follow in the same word, as '
        "'pkg/exe --rate 2'; repeat it for more nodes")
    what.add_argument(
        '--synthetic', choices=('sleep', 'spin', 'native', 'mixed'),
        help='make the nodes from the declaration; for the declared execution times their '
        'callbacks sleep, compute in Python, compute without the interpreter lock, or, drawn for '
        'each callback, do one of the three')
    options.add(parser, '--utilisation', '--seed', only='with --synthetic: ')
    add('--duration', type=options.duration, metavar='TIME',
        help='end after this time, for instance 20s, with --synthetic after a warm-up of 1 s '
        '(default: run until Ctrl-C)')
    add('--concurrent', metavar='NAME', action='append', default=[],
        help='let the callbacks of this node overlap with others of its program, even if the '
        'program spins in a single thread; repeat it for more nodes')
    options.add(parser, '--policy', **options.live_policy())
    options.add(parser, '--workers', '--fail-on-miss')
    options.add(parser, '--on-late', default='demote')
    add('--diagnostics', type=_or_off, default='1s', metavar='TIME',
        help="how often to publish the executor's state on /diagnostics, for mddag top and other "
        "tools; 'off': never (default: 1s)")
    add('--trace', metavar='OUT.mcap', type=options.TraceOfRun,
        help='record the run to this file; of several processes each to OUT.NAME.mcap, or to '
        'NAME.mcap in OUT if that is a directory')
    several = parser.add_argument_group('several processes').add_argument
    several('--processes', metavar='N|FILE', type=options.Input,
        help='run the nodes in N processes, or in those of a YAML file with `processes:` '
        "(default: those of the declaration); '1': in this process")
    several('--process', metavar='NAME',
        help='run only the nodes of this declared process, for a launch file that starts each '
        'process; give the --node options of these nodes only')
    several('--on-exit', choices=('end', 'continue'), default='end',
        help='if one of several processes ends by itself: end the run, or continue without it '
        '(default: end)')
    add('--part', help=argparse.SUPPRESS)  # the folder of a run of several processes
    parser.add_argument(
        'graph', metavar='GRAPH', nargs='?', type=options.Input,
        help="the declaration, a YAML file ('-': standard input); with --node it may be left out: "
        'then nothing is judged, and a trace shows what there is to declare')
    options.add(parser, '--json', '--overwrite', '--ros-args')


def passed_on(args: argparse.Namespace) -> dict[str, Any]:
    """Return the options that each process of several gets."""
    return {name: value for name, value in vars(args).items() if name not in _OF_THE_RUN}


def _or_off(text: str) -> int:
    """Return the nanoseconds of a time, 0 for `off`."""
    return 0 if text == 'off' else options.duration(text)


def main(args: argparse.Namespace) -> int:
    _check_arguments(args)
    if args.part is not None:
        return part(args)
    task_set = EMPTY_TASK_SET if args.graph is None else common.load_graph(args.graph)
    if args.processes not in (None, '1') or (task_set.processes and args.processes is None):
        from mddag_executor.cli.run_processes import run_processes, with_declared
        if args.process is None:
            return run_processes(args, task_set)
        task_set = with_declared(args, task_set)
    elif task_set.processes:
        task_set = replace(task_set, processes=())
    return run_here(args, task_set, partial(_finish, args))


def _finish(args: argparse.Namespace, result: dict[str, Any], error: BaseException | None) -> int:
    """Show the result; return the exit status, or raise what a node raised."""
    common.show(args, result, live_lines(result))
    status = verdicts.exit_status(args, result, result['file'] or 'mddag run')
    return _end(error or incomplete(result['trace']) or not_found(args, result), status)


def not_found(args: argparse.Namespace, result: dict[str, Any]) -> MddagError | None:
    """Return the error that nothing declared was there; `--fail-on-miss` has one of its own."""
    if args.fail_on_miss or not result['dags'] or any(
            each['declared'] for each in result['callbacks'].values()):
        return None
    return UsageError(
        f'{result["file"] or "GRAPH"}: none of its callbacks was in the nodes that ran, so '
        'nothing was judged: check that it is the declaration of these nodes, with their names '
        'and namespaces')


def incomplete(*traces: dict[str, Any] | None) -> MddagError | None:
    """Return the error about a recording that could not be written, if there is one."""
    errors = [trace['error'] for trace in traces if trace is not None and trace['error']]
    return MddagError(errors[0]) if errors else None


def part(args: argparse.Namespace) -> int:
    """Run one process of several, and write its result to the folder of the run."""
    from mddag_executor.hosting.processes import belong_to_parent, Part
    the_part = Part.read(args.part)
    belong_to_parent(the_part.parent)
    vars(args).update(the_part.options)
    set_quiet(args.quiet)
    task_set = loads(the_part.text, name=args.graph)
    if args.process is None:
        from mddag_executor.hosting.host import nodes_of
        from mddag_executor.hosting.initialised import initialised
        from mddag_executor.hosting.loading import ros_arguments

        def then(names: list[list[str]]) -> NoReturn:
            the_part.write_result(names)
            _exit(0)  # without the ends of programs that were only probed

        with initialised(args.ros_args):
            nodes_of(args.node, ros_arguments(args.ros_args), then, _leave_main)

    def finish(result: dict[str, Any], error: BaseException | None) -> int:
        the_part.write_result(result)
        if args.synthetic is not None and error is None:
            _exit(0)  # the nodes are not destroyed one by one: see _run_synthetic
        return _end(error)

    return run_here(args, task_set, finish)


def _exit(status: int) -> NoReturn:
    """End the process here, with whatever runs in other threads."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def _leave_main(finish: Callable[[], int]) -> NoReturn:
    """End the process from another thread than the main one, as a program still has that."""
    _exit(status_of(lambda argv: finish(), ()))


def run_here(
    args: argparse.Namespace, task_set: TaskSet, finish: Callable[..., int]
) -> int:
    """
    Run nodes in this process.

    :param finish: gets the result (with what those of several processes are put together from, if
        it is one of these), and what a node raised; returns the exit status.
    """
    common.check_output(args.trace, is_kept=True, overwrite=args.overwrite)
    trace = None if args.trace is None else Path(args.trace).absolute()  # nodes may change folders
    workers = defaults.workers(args.workers, task_set)
    plan = None
    host: Host | None = None
    programs: list[Program] = []
    # What the end needs is imported here: an interrupt of an import in a program may keep the lock
    # of the imported module for ever.
    from mddag_executor.hosting import processes  # noqa: F401
    from mddag_executor.synthetic.measure import ExecutionPlan
    if args.synthetic is not None:
        plan = ExecutionPlan(task_set, args.seed, args.utilisation, workers, args.synthetic)
    with ExitStack() as stack:
        stack.callback(faulthandler.cancel_dump_traceback_later)
        from mddag_executor.hosting.signals import Signals
        signals = stack.enter_context(Signals())
        from mddag_executor.hosting.initialised import initialised
        stack.enter_context(initialised(args.ros_args))
        if args.synthetic is None:
            from mddag_executor.hosting.host import Host
            from mddag_executor.hosting.loading import ros_arguments
            host = stack.enter_context(Host(
                signals, [*task_set.concurrent, *(
                    f'/{name.lstrip("/")}' for name in args.concurrent)]))
            programs = host.load(args.node, ros_arguments(args.ros_args))
        from mddag_executor.executor.executor import MultiDeadlineExecutor
        executor = MultiDeadlineExecutor(
            task_set, num_workers=workers, policy=args.policy, on_late=args.on_late,
            trace=trace, freeze_gc=True, diagnostics_period=args.diagnostics, process=args.process,
            overwrite=args.overwrite)
        # With `--json -` what nodes print must not get into the JSON.
        output = sys.stdout if common.wants_tables(args) else sys.stderr
        stdout = sys.stdout

        def leave(outcome: Callable[[], tuple[dict[str, Any], BaseException | None]]) -> NoReturn:
            sys.stdout = stdout
            _leave_main(lambda: finish(*outcome()))

        try:
            with redirect_stdout(output):
                outcome = _run(args, task_set, executor, host, programs, plan, signals, leave)
        except (MddagError, SystemExit):
            if trace is not None:  # nothing ran: leave no empty trace behind
                remove_recording(str(trace))
            raise
    return finish(*outcome)


def _end(error: BaseException | None, status: int = 0) -> int:
    """
    Return the exit status, or raise what a node raised.

    The process ends here if a node's thread would keep the interpreter from ending.
    """
    if isinstance(error, KeyboardInterrupt):  # which a program did not catch
        import traceback
        traceback.print_exception(from_user_code(error))
    if error is not None:
        raise error
    left = [t.name for t in threading.enumerate()
            if not t.daemon and t is not threading.main_thread()]
    if not left:
        return status
    warn(f'threads that nodes started still run and are abandoned: {listed(left)}')
    _exit(status)


def _check_arguments(args: argparse.Namespace) -> None:
    from mddag_executor.executor.settings import diagnostics_period_ns
    diagnostics_period_ns(args.diagnostics)
    if args.processes is not None and args.processes.isdecimal() and not int(args.processes):
        raise UsageError('--processes 0: give 1 or more, or a file')
    needs_graph = next((name for name in ('synthetic', 'processes', 'process')
                        if getattr(args, name) not in (None, '1')), None)
    if args.graph is None and args.fail_on_miss:
        raise UsageError('--fail-on-miss: without a GRAPH no deadline is judged: give one')
    if args.graph is None and needs_graph is not None:
        raise UsageError(f'--{needs_graph}: it is about the nodes of a declaration: give a GRAPH')
    if args.synthetic is None and args.utilisation is not None:
        raise UsageError(
            '--utilisation: it scales synthetic nodes only: add --synthetic or leave it out')


def warn_of(plan: ExecutionPlan, n_processes: int = 1) -> None:
    """Warn of what the draw makes impossible."""
    for sink in plan.infeasible():
        warn(f'{sink.vertex}: no scheduler can keep its deadline of '
             f'{sink.deadline_ns / 1e6:.1f} ms: with seed {plan.seed} its critical path takes '
             f'{sink.critical_path_ns / 1e6:.1f} ms')
    if plan.mode == 'spin' and plan.utilisation * plan.workers > 0.9 * n_processes:
        warn('spinning callbacks share the interpreter lock, and so one core for each process; '
             f'these need {plan.utilisation * plan.workers:.2f} cores: lower --utilisation, give '
             'more --processes, or use --synthetic sleep')


def _run(
    args: argparse.Namespace, task_set: TaskSet, executor: MultiDeadlineExecutor,
    host: Host | None, programs: list[Program], plan: ExecutionPlan | None, signals: Signals,
    leave: Callable[..., NoReturn],
) -> tuple[dict[str, Any], BaseException | None]:
    """
    Run nodes; return the result, and what a node raised.

    :param leave: see ``Host.run``.
    """
    from mddag_executor.executor.session import Session
    from mddag_executor.executor.watch import Watch

    def end_begins() -> None:
        # a native thread writes the stacks, even if the thread that holds the GIL is stuck
        faulthandler.dump_traceback_later(STUCK_S, file=2)
        if args.part is not None:
            signal.alarm(_PART_ENDS_S)

    session = Session(executor, on_end=end_begins)
    watch = Watch(executor, task_set)
    seconds = None if args.duration is None else args.duration / 1e9
    signals.end_of(session)
    if host is not None:  # without progress: programs also use the terminal
        outcome: tuple[dict[str, Any], BaseException | None] = host.run(
            partial(_run_programs, args, task_set, session, watch, host, programs, seconds), leave)
        return outcome
    assert plan is not None
    with Progress('running', seconds) as progress:
        if args.part is None:
            warn_of(plan)
        ledger = _run_synthetic(args, session, task_set, plan, seconds, progress)
    result = _result(args, task_set, session, watch, ledger, plan)
    return result, _with_place(session.error, result, ())


def _result(
    args: argparse.Namespace, task_set: TaskSet, session: Session, watch: Watch,
    ledger: Ledger | None = None, plan: ExecutionPlan | None = None,
) -> dict[str, Any]:
    """Return the result of a run that has ended."""
    from mddag_executor.synthetic.measure import measure
    executor: Any = session.executor
    counts = executor.statistics()
    if counts['trace'] is not None:
        counts['trace']['path'] = args.trace
    result: dict[str, Any] = {
        'file': task_set.file or None, 'nodes': args.node, 'synthetic': args.synthetic, **counts,
        'measured': None if ledger is None or plan is None else measure(ledger, plan)}
    result['exclusion'] = []
    result['drift'] = [each.result() for each in watch.drift(counts)]
    if not session.clean:
        warn('a callback has not ended in time; it is abandoned')
    if args.part is not None:
        result.update(observed=asdict(watch.observed(counts)))
    return result


def _with_place(
    error: BaseException | None, result: dict[str, Any], guests: Sequence[Guest],
) -> BaseException | None:
    """Return what a node raised, with the callbacks or the program that raised it."""
    if error is None or isinstance(error, (KeyboardInterrupt, SystemExit)):
        return error
    from mddag_executor.hosting.loading import describe, MainFailed
    of_mains = [f'--node {guest.program.spec}' for guest in guests if guest.error is error]
    places = [name for name, each in result['callbacks'].items() if each['failed']] or of_mains
    if not places and isinstance(error, OSError) and error.filename is None:
        return error  # of this program: too many open files
    failed = (MainFailed if of_mains else UserCodeError)(
        f'{listed(places) or "mddag run"}: it raised {describe(error)}: correct it, or see its '
        'traceback')
    failed.__cause__ = error
    return failed


def _run_synthetic(
    args: argparse.Namespace, session: Session, task_set: TaskSet, plan: ExecutionPlan,
    seconds: float | None, progress: Progress,
) -> Ledger | None:
    from mddag_executor.executor import current_job
    from mddag_executor.synthetic.workload import SyntheticWorkload
    workload = SyntheticWorkload(
        task_set, plan, current_job=current_job, process=args.process)
    for node in workload.nodes:
        session.executor.add_node(node)
    try:
        with session:
            measured = workload.run(
                session, seconds, progress.update, begin=_begin(args, task_set))
            # The jobs of one process of several begin or end in others.
            return workload.ledger if measured and args.process is None else None
    finally:
        # Processes that destroy hundreds of entities while their peers do so may wait for each
        # other within the middleware; a process of several ends without that.
        if args.part is None:
            workload.destroy()


def _begin(args: argparse.Namespace, task_set: TaskSet) -> Callable[..., int | None]:
    """Return what waits until endpoints have discovered each other, and for other processes."""
    from mddag_executor.executor.session import Session
    from mddag_executor.hosting.processes import Part
    if args.part is None:
        return Session.wait_until_matched
    return partial(Part.read(args.part).start_together, args.process,
                   [process.name for process in task_set.processes])


def _run_programs(
    args: argparse.Namespace, task_set: TaskSet, session: Session, watch: Watch, host: Host,
    programs: list[Program], seconds: float | None,
) -> tuple[dict[str, Any], BaseException | None]:
    from mddag_executor.executor.session import SessionError
    from mddag_executor.hosting.loading import MainFailed, ProgramFailed, ros_arguments
    executor: Any = session.executor
    executor.set_judging(False)
    try:
        with session:
            host.start(
                executor, programs, ros_arguments(args.ros_args), session.stop,
                lambda: session.stopped)
            if host.ended_by is not None and not any(g.has_begun for g in host.guests):
                raise SystemExit(EXIT_SIGNAL + host.ended_by)  # as if it had come before the run
            begins: int | None = None
            if args.process is not None:  # messages that are lost until then do not count
                try:
                    begins = _begin(args, task_set)(
                        session, executor.unmatched, _MEET_S if args.part else _ALONE_S)
                except SessionError as error:
                    warn(f'{error}; messages that are lost meanwhile count as missed')
            executor.set_judging(True, begins)
            session.wait(seconds)
    except MddagError as error:
        # What a callback raised says more than that its program failed to start.
        if session.error is None:
            if isinstance(error, ProgramFailed):
                error.status = MainFailed.status
            elif args.part is not None:  # what it exits with is none of the run's
                error.status = MddagError.status
            raise
    left = host.end(session.is_patient)
    for guest in left:
        warn(f'--node {guest.program.spec}: its main() has not ended in time; it is abandoned')
    if left:
        host.interrupt()
    errors = [guest.error for guest in host.guests
              if guest.error is not None and not (
                  guest in left and isinstance(guest.error, KeyboardInterrupt))]
    # what went wrong says more than that it was interrupted
    errors.sort(key=lambda error: isinstance(error, KeyboardInterrupt))
    result = _result(args, task_set, session, watch)
    result['exclusion'] = host.exclusion()
    return result, _with_place(session.error or next(iter(errors), None), result, host.guests)
