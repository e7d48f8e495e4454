# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
`mddag demo --processes N`: the Autoware workload, computing in Python, placed in N processes.

Each step is a process of its own: `graph place`; `run --synthetic spin` of what that wrote, which
records; `replay` of all traces; and, measured in the same way, rclpy's EventsExecutor in the same
processes, and both executors in one process.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mddag_executor.cli.demo import json_of, mddag, WORKERS
from mddag_executor.cli.text import Cell, Progress, table
from mddag_executor.core.tally import counts, total
from mddag_executor.live.bench.spec import Spec
from mddag_executor.report.live_runs import summary
from mddag_executor.report.tables import (
    each_sink,
    percent,
    response_cells,
    sink_table,
    verdicts_line,
)
from mddag_executor.text import counted

UTILISATION_EACH = 0.1
"""Of seven workers: 0.7 of a core for each process."""


def run_demo(
    args: argparse.Namespace, graph: Path, output: Path, say: Callable[[str], None]
) -> dict[str, Any]:
    """
    Run the steps, say what each found, and return all of it.

    :raises mddag_executor.errors.MddagError: when a step fails
    """
    utilisation = args.utilisation or UTILISATION_EACH * args.processes
    load = ['--utilisation', str(utilisation), '--seed', str(args.seed),
            '--workers', str(WORKERS)]
    placed = output / 'placed.yaml'
    say(f'{graph}: callbacks compute in Python, {utilisation * WORKERS:.2f} cores in all')
    say(f'\n== Placed in {counted(args.processes, "process", "processes")} ==')
    placement = json_of(mddag(
        'graph', 'place', str(graph), '--processes', str(args.processes), *load,
        '-o', str(placed), '--json', '-'), 'placing')
    for process, share in zip(placement['processes'], placement['loads']):
        say(f'{process["name"]}: {counted(len(process["nodes"]), "node")}, {share:.2f} of a core')
    say(f'predicted: {verdicts_line(placement["predicted"])}')
    say(f'predicted of one process: {verdicts_line(placement["one_process"])}')
    say(f'\n== Under MultiDeadlineExecutor({WORKERS}) each, recording, {args.seconds:g} s ==')
    live = json_of(mddag(
        'run', str(placed), '--synthetic', 'spin', *load, '--duration', f'{args.seconds:.3f}s',
        '--trace', str(output / 'demo.mcap'), '--json', '-'), 'running', args.seconds + 3)
    say(sink_table(live['dags']))
    for line in summary(live):
        say(line)
    traces = [process['trace']['path'] for process in live['processes']]
    say('\n== The recordings of all processes, replayed as one run ==')
    recorded = json_of(mddag('replay', *traces, '--json', '-'), 'replaying')
    say(_beside(placement['predicted'], live['dags'], recorded['dags']))
    say(f'mddag replay {" ".join(traces)} --report {output / "demo.html"}')
    say(f'\n== Side by side, {args.baseline_seconds:g} s each ==')
    runs = [(what, executor, _measured(args, path, executor, utilisation)) for what, path in (
        (f'{args.processes} processes', placed), ('one process', graph))
        for executor in ('rad-events', 'events')]
    say(table(['', 'executor', 'due', 'in time', 'share'], [
        [what, 'this' if executor == 'rad-events' else 'EventsExecutor', run['sink_jobs_due'],
         run['on_time'], percent(run['on_time'], run['sink_jobs_due'])]
        for what, executor, run in runs]))
    return {'placement': placement, 'live': live, 'recorded': recorded, 'traces': traces,
            'measured': [{'what': what, 'executor': executor, **run}
                         for what, executor, run in runs]}


def _measured(
    args: argparse.Namespace, graph: Path, executor: str, utilisation: float
) -> dict[str, Any]:
    from mddag_executor.live.bench.campaign import measure
    spec = Spec(
        load='autoware', executor=executor, workers=WORKERS, seconds=args.baseline_seconds,
        seed=args.seed, graph=str(graph), utilisation=utilisation, bodies='spin')
    with Progress('measuring', args.baseline_seconds + 3) as progress:
        return measure(spec, progress.update)


def _beside(*several: dict[str, Any]) -> str:
    """Return a table with a row for each sink: predicted, live, and replayed."""
    names = ('predicted', 'live', 'replayed')
    rows: list[list[Cell]] = []
    for sink in each_sink(several[0]):
        results = [dags[sink.dag]['sinks'][sink.name] for dags in several]
        verdicts = [counts(result) for result in results]
        rows.append([
            sink.shown_dag, sink.shown_name, *(percent(v.in_time, v.due) for v in verdicts),
            *(cell for i in (0, 1) for result in results
              for cell in response_cells(result['response_ns'])[i:i + 1])])
    totals = [total(dags) for dags in several]
    rows.append(['all', '', *(percent(v.in_time, v.due) for v in totals), *[''] * 6])
    return table(['DAG', 'sink', *(f'{name} in time' for name in names),
                  *(f'{name} {what}' for what in ('median', 'p99') for name in names)], rows)
