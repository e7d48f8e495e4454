# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
`mddag run` over several processes: the process of each node, and their run as one.

The nodes of a program are known only when it runs. So each `--node` is started once before the
run, in a process that ends when the nodes are made, unless its process is given: `PROCESS=SPEC`.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
import os
from pathlib import Path
import subprocess
import sys
import tempfile
import time
from typing import Any

from mddag_executor import defaults
from mddag_executor.cli import common, verdicts
from mddag_executor.cli.main import EXIT_DEFECT
from mddag_executor.cli.run import incomplete, not_found, passed_on, warn_of
from mddag_executor.cli.text import warn
from mddag_executor.errors import UsageError
from mddag_executor.hosting.signals import Signals
from mddag_executor.output_rules import remove_recording
from mddag_executor.report.live_runs import live_lines
from msg_graph import TaskSet
from msg_graph.edit import load_processes, with_processes
from msg_graph.errors import did_you_mean, listed, quoted

_PROBE_TIMEOUT_S = 120.0


def with_declared(args: argparse.Namespace, task_set: TaskSet) -> TaskSet:
    """Return the task set with the processes of `--processes FILE`, else of the declaration."""
    if args.processes is None:
        return task_set
    if args.processes.isdecimal():
        raise UsageError(f'--process {args.process}: with --processes {args.processes} no process '
                         'has a name of its own: name a file')
    name, text = common.read_text(args.processes)
    return with_processes(task_set, load_processes(text, name, task_set))


def run_processes(args: argparse.Namespace, task_set: TaskSet) -> int:
    """Run nodes in several processes until the run ends, and print what came of the deadlines."""
    from mddag_executor.hosting.processes import (
        combine_results,
        Part,
        ProcessError,
        read_result,
        Run,
        Supervisor,
    )
    from mddag_executor.synthetic.measure import ExecutionPlan
    plan = None
    if args.synthetic is not None:
        workers = defaults.workers(args.workers, task_set)
        plan = ExecutionPlan(task_set, args.seed, args.utilisation, workers, args.synthetic)
    with tempfile.TemporaryDirectory(prefix='mddag-') as folder, Signals() as signals:
        common_options = passed_on(args)
        Part.make(folder, task_set.text, common_options)
        task_set, specs = _placed(args, task_set, plan, folder)
        Part.make(folder, task_set.text, common_options)
        names = [process.name for process in task_set.processes]
        _warn_of_contested(task_set)
        _warn_of_divided_paths(task_set)
        for name in names:
            common.check_output(
                _trace(args.trace, name), is_kept=True, overwrite=args.overwrite)
        if plan is not None:
            warn_of(plan, len(names))

        def command(name: str) -> list[str]:
            trace = _trace(args.trace, name)
            return [*_command(args, folder, specs[name]), '--process', name,
                    *(() if trace is None else ('--trace', trace))]

        out = sys.stdout if common.wants_tables(args) else sys.stderr

        def ended(run: Run) -> None:
            Part.note_end(folder, run.name)
            if run.died:
                warn(f'process {run.name} {run.how}: {run.said or "it said nothing"}')

        supervisor = Supervisor(command, args.on_exit == 'continue', out, sys.stderr, ended)
        signals.end_of(supervisor)
        began = time.time()
        try:
            supervisor.run(names, None if args.duration is None else args.duration / 1e9)
        except ProcessError:
            traces = [] if Part.has_begun(folder) else [_trace(args.trace, n) for n in names]
            for trace in traces:    # not those of an earlier run
                if trace is not None and Path(trace).exists() and os.stat(trace).st_mtime > began:
                    remove_recording(trace)
            raise
        parts = [read_result(folder, run.process.pid) for run in supervisor.runs]
    results = {run.name: each for run, each in zip(supervisor.runs, parts) if each is not None}
    result = {
        'file': task_set.file, 'nodes': args.node, 'synthetic': args.synthetic,
        'policy': args.policy, 'on_late': args.on_late,
        'workers': defaults.workers(args.workers, task_set),
        **combine_results(task_set, results), 'trace': None,
        'processes': [{
            'name': run.name, 'nodes': next(
                p.nodes for p in task_set.processes if p.name == run.name),
            'pid': run.process.pid, 'status': run.status, 'died': run.died, 'how': run.how,
            'said': run.said if run.died else None,
            'trace': _trace_of_dead(_trace(args.trace, run.name)) if part is None
            else part['trace']}
            for run, part in zip(supervisor.runs, parts)]}
    common.show(args, result, live_lines(result))
    if any(run.died for run in supervisor.runs):
        return EXIT_DEFECT
    status = verdicts.exit_status(args, result, task_set.file)
    if error := incomplete(*(part['trace'] for part in parts if part is not None)) or not_found(
            args, result):
        raise error
    return status


def _warn_of_divided_paths(task_set: TaskSet) -> None:
    from mddag_executor.executor.path_watch import divided
    for name in divided(task_set):
        warn(f'path {name}: its callbacks run in several processes, so this run leaves it out: '
             'record it with --trace, and judge it with mddag replay')


