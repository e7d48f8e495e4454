# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The benchmark `replay`: speed of reading and linking traces, and accuracy of rescheduling.

Figures depend on the machine and its other load: each reader has a separate process, and the best
of several runs counts.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
import statistics
import subprocess
import sys
import tempfile
from typing import Any

from benchmarks import arguments
from benchmarks.slack import check_slack
from benchmarks.slack import show as show_slack
from mddag_executor.cli import common, options
from mddag_executor.cli.text import format_ns, one_line, printable, Progress, table
from mddag_executor.errors import MddagError, UsageError
from mddag_executor.resources import find
from mddag_executor.text import counted

HELP = 'measure the replayer'
DESCRIPTION = """\
Measure the replayer: the speed and memory of reading and linking, next to other readers; with
--accuracy how well reschedule predicts a live run; with --slack whether the slack that it finds
holds in live runs."""
EXAMPLE = """\
python -m benchmarks replay
python -m benchmarks replay --events 10000000 --json replay.json
python -m benchmarks replay --trace run.mcap
python -m benchmarks replay --accuracy --utilisation 0.3,0.6,0.8 --seconds 10
python -m benchmarks replay --accuracy --utilisation 0.6 --workers 7,4
python -m benchmarks replay --accuracy --bodies spin --seconds 20
python -m benchmarks replay --slack --utilisation 0.3 --seconds 10"""

MEDIAN_LIMIT, P99_LIMIT = 0.05, 0.15
_FEW = 100
"""Sinks with fewer jobs are left out: their quantiles are not significant."""
_WARM_UP_S = 2
"""Additional recorded time that is not judged, in which the GIL use of callbacks is measured."""
_UTILISATION = {'sleep': [0.3, 0.6, 0.8]}
_COMPUTING = [0.05, 0.08]
"""Callbacks that compute have one interpreter: 0.08 of seven workers is 0.56 of a core."""
_WORKERS = {'sleep': [7]}
_OTHERS = [7, 1, 2]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add('--trace', metavar='FILE', help='a trace to read (default: one that is written for it)')
    add('--events', type=options.positive_int, default=1_000_000, metavar='N',
        help='how many events the trace is to have (default: %(default)s)')
    add('--others', type=options.positive_int, default=200_000, metavar='N',
        help="messages after which mcap's and rosbags' readers are stopped (default: %(default)s)")
    arguments.add_repeat(
        parser, 3,
        'measure R times alternately: the best speed counts, and the median response times')
    add('--accuracy', action='store_true',
        help='record live runs, reschedule them, and compare the response times of each sink')
    add('--slack', action='store_true',
        help='find the slack of the declaration, and look in live runs whether a callback that '
        'takes 0.9 times its factor longer breaks nothing, and one of 1.1 times something')
    add('--callbacks', type=options.positive_int, default=10, metavar='N',
        help='with --slack: how many callbacks to try (default: %(default)s)')
    add('--bodies', choices=('sleep', 'spin', 'native', 'mixed'), default='sleep',
        help='with --accuracy: how the callbacks of the live runs execute (default: sleep)')
    add('--utilisation', type=options.list_of(options.positive_float), metavar='U[,U…]',
        help='with --accuracy: utilisation of the live runs (default: 0.3,0.6,0.8 for callbacks '
        'that sleep, else 0.05,0.08)')
    add('--seconds', type=options.positive_float, default=30.0, metavar='S',
        help='with --accuracy: how long each live run is, after 2 s that are left out '
        '(default: 30)')
    add('--workers', type=options.list_of(options.workers), metavar='M[,M…]',
        help='with --accuracy: of the live runs; the runs with further numbers are predicted '
        'from the recording with the first (default: 7 for callbacks that sleep, else 7,1,2)')
    arguments.add_graph(parser)
    options.add(parser, '--json')


