# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Ordinary bags rescheduled: recorded sensor messages as releases, declared execution times.

Theory of operation
-------------------
* A DAG whose source is a subscription has a job for each message of its topic in the bag, ready
  when the message came.  Its release is what the declaration's `release_from` says: the arrival,
  the stamp in the message's header, or its publication, where the recorder kept that.  Where a
  message has no such stamp, or one later than its arrival, it is released at its arrival.
* A DAG whose source is a timer has jobs at k * T from the bag's first message on, while messages
  come (see ``trace.times``): when the timers really ran is not in a bag.
* Execution times are drawn for each execution from the declared quantiles (seeded), or come from a
  table, fixed for the whole run.
* What is not in a bag is left out and said: transport, dispatch, what else the machine did.
"""

from __future__ import annotations

from collections.abc import Sequence
import os
import random
from typing import Any, NamedTuple

from mddag_executor.core import NEVER, Tables
from mddag_executor.core import policy as find_policy
from mddag_executor.core.state import Decision
from mddag_executor.replay.bags import Bag, BagError, UNKNOWN
from mddag_executor.replay.computed import ComputedRun
from mddag_executor.replay.tolerances import MissTally
from mddag_executor.replay.usage import share
from mddag_executor.simulate import How, Load, LogEntry, schedule, SimulationError
from mddag_executor.simulate.engine import busy_times
from mddag_executor.simulate.workload import declared_holds
from mddag_executor.text import counted, listed
from mddag_executor.trace.times import credible
from msg_graph import Dag, TaskSet

DEFAULT_WORKERS = 7
_MOST_JOBS = 20_000_000
_STAMP_OF = {'header_stamp': 'header', 'source_timestamp': 'published'}
_CALLED = {'header_stamp': 'header stamp', 'source_timestamp': 'publication time'}


class Source(NamedTuple):
    """What became of a DAG's source: jobs as pairs (ready, release), ns, and what to say of it."""

    jobs: list[tuple[int, int]]
    note: str


