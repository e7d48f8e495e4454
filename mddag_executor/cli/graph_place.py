# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph place`: which node runs in which process, so that the deadlines hold."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import Any, TYPE_CHECKING

from mddag_executor import defaults
from mddag_executor.cli import common, options
from mddag_executor.cli.recorded import as_recorded, Source
from mddag_executor.cli.text import Cell, one_line, Progress, table
from mddag_executor.text import counted

if TYPE_CHECKING:
    from mddag_executor.laboratory.placement import Placing
    from mddag_executor.laboratory.prediction import Predictor
    from msg_graph import Process, TaskSet

EXAMPLE = """\
mddag graph place config/autoware.yaml --processes 2 --cpus 2 --utilisation 0.2 -o placed.yaml
mddag graph place graph.yaml --processes 3 --trace run.mcap --apart /lidar,/camera -o placed.yaml
mddag run placed.yaml --node my_robot/lidar --node my_robot/camera --node my_robot/control"""
DESCRIPTION = """\
Pack the nodes of a declaration into processes by the time for which they need the interpreter of
Python, and improve that by simulation with the rules of the scheduler: each process computes in
one callback at a time, and all share the CPUs. The result is the declaration with `processes:`, as
`mddag run` reads it."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('--processes', type=options.positive_int, required=True, metavar='N',
        help='how many processes')
    add('-o', '--output', metavar='PLACED.yaml', type=options.Output, required=True,
        help="the declaration to write ('-': to standard output)")
    options.add(parser, '--cpus', otherwise='those of this machine')
    options.add(parser, '--workers', only='in each process, ')
    options.add(parser, '--policy')
    add('--trace', metavar='TRACE', type=options.Input, action='append', default=[],
        help='use the execution times of a recorded run, and which callbacks compute in Python '
        'there (default: as declared); repeat it for the traces of several processes')
    options.add(parser, '--execution-times', '--utilisation', '--seed', only='without --trace: ')
    for option, which in (('--together', 'that'), ('--apart', 'of which no two')):
        add(option, metavar='NODE,NODE…', action='append', default=[], type=_nodes,
            help=f'nodes {which} run in one process; repeat it for more groups')
    options.add(parser, 'graph', '--duration', '--json')


def _nodes(text: str) -> list[str]:
    return [node.strip() for node in text.split(',')]


def main(args: argparse.Namespace) -> int:
    from mddag_executor.cli.simulate import execution_times
    from mddag_executor.laboratory.placement import Placing
    from mddag_executor.laboratory.prediction import cost_of, improve, Predictor, PUBLISH_NS
    from msg_graph import Process
    from msg_graph.edit import with_processes
    if args.trace:
        options.refuse(args, ('utilisation', 'execution_times'),
                       'execution times are those of --trace: leave one of them out')
    task_set = common.load_graph(args.graph)
    workers = defaults.workers(args.workers, task_set)
    source = None
    if args.trace:
        source = Source(*common.input_path(common.one_run(args.trace, ())), task_set)
    times, judged = _recorded(source) if source else (
        execution_times(args, task_set, workers), task_set)
    placing = Placing(judged, args.processes, times, args.together, args.apart)
    cpus = args.cpus or defaults.processors()
    predictor = Predictor(judged, workers, cpus, args.policy, args.duration,
                          0 if args.trace else PUBLISH_NS)
    with Progress('placing') as line:
        place, tried = improve(
            placing, placing.place(),
            lambda processes: cost_of(predictor.predict(processes, times)),
            lambda tried: line.update(tried, 'placements simulated'))
        processes = placing.processes(place)
        result: dict[str, Any] = {
            'processes': [{'name': p.name, 'nodes': p.nodes} for p in processes],
            'loads': _loads(placing, place, processes), 'cpus': cpus, 'workers': workers,
            'policy': args.policy, 'tried': tried,
            **{name: _predicted(args, source, cpus, predictor, where, times)
               for name, where in (('predicted', processes),
                                   ('one_process', (Process('all', tuple(placing.nodes)),)))}}
    common.write_text(args.output, with_processes(task_set, processes).text)
    common.show(args, result, _lines(result), aside=True)
    return 0


def _recorded(source: Source) -> tuple[list[list[int]], TaskSet]:
    """Return mean CPU times as recorded, of callbacks that wait what they took."""
    task_set = source.task_set
    assert task_set is not None
    used = as_recorded(source).usage.callbacks()
    times = {}
    holds = {}
    for callback in task_set.callbacks:
        use = used[callback.key]
        count, busy = use['executions'], use['busy_ns']
        if use.get('measured'):
            holds[callback.key] = 2 * use['held_interpreter'] >= use['measured']
            if holds[callback.key]:
                count, busy = use['measured'], use['cpu_ns']
        if not count and callback.execution_time is not None:
            count, busy = 1, callback.execution_time.mean_ns
        times[callback.key] = busy // count if count else 0
    judged = task_set.with_callbacks({
        c.key: {'holds_interpreter': holds.get(c.key)} for c in task_set.callbacks
        if c.holds_interpreter is None})
    return [[times[v.callback.key] for v in dag.vertices] for dag in task_set.dags], judged


def _predicted(
    args: argparse.Namespace, source: Source | None, cpus: int, predictor: Predictor,
    processes: Sequence[Process], times: list[list[int]],
) -> dict[str, Any]:
    """Return the sinks of a placement; of recorded runs with what each job took, and when."""
    if source is None:
        dags: dict[str, Any] = predictor.predict(processes, times).result()['dags']
        return dags
    from mddag_executor.replay import reschedule
    outcome = reschedule(
        source.path, source.task_set, policy=args.policy, workers=args.workers, preemptive=False,
        cpus=cpus, name=source.name, processes=lambda *of: processes)
    dags = outcome.result()['dags']
    return dags


def _loads(placing: Placing, place: dict[int, int], processes: Sequence[Process]) -> list[float]:
    loads = placing.loads(place)
    return [loads[place[placing.block_of(process.nodes[0])]] for process in processes]


def _lines(result: dict[str, Any]) -> Iterator[str]:
    from mddag_executor.core.tally import total
    from mddag_executor.report.tables import sink_table, verdicts_line
    rows: list[list[Cell]] = [
        [process['name'], len(process['nodes']), f'{load:.2f}',
         one_line(', '.join(process['nodes'][:3]))
         + (f', … ({len(process["nodes"]) - 3} more)' if len(process['nodes']) > 3 else '')]
        for process, load in zip(result['processes'], result['loads'])]
    yield table(['process', 'nodes', 'of a core', 'which'], rows)
    yield sink_table(result['predicted'])
    yield (f'predicted with {counted(result["cpus"], "CPU")}: '
           f'{verdicts_line(result["predicted"])}')
    yield f'in one process: {verdicts_line(result["one_process"])}'
    if total(result['predicted']).missed:
        yield ('The deadlines do not hold: '
               f'{counted(result["tried"], "placement")} were simulated, and this is the best.')
    yield ('The prediction has what callbacks and messages cost, no other load of the CPUs and no '
           'waiting of nodes for each other.')
