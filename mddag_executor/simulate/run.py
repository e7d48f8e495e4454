# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""One simulated run: a task set, execution times and a policy give a verdict."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
import json
import math
import random
from typing import Any

from mddag_executor.core import NEVER, Tables, Tally
from mddag_executor.core import policy as find_policy
from mddag_executor.core.jobs import finish
from mddag_executor.core.state import Decision, new_state
from mddag_executor.errors import MddagError
from mddag_executor.simulate.engine import Load, LogEntry, run
from msg_graph import Dag, TaskSet

JUDGES = ('horizon', 'completions')

_FORMAT = 'write {"DAG": {"/node:callback": microseconds}}'
_LONGEST_US = 86_400_000_000


class SimulationError(MddagError):
    """Input of a simulation that can not be used."""


@dataclass(frozen=True)
class Settings:
    """
    How to run.

    :param preemptive: None takes the policy's own mode of the paper's experiment.
    :param judge: ``horizon`` judges what is open at the end, ``completions`` (the paper's way)
        only what completed.
    :param dispatch_overhead_ns: added to an execution at each dispatch.
    :param switch_overhead_ns: added to an execution at each preemption.
    """

    policy: str = 'rad'
    workers: int = 7
    duration_ns: int = 3_000_000_000
    preemptive: bool | None = False
    judge: str = 'horizon'
    stop_at_first_miss: bool = False
    dispatch_overhead_ns: int = 0
    switch_overhead_ns: int = 0


@dataclass
class Run:
    """
    Outcome of a run: the tally, when it ended (ns) and, if asked for, the log of every worker.

    ``log`` and ``decisions`` (those of the core) are in order of time.
    """

    settings: Settings
    tally: Tally
    ended_ns: int
    utilisation: float | None
    preemptive: bool
    log: list[LogEntry] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)

    def result(self) -> dict[str, Any]:
        """Return the result format of ``simulate --json``."""
        return {
            'policy': self.settings.policy, 'workers': self.settings.workers,
            'preemptive': self.preemptive, 'duration_ns': self.settings.duration_ns,
            'utilisation': self.utilisation, **self.tally.result()}


def draw_execution_times(task_set: TaskSet, seed: int) -> list[list[int]]:
    """
    Draw one execution time (ns) for each vertex, for the whole run, as in the paper.

    :return: one list for each DAG, by local vertex index; the same seed gives the same draw.
    :raises SimulationError: when a callback declares no execution time.
    """
    generator = random.Random(seed)
    times = []
    for dag in task_set.dags:
        row = []
        for vertex in dag.vertices:
            times_of_callback = vertex.callback.execution_time
            if times_of_callback is None:
                raise SimulationError(
                    f'{task_set.file}:{vertex.callback.line}: {vertex.callback.key} declares no '
                    'execution_time: add one, or give --execution-times FILE')
            row.append(times_of_callback.draw(generator.random()))
        times.append(row)
    return times


def read_execution_times(task_set: TaskSet, text: str, name: str) -> list[list[int]]:
    """
    Read fixed execution times: JSON ``{"DAG": {"/node:callback": microseconds, …}, …}``.

    :return: ns, one list for each DAG, by local vertex index.
    :raises SimulationError: on anything that is not that, or a vertex without a time.
    """
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise SimulationError(
            f'{name}:{error.lineno}: not JSON ({error.msg}): {_FORMAT}') from None
    except (ValueError, RecursionError) as error:  # numbers of thousands of digits, deep nesting
        raise SimulationError(f'{name}: not usable JSON ({error}): {_FORMAT}') from None
    if not isinstance(data, dict) or not all(isinstance(v, dict) for v in data.values()):
        raise SimulationError(f'{name}: not an object of objects: {_FORMAT}')
    known = {dag.name for dag in task_set.dags}
    for dag_name in data:
        if dag_name not in known:
            raise SimulationError(
                f"{name}: DAG '{dag_name}' is not in {task_set.file}: "
                f"its DAGs are {', '.join(sorted(known))}")
    return [_dag_times(dag, data.get(dag.name, {}), name) for dag in task_set.dags]