def _warn_of_contested(task_set: TaskSet) -> None:
    from mddag_executor.executor.other_processes import contested, divided
    dags = divided(task_set)
    topics = {t for v in task_set.vertices if v.dag in dags for t in v.callback.publishes}
    for topic in sorted(contested(task_set) & topics):
        warn(f'{topic}: nodes of several processes publish it, so the job of a message is '
             'unknown: put these nodes into one process')


def _placed(
    args: argparse.Namespace, task_set: TaskSet, plan: Any, folder: str
) -> tuple[TaskSet, dict[str, list[str]]]:
    """Return the task set with its processes, and the SPECs of each process."""
    number = args.processes if args.processes and args.processes.isdecimal() else None
    if number is None:
        task_set = with_declared(args, task_set)
    names = {process.name for process in task_set.processes} if number is None else set()
    said: dict[str, str] = {}  # where a SPEC is to run, as it says itself
    for spec in args.node:
        name, equals, _ = spec.partition('=')
        if equals and name in names:
            said[spec] = name
        elif equals and not {*'/: '} & {*name}:
            raise UsageError(f'--node {spec}: there is no process {quoted(name)}: '
                             + did_you_mean(name, names, 'name one of the declaration'))
    unsaid = [spec for spec in args.node if spec not in said]
    nodes = _probe(args, folder, unsaid) if unsaid else {}
    if number is not None:
        task_set = _place(args, task_set, int(number), plan, list(nodes.values()))
    specs: dict[str, list[str]] = {process.name: [] for process in task_set.processes}
    for spec in args.node:
        name = said.get(spec) or _process_of(task_set, spec, nodes[spec])
        specs[name].append(spec.removeprefix(f'{name}=') if spec in said else spec)
    for process in task_set.processes:
        if args.node and not specs[process.name]:
            raise UsageError(f'process {quoted(process.name)}: no --node brings one of its nodes '
                             f'({listed(process.nodes)}): give it, or remove the process')
    return task_set, specs


def _place(
    args: argparse.Namespace, task_set: TaskSet, n: int, plan: Any,
    together: Sequence[Sequence[str]],
) -> TaskSet:
    """Place the nodes in N processes; what one program brings stays together."""
    from mddag_executor.laboratory.placement import packed
    from mddag_executor.simulate.workload import draw_execution_times
    times = draw_execution_times(task_set, args.seed, undeclared=0) if plan is None else [
        [plan.execution_ns(v) for v in dag.vertices] for dag in task_set.dags]
    declared = {callback.node for callback in task_set.callbacks}
    return with_processes(task_set, packed(task_set, n, times, [
        group for each in together if (group := [node for node in each if node in declared])]))


def _process_of(task_set: TaskSet, spec: str, nodes: Sequence[str]) -> str:
    """Return the process that a SPEC is to run in: that of its declared nodes."""
    declared = {callback.node for callback in task_set.callbacks}
    found = {str(task_set.process_of(node)): node for node in nodes if node in declared}
    if len(found) > 1:
        (one, a), (other, b), *_ = found.items()
        raise UsageError(
            f'--node {spec}: it brings {a}, which is to run in process {quoted(one)}, and {b}, in '
            f'{quoted(other)}: put both into one process')
    return next(iter(found), task_set.processes[0].name)


def _probe(
    args: argparse.Namespace, folder: str, specs: Sequence[str]
) -> Mapping[str, Sequence[str]]:
    """Return the names of the nodes that each SPEC brings."""
    from mddag_executor.hosting.processes import ProcessError, read_result
    # These nodes must not be discovered.
    environment = {**os.environ, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF'}
    with subprocess.Popen(
        _command(args, folder, specs), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, errors='replace', env=environment,
    ) as process:
        try:
            said, _ = process.communicate(timeout=_PROBE_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            said = 'it has not made its nodes'
        finally:
            process.kill()
    names = read_result(folder, process.pid)
    if names is None:
        lines = [line for line in said.splitlines() if line.strip()]
        error = next((line for line in reversed(lines) if line.startswith('error: ')), None)
        raise ProcessError((error or (lines or ['the nodes cannot be made'])[-1])
                           .removeprefix('error: '))
    return dict(zip(specs, names))


def _command(args: argparse.Namespace, folder: str, specs: Sequence[str]) -> list[str]:
    """Return the command line of a part, up to its name; its options are in the folder."""
    nodes = [word for spec in specs for word in ('--node', spec)]
    return [sys.executable, '-m', 'mddag_executor', 'run', args.graph, '--part', folder,
            *(nodes if args.synthetic is None else ('--synthetic', args.synthetic))]


def _trace(given: str | None, name: str) -> str | None:
    if given is None:
        return None
    path = Path(given)
    if path.is_dir():
        return str(path / f'{name}.mcap')
    return str(path.with_name(f'{path.stem}.{name}{path.suffix}'))


def _trace_of_dead(path: str | None) -> dict[str, Any] | None:
    """Return the result about the trace of a process that has left no result."""
    if path is None or not Path(path).exists():
        return None
    return {'path': path, 'lost': 0, 'error': 'the process has died'}
