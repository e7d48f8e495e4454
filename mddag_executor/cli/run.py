# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `run`: real nodes, or nodes made from the declaration, under the executor.

Its options are the fields of ``hosting.RunOptions``, and ``hosting`` does the work; this module
makes the options of the command line, and shows the result.  The whole command line is checked
before a node starts.  A run ends after `--duration`, with Ctrl-C, SIGTERM or SIGHUP, when a
callback calls `rclpy.shutdown`, or when all programs have ended; its summary is always printed.

A run of several processes starts this verb once for each of them, with `--part`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
import os
import sys
import threading
import traceback
from typing import Any, NoReturn, TYPE_CHECKING

from mddag_executor.cli import common, options, verdicts
from mddag_executor.cli.main import EXIT_DEFECT, status_of
from mddag_executor.cli.text import is_quiet, Progress, warn
from mddag_executor.errors import from_user_code, MddagError, UsageError
from mddag_executor.hosting.run_options import RunOptions
from mddag_executor.report.live_runs import live_lines
from mddag_executor.report.text import listed
from mddag_executor.shared_memory import remove_segments

if TYPE_CHECKING:
    from mddag_executor.hosting.run_here import Display
    from mddag_executor.hosting.run_result import RunResult
    from msg_graph import TaskSet

EXAMPLE = """\
mddag run graph.yaml --node my_package/driver --node my_package.filter:main --trace run.mcap
mddag run config/autoware.yaml --synthetic sleep --utilisation 0.6 --duration 20s
mddag run --node my_package/driver --node my_package/filter --trace run.mcap"""

