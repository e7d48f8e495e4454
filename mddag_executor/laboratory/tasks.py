# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""DAG tasks as the schedulability tests see them: costs, volumes, lengths and deadlines."""

from __future__ import annotations

from dataclasses import dataclass

from mddag_executor import defaults
from mddag_executor.core.tables import leaf_deadline
from mddag_executor.errors import UsageError
from mddag_executor.simulate.execution_times import check_execution_times
from msg_graph import Dag, ExecutionTime, TaskSet
from msg_graph.model import path_lengths, topological_order


@dataclass(frozen=True, slots=True)
class Task:
    """
    A DAG task with a budget for each vertex; all times in ns, vertices by their index.

    :ivar costs: the budgets.
    :ivar latest: when a vertex must be done, after the release, so that its successors can be.
    :ivar sinks: index, relative deadline and length of the longest path, of each sink.
    :ivar volume: sum of the budgets.
    :ivar length: the longest path of all.
    """

    dag: Dag
    costs: tuple[int, ...]
    latest: tuple[int, ...]
    sinks: tuple[tuple[int, int, int], ...]
    volume: int
    length: int

    @property
    def period(self) -> int:
        """Return the time between two releases, ns."""
        return self.dag.period_ns

    @property
    def utilisation(self) -> float:
        """Return the share of one worker that the task needs."""
        return 0.0 if self.dag.once else self.volume / self.period


def tasks_of(task_set: TaskSet, budget: str = 'max') -> list[Task]:
    """Return the tasks of a task set, with one of ``BUDGETS`` of each execution time."""
    if budget not in defaults.BUDGETS:
        raise UsageError(f"budget '{budget}': there is no such budget: choose one of "
                         f'{", ".join(defaults.BUDGETS)}')
    check_execution_times(task_set)
    tasks = []
    for dag in task_set.dags:
        costs = [_budget(vertex.callback.execution_time, budget)  # type: ignore[arg-type]
                 for vertex in dag.vertices]
        lengths = path_lengths(dag, costs)
        sinks = tuple((i, dag.vertices[i].deadline_ns or 0, lengths[i]) for i in dag.sinks)
        tasks.append(Task(
            dag=dag, costs=tuple(costs),
            latest=tuple(_latest(dag, costs)), sinks=sinks, volume=sum(costs),
            length=max(lengths)))
    return tasks


def _budget(time: ExecutionTime, budget: str) -> int:
    if budget == 'max':
        return time.quantiles_ns[-1]
    return time.draw(0.99) if budget == 'p99' else time.mean_ns


def _latest(dag: Dag, costs: list[int]) -> list[int]:
    latest = [0 if vertex.successors else leaf_deadline(vertex, dag) for vertex in dag.vertices]
    for index in reversed(topological_order(dag)):
        after = dag.vertices[index].successors
        if after:
            latest[index] = min(latest[s] - costs[s] for s in after)
    return latest
