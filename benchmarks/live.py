# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The benchmark `live`: compares executors of rclpy nodes, each in a separate process.

All errors of the command line are reported before the first measurement.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
import tempfile
from typing import Any

from benchmarks import arguments
from benchmarks.campaign import (
    DECLARED,
    EXECUTORS,
    LOADS,
    NONE,
    parse_executors,
    PHASES,
    ROBOT,
    ROBOT_GRAPH,
    run_all,
    Spec,
)
from mddag_executor import defaults
from mddag_executor.cli import common, options
from mddag_executor.cli.text import Cell, Progress, table, warn
from mddag_executor.core import POLICIES
from mddag_executor.errors import UsageError
from mddag_executor.report.tables import percent
from mddag_executor.resources import find
from mddag_executor.text import counted

HELP = 'measure executors of rclpy nodes, this one and those of rclpy, side by side'
DESCRIPTION = 'Measure executors of rclpy nodes, this one and those of rclpy, side by side.'
EXAMPLE = """\
python -m benchmarks live --load autoware --utilisation 0.3,0.6,0.8 --seconds 10
python -m benchmarks live --load autoware --executors rad,multi --policies rad,fifo,rm,wc,gedf
python -m benchmarks live --load robot --scale 1,1.2 --seconds 20
python -m benchmarks live --load topics --topics 50 --rate 100 --repeat 3 --json topics.json
"""

UTILISATIONS = (0.3, 0.6, 0.8)
TOPICS = ((20, 50.0), (50, 100.0))
IDLE = (1, 10, 100, 1000)
ENTITIES_RATE_HZ = 100.0

