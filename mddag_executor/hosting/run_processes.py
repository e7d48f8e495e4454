# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A run in several processes: the process of each node, and their run as one.

The nodes of a program are known only when it runs. So each `--node` is started once before the
run, in a process that ends when the nodes are made, unless its process is given: `PROCESS=SPEC`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import os
from pathlib import Path
import subprocess
import sys
import tempfile
from typing import Any

from mddag_executor import defaults
from mddag_executor.errors import UsageError
from mddag_executor.executor import other_processes, path_watch
from mddag_executor.hosting.processes import (
    combine_results,
    kill,
    Part,
    ProcessError,
    read_result,
    Run,
    Supervisor,
)
from mddag_executor.hosting.run_here import Display, plan_of, SIGNAL, warn_of
from mddag_executor.hosting.run_options import RunOptions, spec_of
from mddag_executor.hosting.run_result import RunResult
from mddag_executor.hosting.signals import Signals
from mddag_executor.laboratory.placement import packed
from mddag_executor.output_rules import (
    check_output,
    check_parent,
    remove_recording,
    version_of,
)
from mddag_executor.simulate.execution_times import draw_execution_times
from mddag_executor.synthetic.measure import ExecutionPlan
from msg_graph import TaskSet
from msg_graph.edit import with_processes
from msg_graph.errors import did_you_mean, listed, quoted

_PROBE_TIMEOUT_S = 120.0


def run_processes(options: RunOptions, task_set: TaskSet, display: Display) -> RunResult:
    """Run nodes in several processes until the run ends; return its result."""
    for spec in options.nodes:
        if not isinstance(spec, str):
            raise UsageError(f"--node {spec!r}: several processes need its name: give "
                             f"'{spec_of(spec)}', if it can be imported from there")
    warnings: list[str] = []

    def warn(line: str) -> None:
        warnings.append(line)
        display.warn(line)

    plan = plan_of(options, task_set)
    with tempfile.TemporaryDirectory(prefix='mddag-') as folder, Signals(
            ends_process=display.leave is not None) as signals:
        passed_on = options.passed_on()
        Part.make(folder, task_set.text, passed_on)
        task_set, specs = _placed(options, task_set, plan, folder)
        Part.make(folder, task_set.text, passed_on)
        names = [process.name for process in task_set.processes]
        _warn_of_contested(task_set, warn)
        _warn_of_divided_paths(task_set, warn, options.trace is not None)
        new_folder = _make_folder(options.trace)
        for name in names:
            check_output(_trace(options.trace, name), is_kept=True, overwrite=options.overwrite)
        if plan is not None:
            warn_of(plan, warn, len(names))

        def command(name: str) -> list[str]:
            trace = _trace(options.trace, name)
            return [*_command(options, folder, specs[name], display.is_quiet), '--process', name,
                    *(() if trace is None else ('--trace', trace))]

        def ended(run: Run) -> None:
            Part.note_end(folder, run.name)
            if run.died:
                warn(f'process {run.name} {run.how}: {run.said or "it said nothing"}')

        supervisor = Supervisor(command, options.on_exit == 'continue',
                                display.output or sys.stdout, sys.stderr, ended)
        signals.end_of(supervisor)
        traces = [trace for n in names if (trace := _trace(options.trace, n)) is not None]
        earlier = [version_of(trace) for trace in traces]
        try:
            supervisor.run(names, options.seconds)
        except ProcessError:
            if not Part.has_begun(folder):
                for trace, version in zip(traces, earlier):
                    remove_recording(trace, version)
            raise
        finally:
            if new_folder is not None and not os.listdir(new_folder):
                os.rmdir(new_folder)
        parts = [read_result(folder, run.process.pid) for run in supervisor.runs]
        has_started = signals.ended_by is None or all(
            part is not None and part['has_started'] for part in parts)
        if signals.ended_by is not None and not any(parts) and not any(
                run.died for run in supervisor.runs):  # as if it had come before
            raise SystemExit(SIGNAL + signals.ended_by)
    results = {run.name: each for run, each in zip(supervisor.runs, parts) if each is not None}
    return RunResult({
        'file': task_set.file, 'nodes': options.specs, 'synthetic': options.synthetic,
        'policy': options.policy, 'on_late': options.on_late,
        'workers': defaults.workers(options.workers, task_set),
        **combine_results(task_set, results), 'trace': None,
        'processes': [{
            'name': run.name, 'nodes': next(
                p.nodes for p in task_set.processes if p.name == run.name),
            'pid': run.process.pid, 'status': run.status, 'died': run.died, 'how': run.how,
            'said': run.said if run.died else None,
            'trace': _trace_of_dead(_trace(options.trace, run.name)) if part is None
            else part['trace']}
            for run, part in zip(supervisor.runs, parts)]},
        warnings=tuple(warnings), has_started=has_started)


