# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `demo`: the whole Autoware workload, run, recorded, replayed and compared.

Each step is a command in a process of its own, which is shown with its output: `mddag run`, which
records, and `mddag replay`, as recorded and rescheduled.  Then the same nodes, seed and number of
threads run on rclpy's MultiThreadedExecutor; the nodes measure both executors in the same way
(`mddag_executor.synthetic.measure`).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
import json
import os
from pathlib import Path
import shlex
import sys
from typing import Any

from mddag_executor import defaults
from mddag_executor.cli import common, options
from mddag_executor.cli.text import is_quiet, Progress, run_program, say, table
from mddag_executor.errors import MddagError
from mddag_executor.report.tables import percent
from mddag_executor.resources import find

EXAMPLE = """\
mddag demo --duration 20s"""

WORKERS = defaults.WORKERS
UTILISATION = 0.6
SEED = 0
"""The first seed; at utilisation 0.6 its draw is feasible (`ExecutionPlan.infeasible`)."""


class DemoError(MddagError):
    """A step of the demo that failed."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('--duration', type=options.duration, default=20 * 10 ** 9, metavar='TIME',
        help="how long to measure this executor (default: 20s); rclpy's is measured for half of "
        'that time')
    add('--utilisation', type=options.positive_float, default=UTILISATION, metavar='U',
        help='utilisation that execution times are scaled to (default: %(default)s)')
    add('-o', '--output', default='build/demo', metavar='DIR',
        help='where the trace and the result of each step are written (default: build/demo)')
    options.add(parser, '--json')


def main(args: argparse.Namespace) -> int:
    output = Path(args.output)
    output.mkdir(parents=True, exist_ok=True)
    graph, trace = str(find('config/autoware.yaml')), str(output / 'demo.mcap')
    show = say if common.wants_tables(args) else lambda text: None
    live = _step(
        show, output / 'run.json', args.duration / 1e9 + 3, 'run', graph, '--synthetic', 'sleep',
        '--utilisation', str(args.utilisation), '--seed', str(SEED), '--workers', str(WORKERS),
        '--duration', f'{args.duration / 1e9:g}s', '--trace', trace, '--overwrite')
    if live['measured'] is None:
        raise DemoError('mddag run: it ended before it measured anything: run the demo again')
    recorded = _step(show, output / 'recorded.json', None, 'replay', trace)
    show(_agreement(live['dags'], recorded['dags']))
    rescheduled = _step(
        show, output / 'rescheduled.json', None, 'replay', trace, graph, '--reschedule')
    seconds = args.duration / 2e9
    show(f"\n== The same nodes on rclpy's MultiThreadedExecutor({WORKERS}), {seconds:g} s ==")
    from mddag_executor.synthetic.peers import measure_peer
    with Progress('measuring', seconds + 3) as progress:
        peer = measure_peer(graph, WORKERS, seconds=seconds, seed=SEED,
                            utilisation=args.utilisation, tick=progress.update)
    show(_side_by_side(live['measured'], peer))
    common.write_result(args, {
        'live': live, 'recorded': recorded, 'rescheduled': rescheduled, 'baseline': peer,
        'trace': os.path.abspath(trace)})
    return 0


def _step(
    show: Callable[[str], None], result: Path, seconds: float | None, *words: str
) -> dict[str, Any]:
    """Run a command, show it and what it prints; return its result."""
    show(f'\n$ mddag {shlex.join(words)}')
    sys.stdout.flush()
    # Of this machine only: the demo must not find another one's nodes, nor be found by them.
    done = run_program(
        [sys.executable, '-m', 'mddag_executor', *words, '--json', str(result),
         *['--quiet'] * is_quiet()],
        f'mddag {words[0]}', seconds,
        environment={'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', **os.environ})
    errors = done.stderr.decode()
    if done.returncode != 0:
        lines = errors.strip().splitlines() or [f'it ended with status {done.returncode}']
        raise DemoError(f'mddag {words[0]}: {lines[-1].removeprefix("error: ")}')
    sys.stderr.write(errors)
    show(done.stdout.decode())
    found: dict[str, Any] = json.loads(result.read_text(encoding='utf-8'))
    return found


def _agreement(live: dict[str, Any], recorded: dict[str, Any]) -> str:
    """Return for how many sinks the replay counts what the executor counted."""
    sinks = [(sink, recorded[name]['sinks'][key])
             for name, dag in live.items() for key, sink in dag['sinks'].items()]
    same = sum(all(a[key] == b[key] for key in ('completed', 'late')) for a, b in sinks)
    return f'The replay counts what the executor counted, for {same} of {len(sinks)} sinks.'


def _side_by_side(ours: dict[str, Any], peer: dict[str, Any]) -> str:
    def row(what: str, cells: Any) -> tuple[str, ...]:
        return (what, *map(cells, (ours, peer)))

    return table(('', 'MultiDeadlineExecutor', 'MultiThreadedExecutor'), (
        row('measured for', lambda r: f'{r["window_ns"] / 1e9:.1f} s'),
        row('results due', lambda r: str(r['sink_jobs_due'])),
        row('in time', lambda r: percent(r['on_time'], r['sink_jobs_due'])),
        row('late', lambda r: str(r['late'])), row('missing', lambda r: str(r['missing'])),
        row('callbacks a second', lambda r: f'{r["callbacks_per_s"]:.0f}'),
        row('CPU per callback', lambda r: '-' if r['cpu_us_per_callback'] is None
            else f'{r["cpu_us_per_callback"]:.0f} us')))
