# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `simulate`: one run of a declaration in virtual time.

Each vertex has one execution time for the whole run, as in the paper's experiment: drawn from the
declared distribution (`--seed`) or read from a file (`--execution-times`).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import TYPE_CHECKING

from mddag_executor import defaults
from mddag_executor.cli import common, options, verdicts
from mddag_executor.cli.text import format_ns, printable, Progress
from mddag_executor.text import counted

if TYPE_CHECKING:
    from mddag_executor.results.replays import PathsResult
    from mddag_executor.results.simulations import SimulateResult
    from msg_graph import TaskSet

EXAMPLE = """\
mddag simulate config/autoware.yaml --policy rad --workers 7 --duration 3s --preemptive
mddag simulate graph.yaml --execution-times times.json --json - --fail-on-miss"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('--judge', choices=('horizon', 'completions'), default='horizon',
        help='a job that is overdue at the end is late (horizon, the default), or only completed '
        'jobs are judged (completions, as in the paper)')
    add('--stop-at-first-miss', action='store_true',
        help='end the run with the first missed deadline')
    add('--trace', metavar='OUT.mcap', type=options.Trace, help='record the run to this file')
    options.add(
        parser, 'graph', '--policy', '--on-late', '--workers', '--cpus', '--preemptive',
        '--duration', '--execution-times', '--seed', '--utilisation', '--fail-on-miss',
        '--report', '--json', '--overwrite')


def main(args: argparse.Namespace) -> int:
    from mddag_executor.simulate import periodic_workload, Settings, simulate, utilisation
    task_set = common.load_graph(args.graph)
    workers = defaults.workers(args.workers, task_set)
    times = execution_times(args, task_set, workers)
    settings = Settings(
        policy=args.policy, on_late=args.on_late, pools=(workers,), duration_ns=args.duration,
        preemptive=bool(args.preemptive), judge=args.judge,
        stop_at_first_miss=args.stop_at_first_miss, cpus=args.cpus)
    load = periodic_workload(task_set, times, args.duration)
    required = any(path.requirements for path in task_set.paths)
    with Progress('simulating', settings.duration_ns) as line:
        run = simulate(
            task_set, load, settings, utilisation=utilisation(task_set, times, workers),
            log=bool(args.trace or args.report or required), progress=line.update)
    if args.trace is not None:
        from mddag_executor.trace.trace_file import whole_trace
        from mddag_executor.whatif.run_writer import write_trace
        with whole_trace(args.trace, True) as path:
            write_trace(path, task_set, load, run)
    if args.report is not None:
        from mddag_executor.report.html import of_run
        common.write_report(args.report, of_run(task_set, load, run))
    paths: PathsResult = {}
    if required:
        from mddag_executor.whatif.computed import ComputedRun
        paths = ComputedRun.of_run(task_set, load, run).requirements()
    result: SimulateResult = {
        **run.result(), **paths, 'file': task_set.file, 'judge': run.settings.judge,
        'seed': args.seed if args.execution_times is None else None, 'ended_ns': run.ended_ns,
        'trace': args.trace}
    common.show(args, result, _lines(result))
    return verdicts.exit_status(args, result, task_set.file, 'simulate for longer')


def execution_times(
    args: argparse.Namespace, task_set: TaskSet, workers: int
) -> list[list[int]]:
    """Return the execution times that `--execution-times`, `--seed`, `--utilisation` give."""
    from mddag_executor.simulate import (
        draw_execution_times,
        read_execution_times,
        scale_execution_times,
    )
    if args.execution_times is None:
        times = draw_execution_times(task_set, args.seed)
    else:
        name, text = common.read_text(args.execution_times)
        times = read_execution_times(task_set, text, name)
    if args.utilisation is not None:
        times = scale_execution_times(task_set, times, workers, args.utilisation)
    return times


def _lines(result: SimulateResult) -> Iterator[str]:
    from mddag_executor.report.tables import requirement_table, run_lines, sink_table
    yield sink_table(result['dags'])
    if result.get('requirements'):
        yield requirement_table(result['requirements'])
    jobs = sum(dag['jobs'] for dag in result['dags'].values())
    yield from run_lines(result, f', {counted(jobs, "job")}')
    if result['ended_ns'] < result['duration_ns']:
        yield f'stopped at the first miss, at {format_ns(result["ended_ns"], 9)}'
    if result['trace'] is not None:
        yield f'trace: {printable(result["trace"])}'