class BagReschedule:
    """
    What the core makes of a bag.

    :ivar log: every start, end and preemption, on the bag's clock.
    :ivar notes: what was assumed, one line each; ``warnings``: what is missing or doubtful.
    """

    def __init__(
        self, bag: Bag, task_set: TaskSet, *, policy: str, workers: int, preemptive: bool,
        times: Sequence[Sequence[int]] | None, seed: int, dispatch_overhead: int,
        skip: int = 0, cpus: int | None = None,
    ) -> None:
        self._bag = bag
        self.cpus = cpus
        self.task_set = task_set
        self.policy = policy
        self.workers = workers
        self.preemptive = preemptive
        self.dispatch_overhead = dispatch_overhead
        self.start, self.end = bag.start or 0, (bag.end or 0) + 1
        self.skip = skip
        self.judge_from = self.start + skip if skip else -NEVER
        self.warnings = bag.warnings
        self.notes: list[str] = []
        self.tables = Tables.build(task_set, max_active_jobs=NEVER)
        self.tally = MissTally(task_set, self.tables)
        self.load = load = self._load(times, seed)
        self.demand = sum(load.costs)
        self.executions = len(load.costs)
        self.decisions: list[Decision]
        self.log: list[LogEntry] = self._run(load)

    def _load(self, times: Sequence[Sequence[int]] | None, seed: int) -> Load:
        generator = random.Random(seed)
        releases: list[tuple[int, int, int, int]] = []
        costs: list[int] = []
        holds: list[int] = []
        bases: list[int] = []
        declared = declared_holds(self.task_set)
        for dag in self.task_set.dags:
            source = self._source(dag)
            self.notes.append(f'{dag.name}: {source.note}')
            bases.append(len(costs))
            if len(releases) + len(source.jobs) > _MOST_JOBS:
                raise self._too_many()
            for job, (ready, release) in enumerate(source.jobs):
                releases.append((ready, dag.index, job, release))
                costs.extend(_costs(dag, times, generator))
                holds += declared[dag.index] if declared else []
        bases.append(len(costs))
        if not releases:
            raise BagError(
                self._bag.name, f'none of the sources of {self.task_set.file} is in it: it has '
                + (listed(sorted(self._bag.topics)) or 'no topics'),
                'give the graph of the nodes that were recorded')
        releases.sort()
        return Load(
            [r[0] for r in releases], [r[1] for r in releases], [r[2] for r in releases], costs,
            bases, [*(len(dag.vertices) for dag in self.task_set.dags), 1],
            [r[3] for r in releases], holds)

    def _source(self, dag: Dag) -> Source:
        callback = dag.vertices[dag.source].callback
        if callback.kind == 'timer':
            jobs = self._timer_jobs(dag.period_ns)
            pauses = len(self._bag.stretches) - 1
            return Source(
                jobs, f'{counted(len(jobs), "job")} at the nominal period of its timer, from the '
                'first message on: a bag does not tell when timers ran'
                + (f'; none in {counted(pauses, "pause")} of over a minute without any message'
                   if pauses else ''))
        if not callback.topics:
            self.warnings.append(
                f'{self._bag.name}: {dag.name} starts with a service call, which a bag does not '
                'have: there are no jobs of it')
            return Source([], 'no jobs: its source is a service')
        topic = callback.topics[0]
        stamps = self._bag.stamps.get(topic)
        if stamps is None:
            self.warnings.append(
                f'{self._bag.name}: topic {topic} is not in it, so there are no jobs of '
                f'{dag.name}')
            return Source([], f'no jobs: {topic} is not in the bag')
        arrivals = list(stamps.arrival)
        if dag.release_from == 'arrival':
            jobs = [(arrival, arrival) for arrival in arrivals]
            return Source(sorted(jobs), f'{counted(len(jobs), "job")} from the arrival of {topic}')
        column = getattr(stamps, _STAMP_OF[dag.release_from])
        jobs = [(arrival, stamp if stamp <= arrival and credible(stamp, arrival) else arrival)
                for arrival, stamp in zip(arrivals, column)]
        what = _CALLED[dag.release_from]
        without = sum(stamp in (UNKNOWN, 0) for stamp in column)
        later = sum(stamp > arrival for arrival, stamp in zip(arrivals, column))
        far = sum(0 < stamp and not credible(stamp, arrival)
                  for arrival, stamp in zip(arrivals, column))
        for count, why in ((without, f'without a {what}'),
                           (far, f'with a {what} years before the arrival'),
                           (later, f'with a {what} after the arrival')):
            if count:
                self.warnings.append(
                    f'{self._bag.name}: {count} of {counted(len(jobs), "message")} of {topic} '
                    f'({stamps.type}) {why}: released at the arrival')
        return Source(sorted(jobs), f'{counted(len(jobs), "job")} from the {what} of {topic}')

    def _timer_jobs(self, period: int) -> list[tuple[int, int]]:
        """Return the jobs of a timer: at its period, while messages came."""
        found: list[tuple[int, int]] = []
        for start, end in self._bag.stretches:
            first = self.start - (self.start - start) // period * period
            if (end - first) // period + len(found) >= _MOST_JOBS:
                raise self._too_many()
            found.extend((t, t) for t in range(first, end + 1, period))
        return found

    def _too_many(self) -> BagError:
        return BagError(
            self._bag.name, f'there are more than {_MOST_JOBS} jobs in it', 'give a shorter bag')

    def _run(self, load: Load) -> list[LogEntry]:
        how = How(
            self.policy, self.workers, find_policy(self.policy).mode(self.preemptive),
            self.dispatch_overhead, judge_from=self.judge_from, cpus=self.cpus)
        _, log, self.decisions = schedule(self.tables, load, how, self.end, log=True)
        for dag, release in zip(load.dags, load.releases):
            if release >= self.judge_from:
                self.tally.released(dag)
        self.tally.add(self.decisions)
        return log

    @property
    def duration_ns(self) -> int:
        """Return the time from the first to the last message of the bag."""
        return self.end - self.start

    def computed(self) -> ComputedRun:
        """Return the schedule, to be played to observers."""
        return ComputedRun(self.task_set, self.load, self.log, self.decisions, self.end, self.end,
                           judge_from=self.judge_from)

    def worker_busy(self) -> list[int]:
        """Return for each worker how long it was busy, ns."""
        return busy_times(self.log, self.workers, self.end)

    def result(self) -> dict[str, Any]:
        """Return the result format of ``replay --json``."""
        busy = self.worker_busy()
        return {
            'policy': self.policy, 'workers': self.workers, 'preemptive': self.preemptive,
            **({} if self.cpus is None else {'cpus': self.cpus}),
            'duration_ns': self.duration_ns,
            'utilisation': share(self.demand, self.workers, self.duration_ns),
            **self.tally.result(), 'rescheduled': True, 'skip_ns': self.skip,
            'executions': self.executions, 'estimated_executions': 0,
            'overheads': {
                'included': False, 'added_ns': self.dispatch_overhead,
                'dispatch_median_ns': None, 'transport_median_ns': None},
            'worker_use': {
                'busy_ns': {str(w): took for w, took in enumerate(busy)},
                'use': share(sum(busy), self.workers, self.duration_ns)},
            'recorded': None,
            'recording': {
                'trace': self._bag.name, 'declaration': self.task_set.file,
                'start_ns': self.start, 'end_ns': self.end, 'messages': self._bag.count},
            'notes': self.notes, 'warnings': self.warnings}