def main(args: argparse.Namespace) -> int:
    """Measure and print."""
    if args.accuracy and args.slack:
        raise UsageError('--slack: it is another measurement: leave it or --accuracy out')
    if (args.accuracy or args.slack) and args.trace:
        raise UsageError(f'--{"accuracy" if args.accuracy else "slack"}: it records its own runs: '
                         'leave --trace out')
    args.utilisation = args.utilisation or _UTILISATION.get(args.bodies, _COMPUTING)
    args.workers = args.workers or _WORKERS.get(args.bodies, _OTHERS)
    with tempfile.TemporaryDirectory(prefix='mddag-bench-') as folder:
        result = _accuracy(args, folder) if args.accuracy else \
            _slack(args, folder) if args.slack else _speed(args, folder)
    if common.write_result(args, result):
        if args.accuracy:
            _show_accuracy(result)
        elif args.slack:
            show_slack(result)
        else:
            _show_speed(result)
    return 0


def _slack(args: argparse.Namespace, folder: str) -> dict[str, Any]:
    def record(graph: str, path: str) -> None:
        _record(graph, args, None, args.workers[0], path)

    return check_slack(args, arguments.load_workload(args.graph), folder, record)


# --- speed ---------------------------------------------------------------------------------------

def _speed(args: argparse.Namespace, folder: str) -> dict[str, Any]:
    from benchmarks.readers import measure, READERS, write_long_trace
    from mddag_executor.trace import TraceReader
    path = args.trace
    if path is None:
        path = os.path.join(folder, 'long.mcap')
        task_set = arguments.load_workload(args.graph)
        write_long_trace(path, task_set, args.events)
    events = TraceReader(path).message_count
    rows: dict[str, dict[str, Any]] = {}
    with Progress('measuring', len(READERS) * args.repeat) as line:
        for turn in range(args.repeat):
            for place, name in enumerate(READERS):
                line.update(turn * len(READERS) + place, name)
                found = measure(name, path, args.others)
                rows[name] = min(
                    found, rows.get(name, found), key=lambda row: float(row['elapsed_s']))
    return {'events': events, 'bytes': os.path.getsize(path), 'readers': rows}


def _show_speed(result: dict[str, Any]) -> None:
    print(f'{counted(result["events"], "event")}, {result["bytes"] / 1e6:.1f} MB')
    print(table(
        ('what', 'events', 'time', 'CPU', 'events a second', 'peak memory'),
        [(name, row['events'], f'{row["elapsed_s"]:.2f} s', f'{row["cpu_s"]:.2f} s',
          f'{round(row["events_per_s"]):,}', f'{row["peak_mb"]:.0f} MB')
         for name, row in result['readers'].items()]))


# --- accuracy ------------------------------------------------------------------------------------

def _accuracy(args: argparse.Namespace, folder: str) -> dict[str, Any]:
    graph = args.graph or str(find('config/autoware.yaml'))
    if graph == '-':
        name, text = common.read_text(graph)
        graph = os.path.join(folder, 'graph.yaml')
        Path(graph).write_text(text, encoding='utf-8')
    runs: list[dict[str, Any]] = []
    steps = len(args.utilisation) * len(args.workers) * args.repeat
    with Progress('recording', steps) as line:
        for turn in range(args.repeat):
            for utilisation in args.utilisation:
                first = None
                for workers in args.workers:
                    line.update(len(runs), f'utilisation {utilisation:g}, '
                                f'{counted(workers, "worker")}')
                    path = os.path.join(folder, f'{turn}-{utilisation}-{workers}.mcap')
                    _record(graph, args, utilisation, workers, path)
                    first = first or path
                    runs.append(_compared(first, path, utilisation, workers, args.workers[0]))
    return {'bodies': args.bodies, 'seconds': args.seconds, 'repeat': args.repeat, 'runs': runs,
            'summary': _summaries(runs)}


def _record(
    graph: str, args: argparse.Namespace, utilisation: float | None, workers: int, path: str
) -> None:
    """Record a live run, in a separate process; without utilisation with the declared times."""
    # The load is the utilisation of the first number of workers: it stays the same.
    scaled = [] if utilisation is None else [
        '--utilisation', repr(utilisation * args.workers[0] / workers)]
    done = subprocess.run(
        [sys.executable, '-m', 'mddag_executor', 'run', graph, '--synthetic', args.bodies,
         *scaled, '--workers', str(workers), '--duration', f'{args.seconds + _WARM_UP_S:g}s',
         '--trace', path, '--overwrite'],
        capture_output=True, text=True, check=False, timeout=args.seconds + 120)
    if done.returncode != 0 or not os.path.exists(path):
        lines = done.stderr.strip().splitlines()
        raise MddagError(f'the live run failed: {one_line(lines[-1]) if lines else "no reason"}')


