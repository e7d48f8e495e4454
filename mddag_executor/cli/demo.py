# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `demo`: the whole Autoware workload, run, recorded, replayed and compared.

Each step runs in a process of its own, without the threads, caches or nodes of another step:
`mddag run --synthetic sleep`, which records; two times `mddag replay`; and rclpy's own
MultiThreadedExecutor with the same nodes, seed and number of threads.  The nodes measure both
executors in the same way (`mddag_executor.hosting.measure`).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from functools import partial
from io import StringIO
import json
import os
from pathlib import Path
import sys
from typing import Any

from mddag_executor import defaults
from mddag_executor.cli import common, options
from mddag_executor.cli.text import Cell, format_ns, printable, Progress, run_program, table
from mddag_executor.core.tally import counts, total
from mddag_executor.errors import MddagError
from mddag_executor.report.explained import causes_line
from mddag_executor.report.live_runs import summary
from mddag_executor.report.tables import (
    each_sink,
    percent,
    response_cells,
    sink_table,
)
from mddag_executor.resources import find
from mddag_executor.text import counted

EXAMPLE = """\
mddag demo --duration 20s"""

WORKERS = defaults.WORKERS
UTILISATION = 0.6
SEED = 0
"""The first seed; at utilisation 0.6 its draw is feasible (`ExecutionPlan.infeasible`)."""


class DemoError(MddagError):
    """A step of the demo that failed."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add('--duration', type=options.duration, default=20 * 10 ** 9, metavar='TIME',
        help="how long to measure this executor (default: 20s), and half of it rclpy's")
    add('--utilisation', type=options.positive_float, default=UTILISATION, metavar='U',
        help='normalised utilisation that execution times are scaled to (default: %(default)s)')
    add('-o', '--output', default='build/demo', metavar='DIR',
        help='where trace and results are written (default: build/demo)')
    options.add(parser, '--json')


def main(args: argparse.Namespace) -> int:
    """Run the steps and print what each found."""
    output = Path(args.output)
    output.mkdir(parents=True, exist_ok=True)
    graph = find('config/autoware.yaml')
    # at once, also into a pipe: the next step takes long
    say = partial(print, flush=True, file=None if common.wants_tables(args) else StringIO())
    for line in _introduction(args, graph):
        say(line)
    live = run_live(args, graph, output)
    say(sink_table(live['dags']))
    for line in summary(live):
        say(line)
    recorded, rescheduled = run_replays(graph, output)
    say('\n== The recording, replayed ==')
    say(results_table(live=live['dags'], recorded=recorded['dags'],
                      rescheduled=rescheduled['dags']))
    say(agreement(live, recorded))
    for line in causes_line(recorded['misses']):
        say(f'{line} (mddag explain {output / "demo.mcap"})')
    say(f"\n== The same nodes on rclpy's MultiThreadedExecutor({WORKERS}), {_half(args):g} s ==")
    baseline = _baseline(args, graph)
    say(side_by_side(live['measured'], baseline))
    common.write_result(args, {
        'live': live, 'recorded': recorded, 'rescheduled': rescheduled, 'baseline': baseline,
        'trace': str((output / 'demo.mcap').absolute())})
    return 0


def _half(args: argparse.Namespace) -> float:
    """Return how long a baseline is measured, s."""
    seconds: float = args.duration / 2e9
    return seconds


def _baseline(args: argparse.Namespace, graph: Path) -> dict[str, Any]:
    """Run the same nodes on rclpy's executor; return what they measured."""
    from mddag_executor.hosting.peers import measure_peer
    with Progress('measuring', _half(args) + 3) as progress:
        return measure_peer(
            'multi', str(graph), WORKERS, seconds=_half(args), seed=SEED,
            utilisation=args.utilisation, mode='sleep', tick=progress.update)


def _introduction(args: argparse.Namespace, graph: Path) -> Iterator[str]:
    from mddag_executor.hosting.measure import ExecutionPlan
    from msg_graph import load
    task_set = load(graph)
    plan = ExecutionPlan(task_set, SEED, args.utilisation, WORKERS)
    nodes = {callback.node for callback in task_set.callbacks}
    yield (f'{printable(task_set.file)}: {counted(len(task_set.dags), "DAG")}, '
           f'{counted(len(task_set.vertices), "vertex", "vertices")}, '
           f'{counted(len(nodes), "node")}')
    yield (f'Execution times: one draw from the measured distributions (seed {SEED}), scaled '
           f'by {plan.factor:.2f} to utilisation {plan.utilisation:.2f} of {WORKERS} workers. '
           'Another seed gives another draw.')
    infeasible = plan.infeasible()
    if infeasible:
        yield (f'No scheduler can keep the deadlines of {counted(len(infeasible), "sink")}: '
               'with these times the critical path is longer than the deadline.')
    else:
        yield 'No critical path is longer than its deadline.'
    yield (f'\n== rclpy nodes under MultiDeadlineExecutor({WORKERS}), policy rad, recording, '
           f'{args.duration / 1e9:g} s ==')


