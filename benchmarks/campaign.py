# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Runs measurements one after the other, each in a separate process.

With repetitions all measurements are made once, then all again, so a temporary disturbance of the
machine affects every executor alike.  The result has the median of each figure; messages are
counted over all repetitions, so that no loss is hidden.

This module imports nothing of ROS.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import statistics
from typing import Any

from mddag_executor.child import ChildError, CrashError, run_child
from mddag_executor.core import policy as find_policy
from mddag_executor.errors import UsageError

OURS = 'rad'
"""The name of this executor."""

PEERS = ('single', 'multi', 'events')
"""rclpy's SingleThreadedExecutor, MultiThreadedExecutor and EventsExecutor."""

NONE = 'none'
"""No executor: the cost of the nodes of a declared load themselves (see ``executors``)."""

EXECUTORS = (OURS, *PEERS)
ROBOT = 'robot'
"""The load of the ordinary nodes of an example."""
LOADS = ('autoware', 'topics', 'entities', 'reference-system', ROBOT)
DECLARED = {
    'autoware': 'config/autoware.yaml', 'reference-system': 'config/reference_system.yaml'}
"""The loads of synthetic nodes, and their declarations."""
ROBOT_GRAPH = 'examples/robot/graph.yaml'
PHASES = ('drawn', 'together')
"""When the topics of a message load are published: at drawn phases, or all in a row."""

PATIENCE_S = 90.0
"""Allowed time of a process beyond its window: discovery, warm-up and the end."""


@dataclass(frozen=True)
class Spec:
    """
    One measurement: an executor and a load.

    :ivar executor: one of ``EXECUTORS``.
    :ivar policy: of this executor; rclpy's have none.
    :ivar seconds: length of the measured window, after ``WARM_UP_S``.
    :ivar seed: of the execution times, or of the phases of the published topics.
    :ivar graph: path of the declaration, for declared loads.
    :ivar utilisation: target to which its execution times are scaled; None: as drawn.
    :ivar bodies: how these execute, as ``execution.Mode``.
    :ivar topics: number of published topics, each with one subscription.
    :ivar rate_hz: rate of each topic.
    :ivar idle: number of additional subscriptions, to topics without publisher.
    :ivar phases: when the topics are published, one of ``PHASES``.
    :ivar scale: factor of the CPU time of the robot's nodes.
    """

    load: str
    executor: str
    policy: str = 'rad'
    workers: int = 7
    seconds: float = 10.0
    seed: int = 0
    graph: str | None = None
    utilisation: float | None = None
    bodies: str = 'sleep'
    topics: int = 1
    rate_hz: float = 100.0
    idle: int = 0
    phases: str = 'drawn'
    scale: float = 1.0

    @property
    def name(self) -> str:
        """Return the executor's name, with the policy unless that is rad."""
        return self.executor if self.policy == 'rad' else f'{self.executor}:{self.policy}'


def parse_executors(text: str, policies: str | None = None) -> list[tuple[str, str]]:
    """
    Return executors and policies of a comma separated list.

    :param text: as ``rad,rad:fifo,multi``.
    :param policies: comma separated; this executor, if named without policy, runs with each of
        them.
    :raises UsageError: for an unknown or repeated name.
    """
    default = ['rad'] if policies is None else [name.strip() for name in policies.split(',')]
    for name in default:
        find_policy(name)
    found: list[tuple[str, str]] = []
    for item in text.split(','):
        name, colon, policy = item.strip().partition(':')
        if name not in (*EXECUTORS, NONE):
            raise UsageError(
                f"--executors: '{name}' is unknown: give some of {', '.join((*EXECUTORS, NONE))}")
        if colon and name != OURS:
            raise UsageError(
                f"--executors: '{item.strip()}': only this executor knows policies: leave it out")
        if colon:
            find_policy(policy)
        for each in [policy] if colon else default if name == OURS else ['rad']:
            if (name, each) in found:
                raise UsageError(f"--executors: '{item.strip()}' is listed twice: name it once")
            found.append((name, each))
    if policies is not None and not any(name == OURS for name, _ in found):
        raise UsageError(f'--policies: they are those of this executor: name {OURS}')
    return found


def run_all(
    specs: Sequence[Spec], repeat: int, tick: Callable[[Spec, int, float], None],
    warn: Callable[[str], None],
) -> list[dict[str, Any]]:
    """
    Make all measurements one after the other, ``repeat`` times; return a result for each.

    :param tick: receives regularly the present measurement, the number made, and its duration, s.
    :param warn: receives each crashed measurement; if none succeeded, its figures are None.
    :raises ChildError: if a measurement cannot be made, or all of them crashed.
    """
    runs: list[list[dict[str, Any]]] = [[] for _ in specs]
    made = 0
    for _ in range(repeat):
        for spec, results in zip(specs, runs):
            def report(passed: float, spec: Spec = spec, made: int = made) -> None:
                tick(spec, made, passed)

            try:
                limit_s = spec.seconds + PATIENCE_S + spec.idle * 0.05
                results.append(run_child(
                    'benchmarks.loads:run', (spec,), spec.name, limit_s, report))
            except CrashError as error:
                warn(str(error))
            made += 1
    if not any(runs):
        raise ChildError('no measurement succeeded: see the warnings')
    return [combine(spec, results, repeat) for spec, results in zip(specs, runs)]


_COUNTS = ('published', 'received', 'lost')
_FIGURES = (
    'utilisation', 'sink_jobs_due', 'on_time', 'late', 'missing', 'important_due',
    'important_on_time', 'callbacks_per_s',
    'cpu_us_per_callback', 'middleware_cpu_us_per_callback', 'utilisation_taken',
    'dispatch_latency_us', 'hot_path_us')
_OF_ROBOT = ('sinks', 'cpu_cores')


def combine(spec: Spec, runs: Sequence[dict[str, Any]], repeat: int = 1) -> dict[str, Any]:
    """
    Return the result of a measurement from its repetitions.

    :return: an object of ``live --json``; its ``runs`` has the repetitions' figures.
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
    """Return the median of values other than None, also within dictionaries; int if all are."""
    found = [value for value in values if value is not None]
    if not found:
        return None
    if isinstance(found[0], dict):
        return {name: _median([value[name] for value in found]) for name in found[0]}
    whole = all(isinstance(value, int) for value in found)
    return statistics.median_low(found) if whole else statistics.median(found)
