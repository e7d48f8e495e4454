# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Ordinary bags rescheduled: recorded sensor messages as releases, declared execution times.

Theory of operation
-------------------
* A bag is a recording without executions.  A DAG whose source is a subscription has a job for each
  message of its topic, ready at its arrival.  Its release is as declared by `release_from`: the
  arrival, the header stamp, or the publication if the recorder stored it.  If a message has no
  such stamp, or a stamp after its arrival, it is released at its arrival.
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
from typing import Any, NamedTuple

from mddag_executor.core import DEFAULT_DEADLINE_NS
from mddag_executor.recording.entities import Entities
from mddag_executor.recording.head import Head
from mddag_executor.recording.tables import Recording, RELEASES, rows, sort_by
from mddag_executor.replay.bags import Bag, BagError
from mddag_executor.replay.reschedule import Reschedule, reschedule
from mddag_executor.simulate.workload import check_execution_times
from mddag_executor.text import counted, listed
from mddag_executor.trace.times import credible
from msg_graph import Dag, TaskSet
import numpy as np

DEFAULT_WORKERS = 7
_MOST_JOBS = 20_000_000
_STAMP_OF = {'header_stamp': 'header', 'source_timestamp': 'published'}
_CALLED = {'header_stamp': 'header stamp', 'source_timestamp': 'publication time'}


class Source(NamedTuple):
    """The jobs of a DAG's source as pairs (ready, release), ns, and notes about them."""

    jobs: list[tuple[int, int]]
    note: str


class _Releases:
    """Makes the releases of a recording from the messages of a bag."""

    def __init__(self, bag: Bag, task_set: TaskSet) -> None:
        self._bag, self._task_set = bag, task_set
        self._start = bag.start or 0
        self.warnings = bag.warnings
        #: Assumptions, one line each.
        self.notes: list[str] = []

    def table(self) -> Any:
        """Return the releases, in the order of time."""
        parts = [rows(RELEASES)]
        for dag in self._task_set.dags:
            source = self._source(dag)
            self.notes.append(f'{dag.name}: {source.note}')
            ready, release = np.array(source.jobs, dtype=np.int64).reshape(-1, 2).T
            parts.append(rows(RELEASES, len(ready), dag=dag.index, job=np.arange(len(ready)),
                              release=release, noticed=ready))
            if sum(map(len, parts)) > _MOST_JOBS:
                raise self._too_many()
        found = np.concatenate(parts)
        if not len(found):
            raise BagError(
                self._bag.name, f'none of the sources of {self._task_set.file} is in it: it has '
                + (listed(sorted(self._bag.topics)) or 'no topics'),
                'give the graph of the nodes that were recorded')
        found = found[sort_by(*(found[name] for name in ('noticed', 'dag', 'job')))]
        found['order'] = np.arange(len(found))
        return found

    def _source(self, dag: Dag) -> Source:
        callback = dag.vertices[dag.source].callback
        if callback.kind == 'timer':
            jobs = self._timer_jobs(dag.period_ns)
            pauses = len(self._bag.stretches) - 1
            return Source(
                jobs, f'{counted(len(jobs), "job")} at the nominal period of its timer, from the '
                'first message on: a bag does not show when timers ran'
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
        usable = [stamp <= arrival and bool(credible(stamp, arrival))
                  for arrival, stamp in zip(arrivals, column)]
        jobs = [(arrival, stamp if fits else arrival)
                for arrival, stamp, fits in zip(arrivals, column, usable)]
        what = _CALLED[dag.release_from]
        if not all(usable):
            self.warnings.append(
                f'{self._bag.name}: {usable.count(False)} of {counted(len(jobs), "message")} of '
                f'{topic} ({stamps.type}) without a {what}, or with one after the arrival or '
                'years before: released at the arrival')
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


def read_bag(
    path: str | os.PathLike[str], task_set: TaskSet, name: str | None = None
) -> Recording:
    """Return the recording of an ordinary bag: the releases of its sources."""
    sources = (dag.vertices[dag.source].callback for dag in task_set.dags)
    topics = {topic for source in sources if source.kind != 'timer' for topic in source.topics}
    bag = Bag(path, topics, name)
    if bag.start is None:
        what = '; '.join(bag.warnings) or 'there are no messages in it'
        raise BagError(bag.name, what.removeprefix(f'{bag.name}: '), 'record one again')
    releases = _Releases(bag, task_set)
    workers = task_set.workers or DEFAULT_WORKERS
    end = (bag.end or 0) + 1
    return Recording(
        bag.name, Head(bag.start, '', task_set.file, 'rad', workers, DEFAULT_DEADLINE_NS, 0,
                       False),
        task_set, task_set, Entities(), declared=False, imported=True,
        releases=releases.table(), start=bag.start, end=end, judged_until=end,
        workers_each=workers, messages=bag.count, notes=releases.notes,
        warnings=releases.warnings)


def reschedule_bag(
    path: str | os.PathLike[str], task_set: TaskSet, *,
    times: Sequence[Sequence[int]] | None = None, seed: int = 0, name: str | None = None,
    **options: Any,
) -> Reschedule:
    """
    Run the core with the messages of an ordinary bag.

    :param path: a bag's folder, or one of its files.
    :param times: execution times by DAG and vertex, ns; None: drawn from the declared ones.
    :param options: as for ``reschedule``; a bag has no overheads.
    """
    if times is None:
        check_execution_times(task_set, ', or give --execution-times FILE')
    run = read_bag(path, task_set, name)
    counts = np.bincount(run.releases['dag'], minlength=len(task_set.dags)).tolist()
    generator = random.Random(seed)
    return reschedule(run, times=[
        np.array([_costs(dag, times, generator) for _ in range(count)], dtype=np.int64)
        for dag, count in zip(task_set.dags, counts)], overheads=False, **options)


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