_KINDS: dict[str, dict[str, Any]] = {
    'several': {'action': 'append', 'default': []},
    'switch': {'action': 'store_true'},
    'duration': {'type': options.duration},
    'time or off': {'type': lambda text: 0 if text == 'off' else options.duration(text)},
    'input': {'type': options.Input},
    'trace': {'type': options.TraceOfRun},
}
"""The parser's arguments for an option of a kind."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    groups: dict[str, options.Arguments] = {
        '': parser, 'what': parser.add_mutually_exclusive_group(required=True)}
    shared = {'on_late': {'default': 'demote'}, 'policy': options.live_policy()}
    for each in fields(RunOptions):
        how, name = each.metadata, each.name
        flag = how.get('flag') or f'--{name.replace("_", "-")}'
        if not how['help']:     # several verbs have it
            if name != 'ros_args':  # which is the last one: it takes the rest of the command line
                options.add(parser, flag, only=how.get('only', ''), **shared.get(name, {}))
            continue
        group = how.get('group', '')
        if group not in groups:
            groups[group] = parser.add_argument_group(group)
        more = {key: how[key] for key in ('metavar', 'choices') if key in how}
        more |= _KINDS[how['kind']] if 'kind' in how else {}
        if flag[0] != '-':
            more['nargs'] = '?'
        elif 'default' not in more:
            more['default'] = each.default
        groups[group].add_argument(flag, help=how['help'].replace('%', '%%'), **more)
    parser.add_argument('--part', help=argparse.SUPPRESS)  # the folder of a run of several
    options.add(parser, '--fail-on-miss', '--json', '--ros-args')


def options_of(args: argparse.Namespace) -> RunOptions:
    """Return the options that a command line gives."""
    return RunOptions(**{
        each.name: getattr(args, each.metadata.get('flag', each.name).removeprefix('--'))
        for each in fields(RunOptions)})


def main(args: argparse.Namespace) -> int:
    from mddag_executor.executor.settings import diagnostics_period_ns
    from mddag_executor.hosting.initialised import quiet_log
    diagnostics_period_ns(args.diagnostics)
    if args.graph is None and args.fail_on_miss:
        raise UsageError('--fail-on-miss: without a GRAPH no deadline is judged: give one')
    with quiet_log(is_quiet()):
        return part(args) if args.part is not None else _run(args)


def _run(args: argparse.Namespace) -> int:
    from mddag_executor.hosting.run_nodes import run_with
    given = options_of(args)
    if args.graph is not None:
        given = replace(given, graph=common.load_graph(args.graph))
    if args.processes == '-':
        given = replace(given, **_processes_of_stdin(given))
    finish = partial(_finish, args)
    return finish(run_with(given, _display(args, finish)))


def _processes_of_stdin(given: RunOptions) -> dict[str, Any]:
    from msg_graph.edit import load_processes, with_processes
    name, text = common.read_text('-')
    task_set: Any = given.graph
    return {'processes': None,
            'graph': with_processes(task_set, load_processes(text, name, task_set))}


def _display(args: argparse.Namespace, finish: Callable[[RunResult], int]) -> Display:
    """Return what shows a run on the terminal."""
    from mddag_executor.hosting.run_here import Display
    stdout = sys.stdout

    def leave(outcome: Callable[[], RunResult]) -> NoReturn:
        """End the process from another thread than the main one, as a program has that."""
        sys.stdout = stdout
        _exit(status_of(lambda argv: finish(outcome()), ()))

    # With `--json -` what nodes print must not get into the JSON.
    output = sys.stderr if common.is_output_taken(args) else stdout
    return Display(warn, Progress, output, is_quiet(), leave)


def _finish(args: argparse.Namespace, result: RunResult) -> int:
    """Show the result; return the exit status, or raise what a node raised."""
    values: Any = result.to_json()
    common.show(args, values, live_lines(values))
    processes = values.get('processes')
    if processes is not None and any(each['died'] for each in processes):
        return EXIT_DEFECT
    status = verdicts.exit_status(args, values, values['file'] or 'mddag run')
    traces = [values['trace'], *(each['trace'] for each in processes or () if not each['died'])]
    missing = _not_found(args, values) if result.has_started else None
    return _end(result.error or _incomplete(traces) or missing, status)


def _not_found(args: argparse.Namespace, values: dict[str, Any]) -> MddagError | None:
    """Return the error that nothing declared was there; `--fail-on-miss` has one of its own."""
    if args.fail_on_miss or not values['dags'] or any(
            each['declared'] for each in values['callbacks'].values()):
        return None
    return UsageError(
        f'{values["file"] or "GRAPH"}: none of its callbacks was in the nodes that ran, so '
        'nothing was judged: check that it is the declaration of these nodes, with their names '
        'and namespaces')


def _incomplete(traces: list[Any]) -> MddagError | None:
    """Return the error about a recording that could not be written, if there is one."""
    errors = [trace['error'] for trace in traces if trace is not None and trace['error']]
    return MddagError(errors[0]) if errors else None


def part(args: argparse.Namespace) -> int:
    """Run one process of several, and write its result to the folder of the run."""
    from mddag_executor.hosting.host import nodes_of
    from mddag_executor.hosting.initialised import initialised
    from mddag_executor.hosting.loading import ros_arguments
    from mddag_executor.hosting.processes import belong_to_parent, Part
    from mddag_executor.hosting.run_here import run_here
    from msg_graph import loads
    the_part = Part.read(args.part)
    belong_to_parent(the_part.parent)
    task_set: TaskSet = loads(the_part.text, name=args.graph)
    given = options_of(args).of_part(the_part.options, task_set)
    if given.process is None:
        def then(names: list[list[str]]) -> NoReturn:
            the_part.write_result(names)
            _exit(0)  # without the ends of programs that were only probed

        def leave(finish: Callable[[], int]) -> NoReturn:
            _exit(status_of(lambda argv: finish(), ()))

        with initialised(given.ros_args):
            nodes_of(given.specs, ros_arguments(given.ros_args), then, leave)

    def finish(result: RunResult) -> int:
        the_part.write_result({
            **result.to_json(), 'observed': result.observed, 'has_started': result.has_started})
        if given.synthetic is not None and result.error is None:
            _exit(0)  # the nodes are not destroyed one by one
        return _end(result.error)

    return finish(run_here(given, task_set, _display(args, finish), the_part))


def _exit(status: int) -> NoReturn:
    """End the process here, with whatever runs in other threads."""
    sys.stdout.flush()
    sys.stderr.flush()
    remove_segments()
    os._exit(status)


def _end(error: BaseException | None, status: int = 0) -> int:
    """
    Return the exit status, or raise what a node raised.

    The process ends here if a node's thread would keep the interpreter from ending.
    """
    if isinstance(error, KeyboardInterrupt):  # which a program did not catch
        traceback.print_exception(from_user_code(error))
    if error is not None:
        raise error
    left = [t.name for t in threading.enumerate()
            if not t.daemon and t is not threading.main_thread()]
    if not left:
        return status
    warn(f'threads that nodes started still run and are abandoned: {listed(left)}')
    _exit(status)
