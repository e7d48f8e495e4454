# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph place`: pack the nodes of a declaration into processes."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import TYPE_CHECKING

from mddag_executor.cli import common, options
from mddag_executor.cli.recorded import as_recorded, Source
from mddag_executor.cli.text import Cell, one_line, table
from msg_graph import TaskSet

if TYPE_CHECKING:
    from mddag_executor.results.graphs import PlaceResult

EXAMPLE = """\
mddag graph place graph.yaml run.mcap --processes 3 -o placed.yaml
mddag replay run.mcap --reschedule --processes placed.yaml
mddag run placed.yaml --node my_robot/lidar --node my_robot/camera --node my_robot/control"""
DESCRIPTION = """\
Pack the nodes of a declaration into processes, so that the busiest process needs Python's
interpreter for as little time as possible. Nodes that publish the same topic
stay together. The result is the declaration with `processes:`, as `mddag run` reads it: move nodes
there by hand if they must be together or apart. Deadlines are not considered:
'mddag replay RUN.mcap --reschedule --processes PLACED.yaml' checks them."""
REMOVED_OPTIONS = {
    **dict.fromkeys(('--apart', '--together'),
                    "edit 'processes:' in the written declaration instead"),
    **dict.fromkeys(('--cpus', '--workers', '--policy', '--duration'),
                    "'mddag replay RUN.mcap --reschedule --processes PLACED.yaml' has it, and "
                    'checks the placement'),
    **dict.fromkeys(('--execution-times', '--utilisation', '--seed'),
                    'declare execution times, or name a recording after GRAPH'),
    '--trace': 'name the recording after GRAPH'}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('--processes', type=options.positive_int, required=True, metavar='N',
        help='how many processes')
    add('-o', '--output', metavar='PLACED.yaml', type=options.Declaration, required=True,
        help="the declaration to write ('-': to standard output)")
    options.add(parser, '--overwrite', 'graph', '--json')
    add('trace', metavar='TRACE', type=options.Input, nargs='*',
        help='use the execution times of this recorded run, and which callbacks compute in Python '
        'there (default: as declared); if a run had several processes, name the traces of all')


def main(args: argparse.Namespace) -> int:
    from mddag_executor.laboratory.placement import Placing
    from mddag_executor.simulate.execution_times import check_execution_times
    from msg_graph.edit import with_processes
    from msg_graph.model import mean_execution_times
    task_set = common.load_graph(args.graph)
    if args.trace:
        times, placed = _recorded(
            Source(*common.input_path(common.one_run(args.trace, ())), task_set))
    else:
        check_execution_times(task_set)
        times, placed = [mean_execution_times(dag) or [] for dag in task_set.dags], task_set
    placing = Placing(placed, args.processes, times)
    place = placing.place()
    processes = placing.processes(place)
    loads = placing.loads(place)
    result: PlaceResult = {
        'processes': [{'name': p.name, 'nodes': list(p.nodes)} for p in processes],
        'loads': [loads[place[placing.block_of(p.nodes[0])]] for p in processes]}
    common.write_text(args.output, with_processes(task_set, processes).text)
    common.show(args, result, _lines(result), tables_to_stderr=True)
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


def _lines(result: PlaceResult) -> Iterator[str]:
    rows: list[list[Cell]] = [
        [process['name'], len(process['nodes']), f'{load:.2f}',
         one_line(', '.join(process['nodes'][:3]))
         + (f', … ({len(process["nodes"]) - 3} more)' if len(process['nodes']) > 3 else '')]
        for process, load in zip(result['processes'], result['loads'])]
    yield table(['process', 'nodes', 'of a core', 'which'], rows)
    yield ("Deadlines were not considered: 'mddag replay RUN.mcap --reschedule --processes "
           "PLACED.yaml' checks them.")
