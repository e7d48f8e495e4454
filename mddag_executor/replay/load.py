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

"""
The load of a recorded run: releases, execution times and callback groups, for the core.

Theory of operation
-------------------
* The jobs are those that were released, in that order.  A timer's job is ready at its release, a
  message's when the executor noticed it, which may be later than its release (header stamp).
* The execution time of a vertex in a job is what its execution took, its legs and the pieces of a
  coroutine added up.  Where it did not complete (the job was dropped, expired, or open at the
  end) it is the median of the callback's executions in the recording, or else the declared mean.
* What no DAG declares loads the workers too: each piece is a job of the undeclared DAG, ready when
  it was in the recording.  Callback groups of undeclared callbacks are not kept.
* Declared callbacks keep the callback groups that they had in the recording.  A `group:` of
  another declaration than the recorded one goes before.

Inside the engine a job's index is its place among the recorded jobs of its DAG; ``jobs`` has the
indices that were recorded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from mddag_executor.core import quantile, Tables
from mddag_executor.replay.follower import Execution, Observer, Piece
from mddag_executor.simulate import Load
from msg_graph import TaskSet


class RecordedLoad(NamedTuple):
    """
    A load made from a recording.

    ``jobs`` has, by DAG, the recorded index of each job; ``demand`` the execution times of all
    declared jobs, ns; ``estimated`` counts vertices of jobs whose execution time was not recorded,
    ``executions`` all of them; ``unknown`` names callbacks of which no time is known at all.
    """

    load: Load
    jobs: list[list[int]]
    demand: int
    executions: int
    estimated: int
    unknown: list[str]


class LoadBuilder(Observer):
    """Collects a load while it is told what happened."""

    def __init__(self, task_set: TaskSet, tables: Tables) -> None:
        self._task_set = task_set
        self._first = tables.first_vertex
        self._timer = [d.vertices[d.source].callback.kind == 'timer' for d in task_set.dags]
        self._sizes = [len(d.vertices) for d in task_set.dags]
        self._row: dict[tuple[int, int], int] = {}
        self._jobs: list[list[int]] = [[] for _ in task_set.dags]
        # (time when ready, DAG, place of the job in its DAG, release)
        self._releases: list[tuple[int, int, int, int]] = []
        # by DAG, flat: what each vertex of each job took, and whether it completed
        self._took: list[list[int]] = [[] for _ in task_set.dags]
        self._whole = [bytearray() for _ in task_set.dags]
        # (time when ready, what it took)
        self._undeclared: list[tuple[int, int]] = []
        #: By global vertex: the address of the callback that ran as it.
        self.callback_of: dict[int, int] = {}

    def released(self, dag: int, job: int, release: int, now: int) -> None:
        """Take in a job."""
        row = len(self._jobs[dag])
        self._row[(dag, job)] = row
        self._jobs[dag].append(job)
        ready = release if self._timer[dag] else max(release, now)
        self._releases.append((ready, dag, row, release))
        self._took[dag].extend([0] * self._sizes[dag])
        self._whole[dag].extend(bytes(self._sizes[dag]))

    def ran(self, piece: Piece) -> None:
        """Add to an execution time."""
        took = piece.end - piece.start
        if piece.vertex < 0:
            self._undeclared.append((piece.ready if piece.first else piece.start, took))
            return
        self.callback_of.setdefault(piece.vertex, piece.callback)
        row = self._row.get((piece.dag, piece.job))
        if row is not None:
            place = row * self._sizes[piece.dag] + piece.vertex - self._first[piece.dag]
            self._took[piece.dag][place] += took

    def completed(
        self, dag: int, vertex: int, job: int, leg: int, whole: bool, end: int,
        execution: Execution | None,
    ) -> None:
        """Note that an execution time is complete."""
        row = self._row.get((dag, job))
        if whole and execution is not None and row is not None:
            self._whole[dag][row * self._sizes[dag] + vertex - self._first[dag]] = 1

    def build(self) -> RecordedLoad:
        """Return what was collected."""
        typical = self._typical()
        unknown: dict[str, None] = {}
        estimated = 0
        costs: list[int] = []
        bases: list[int] = []
        for dag in self._task_set.dags:
            bases.append(len(costs))
            keys = [v.callback.key for v in dag.vertices]
            for place, whole in enumerate(self._whole[dag.index]):
                took = self._took[dag.index][place]
                if not whole:
                    estimated += 1
                    key = keys[place % len(keys)]
                    took = typical.get(key, -1)
                    if took < 0:
                        unknown[key] = None
                costs.append(max(0, took))
        demand, executions = sum(costs), len(costs)
        bases.append(len(costs))
        undeclared = sorted(self._undeclared)
        costs.extend(max(0, took) for _, took in undeclared)
        releases = sorted(self._releases + [
            (ready, len(self._jobs), place, ready)
            for place, (ready, _) in enumerate(undeclared)])
        load = Load(
            [r[0] for r in releases], [r[1] for r in releases], [r[2] for r in releases], costs,
            bases, [*self._sizes, 1], [r[3] for r in releases])
        return RecordedLoad(
            load, self._jobs, demand, executions, estimated, list(unknown))

    def _typical(self) -> dict[str, int]:
        """Return by callback the median of its recorded times, or else the declared mean."""
        recorded: dict[str, list[int]] = {}
        for dag in self._task_set.dags:
            size = self._sizes[dag.index]
            for vertex in dag.vertices:
                took = self._took[dag.index][vertex.index::size]
                whole = self._whole[dag.index][vertex.index::size]
                recorded.setdefault(vertex.callback.key, []).extend(
                    t for t, w in zip(took, whole) if w)
        typical = {
            c.key: c.execution_time.mean_ns
            for c in self._task_set.callbacks if c.execution_time is not None}
        typical.update(
            (key, quantile(sorted(times), 0.5)) for key, times in recorded.items() if times)
        return typical


class RecordedGroups:
    """The callback groups of a recording: collects what the executor said at the beginning."""

    def __init__(self) -> None:
        self._exclusive: dict[int, bool] = {}
        self._group_of_entity: dict[int, int] = {}
        self._callbacks_of: dict[int, list[int]] = {}

    def handlers(self) -> dict[str, Callable[[tuple[Any, ...]], None]]:
        """Return what takes in the events, by full name."""
        return {
            'ros2_caret:add_callback_group': self._group,
            'ros2_caret:callback_group_add_timer': self._entity,
            'ros2_caret:callback_group_add_subscription': self._entity,
            'ros2_caret:callback_group_add_service': self._entity,
            'ros2:rclcpp_timer_callback_added': self._callback,
            'ros2:rclcpp_subscription_init': self._callback,
            'ros2:rclcpp_subscription_callback_added': self._callback,
            'ros2:rclcpp_service_callback_added': self._callback,
        }

    def _group(self, event: tuple[Any, ...]) -> None:
        self._exclusive[event[5]] = event[6] == 'mutually_exclusive'

    def _entity(self, event: tuple[Any, ...]) -> None:
        self._group_of_entity[event[5]] = event[4]

    def _callback(self, event: tuple[Any, ...]) -> None:
        # also from a subscription's handle to the subscription, which the callback belongs to
        self._callbacks_of.setdefault(event[4], []).append(event[5])

    def by_callback(self) -> dict[int, int]:
        """Return by callback its mutually exclusive group, or -1 for a reentrant one."""
        found: dict[int, int] = {}
        for entity, group in self._group_of_entity.items():
            number = group if self._exclusive.get(group) else -1
            for callback in self._reachable(entity):
                found[callback] = number
        return found

    def _reachable(self, entity: int) -> Iterable[int]:
        seen = {entity: None}
        todo = [entity]
        for handle in todo:
            for after in self._callbacks_of.get(handle, ()):
                if after not in seen:
                    seen[after] = None
                    todo.append(after)
        return seen


def with_groups(
    tables: Tables, callback_of: dict[int, int], groups: dict[int, int], declared_first: bool
) -> Tables:
    """
    Return tables with the callback groups of a recording.

    :param callback_of: by global vertex the callback that ran as it.
    :param groups: by callback its group in the recording, -1 for a reentrant one.
    :param declared_first: whether declared groups go before recorded ones.
    """
    numbers: dict[tuple[bool, int], int] = {}
    column = []
    for vertex, declared in enumerate(tables.group):
        recorded = groups.get(callback_of.get(vertex, 0))
        if recorded is None or (declared_first and declared >= 0):
            choice = (False, declared)
        else:
            choice = (True, recorded)
        column.append(-1 if choice[1] == -1 else numbers.setdefault(choice, len(numbers)))
    return tables._replace(group=column, n_groups=len(numbers))