def run_live(args: argparse.Namespace, graph: Path, output: Path) -> dict[str, Any]:
    """Run the workload under the executor, recording; return the result of `mddag run`."""
    command = [
        'run', str(graph), '--synthetic', 'sleep', '--utilisation', str(args.utilisation),
        '--seed', str(SEED), '--workers', str(WORKERS), '--duration', f'{args.duration}ns',
        '--trace', str(output / 'demo.mcap'), '--overwrite', '--json', '-']
    result = json_of(mddag(*command), 'running', args.duration / 1e9 + 3)
    if result['measured'] is None:
        raise DemoError('mddag run: it ended before it measured anything: run the demo again')
    return result


def run_replays(graph: Path, output: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Replay the recording as it was, and rescheduled by the core."""
    trace = str(output / 'demo.mcap')
    recorded = json_of(mddag('replay', trace, '--json', '-'), 'replaying')
    rescheduled = json_of(
        mddag('replay', trace, str(graph), '--reschedule', '--workers', str(WORKERS),
              '--json', '-'), 'rescheduling')
    return recorded, rescheduled


def mddag(*arguments: str) -> list[str]:
    """Return the command line of a verb."""
    return [sys.executable, '-m', 'mddag_executor', *arguments]


def json_of(command: list[str], what: str, seconds: float | None = None) -> dict[str, Any]:
    """Run a program that prints JSON, with progress on a terminal meanwhile."""
    # Of this machine only: the demo must not find another one's nodes, nor be found by them.
    done = run_program(command, what, seconds, environment={
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', **os.environ})
    errors = done.stderr.decode()
    if done.returncode != 0:
        lines = errors.strip().splitlines() or [f'it ended with status {done.returncode}']
        name = ' '.join(command[2:4]).replace('mddag_executor ', 'mddag ')
        raise DemoError(f'{name}: {lines[-1].removeprefix("error: ")}')
    sys.stderr.write(errors)
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def results_table(**several: dict[str, Any]) -> str:
    """Return a table with a row for each sink: the verdicts and times of several results."""
    rows: list[list[Cell]] = []
    for sink in each_sink(next(iter(several.values()))):
        results = [dags[sink.dag]['sinks'][sink.name] for dags in several.values()]
        verdicts = [counts(result) for result in results]
        rows.append([
            sink.shown_dag, sink.shown_name, *(f'{v.in_time} of {v.due}' for v in verdicts),
            *(response_cells(result['response_ns'])[1] for result in results),
            format_ns(results[0]['relative_deadline_ns'])])
    totals = [total(dags) for dags in several.values()]
    rows.append(['all', '', *(percent(v.in_time, v.due) for v in totals),
                 *[''] * (len(several) + 1)])
    return table(['DAG', 'sink', *(f'{name} in time' for name in several),
                  *(f'{name} p99' for name in several), 'deadline'], rows)


def agreement(live: dict[str, Any], recorded: dict[str, Any]) -> str:
    """Return for how many sinks the replay counts what the executor counted."""
    wrong = []
    n = 0
    for dag, _, name, _, ours in each_sink(live['dags']):
        theirs = recorded['dags'][dag]['sinks'][name]
        n += 1
        if any(ours[key] != theirs[key] for key in ('completed', 'late')):
            wrong.append(
                f'{name} (live {ours["completed"]} completed, {ours["late"]} late; recorded '
                f'{theirs["completed"]}, {theirs["late"]})')
    if not wrong:
        return f'The replay counts what the executor counted, for all {n} sinks.'
    return f'The replay counts otherwise for {len(wrong)} of {n} sinks: ' + '; '.join(wrong)


def side_by_side(ours: dict[str, Any], baseline: dict[str, Any]) -> str:
    """Return a table of both executors: each sink's share in time, then the totals."""
    header = ('DAG', 'sink', 'deadline', 'this: in time', 'p99', 'Multi: in time', 'p99')
    rows: list[list[Cell]] = []
    for dag, shown_dag, name, shown_name, own in each_sink(ours['dags']):
        row: list[Cell] = [shown_dag, shown_name, format_ns(own['relative_deadline_ns'])]
        for sink in (own, baseline['dags'][dag]['sinks'][name]):
            row += [percent(sink['on_time'], sink['due']), response_cells(sink['response_ns'])[1]]
        rows.append(row)
    totals = [
        ('sink jobs due', *(str(r['sink_jobs_due']) for r in (ours, baseline))),
        ('in time', *(percent(r['on_time'], r['sink_jobs_due']) for r in (ours, baseline))),
        ('late', *(str(r['late']) for r in (ours, baseline))),
        ('missing', *(str(r['missing']) for r in (ours, baseline))),
        ('callbacks a second', *(f'{r["callbacks_per_s"]:.0f}' for r in (ours, baseline))),
        ('CPU each', *(_cpu(r) for r in (ours, baseline)))]
    return table(header, rows) + '\n' + table(
        ('', 'MultiDeadlineExecutor', 'MultiThreadedExecutor'), totals)


def _cpu(result: dict[str, Any]) -> str:
    cpu = result['cpu_us_per_callback']
    return '-' if cpu is None else f'{cpu:.0f} us'