def _warn_of_divided_paths(
    task_set: TaskSet, warn: Callable[[str], None], is_recorded: bool
) -> None:
    remedy = ('judge its traces with mddag replay' if is_recorded
              else 'record it with --trace, and judge its traces with mddag replay')
    for name in path_watch.divided(task_set):
        warn(f'path {name}: its callbacks run in several processes, so this run leaves it out: '
             + remedy)


def _warn_of_contested(task_set: TaskSet, warn: Callable[[str], None]) -> None:
    dags = other_processes.divided(task_set)
    topics = {t for v in task_set.vertices if v.dag in dags for t in v.callback.publishes}
    for topic in sorted(other_processes.contested(task_set) & topics):
        warn(f'{topic}: nodes of several processes publish it, so the job of a message is '
             'unknown: put these nodes into one process')


def _placed(
    options: RunOptions, task_set: TaskSet, plan: ExecutionPlan | None, folder: str
) -> tuple[TaskSet, dict[str, list[str]]]:
    """Return the task set with its processes, and the SPECs of each process."""
    number = options.n_processes
    names = {process.name for process in task_set.processes} if number is None else set()
    said: dict[str, str] = {}  # where a SPEC is to run, as it says itself
    for spec in options.specs:
        name, equals, _ = spec.partition('=')
        if equals and name in names:
            said[spec] = name
        elif equals and not {*'/: '} & {*name}:
            raise UsageError(f'--node {spec}: there is no process {quoted(name)}: '
                             + did_you_mean(name, names, 'name one of the declaration'))
    unsaid = [spec for spec in options.specs if spec not in said]
    nodes = _probe(options, folder, unsaid) if unsaid else {}
    if number is not None:
        task_set = _place(options, task_set, number, plan, list(nodes.values()))
    specs: dict[str, list[str]] = {process.name: [] for process in task_set.processes}
    for spec in options.specs:
        name = said.get(spec) or _process_of(task_set, spec, nodes[spec])
        specs[name].append(spec.removeprefix(f'{name}=') if spec in said else spec)
    for process in task_set.processes:
        if options.nodes and not specs[process.name]:
            raise UsageError(f'process {quoted(process.name)}: no --node brings one of its nodes '
                             f'({listed(process.nodes)}): give it, or remove the process')
    return task_set, specs


def _place(
    options: RunOptions, task_set: TaskSet, n: int, plan: ExecutionPlan | None,
    together: Sequence[Sequence[str]],
) -> TaskSet:
    """Place the nodes in N processes; what one program brings stays together."""
    times = draw_execution_times(task_set, options.seed, undeclared=0) if plan is None else [
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
    options: RunOptions, folder: str, specs: Sequence[str]
) -> Mapping[str, Sequence[str]]:
    """Return the names of the nodes that each SPEC brings."""
    # These nodes must not be discovered.
    environment = {**os.environ, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF'}
    with subprocess.Popen(
        _command(options, folder, specs), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, errors='replace', env=environment,
    ) as process:
        try:
            said, _ = process.communicate(timeout=_PROBE_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            said = 'it has not made its nodes'
        finally:
            kill(process)
    names = read_result(folder, process.pid)
    if names is None:
        lines = [line for line in said.splitlines() if line.strip()]
        error = next((line for line in reversed(lines) if line.startswith('error: ')), None)
        raise ProcessError((error or (lines or ['the nodes cannot be made'])[-1])
                           .removeprefix('error: '))
    return dict(zip(specs, names))


def _command(
    options: RunOptions, folder: str, specs: Sequence[str], is_quiet: bool = False
) -> list[str]:
    """Return the command line of a part, up to its name; its options are in the folder."""
    nodes = [word for spec in specs for word in ('--node', spec)]
    return [sys.executable, '-m', 'mddag_executor', 'run', options.graph_name, '--part', folder,
            *(() if not is_quiet else ('--quiet',)),
            *(nodes if options.synthetic is None else ('--synthetic', options.synthetic))]


def _make_folder(given: str | os.PathLike[str] | None) -> str | None:
    """Make the folder for the traces that `FOLDER/` names; return it if it is new."""
    folder = '' if given is None else os.fspath(given)
    if not folder.endswith('/') or os.path.isdir(folder):
        return None
    check_parent(folder.rstrip('/'))
    os.mkdir(folder.rstrip('/'))
    return folder


def _trace(given: str | os.PathLike[str] | None, name: str) -> str | None:
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