def _compared(
    recorded_before: str, path: str, utilisation: float, workers: int, recorded_workers: int
) -> dict[str, Any]:
    """Return how well a run is predicted from a recording of the same or another run."""
    from mddag_executor import replay, reschedule
    skip = _WARM_UP_S * 1_000_000_000
    recorded = replay(path, skip=skip).result()
    predicted = reschedule(recorded_before, workers=workers, skip=skip).result()
    ideal = reschedule(recorded_before, workers=workers, skip=skip, overheads=False).result()
    rows = []
    for dag_name, dag in recorded['dags'].items():
        for name, sink in dag['sinks'].items():
            times, expected, without = (
                side['dags'][dag_name]['sinks'][name]['response_ns']
                for side in (recorded, predicted, ideal))
            if times and expected and without:
                rows.append(_with_errors({
                    'dag': dag_name, 'sink': name, 'jobs': sink['completed'],
                    'recorded_median': times['median'], 'predicted_median': expected['median'],
                    'ideal_median': without['median'], 'recorded_p99': times['p99'],
                    'predicted_p99': expected['p99']}))
    return {
        'utilisation': utilisation, 'workers': workers, 'recorded_workers': recorded_workers,
        'overheads': predicted['overheads'], 'sinks': rows}


def _with_errors(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row with the relative errors of the prediction."""
    median, p99 = (row[f'predicted_{name}'] / row[f'recorded_{name}'] - 1
                   for name in ('median', 'p99'))
    return {**row, 'median_error': median, 'p99_error': p99,
            'within': abs(median) <= MEDIAN_LIMIT and abs(p99) <= P99_LIMIT}


def _summaries(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for each setting and sink, with medians of the repeated runs."""
    found: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for run in runs:
        setting = {name: run[name] for name in ('utilisation', 'workers', 'recorded_workers')}
        for row in run['sinks']:
            which = {**setting, 'dag': row['dag'], 'sink': row['sink']}
            found.setdefault(tuple(which.items()), []).append(row)
    medians = ({**dict(which), **{
        name: statistics.median(row[name] for row in rows) for name in rows[0]
        if name == 'jobs' or name.endswith(('_median', '_p99'))}} for which, rows in found.items())
    return [_with_errors(row) for row in medians if row['jobs'] >= _FEW]


def _show_accuracy(result: dict[str, Any]) -> None:
    from mddag_executor.report.tables import short_names
    settings = dict.fromkeys(
        (row['utilisation'], row['workers'], row['recorded_workers'])
        for row in result['summary'])
    for setting in settings:
        rows = [row for row in result['summary']
                if (row['utilisation'], row['workers'], row['recorded_workers']) == setting]
        short = short_names(row['sink'] for row in rows)
        utilisation, workers, recorded = setting
        source = 'the recording itself' if workers == recorded else \
            f'a recording with {counted(recorded, "worker")}'
        print(f'utilisation {utilisation:g} of {counted(recorded, "worker")}, '
              f'{counted(workers, "worker")}, predicted from {source}:')
        print(table(
            ('DAG', 'sink', 'jobs', 'median', 'predicted', 'error', 'without overheads', 'p99',
             'predicted', 'error', ''),
            [(printable(row['dag']), short[row['sink']], int(row['jobs']),
              *(format_ns(round(row[f'{side}_median'])) for side in ('recorded', 'predicted')),
              f'{row["median_error"]:+.1%}'.replace('%', ' %'),
              format_ns(round(row['ideal_median'])),
              *(format_ns(round(row[f'{side}_p99'])) for side in ('recorded', 'predicted')),
              f'{row["p99_error"]:+.1%}'.replace('%', ' %'),
              '' if row['within'] else 'worse')
             for row in rows]))
        within = sum(row['within'] for row in rows)
        print(f'{within} of {len(rows)} sinks within {MEDIAN_LIMIT:.0%} of the median and '
              f'{P99_LIMIT:.0%} of the p99\n')
