# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A placement in virtual time: what the scheduler's rules make of it.

Theory of operation
-------------------
1. Each process has its workers and its interpreter, all in one state of the core (its rules 11 and
   12): of those that compute in Python the most urgent goes first, and one at a time computes.
2. All processes share the CPUs (``simulate.machine``).
3. What the executor and the middleware take is added to execution times: ``CALLBACK_NS`` for each
   callback, ``TRANSPORT_NS`` for each message that it sends to another process.  DAGs are released
   ``APART_NS`` after one another: timers that start together are never due at the very same time,
   so there are no ties.
4. The thread of the intake notices a timer, and takes a message of another process, which is there
   ``ARRIVAL_NS`` after it was sent.  That takes ``INTAKE_NS`` with Python's lock, for which it
   waits a switch interval where a callback computes, and meanwhile that one stands still.  It is
   an execution of its own, ahead of the callback.
5. One placement is better than another where fewer deadlines are missed, then where the response
   that uses most of its deadline uses less of it.  Placements that differ in one block of nodes or
   two are tried, those of the least load first, until none is better or ``MOST_TRIES`` were tried.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import accumulate, islice

from mddag_executor.assign.placement import Placing, TRANSPORT_NS
from mddag_executor.core import NEVER, Tables, Tally
from mddag_executor.core import policy as find_policy
from mddag_executor.core.tally import total
from mddag_executor.simulate.load import edge_numbers, edges_of, Load
from mddag_executor.simulate.schedule import prepare, schedule, Settings
from mddag_executor.simulate.workload import periodic_load
from msg_graph import Process, TaskSet, Vertex

CALLBACK_NS = 130_000
ARRIVAL_NS = 300_000
INTAKE_NS = 300_000
APART_NS = 20_000
MOST_TRIES = 150
_AHEAD = 40

Cost = tuple[int, float]


class Predictor:
    """
    Simulates placements.

    :param workers: of each process.
    :param cpus: that all processes share; None: enough for all.
    :param duration_ns: virtual time of a run.
    """

    def __init__(
        self, task_set: TaskSet, workers: int, cpus: int | None, policy: str, duration_ns: int,
    ) -> None:
        self._task_set = task_set
        self._workers = workers
        self._cpus = cpus
        self._policy = find_policy(policy)
        self._duration = duration_ns
        self._compiled: bool | None = None  # not known yet

    def predict(
        self, processes: Sequence[Process], execution_ns: Sequence[Sequence[int]]
    ) -> Tally:
        """Return the verdicts about a placement, with these execution times in each job."""
        task_set = replace(self._task_set, processes=tuple(processes))
        sends, noticed = _with_intakes(task_set)
        tables = Tables.build(noticed, max_active_jobs=NEVER)
        times: list[list[int]] = []
        locks: list[int] = []
        for number, row in enumerate(execution_ns):
            intakes = len(noticed.dags[number].vertices) - len(row)
            times.append([ns + CALLBACK_NS + TRANSPORT_NS * ((number, vertex) in sends)
                          for vertex, ns in enumerate(row)] + [INTAKE_NS] * intakes)
            locks += [0] * len(row) + [1] * intakes
        holds = [0 if locked or vertex.callback.holds_interpreter is False else process
                 for vertex, process, locked in zip(noticed.vertices, tables.process, locks)]
        delays = [ARRIVAL_NS * locks[after] for _, after in edge_numbers(tables)]
        bases = list(accumulate(edges_of(tables), initial=0))[:-1]
        load = _apart(periodic_load(noticed, times, self._duration)._replace(
            holds=holds, locks=locks, delays=delays, delay_base=bases,
            delay_stride=[0] * len(bases)))
        settings = Settings(
            self._policy.name, self._workers, self._duration, cpus=self._cpus,
            processes=max(1, len(processes)))
        if self._compiled is None:
            self._compiled = prepare(tables, load, settings, MOST_TRIES)
        decisions = schedule(tables, load, settings, compiled=self._compiled).decisions
        tally = Tally(noticed, tables)
        for time, dag in zip(load.times, load.dags):
            if time < self._duration:
                tally.released(dag)
        tally.add(decisions)
        return tally


def _with_intakes(task_set: TaskSet) -> tuple[set[tuple[int, int]], TaskSet]:
    """
    Return who sends to other processes, by DAG and index, and the task set with what intakes do.

    That (rule 4) is behind the vertices of each DAG.
    """
    sends: set[tuple[int, int]] = set()
    dags = []
    for dag in task_set.dags:
        vertices = list(dag.vertices)
        source = dag.source
        home = [task_set.process_of(vertex.callback.node) for vertex in vertices]
        ways: list[tuple[int | None, int]] = [
            (before, after) for before, after in dag.edges if home[before] != home[after]]
        if vertices[source].callback.kind == 'timer':
            ways.append((None, source))
        for before, after in ways:
            new = len(vertices)
            later = vertices[after]
            came: tuple[int, ...] = ()
            if before is None:
                source = new
                vertices[after] = replace(later, predecessors=(new,))
            else:
                came = (before,)
                sends.add((dag.index, before))
                vertices[before] = replace(vertices[before], successors=tuple(
                    new if s == after else s for s in vertices[before].successors))
                vertices[after] = replace(later, predecessors=tuple(
                    new if p == before else p for p in later.predecessors))
            vertices.append(Vertex(
                f'intake of {later.name} {new}', replace(later.callback, group=None), dag.index,
                new, came, (after,), None))
        dags.append(replace(
            dag, vertices=tuple(vertices), source=source, edges=tuple(sorted(
                (v.index, s) for v in vertices for s in v.successors))))
    return sends, replace(task_set, dags=tuple(dags))


def _apart(load: Load) -> Load:
    """Release each DAG a little after the one before it (rule 3)."""
    releases = sorted((time + dag * APART_NS, dag, job) for time, dag, job in zip(
        load.times, load.dags, load.jobs))
    times, dags, jobs = (list(column) for column in zip(*releases))
    return load._replace(times=times, dags=dags, jobs=jobs)


def cost_of(tally: Tally) -> Cost:
    """Return what is compared of two placements (rule 5)."""
    dags = tally.result()['dags']
    worst = max((sink['response_ns']['max'] / sink['relative_deadline_ns']
                 for dag in dags.values() for sink in dag['sinks'].values()
                 if sink['response_ns'] is not None), default=0.0)
    return total(dags).missed, round(worst, 2)


def improve(
    placing: Placing, place: dict[int, int], cost: Callable[[tuple[Process, ...]], Cost],
    report: Callable[[int], None] = lambda tried: None, most: int = MOST_TRIES,
) -> tuple[dict[int, int], int]:
    """
    Return a placement at least as good, and how many were simulated.

    :param cost: simulates one.
    :param report: called now and then with how many have been tried.
    """
    best, tried = cost(placing.processes(place)), 1
    seen = {tuple(sorted(place.items()))}
    while tried < most:
        for other in _next(placing, place, seen):
            seen.add(tuple(sorted(other.items())))
            tried += 1
            report(tried)
            found = cost(placing.processes(other))
            if found < best:
                place, best = other, found
                break
            if tried >= most:
                break
        else:
            break
    return place, tried


def _next(
    placing: Placing, place: dict[int, int], seen: set[tuple[tuple[int, int], ...]]
) -> Iterable[dict[int, int]]:
    """Return the placements to try next, those of the least load first."""
    candidates = [each for each in placing.neighbours(place)
                  if tuple(sorted(each.items())) not in seen]
    return islice(sorted(candidates, key=lambda each: max(placing.loads(each))), _AHEAD)
