# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Where the time of a job went, along its critical chain.

Theory of operation
-------------------
The critical chain of a sink's completion is found backwards: the sink's vertex became ready when
the last message that it needed was there, which the vertex before it published; and so on up to
the source.  Along the chain the response time, completion minus release, splits without rest into

* release lag: from the release until the source was ready (a timer noticed late, or, with
  `release_from: header_stamp`, the way of the sensor's message);
* waiting: from ready to the start of the execution, for a worker or for the callback group (the
  part while another callback of the group ran);
* executing: from the start until the next vertex was ready, or the execution's end, whichever
  was first;
* suspended: in between, where a coroutine waited;
* transport: from the end of an execution until the next vertex was ready;
* unknown: what came before the part of the chain that is in the trace.

A callback that publishes early may still run when the sink completes: then it has executed until
its message was there, and which of its legs it was is not known.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from mddag_executor.core import legs_of, NEVER, Tables
from mddag_executor.replay.follower import Execution
from msg_graph import TaskSet


class Breakdown(NamedTuple):
    """Parts of a response time, ns."""

    release_lag_ns: int = 0
    waiting_ns: int = 0
    executing_ns: int = 0
    suspended_ns: int = 0
    transport_ns: int = 0
    unknown_ns: int = 0


class Step(NamedTuple):
    """
    A vertex of a chain.

    `leg` is the one that completed it (-1: it still ran), `execution` that execution, `group` how
    much of its waiting was for its callback group, ns.
    """

    vertex: int
    leg: int
    execution: Execution
    group: int = 0


class Worst(NamedTuple):
    """The job with a sink's longest response time."""

    job: int
    release: int
    completed: int
    chain: list[Step]
    breakdown: Breakdown

    @property
    def group(self) -> int:
        """Return how much of the waiting was for callback groups, ns."""
        return sum(step.group for step in self.chain)


class SinkTimes:
    """Where the time of a sink's completed jobs went: sums, and the worst job."""

    __slots__ = ('completed', 'sums', 'group', 'worst')

    def __init__(self) -> None:
        self.completed = 0
        self.sums = [0] * len(Breakdown._fields)
        self.group = 0
        self.worst: Worst | None = None

    def add(self, worst: Worst) -> None:
        """Take in a completed job."""
        self.completed += 1
        for i, part in enumerate(worst.breakdown):
            self.sums[i] += part
        self.group += worst.group
        before = self.worst
        if (before is None
                or worst.completed - worst.release > before.completed - before.release):
            self.worst = worst


class Chains:
    """
    The chains of open jobs, and what came of those of completed ones.

    :param tables: tables of the task set, with legs.
    """

    def __init__(self, task_set: TaskSet, tables: Tables) -> None:
        self._tables = tables
        #: By global vertex and leg: the vertex whose message it is.
        self.before = [
            [first + before for _, before in legs_of(vertex, dag.vertices)]
            for dag, first in zip(task_set.dags, tables.first_vertex) for vertex in dag.vertices]
        self._release: dict[int, int] = {}
        self._done: dict[int, dict[int, Step]] = {}
        self.sinks = {vertex: SinkTimes() for vertex in tables.sinks}

    def begin(self, slot: int, release: int) -> None:
        """Begin a job; what was known of the slot's last one is forgotten."""
        self._release[slot] = release
        self._done[slot] = {}

    def started(self, slot: int, vertex: int, ready: int, start: int) -> None:
        """Take in an execution that has begun, or a coroutine that went on."""
        before = self._done[slot].get(vertex)
        if before is None or before.execution.ready != ready:
            self._done[slot][vertex] = Step(vertex, -1, Execution(ready, start, NEVER, NEVER))

    def completed(
        self, slot: int, vertex: int, leg: int, execution: Execution, group: int = 0
    ) -> None:
        """Take in the execution that completed a vertex, and its waiting for its group."""
        self._done[slot][vertex] = Step(vertex, leg, execution, group)

    def sink(self, slot: int, vertex: int, job: int, completed: int) -> None:
        """Take in that a sink has completed."""
        release = self._release[slot]
        chain = self._chain(self._done[slot], vertex)
        breakdown = self._split(chain, release, completed)
        self.sinks[vertex].add(Worst(job, release, completed, chain, breakdown))

    def _chain(self, done: dict[int, Step], vertex: int) -> list[Step]:
        chain: list[Step] = []
        step = done.get(vertex)
        while step is not None:
            chain.append(step)
            publishers = self.before[step.vertex]
            if step.leg >= 0 and publishers:
                publishers = [publishers[step.leg]]
            ready = step.execution.ready
            candidates = [
                done[v] for v in publishers if v in done and done[v].execution.start <= ready]
            step = max(candidates, key=lambda s: s.execution.end, default=None)
        chain.reverse()
        return chain

    def _split(self, chain: list[Step], release: int, completed: int) -> Breakdown:
        if not chain:
            return Breakdown(unknown_ns=completed - release)
        before = chain[0].execution.ready - release
        waiting = executing = suspended = transport = 0
        for step, after in zip(chain, [*chain[1:], None]):
            ready, start, end, busy = step.execution
            waiting += start - ready
            published = completed if after is None else min(end, after.execution.ready)
            pause = end - start - busy
            if step.leg < 0:
                pause = 0  # it still runs: nothing more is known
            # Where in the execution a pause was is not kept: it counts as far as there is room.
            pause = max(0, min(pause, published - start))
            suspended += pause
            executing += published - start - pause
            if after is not None:
                transport += after.execution.ready - published
        whole = not self.before[chain[0].vertex]
        return Breakdown(
            before if whole else 0, waiting, executing, suspended, transport,
            0 if whole else before)

    def result(self, task_set: TaskSet, vertex: int) -> dict[str, Any] | None:
        """Return a sink's part of the result: means over completed jobs, and the worst job."""
        times = self.sinks[vertex]
        worst = times.worst
        if worst is None:
            return None
        means = [round(total / times.completed) for total in times.sums]
        return {
            'mean': {**dict(zip(Breakdown._fields, means)),
                     'waiting_group_ns': round(times.group / times.completed)},
            'worst': {
                'job': worst.job, 'release_ns': worst.release, 'completed_ns': worst.completed,
                **worst.breakdown._asdict(), 'waiting_group_ns': worst.group,
                'chain': [_step_result(task_set, step) for step in worst.chain]}}


def _step_result(task_set: TaskSet, step: Step) -> dict[str, Any]:
    ready, start, end, busy = step.execution
    known = step.leg >= 0
    return {
        'vertex': task_set.vertices[step.vertex].name, 'ready_ns': ready, 'start_ns': start,
        'end_ns': end if known else None, 'busy_ns': busy if known else None,
        'waiting_group_ns': step.group if known else None}
