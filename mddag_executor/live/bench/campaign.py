# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Make measurements one after the other, each in a process of its own, and sum them up.

With repetitions all measurements are made in turn, and then all of them again: what disturbs the
machine for a while hits every executor alike.  Of the repetitions the median of each figure is
taken; messages are counted over all of them, so that no loss is hidden.

A process that does not end in time is killed: rclpy's EventsExecutor holds off SIGTERM.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from typing import Any

from mddag_executor.live.bench.spec import BenchError, DECLARED, ROBOT, Spec
from msg_graph import GraphError, load

PATIENCE_S = 90.0
"""What a process may take besides its window and warm-up: discovery and the end."""
_KILLED = -9

Tick = Callable[[float], None]
"""Called now and then with how many seconds a measurement has been going on."""


class CrashError(BenchError):
    """A measurement whose executor crashed or hung."""


def measure(
    spec: Spec, tick: Tick | None = None, patience_s: float = PATIENCE_S
) -> dict[str, Any]:
    """
    Make one measurement in a new process; return its figures.

    Of a declaration with ``processes:`` each is one, all at a time.

    :raises CrashError: when the process crashed, did not end and was killed, or gave no result.
    :raises BenchError: when the measurement cannot be made.
    """
    names = _processes(spec)
    if len(names) > 1:
        from mddag_executor.live.bench.loads import of_processes
        with ThreadPoolExecutor(len(names)) as threads:
            parts = threads.map(lambda name: measure(
                replace(spec, process=name), tick if name == names[0] else None, patience_s),
                names)
            return of_processes(spec, list(parts))
    # Of this machine only: it must not find another one's nodes, nor be found by them.
    environment = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', **os.environ}
    command = [sys.executable, '-m', 'mddag_executor.live.bench', spec.to_json()]
    limit = spec.seconds + spec.warm_up_s + patience_s + spec.idle * 0.05
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        # Not communicate(), which would close standard input: that ends the process.
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=out, stderr=err, env=environment)
        try:
            _wait(process, limit, tick)
        finally:
            process.kill()
            process.wait()
            if process.stdin is not None:
                process.stdin.close()
        out.seek(0)
        err.seek(0)
        lines = err.read().decode(errors='replace').strip().splitlines()
        if process.returncode == 2 and lines:
            raise BenchError(lines[-1])
        if process.returncode != 0:
            raise CrashError(f'{spec.name}: {_reason(process.returncode, limit, lines)}')
        text = out.read()
        try:
            result: dict[str, Any] = json.loads(text)
        except ValueError:
            raise CrashError(
                f'{spec.name}: it ended well but gave no result: {text[:60]!r}') from None
        return result


def _processes(spec: Spec) -> list[str]:
    """Return the declared processes that a measurement is made of."""
    if spec.load not in DECLARED or spec.process is not None or spec.graph is None:
        return []
    try:
        return [process.name for process in load(spec.graph).processes]
    except GraphError as error:
        raise BenchError(str(error)) from None


def _wait(process: subprocess.Popen[bytes], limit: float, tick: Tick | None) -> None:
    begin = time.monotonic()
    while (passed := time.monotonic() - begin) < limit:
        if tick is not None:
            tick(passed)
        try:
            process.wait(0.5)
            return
        except subprocess.TimeoutExpired:
            continue


def _reason(status: int, limit: float, lines: Sequence[str]) -> str:
    if status == _KILLED:
        return f'it did not end within {limit:.0f} s and was killed'
    if status < 0:
        return f'it crashed with signal {-status}'
    return lines[-1] if lines else f'it ended with status {status}'


def run_all(
    specs: Sequence[Spec], repeat: int, tick: Callable[[Spec, int, float], None],
    warn: Callable[[str], None],
) -> list[dict[str, Any]]:
    """
    Make all measurements in turn, ``repeat`` times; return a result for each of them.

    :param tick: gets now and then which one goes on, how many were made, and for how many s.
    :param warn: gets each that crashed; its figures are None when it never succeeded.
    :raises BenchError: when a measurement cannot be made, or when all of them crashed.
    """
    runs: list[list[dict[str, Any]]] = [[] for _ in specs]
    made = 0
    for _ in range(repeat):
        for spec, results in zip(specs, runs):
            def report(passed: float, spec: Spec = spec, made: int = made) -> None:
                tick(spec, made, passed)

            try:
                results.append(measure(spec, report))
            except CrashError as error:
                warn(str(error))
            made += 1
    if not any(runs):
        raise BenchError('no measurement succeeded: see the warnings')
    return [combine(spec, results, repeat) for spec, results in zip(specs, runs)]


_COUNTS = ('published', 'received', 'lost')
_FIGURES = (
    'utilisation', 'sink_jobs_due', 'on_time', 'late', 'missing', 'callbacks_per_s',
    'cpu_us_per_callback', 'middleware_cpu_us_per_callback', 'utilisation_taken',
    'dispatch_latency_us', 'hot_path_us')
_OF_ROBOT = ('sinks', 'cpu_cores')


def combine(spec: Spec, runs: Sequence[dict[str, Any]], repeat: int = 1) -> dict[str, Any]:
    """
    Return the result of a measurement from its repetitions.

    :return: an object of ``bench live --json``; ``runs`` in it has the repetitions' figures.
    """
    result: dict[str, Any] = {
        'load': spec.load, 'executor': spec.name, 'workers': spec.workers,
        'seconds': spec.seconds, 'seed': spec.seed, 'repeat': repeat,
        'crashed': repeat - len(runs)}
    figures = (*_FIGURES, *_OF_ROBOT) if spec.load == ROBOT else _FIGURES
    middle = {name: _median([run.get(name) for run in runs]) for name in figures}
    if spec.load == ROBOT:
        result.update(graph=spec.graph, scale=spec.scale)
        middle['sinks'] = middle['sinks'] or {}
    elif spec.load in DECLARED:
        result.update(graph=spec.graph, bodies=spec.bodies)
    else:
        result.update(
            topics=spec.topics, rate_hz=spec.rate_hz, idle=spec.idle, phases=spec.phases,
            **{name: sum(run[name] for run in runs) for name in _COUNTS})
    due = middle['sink_jobs_due']
    result.update(middle, on_time_ratio=middle['on_time'] / due if due else None)
    kept = {*_FIGURES, *_OF_ROBOT, *_COUNTS, 'on_time_ratio', 'callbacks', 'window_ns',
            'attribution', 'infeasible_sinks'} - {'utilisation'}
    result['runs'] = [{k: v for k, v in run.items() if k in kept} for run in runs]
    return result


def _median(values: Sequence[Any]) -> Any:
    """Return the median of what is not None, also of each in dictionaries; whole where all are."""
    found = [value for value in values if value is not None]
    if not found:
        return None
    if isinstance(found[0], dict):
        return {name: _median([value[name] for value in found]) for name in found[0]}
    whole = all(isinstance(value, int) for value in found)
    return statistics.median_low(found) if whole else statistics.median(found)