# Loads of each option; with another load an option is an error.
_LOADS_OF_OPTIONS = {
    'graph': ('autoware', 'reference-system'), 'utilisation': ('autoware', 'reference-system'),
    'bodies': ('autoware', 'reference-system'), 'topics': ('topics',),
    'rate': ('topics', 'entities'), 'idle': ('entities',),
    'phases': ('topics',), 'scale': (ROBOT,)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add('--load', choices=LOADS, required=True,
        help='autoware and reference-system: the synthetic nodes of these declarations; topics: '
        'empty callbacks of many topics; entities: one active topic next to idle subscriptions; '
        'robot: the ordinary nodes of examples/robot')
    add('--executors', default=','.join(EXECUTORS), metavar='E[,E…]',
        help=f'some of {", ".join(EXECUTORS)}; the first is this one, which takes another policy '
        'as rad:fifo (default: all); and none: what the nodes of a declaration cost without an '
        'executor')
    add('--policies', metavar='P[,P…]',
        help=f'run this executor with each of these: {", ".join(POLICIES)} (default: rad)')
    add('--utilisation', type=options.list_of(options.positive_float), metavar='U[,U…]',
        help='scale the execution times to these normalised utilisations, sum(C/T)/workers '
        '(default: 0.3,0.6,0.8 for autoware, as declared for reference-system)')
    add('--bodies', choices=('sleep', 'spin', 'native', 'mixed'),
        help='how the synthetic callbacks execute: they sleep, compute in Python, compute without '
        'the interpreter lock, or, drawn for each, do one of the three (default: sleep)')
    add('--topics', type=options.positive_int, metavar='N',
        help='with --load topics: how many (default: both 20 at 50 Hz and 50 at 100 Hz)')
    add('--rate', type=options.positive_float, metavar='HZ',
        help='how often each topic is published (default: see --topics; 100 for entities)')
    add('--idle', type=options.list_of(options.not_negative_int), metavar='N[,N…]',
        help='with --load entities: how many idle subscriptions (default: 1,10,100,1000)')
    add('--phases', choices=PHASES,
        help='with --load topics: each topic at a phase of its own, or all published in a row, '
        'as one timer does (default: drawn)')
    add('--scale', type=options.list_of(options.positive_float), metavar='F[,F…]',
        help='with --load robot: factor of the time that its nodes compute (default: 1)')
    add('--workers', type=options.workers, default=defaults.WORKERS, metavar='M',
        help='threads of this executor and of MultiThreadedExecutor (default: %(default)s)')
    add('--seconds', type=options.positive_float, default=10.0, metavar='S',
        help='how long each measurement is, after a warm-up of 1 s (default: 10)')
    add('--seed', type=options.seed, default=arguments.LIVE_SEED, metavar='N',
        help='seed of the drawn execution times and phases, the same for all executors; with the '
        'default (%(default)s) every deadline of the Autoware workload can be kept')
    arguments.add_repeat(parser, 1, 'measure everything R times alternately, and take the medians')
    arguments.add_graph(parser)
    options.add(parser, '--json')


def main(args: argparse.Namespace) -> int:
    """Make all measurements and print them."""
    _check(args)
    executors = parse_executors(args.executors, args.policies)
    if args.load not in DECLARED and any(name == NONE for name, _ in executors):
        raise UsageError(
            f'--executors: none: not with --load {args.load}, whose publishers are in another '
            f'process: leave it out, or take --load {" or ".join(DECLARED)}')
    with _graph(args) as graph:
        specs = make_specs(args, executors, graph)
        results = _measure(specs, args.repeat)
    for result in results:
        if graph is not None:
            result['graph'] = args.graph or graph
    common.show(args, results, (result_table(results), *notes(results)))
    return 0


def _check(args: argparse.Namespace) -> None:
    for option, loads in _LOADS_OF_OPTIONS.items():
        if getattr(args, option) is not None and args.load not in loads:
            raise UsageError(
                f'--{option}: it means nothing to --load {args.load}: leave it out, or take '
                f'--load {" or ".join(loads)}')
    if find_spec('rclpy') is None:
        raise ModuleNotFoundError('there is no rclpy', name='rclpy')


@contextmanager
def _graph(args: argparse.Namespace) -> Iterator[str | None]:
    """Yield the path of the declaration, checked with all utilisations; None: no declaration."""
    if args.load == ROBOT:
        yield str(find(ROBOT_GRAPH))
        return
    if args.load not in DECLARED:
        yield None
        return
    from mddag_executor.synthetic.measure import ExecutionPlan
    from msg_graph import load, loads
    with tempfile.TemporaryDirectory(prefix='mddag-') as folder:
        path = args.graph or str(find(DECLARED[args.load]))
        if path == '-':
            name, text = common.read_text(path)
            task_set = loads(text, name=name)
            path = str(Path(folder, 'graph.yaml'))
            Path(path).write_text(text, encoding='utf-8')
        else:
            task_set = load(path)
        for utilisation in _utilisations(args):
            plan = ExecutionPlan(task_set, args.seed, utilisation, args.workers)
            if infeasible := plan.infeasible():
                warn(f'at utilisation {plan.utilisation:.2f} with seed {args.seed} '
                     f'no scheduler can keep the deadlines of {counted(len(infeasible), "sink")}: '
                     'the critical path is longer')
        yield path


def _utilisations(args: argparse.Namespace) -> Sequence[float | None]:
    if args.utilisation is not None:
        given: list[float | None] = args.utilisation
        return given
    return UTILISATIONS if args.load == 'autoware' else [None]


def make_specs(
    args: argparse.Namespace, executors: Sequence[tuple[str, str]], graph: str | None
) -> list[Spec]:
    """Return the measurements of a command line, in the order of the table."""
    variants: list[dict[str, Any]]
    if args.load == ROBOT:
        variants = [{'graph': graph, 'scale': scale} for scale in args.scale or [1.0]]
    elif graph is not None:
        variants = [{'graph': graph, 'utilisation': utilisation, 'bodies': args.bodies or 'sleep'}
                    for utilisation in _utilisations(args)]
    elif args.load == 'topics':
        pairs = TOPICS if args.topics is None and args.rate is None else [
            (args.topics or TOPICS[0][0], args.rate or TOPICS[0][1])]
        variants = [{'topics': topics, 'rate_hz': rate,
                     'phases': args.phases or 'drawn'}
                    for topics, rate in pairs]
    else:
        rate = args.rate or ENTITIES_RATE_HZ
        variants = [{'idle': idle, 'rate_hz': rate}
                    for idle in args.idle or IDLE]
    return [
        Spec(load=args.load, executor=executor, policy=policy, workers=args.workers,
             seconds=args.seconds, seed=args.seed, **variant)
        for variant in variants for executor, policy in executors]


def _measure(specs: Sequence[Spec], repeat: int) -> list[dict[str, Any]]:
    each = specs[0].seconds + 3.0  # with discovery and warm-up
    with Progress('measuring', len(specs) * repeat * each) as progress:
        def tick(spec: Spec, made: int, passed: float) -> None:
            note = f'({spec.name}, {made + 1} of {len(specs) * repeat})'
            progress.update(made * each + min(passed, each), note)

        return run_all(specs, repeat, tick, warn)


def result_table(results: Sequence[dict[str, Any]]) -> str:
    """Return the table for a terminal: a row for each measurement."""
    load = results[0]['load']
    if load == ROBOT:
        return robot_table(results)
    rows = [_row(load, result) for result in results]
    return table([title for title, _ in rows[0]], [[cell for _, cell in row] for row in rows])


def robot_table(results: Sequence[dict[str, Any]]) -> str:
    """Return the table of the robot's sinks: a row for each, a measurement after the other."""
    rows: list[list[Cell]] = []
    for result in results:
        lead: list[Cell] = [f'{result["scale"]:g}', result['executor'],
                            _number(result['cpu_cores'], '.2f')]
        for name, sink in result['sinks'].items():
            times = sink['response_ns'] or {}
            rows.append([
                *lead, name, sink['due'],
                percent(sink['on_time'], sink['due']) if sink['due'] else None,
                *(_number(times[key] / 1e6, '.1f', ' ms') if key in times else None
                  for key in ('median', 'p99', 'max'))])
            lead = [None, None, None]
    header = ['scale', 'executor', 'cores', 'sink', 'due', 'in time', 'median', 'p99', 'max']
    return table(header, rows)


def _row(load: str, result: dict[str, Any]) -> list[tuple[str, Cell]]:
    """Return the titles and cells of a measurement."""
    row: list[tuple[str, Cell]] = [('utilisation', _number(result['utilisation'], '.2f'))]
    if load == 'topics':
        row = [('topics', result['topics']), ('rate', f'{result["rate_hz"]:g} Hz')]
    elif load == 'entities':
        row = [('idle', result['idle'])]
    row.append(('executor', result['executor']))
    due = result['sink_jobs_due']
    if load in DECLARED:
        row += [('due', due),
                ('in time', None if due is None else percent(result['on_time'], due))]
        if result['important_due']:
            row.append(('important in time', percent(
                result['important_on_time'], result['important_due'])))
    else:
        row += [('published', result['published']), ('lost', result['lost'])]
    row += [('callbacks/s', _number(result['callbacks_per_s'], '.0f')),
            ('CPU per callback', _number(result['cpu_us_per_callback'], '.1f', ' us'))]
    if load not in DECLARED:
        row.append(('of it DDS', _number(
            result['middleware_cpu_us_per_callback'], '.1f', ' us')))
    row += _times('dispatch', result['dispatch_latency_us'])
    return row + (
        _times('hot path', result['hot_path_us']) if load == 'reference-system' else [])


def _times(what: str, latency: dict[str, Any] | None) -> list[tuple[str, Cell]]:
    times = latency or {}
    return [(f'{what} p50' if name == 'p50' else name,
             None if times.get(name) is None else f'{times[name] / 1000:.2f} ms')
            for name in ('p50', 'p99', 'max')]


def _number(value: float | None, form: str, unit: str = '') -> str | None:
    return None if value is None else f'{value:{form}}{unit}'


def notes(results: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines below the table."""
    first = results[0]
    how = f', medians of {first["repeat"]}' if first['repeat'] > 1 else ''
    yield (f'{first["seconds"]:g} s each{how}, seed {first["seed"]}, '
           + counted(first['workers'], 'worker')
           + (', published together' if first.get('phases') == 'together' else ''))
    if first['load'] == ROBOT:
        yield ("in time: by the nodes' own stamps, of the results that were due; cores: CPU of "
               'the whole process')
    elif first['load'] in DECLARED:
        yield ('in time: of the results that were due, noticed by the executor or not; CPU: of '
               'the whole process')
    else:
        yield ('lost: published and never run, warm-up included; CPU: of the whole process, '
               "without the publishers; of it DDS: the middleware's own threads")
    for result in results:
        for run in result['runs']:
            wrong = run.get('attribution', {}).get('wrong', 0)
            if wrong:
                yield f'{result["executor"]}: {counted(wrong, "callback")} ran as the wrong job'
