# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Reads ordinary bags as recordings: recorded sensor messages are releases.

Theory of operation
-------------------
* A bag is a recording without executions.  A DAG whose source is a subscription has a job for each
  message of its topic, ready at its arrival.  Its release is as declared by `release_from`: the
  arrival, the header stamp, or the publication if the recorder stored it.  If a message has no
  such stamp, or a stamp after its arrival, it is released at its arrival.
* A DAG whose source is a timer has jobs at k * T from the bag's first message on, while messages
  arrive (see ``trace.times``): a bag does not have the real times of timers.
"""

from __future__ import annotations

import os

from mddag_executor import defaults
from mddag_executor.core import DEFAULT_DEADLINE_NS
from mddag_executor.memory import give_back
from mddag_executor.recording.columns import concatenate, Ints, rows
from mddag_executor.recording.head import Head
from mddag_executor.recording.joins import sort_by
from mddag_executor.recording.losses import Loss, Losses
from mddag_executor.recording.recording import Recording
from mddag_executor.recording.run import Run
from mddag_executor.recording.tables import Columns, RELEASES
from mddag_executor.simulate.workload import MOST_JOBS
from mddag_executor.sources.bags import Bag
from mddag_executor.sources.kinds import BagError
from mddag_executor.text import counted, listed
from mddag_executor.trace.times import credible
from msg_graph import Dag, TaskSet
import numpy as np

_ODD_NS = 5_000_000_000
"""Stamps that are longer before the arrivals are odd."""
_STAMPS = {
    'arrival': ('arrival', 'arrival'), 'header_stamp': ('header', 'header stamp'),
    'source_timestamp': ('published', 'publication time')}
"""By ``release_from``: the column of ``Stamps``, and its name in messages."""

Jobs = tuple[Ints, Ints]
"""When the jobs of a source are ready, and their releases, ns."""
_NONE: Jobs = (np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))


def _source(bag: Bag, dag: Dag) -> tuple[Jobs, str]:
    """Return the jobs of a DAG, and a note about them."""
    callback = dag.vertices[dag.source].callback
    if callback.kind == 'timer':
        jobs = _timer_jobs(bag, dag.period_ns)
        pauses = len(bag.stretches) - 1
        return jobs, (
            f'{counted(len(jobs[0]), "job")} at the nominal period of its timer, from the '
            'first message on: a bag does not show when timers ran'
            + (f'; none in {counted(pauses, "pause")} of over a minute without any message'
               if pauses else ''))
    if not callback.topics:
        bag.warnings.append(
            f'{bag.name}: {dag.name} starts with a service call, which a bag does not have: there '
            'are no jobs of it')
        return _NONE, 'no jobs: its source is a service'
    topic = callback.topics[0]
    stamps = bag.stamps.get(topic)
    if stamps is None:
        bag.warnings.append(
            f'{bag.name}: topic {topic} is not in it, so there are no jobs of {dag.name}')
        return _NONE, f'no jobs: {topic} is not in the bag'
    name, what = _STAMPS[dag.release_from]
    arrival, stamp = np.array(stamps.arrival), np.array(getattr(stamps, name))
    usable = (stamp <= arrival) & credible(stamp, arrival)
    release = np.where(usable, stamp, arrival)
    order = np.lexsort((release, arrival))
    jobs = arrival[order], release[order]
    if name != 'arrival' and not usable.all():
        bag.warnings.append(
            f'{bag.name}: {np.count_nonzero(~usable)} of {counted(len(order), "message")} of '
            f'{topic} ({stamps.type}) without a {what}, or with one after the arrival or '
            'years before: released at the arrival')
    away = float(np.median(arrival - release)) if len(order) else 0.0
    return jobs, f'{counted(len(order), "job")} from the {what} of {topic}' + (
        f', {away / 1e9:.0f} s before the arrival: was another bag played when it was recorded?'
        if away > _ODD_NS else '')


def _timer_jobs(bag: Bag, period: int) -> Jobs:
    """Return the jobs of a timer: at its period, while messages arrive."""
    found, count = [np.zeros(0, dtype=np.int64)], 0
    begin = bag.start or 0
    for start, end in bag.stretches:
        first = begin - (begin - start) // period * period
        if (end - first) // period + count >= MOST_JOBS:
            raise _too_many(bag)
        found.append(np.arange(first, end + 1, period))
        count += len(found[-1])
    times = np.concatenate(found)
    return times, times


def _too_many(bag: Bag) -> BagError:
    return BagError(bag.name, f'there are more than {MOST_JOBS} jobs in it', 'give a shorter bag')


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
    parts, notes = [rows(RELEASES)], []
    for dag in task_set.dags:
        (ready, release), note = _source(bag, dag)
        notes.append(f'{dag.name}: {note}')
        parts.append(rows(RELEASES, len(ready), dag=dag.index, job=np.arange(len(ready)),
                          release=release, noticed=ready))
        if sum(map(len, parts)) > MOST_JOBS:
            raise _too_many(bag)
    releases = concatenate(parts)
    if not len(releases):
        raise BagError(
            bag.name, f'none of the sources of {task_set.file} is in it: it has '
            + (listed(sorted(bag.topics)) or 'no topics'),
            'give the graph of the nodes that were recorded')
    releases = releases[sort_by(*(releases[name] for name in ('noticed', 'dag', 'job')))]
    releases['order'] = np.arange(len(releases))
    del parts
    give_back()     # messages that were read
    workers = defaults.workers(None, task_set)
    end = (bag.end or 0) + 1
    run = Run(
        bag.name, Head(bag.start, '', task_set.file, 'rad', workers, DEFAULT_DEADLINE_NS, 0,
                       False),
        task_set, task_set, declared=False, imported=True, start=bag.start, end=end,
        judged_until=end, workers_each=workers, messages=bag.count, notes=notes)
    return Recording(run, Columns(releases=releases), missing=Losses(
        Loss('damage', 1, text) for text in bag.warnings))
