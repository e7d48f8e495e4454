# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A placement in virtual time: which deadlines hold with it.

Theory of operation
-------------------
1. Each process has its workers and its interpreter, all in one state of the core (its rules 11 and
   12): of those that compute in Python the most urgent goes first, and one at a time computes.
2. All processes share the CPUs (``simulate.machine``).
3. The cost of the executor and the middleware is added to execution times: ``CALLBACK_NS`` for
   each callback, ``PUBLISH_NS`` for each callback that it sends a message to, ``TIMER_NS`` for a
   timer, ``RECEIVE_NS`` for each message of another process, and ``SEND_NS`` if it sends to other
   processes.
4. A placement is better if fewer deadlines are missed, then if the largest response time, as a
   share of its deadline, is smaller.  Placements that differ in one block of nodes or two are
   tried, those of the least load first, until none is better or ``MOST_TRIES`` were tried.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import islice

from mddag_executor.core import NEVER, Tables, Tally
from mddag_executor.core import policy as find_policy
from mddag_executor.core.tally import total
from mddag_executor.laboratory.placement import Placing
from mddag_executor.simulate.schedule import prepare, schedule, Settings
from mddag_executor.simulate.workload import periodic_load
from msg_graph import Process, TaskSet, Vertex

CALLBACK_NS = 20_000
PUBLISH_NS = 75_000
TIMER_NS = 280_000
RECEIVE_NS = 480_000
SEND_NS = 100_000
MOST_TRIES = 150
_AHEAD = 40

Cost = tuple[int, float]


class Predictor:
    """
    Simulates placements.

    :param workers: of each process.
    :param cpus: that all processes share; None: enough for all.
    :param duration_ns: virtual time of a run.
    :param publish_ns: cost of publishing in addition to execution times, for each receiving
        callback; recorded execution times include it.
    """

    def __init__(
        self, task_set: TaskSet, workers: int, cpus: int | None, policy: str, duration_ns: int,
        publish_ns: int = PUBLISH_NS,
    ) -> None:
        self._task_set = task_set
        self._workers = workers
        self._cpus = cpus
        self._policy = find_policy(policy)
        self._duration, self._publish = duration_ns, publish_ns
        self._compiled: bool | None = None  # not known yet

    def predict(
        self, processes: Sequence[Process], execution_ns: Sequence[Sequence[int]]
    ) -> Tally:
        """Return the verdicts about a placement, with these execution times in each job."""
        task_set = replace(self._task_set, processes=tuple(processes))
        tables = Tables.build(task_set, max_active_jobs=NEVER)
        times = [[ns + self._overhead(vertex, tables.process[first:]) for ns, vertex in zip(
            row, dag.vertices)] for row, dag, first in zip(
                execution_ns, task_set.dags, tables.first_vertex)]
        load = periodic_load(task_set, times, self._duration)._replace(
            holds=[0 if vertex.callback.holds_interpreter is False else process
                   for vertex, process in zip(task_set.vertices, tables.process)])
        settings = Settings(
            self._policy.name, self._workers, self._duration, cpus=self._cpus,
            processes=max(1, len(processes)))
        if self._compiled is None:
            self._compiled = prepare(tables, load, settings, MOST_TRIES)
        tally = Tally(task_set, tables)
        schedule(tables, load, settings, compiled=self._compiled).count_into(
            tally, load, settings)
        return tally

    def _overhead(self, vertex: Vertex, process: Sequence[int]) -> int:
        """
        Return the cost of the executor and the middleware for an execution (rule 3), ns.

        :param process: by local vertex its process.
        """
        here = process[vertex.index]
        return (CALLBACK_NS + self._publish * len(vertex.successors)
                + TIMER_NS * (vertex.callback.kind == 'timer')
                + RECEIVE_NS * sum(process[other] != here for other in vertex.predecessors)
                + SEND_NS * any(process[other] != here for other in vertex.successors))


def cost_of(tally: Tally) -> Cost:
    """Return what is compared of two placements (rule 4)."""
    dags = tally.result()['dags']
    worst = max((sink['response_ns']['max'] / sink['relative_deadline_ns']
                 for dag in dags.values() for sink in dag['sinks'].values()
                 if sink['response_ns'] is not None), default=0.0)
    return total(dags).missed, round(worst, 2)


def improve(
    placing: Placing, place: dict[int, int], cost: Callable[[tuple[Process, ...]], Cost],
    report: Callable[[int], None] = lambda tried: None, most: int = MOST_TRIES,
) -> tuple[dict[int, int], int]:
    """Return a placement that costs no more, and how many have been simulated."""
    best, tried = cost(placing.processes(place)), 1
    seen = {tuple(sorted(place.items()))}
    candidates = _next(placing, place, seen)
    while tried < most and (other := next(candidates, None)) is not None:
        seen.add(tuple(sorted(other.items())))
        tried += 1
        report(tried)
        found = cost(placing.processes(other))
        if found < best:
            place, best = other, found
            candidates = _next(placing, place, seen)
    return place, tried


def _next(
    placing: Placing, place: dict[int, int], seen: set[tuple[tuple[int, int], ...]]
) -> Iterator[dict[int, int]]:
    """Return the placements to try next, those of the least load first."""
    candidates = [each for each in placing.neighbours(place)
                  if tuple(sorted(each.items())) not in seen]
    return islice(sorted(candidates, key=lambda each: max(placing.loads(each))), _AHEAD)