def _dag_times(dag: Dag, times: Mapping[str, Any], name: str) -> list[int]:
    row = []
    names: set[str] = set()
    for vertex in dag.vertices:
        names.update((vertex.name, vertex.callback.key))
        value = times.get(vertex.name, times.get(vertex.callback.key))
        if value is None:
            raise SimulationError(
                f'{name}: no execution time for {vertex.callback.key} of DAG {dag.name}: add it')
        if isinstance(value, bool) or not isinstance(value, (int, float)) \
                or not 0 < value < _LONGEST_US:
            raise SimulationError(
                f'{name}: execution time of {vertex.callback.key} of DAG {dag.name} is '
                f'{_shown(value)}: give microseconds, above 0 and below one day')
        row.append(max(1, round(value * 1000)))
    for key in times:
        if key not in names:
            raise SimulationError(
                f"{name}: '{key}' is not a vertex of DAG {dag.name}: take it out or correct it")
    return row


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + '...'


def utilisation(task_set: TaskSet, times: Sequence[Sequence[int]], workers: int) -> float:
    """Return the normalised utilisation: sum of execution time over period, by workers."""
    total = sum(sum(row) / dag.period_ns for dag, row in zip(task_set.dags, times))
    return total / workers


def scale_execution_times(
    task_set: TaskSet, times: Sequence[Sequence[int]], workers: int, target: float
) -> list[list[int]]:
    """
    Return the execution times scaled by one factor to a normalised utilisation, ns.

    :raises SimulationError: when the target is no number above zero, or there is nothing to scale.
    """
    now = utilisation(task_set, times, workers)
    if not (target > 0 and math.isfinite(target)):
        raise SimulationError(f'utilisation {target}: no number above zero: give one as 0.6')
    if now == 0:
        raise SimulationError('utilisation: all execution times are 0: give times to scale')
    factor = target / now
    return [[round(time * factor) for time in row] for row in times]


def periodic_load(task_set: TaskSet, times: Sequence[Sequence[int]], duration_ns: int) -> Load:
    """Return the load of releases at k*T from 0, with the same execution times in each job."""
    releases = sorted(
        (job * dag.period_ns, dag.index, job)
        for dag in task_set.dags
        for job in range(-(-duration_ns // dag.period_ns)))
    bases = []
    costs: list[int] = []
    for row in times:
        bases.append(len(costs))
        costs.extend(row)
    return Load(
        [r[0] for r in releases], [r[1] for r in releases], [r[2] for r in releases],
        costs, bases, [0] * len(bases))


def simulate(
    task_set: TaskSet,
    load: Load,
    settings: Settings,
    *,
    utilisation: float | None = None,
    max_active_jobs: int | None = None,
    log: bool = False,
    progress: Callable[[int], None] | None = None,
) -> Run:
    """
    Run the core over a load.

    :param utilisation: of the load, for the result.
    :param max_active_jobs: bound on the open jobs of a DAG that declares none itself.
    :param log: keep the log of every worker.
    :param progress: told the virtual time (ns) now and then.
    :raises SimulationError: on settings that make no sense.
    :raises mddag_executor.core.PolicyError: when there is no such policy.
    """
    check(settings)
    policy = find_policy(settings.policy)
    preemptive = policy.mode(settings.preemptive)
    tables = Tables.build(
        task_set, max_active_jobs=NEVER if max_active_jobs is None else max_active_jobs)
    state = new_state(
        tables, settings.workers, preemptive=preemptive,
        dispatch_overhead=settings.dispatch_overhead_ns,
        switch_overhead=settings.switch_overhead_ns, polling=policy.polling)
    entries: list[LogEntry] = []
    ended = run(
        tables, state, policy.key, load, settings.duration_ns, settings.stop_at_first_miss,
        entries if log else None, progress)
    stopped = settings.stop_at_first_miss and ended < settings.duration_ns
    if settings.judge == 'horizon' and not stopped:
        finish(tables, state, ended)
    tally = Tally(task_set, tables)
    for time, dag in zip(load.times, load.dags):
        if time < settings.duration_ns and time <= ended:
            tally.released(dag)
    tally.add(state.decisions)
    return Run(settings, tally, ended, utilisation, preemptive, entries, state.decisions)


def check(settings: Settings) -> None:
    """
    Check that settings make sense.

    :raises SimulationError: when they do not.
    """
    if settings.workers < 1:
        raise SimulationError(f'workers: {settings.workers} is too few: give at least 1')
    if settings.duration_ns < 1:
        raise SimulationError(f'duration: {settings.duration_ns} ns is too short: give at least 1')
    if settings.judge not in JUDGES:
        raise SimulationError(
            f"judge '{settings.judge}': there is no such way: choose one of {', '.join(JUDGES)}")
    if settings.dispatch_overhead_ns < 0 or settings.switch_overhead_ns < 0:
        raise SimulationError('overhead: it is negative: give 0 or more')
