# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `rerun`: real nodes again from a recording, in virtual time, the same every time."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import ExitStack, redirect_stdout
import os
import sys
from typing import BinaryIO, TYPE_CHECKING

from mddag_executor.cli import common, options
from mddag_executor.cli.text import is_quiet, printable, Progress, warn
from mddag_executor.text import counted, listed

if TYPE_CHECKING:
    from mddag_executor.rerun import Difference, Result
    from mddag_executor.results.comparisons import RerunResult

EXAMPLE = """\
mddag rerun drive.mcap graph.yaml --node my_package/tracker -o before.mcap
mddag rerun drive.mcap graph.yaml --node my_package/tracker --expect before.mcap
mddag rerun drive.mcap graph.yaml --node my_package.tracker:main --execution-times run.mcap

exit status: 0 done; 1 the outputs are not those of --expect; 2 bad input; 70 a node raised"""

_PROGRAMS = ('mddag', 'ros2')  # wherever pip, colcon or a user has put them
_MODULE = 'mddag_executor/__main__.py'

REMOVED_OPTIONS = {
    '--times': 'it is --execution-times now', '--tolerance': 'it is --allow-difference now'}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('recording', metavar='BAG|TRACE', type=options.Input,
        help="a bag with the messages that the nodes receive, or a trace of mddag run ('-': "
        'standard input)')
    options.add(parser, 'graph', '--workers', '--json', '--overwrite', '--ros-args')
    add('--node', metavar='SPEC', action='append', required=True,
        help='run this node, as mddag run does; repeat the option for more nodes')
    add('-o', '--output', metavar='OUT.mcap', type=options.Bag,
        help='write what the nodes publish to this bag, with virtual times')
    add('--trace', metavar='RUN.mcap', type=options.Trace,
        help='record the run to this file, for mddag replay')
    add('--expect', metavar='OUT.mcap', type=options.Input,
        help='compare what the nodes publish with this bag, and exit with status 1 if it '
        'differs')
    add('--allow-difference', type=options.share, default=0.0, metavar='X',
        help='with --expect: floating-point numbers may differ by this much, or by this share of '
        'the larger number (default: 0)')
    add('--execution-times', metavar='WHICH', type=options.Input,
        help='how long callbacks take: recorded (the default for a trace), declared (the default '
        'for a bag), or a file: a trace, or JSON with execution times')
    options.add(parser, '--cpus', otherwise='as many as are needed')
    options.add(parser, '--policy', **options.live_policy())
    options.add(parser, '--seed',
                help="seed of Python's and numpy's random numbers and of declared times")
    add('--all-clocks', action='store_true',
        help='make steady and system clocks, and the functions of the module time, virtual as '
        'well')


def main(args: argparse.Namespace) -> int:
    if args.expect is not None:
        os.stat(args.expect)  # now, not after the run
    args.ros_args = args.ros_args or []
    _fix_hashes()
    from mddag_executor.hosting.initialised import quiet_log
    # With `--json -` what nodes print must not get into the JSON.
    with quiet_log(is_quiet()), redirect_stdout(
            sys.stdout if common.wants_tables(args) else sys.stderr):
        result, found = _run(args)
    warn(*result.warnings)
    values = result.result(found)
    differences = [printable(each.line()) for each in found or ()]
    common.show(args, values, (*_lines(args, result, values), *differences))
    if not common.wants_tables(args):
        print(*differences, sep='\n', end='\n' * bool(found), file=sys.stderr)
    return int(bool(found))


def _fix_hashes() -> None:
    """
    Start the program again with fixed hashes of strings, on which the order of a set depends.

    Another program that calls this verb, and a Python that ignores its environment, only get a
    warning.
    """
    if not sys.flags.hash_randomization:
        return
    is_ours = os.path.basename(sys.argv[0]) in _PROGRAMS or sys.argv[0].endswith(_MODULE)
    if is_ours and not sys.flags.ignore_environment:
        os.execve(
            sys.executable, [sys.executable, *sys.orig_argv[1:]],
            {**os.environ, 'PYTHONHASHSEED': '0'})
    warn('hashes of strings are not the same in each run: start Python with PYTHONHASHSEED=0, '
         'without -E and -I')


def _run(args: argparse.Namespace) -> tuple[Result, list[Difference] | None]:
    from mddag_executor.rerun import compare, programs
    from mddag_executor.rerun.inputs import open_input
    from mddag_executor.rerun.run import Rerun
    from mddag_executor.trace.trace_file import whole_trace
    task_set = common.load_graph(args.graph)
    common.leave_out_paths('rerun', task_set)
    path, name = common.input_path(args.recording)
    with ExitStack() as files:
        messages, times = open_input(path, task_set, args.execution_times, args.seed, name)
        output: BinaryIO | None = None
        if args.output is not None:
            output = files.enter_context(common.output_file(args.output))
        trace = None
        if args.trace is not None:
            trace = files.enter_context(whole_trace(args.trace, True))
        run = Rerun(
            messages, times, task_set, workers=args.workers, cpus=args.cpus, policy=args.policy,
            seed=args.seed, all_clocks=args.all_clocks, ros_args=args.ros_args, output=output,
            trace=trace, keep=args.expect is not None)
        with Progress('running', (messages.end - messages.start) / 1e9) as line:
            result = run.run(
                lambda: programs(args.node, args.ros_args),
                lambda done: line.update(done / 1e9))
        if args.expect is None:
            return result, None
        return result, compare(result, args.expect, args.allow_difference)


def _lines(
    args: argparse.Namespace, result: Result, values: RerunResult
) -> Iterator[str]:
    from mddag_executor.report.tables import sink_table
    yield sink_table(values['dags'])
    speed = result.virtual_ns / 1e9 / max(result.elapsed_s, 1e-9)
    yield (f'{counted(result.callbacks, "callback")}, {result.virtual_ns / 1e9:.3f} s in '
           f'{result.elapsed_s:.3f} s ({speed:.1f} times as fast as real time)')
    topics = listed([f'{topic} {n}' for topic, n in sorted(result.counts.items())])
    yield (f'{counted(sum(result.counts.values()), "message")} published'
           + (f' ({printable(topics)})' if topics else '') + f', {result.digest}')
    if result.recorded_topics:
        same = len(result.recorded_topics) - len(result.recorded)
        yield f'{counted(len(result.recorded_topics), "topic")} also recorded, {same} the same'
    for difference in result.recorded:
        yield f'not as recorded: {printable(difference.line())}'
    if args.expect is not None and not values.get('differences'):
        yield f'the same as {printable(args.expect)}'
