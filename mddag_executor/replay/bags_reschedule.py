# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Ordinary bags rescheduled: recorded sensor messages as releases, declared execution times.

Theory of operation
-------------------
* A DAG whose source is a subscription has a job for each message of its topic in the bag, ready at
  its arrival.  Its release is as declared by `release_from`: the arrival, the header stamp, or the
  publication if the recorder stored it.  If a message has no such stamp, or a stamp after its
  arrival, it is released at its arrival.
* A DAG whose source is a timer has jobs at k * T from the bag's first message on, while messages
  arrive (see ``trace.times``): a bag does not have the real times of timers.
* Execution times are drawn for each execution from the declared quantiles (seeded), or come from a
  table, fixed for the whole run.
* Data that a bag does not have is ignored, and reported: transport, dispatch, other load of the
  machine.
"""

from __future__ import annotations

from collections.abc import Sequence
import os
import random
from typing import NamedTuple

from mddag_executor.core import NEVER, Tables
from mddag_executor.core import policy as find_policy
from mddag_executor.errors import InputError
from mddag_executor.replay.bags import Bag, BagError, UNKNOWN
from mddag_executor.replay.load import RecordedLoad
from mddag_executor.replay.reschedule import Reschedule
from mddag_executor.simulate import Load, Settings
from mddag_executor.simulate.workload import declared_holds
from mddag_executor.text import counted, listed
from mddag_executor.trace.times import credible
from msg_graph import Dag, TaskSet

DEFAULT_WORKERS = 7
_MOST_JOBS = 20_000_000
_STAMP_OF = {'header_stamp': 'header', 'source_timestamp': 'published'}
_CALLED = {'header_stamp': 'header stamp', 'source_timestamp': 'publication time'}


class Source(NamedTuple):
    """The jobs of a DAG's source as pairs (ready, release), ns, and notes about them."""

    jobs: list[tuple[int, int]]
    note: str


class _Builder:
    """
    Makes a load from the messages of a bag.

    :ivar notes: assumptions, one line each; ``warnings``: missing or doubtful data.
    """

    def __init__(self, bag: Bag, task_set: TaskSet) -> None:
        self._bag, self._task_set = bag, task_set
        self._start = bag.start or 0
        self.warnings = bag.warnings
        self.notes: list[str] = []

    def build(self, times: Sequence[Sequence[int]] | None, seed: int) -> RecordedLoad:
        """Return the load; ``times`` and ``seed``: see ``reschedule_bag``."""
        generator = random.Random(seed)
        releases: list[tuple[int, int, int, int]] = []
        costs: list[int] = []
        holds: list[int] = []
        bases: list[int] = []
        jobs: list[Sequence[int]] = []
        declared = declared_holds(self._task_set)
        for dag in self._task_set.dags:
            source = self._source(dag)
            self.notes.append(f'{dag.name}: {source.note}')
            bases.append(len(costs))
            jobs.append(range(len(source.jobs)))
            if len(releases) + len(source.jobs) > _MOST_JOBS:
                raise self._too_many()
            for job, (ready, release) in enumerate(source.jobs):
                releases.append((ready, dag.index, job, release))
                costs.extend(_costs(dag, times, generator))
                holds += declared[dag.index] if declared else []
        bases.append(len(costs))
        if not releases:
            raise BagError(
                self._bag.name, f'none of the sources of {self._task_set.file} is in it: it has '
                + (listed(sorted(self._bag.topics)) or 'no topics'),
                'give the graph of the nodes that were recorded')
        releases.sort()
        load = Load(
            [r[0] for r in releases], [r[1] for r in releases], [r[2] for r in releases], costs,
            bases, [*(len(dag.vertices) for dag in self._task_set.dags), 1],
            [r[3] for r in releases], holds)
        return RecordedLoad(load, jobs, sum(costs), len(costs), 0, [])

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
        """Return the jobs of a timer: at its period, while messages arrive."""
        found: list[tuple[int, int]] = []
        for start, end in self._bag.stretches:
            first = self._start - (self._start - start) // period * period
            if (end - first) // period + len(found) >= _MOST_JOBS:
                raise self._too_many()
            found.extend((t, t) for t in range(first, end + 1, period))
        return found

    def _too_many(self) -> BagError:
        return BagError(
            self._bag.name, f'there are more than {_MOST_JOBS} jobs in it', 'give a shorter bag')


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
    on_late: str = 'continue',
    times: Sequence[Sequence[int]] | None = None,
    seed: int = 0,
    dispatch_overhead: int = 0,
    skip: int = 0,
    name: str | None = None,
    cpus: int | None = None,
) -> Reschedule:
    """
    Run the core with the messages of an ordinary bag.

    :param path: a bag's folder, or one of its files.
    :param policy: a row of ``mddag_executor.core.POLICIES``; None: `rad`.
    :param workers: size of the pool; None: as declared, otherwise 7.
    :param times: execution times by DAG and vertex, ns; None: drawn from the declared ones.
    :param dispatch_overhead: added to each execution, ns.
    :param skip: warm-up time after the bag's first message; jobs released in it are not judged,
        ns.
    :param cpus: shared by executions that compute; None: enough for all.
    """
    policy = policy or 'rad'
    find_policy(policy).mode(preemptive)
    if times is None:
        missing = [c for c in (v.callback for v in task_set.vertices) if c.execution_time is None]
        if missing:
            raise InputError(task_set.file, f'{missing[0].key} declares no execution_time',
                             'add one, or give --execution-times FILE', missing[0].line)
    sources = (dag.vertices[dag.source].callback for dag in task_set.dags)
    topics = {topic for source in sources if source.kind != 'timer' for topic in source.topics}
    bag = Bag(path, topics, name)
    if bag.start is None:
        what = '; '.join(bag.warnings) or 'there are no messages in it'
        raise BagError(bag.name, what.removeprefix(f'{bag.name}: '), 'record one again')
    builder = _Builder(bag, task_set)
    work = builder.build(times, seed)
    end = (bag.end or 0) + 1
    settings = Settings(
        policy, workers or task_set.workers or DEFAULT_WORKERS, end, preemptive,
        dispatch_overhead_ns=dispatch_overhead, cpus=cpus,
        judge_from=bag.start + skip if skip else -NEVER, on_late=on_late)
    return Reschedule(
        task_set, work, Tables.build(task_set, max_active_jobs=NEVER, on_late=on_late), settings,
        bag.start,
        {'trace': bag.name, 'declaration': task_set.file, 'start_ns': bag.start, 'end_ns': end,
         'messages': bag.count}, builder.warnings, skip=skip, notes=builder.notes)