def _costs(
    dag: Dag, times: Sequence[Sequence[int]] | None, generator: random.Random
) -> Sequence[int]:
    if times is not None:
        return times[dag.index]
    row = []
    for vertex in dag.vertices:
        declared = vertex.callback.execution_time
        assert declared is not None     # checked before
        row.append(declared.draw(generator.random()))
    return row


def reschedule_bag(
    path: str | os.PathLike[str],
    task_set: TaskSet,
    *,
    policy: str | None = None,
    workers: int | None = None,
    preemptive: bool = False,
    times: Sequence[Sequence[int]] | None = None,
    seed: int = 0,
    dispatch_overhead: int = 0,
    skip: int = 0,
    name: str | None = None,
    cpus: int | None = None,
) -> BagReschedule:
    """
    Run the core over the messages of an ordinary bag.

    :param path: a bag's folder, or one of its files.
    :param policy: a row of ``mddag_executor.core.POLICIES``; None: `rad`.
    :param workers: size of the pool; None: as declared, else 7.
    :param times: execution times by DAG and vertex, ns; None: drawn from the declared ones.
    :param dispatch_overhead: added to each execution, ns.
    :param skip: how long after the bag's first message jobs are not judged (a warm-up), ns.
    :param name: what messages call the bag, where that is not its path.
    :param cpus: that those who compute share; None: enough for all.
    :raises BagError: where there is no bag, or none of the sources is in it.
    :raises mddag_executor.simulate.SimulationError: where an execution time is not known.
    :raises mddag_executor.errors.MddagError: on a policy that cannot be.
    """
    policy = policy or 'rad'
    find_policy(policy).mode(preemptive)
    if times is None:
        missing = [c for c in (v.callback for v in task_set.vertices) if c.execution_time is None]
        if missing:
            raise SimulationError(
                f'{task_set.file}:{missing[0].line}: {missing[0].key} declares no execution_time: '
                'add one, or give --execution-times FILE')
    sources = (dag.vertices[dag.source].callback for dag in task_set.dags)
    topics = {topic for source in sources if source.kind != 'timer' for topic in source.topics}
    bag = Bag(path, topics, name)
    if bag.start is None:
        what = '; '.join(bag.warnings) or 'there are no messages in it'
        raise BagError(bag.name, what.removeprefix(f'{bag.name}: '), 'record one anew')
    return BagReschedule(
        bag, task_set, policy=policy, workers=workers or task_set.workers or DEFAULT_WORKERS,
        preemptive=preemptive, times=times, seed=seed, dispatch_overhead=dispatch_overhead,
        skip=skip, cpus=cpus)
