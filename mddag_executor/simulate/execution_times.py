# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Execution times of one simulated run: drawn, read from a file, scaled.

They are a list for each DAG, by local vertex index, in ns.  Each vertex has one execution time for
the whole run, as in the paper's experiment.  (``laboratory.draws`` has those of many runs, as
arrays.)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
import json
import math
import random
from typing import Any

from mddag_executor.errors import InputError, UsageError
from mddag_executor.text import counted
from msg_graph import Dag, ExecutionTime, TaskSet, Vertex
from msg_graph.duration import DAY, MICROSECOND

_FORMAT = 'write {"DAG": {"/node:callback": microseconds}}'
_LONGEST_US = DAY // MICROSECOND


def check_execution_times(task_set: TaskSet, otherwise: str = '') -> None:
    """
    Check that each callback declares an execution time.

    :param otherwise: what else to do about it, as ``, or give --execution-times FILE.npz``.
    :raises InputError: it names the first one that does not.
    """
    missing = [each for each in task_set.callbacks if each.execution_time is None]
    if missing:
        others = f' (and {counted(len(missing) - 1, "more callback")})' if missing[1:] else ''
        raise InputError(
            missing[0].file or task_set.file,
            f'{missing[0].key}{others} declares no execution_time', f'add one{otherwise}',
            missing[0].line)


def draw_execution_times(
    task_set: TaskSet, seed: int, undeclared: int | None = None
) -> list[list[int]]:
    """
    Draw one execution time (ns) for each vertex, for the whole run, as in the paper.

    :param undeclared: execution time of callbacks that declare none, ns; None: each must declare
        one.
    :return: one list for each DAG, by local vertex index; the same seed gives the same draw.
    :raises InputError: if a callback declares no execution time.
    """
    if undeclared is None:
        check_execution_times(task_set, ', or give --execution-times FILE')
    generator = random.Random(seed)

    def draw(vertex: Vertex) -> int:
        # Drawn even if nothing is declared: then declaring one more time changes no other draw.
        share = generator.random()
        time = vertex.callback.execution_time
        return undeclared or 0 if time is None else time.draw(share)

    return [[draw(vertex) for vertex in dag.vertices] for dag in task_set.dags]


def read_execution_times(
    task_set: TaskSet, text: str | bytes, name: str
) -> list[list[int]]:
    """
    Read fixed execution times: JSON ``{"DAG": {"/node:callback": microseconds, …}, …}``.

    :return: ns, one list for each DAG, by local vertex index.
    :raises InputError: for any other contents, or a vertex without a time.
    """
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:  # also bytes that are not text
        raise InputError(
            name, f'not usable JSON ({error})', _FORMAT, getattr(error, 'lineno', None)) from None
    if not isinstance(data, dict) or not all(isinstance(v, dict) for v in data.values()):
        raise InputError(name, 'not an object of objects', _FORMAT)
    known = {dag.name for dag in task_set.dags}
    for dag_name in data:
        if dag_name not in known:
            raise InputError(name, f"DAG '{dag_name}' is not in {task_set.file}",
                             f"its DAGs are {', '.join(sorted(known))}")
    return [_dag_times(dag, data.get(dag.name, {}), name) for dag in task_set.dags]


def _dag_times(dag: Dag, times: Mapping[str, Any], name: str) -> list[int]:
    row = []
    names: set[str] = set()
    for vertex in dag.vertices:
        names.update((vertex.name, vertex.callback.key))
        value = times.get(vertex.name, times.get(vertex.callback.key))
        if value is None:
            raise InputError(
                name, f'no execution time for {vertex.callback.key} of DAG {dag.name}', 'add it')
        if isinstance(value, bool) or not isinstance(value, (int, float)) \
                or not 0 < value < _LONGEST_US:
            raise InputError(
                name, f'execution time of {vertex.callback.key} of DAG {dag.name} is '
                f'{_shown(value)}', 'give microseconds, above 0 and below one day')
        row.append(max(1, round(value * 1000)))
    for key in times:
        if key not in names:
            raise InputError(name, f"'{key}' is not a vertex of DAG {dag.name}",
                             'take it out or correct it')
    return row


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + '...'


def utilisation(task_set: TaskSet, times: Sequence[Sequence[int]], workers: int) -> float:
    """Return the normalised utilisation: sum of execution time over period, by workers."""
    total = sum(sum(row) / dag.period_ns for dag, row in zip(task_set.dags, times)
                if not dag.once)
    return total / workers


def scale_execution_times(
    task_set: TaskSet, times: Sequence[Sequence[int]], workers: int, target: float
) -> list[list[int]]:
    """
    Return the execution times scaled by one factor to a normalised utilisation, ns.

    :raises UsageError: if the target is not a positive number, or there is nothing to scale.
    """
    now = utilisation(task_set, times, workers)
    if not (target > 0 and math.isfinite(target)):
        raise UsageError(
            f'utilisation {target}: it is not a number above zero: give one, as 0.6')
    if now == 0:
        raise UsageError(
            f'{task_set.file}: no callback has an execution time, so there is nothing to scale: '
            'declare execution_time, or leave the utilisation out')
    factor = target / now
    return [[round(time * factor) for time in row] for row in times]


def with_execution_times(task_set: TaskSet, times: Sequence[Sequence[int]]) -> TaskSet:
    """Return a task set whose vertices declare these execution times, ns."""
    return replace(task_set, dags=tuple(
        replace(dag, vertices=tuple(
            replace(vertex, callback=replace(
                vertex.callback, execution_time=ExecutionTime((time,), (50.0,))))
            for vertex, time in zip(dag.vertices, row)))
        for dag, row in zip(task_set.dags, times)))
