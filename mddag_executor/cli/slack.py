# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `slack`: how much longer callbacks may take before a deadline is missed.

If deadlines are missed already, it says how much shorter callbacks must become.

A recorded run is rescheduled (see `replay --reschedule`), and a declaration is simulated (see
`simulate`), many times with other execution times; `mddag_executor.whatif.slack` says how.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

from mddag_executor import defaults
from mddag_executor.cli import common, options, recorded, simulate, verdicts
from mddag_executor.cli.text import Progress, warn
from mddag_executor.core.tally import total
from mddag_executor.errors import UsageError
from mddag_executor.output_rules import is_declaration

if TYPE_CHECKING:
    from mddag_executor.results.sinks import DagCounts, Requirements
    from mddag_executor.whatif.slack import Problem
    from msg_graph import Process, TaskSet

    _Given = tuple[
        Problem, TaskSet, dict[str, DagCounts], Sequence[Process], Requirements]

EXAMPLE = """\
mddag slack run.mcap
mddag slack run.perception.mcap run.control.mcap
mddag slack config/autoware.yaml --utilisation 0.6 --workers 6
mddag slack run.mcap --fail-under 1.2 --json slack.json --report slack.html"""

_ONLY_GRAPH = ('duration', 'execution_times', 'seed', 'utilisation')
REMOVED_OPTIONS = {'--jobs': 'it is --parallel now', '--skip': 'it is --from now'}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    options.add_recording(
        parser, "a recorded run, an MCAP file ('-': standard input), or a declaration alone, a "
        'YAML file')
    options.add(parser, '--workers', only='in each process, ',
                otherwise="as recorded, or the declaration's", type=options.workers_of,
                metavar='N|PROCESS=N,…')
    options.add(parser, '--cpus', otherwise='as recorded, or enough for all')
    options.add(parser, '--policy', otherwise='as recorded, or rad')
    options.add(parser, '--preemptive', otherwise='as recorded')
    options.add(parser.add_argument_group('with GRAPH'), *(
        f'--{name.replace("_", "-")}' for name in _ONLY_GRAPH), default=None)
    add('--parallel', type=options.positive_int, metavar='N',
        help='how many processes search (default: one for each processor)')
    add('--fail-under', type=options.positive_float, metavar='FACTOR',
        help='exit with status 1 if the factor of a callback is smaller, if a deadline is missed '
        'already, or if no job was due')
    options.add(parser, '--report', help="write the tables with bars as one HTML file "
                "('-': to standard output)")
    options.add(parser, '--from', '--json')


def main(args: argparse.Namespace) -> int:
    from mddag_executor.core.requirements import not_met
    from mddag_executor.core.tolerances import NOTHING_DUE
    from mddag_executor.report.slack import lines, page
    from mddag_executor.whatif.slack import find_slack, slack_result
    common.recording_and_graph(args)
    is_graph = is_declaration(str(args.trace))
    problem, task_set, dags, processes, required = (_of_graph if is_graph else _of_trace)(args)
    with Progress('searching', len(problem.callbacks)) as line:
        slack = find_slack(problem, line.update, args.parallel or defaults.processors())
    result = slack_result(slack, task_set, dags, processes, required)
    if args.report is not None:
        common.write_text(args.report, ''.join(page(result, str(args.trace))))
    common.show(args, result, lines(result))
    if args.fail_under is None:
        return 0
    if not total(dags).due:
        return verdicts.unproven(
            str(args.trace), NOTHING_DUE, 'give a longer run, or a longer --duration')
    return int(bool(result['missed']) or bool(not_met(required)) or any(
        one['factor'] is not None and one['factor'] < args.fail_under
        for one in result['callbacks'].values()))


def _of_trace(args: argparse.Namespace) -> _Given:
    from mddag_executor.whatif.reschedule import reschedule
    from mddag_executor.whatif.slack import Problem
    options.reject_options(args, _ONLY_GRAPH, 'a recording has its own: leave the option out')
    source = recorded.source_of(args)
    if source.is_bag:
        raise UsageError(f'{source.name}: it has no execution times: give the declaration instead '
                         'of an ordinary bag')
    with Progress('replaying') as line:
        outcome = reschedule(
            source.path, source.task_set, policy=args.policy, workers=args.workers,
            preemptive=args.preemptive, name=source.name, progress=line.events,
            skip=args.begin or 0, cpus=args.cpus)
    warn(*outcome.warnings)
    work = outcome.work
    number = outcome.task_set.callback_indices()
    problem = Problem(
        work.load, outcome.settings, outcome.tables, outcome.task_set.places_of_vertices(),
        work.dispatches, frozenset(number[key] for key in (*work.silent, *work.elsewhere)))
    result = outcome.result()
    return (problem, outcome.task_set, result['dags'], outcome.processes,
            result.get('requirements', {}))


def _of_graph(args: argparse.Namespace) -> _Given:
    from mddag_executor.core import Tables
    from mddag_executor.simulate import periodic_workload, Settings
    from mddag_executor.simulate import simulate as simulated
    from mddag_executor.whatif.computed import ComputedRun
    from mddag_executor.whatif.slack import Problem
    if args.graph is not None:
        raise UsageError(f'{args.graph}: there is a declaration already: give one, or a trace '
                         'before it')
    if args.begin:
        raise UsageError('--from: a simulation needs no warm-up: leave the option out')
    task_set = common.load_graph(args.trace)
    if isinstance(args.workers, dict):
        raise UsageError('--workers: a declaration is simulated in one process: give a number '
                         'alone')
    workers = defaults.workers(args.workers, task_set)
    args.seed = args.seed or 0
    times = simulate.execution_times(args, task_set, workers)
    settings = Settings(
        policy=args.policy or 'rad', pools=(workers,),
        duration_ns=args.duration or defaults.DURATION_NS, preemptive=bool(args.preemptive),
        cpus=args.cpus)
    load = periodic_workload(task_set, times, settings.duration_ns)
    requires = any(path.requirements for path in task_set.paths)
    run = simulated(task_set, load, settings, log=requires)
    problem = Problem(load, settings, Tables.build(task_set), task_set.places_of_vertices())
    required = ComputedRun.of_run(task_set, load, run).requirements() if requires else {}
    return problem, task_set, run.result()['dags'], (), required.get('requirements', {})
