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
from mddag_executor.core.state import SINK_LATE
from mddag_executor.replay.happenings import (
    Batch,
    COMPLETED,
    Ints,
    STARTED,
    sums,
)
from msg_graph import TaskSet
import numpy as np


class Breakdown(NamedTuple):
    """Parts of a response time, ns."""

    release_lag_ns: int = 0
    waiting_ns: int = 0
    executing_ns: int = 0
    suspended_ns: int = 0
    transport_ns: int = 0
    unknown_ns: int = 0


# Columns of a link, a step of a chain: the leg that completed its vertex (-1: it still ran); of
# the execution ready, first start, last end and the time that its pieces took, how much of its
# waiting was for its callback group, and its CPU time, ns.
L_VERTEX, L_LEG, L_READY, L_START, L_END, L_BUSY, L_GROUP, L_CPU, N_LINK = range(9)


# Columns of a miss; ``M_AT`` is the vertex that the job came to, ``M_LENGTH`` of how many links.
M_KIND, M_SINK, M_JOB, M_RELEASE, M_UNTIL, M_AT, M_LENGTH, N_MISS = range(8)


class Misses(NamedTuple):
    """Missed deadlines of a batch; the links of their chains one after the other, end first."""

    rows: Ints
    chains: Ints


class Worst(NamedTuple):
    """The job with a sink's longest response time; `chain` has its links."""

    job: int
    release: int
    completed: int
    chain: list[list[int]]
    breakdown: Breakdown


class SinkTimes:
    """Where the time of a sink's completed jobs went: sums, and the worst job."""

    __slots__ = ('completed', 'sums', 'group', 'longest', 'worst')

    def __init__(self) -> None:
        self.completed = 0
        self.sums = [0] * len(Breakdown._fields)
        self.group = 0
        self.longest = -1
        self.worst: Worst | None = None


class Chains:
    """
    The chains of open jobs, and what came of those of completed ones.

    Links are counted in a batch: those that were kept of the batches before, then what completed,
    then what was started.

    :param tables: tables of the task set, with legs.
    """

    def __init__(self, task_set: TaskSet, tables: Tables) -> None:
        #: By global vertex and leg: the vertex whose message it is.
        self.before = [
            [first + before for _, before in legs_of(vertex, dag.vertices)]
            for dag, first in zip(task_set.dags, tables.first_vertex) for vertex in dag.vertices]
        self._offset = tables.region_offset
        self._region = tables.n_region
        self._is_source = np.array([not each for each in self.before])
        self.sinks = {vertex: SinkTimes() for vertex in tables.sinks}
        #: As the core's columns of executions: the link of each vertex of the open jobs, or -1.
        self.links: list[int] = []
        self._kept = np.empty((0, N_LINK), dtype=np.int64)
        # of the sinks that have completed in this batch: vertex, job, release, completion; and
        # their chains one after the other, from the end on, and how long each is
        self._sinks: list[tuple[int, int, int, int]] = []
        self._chains: list[int] = []
        self._lengths: list[int] = []
        #: Whether to keep the chains of sinks that missed their deadlines, for ``misses``.
        self.keeps_misses = False
        # of these sinks in this batch the columns of a miss; as above, their chains
        self._missed: list[tuple[int, ...]] = []
        self._of_missed: list[int] = []
        self.misses = Misses(
            np.empty((0, N_MISS), dtype=np.int64), np.empty((0, N_LINK), dtype=np.int64))

    def begin_batch(self, batch: Batch) -> None:
        """Begin with what completes and starts."""
        completed, started = batch.columns(COMPLETED), batch.columns(STARTED)
        first = self.first = len(self._kept)
        running = self.first_started = first + len(completed)
        columns = np.zeros((N_LINK, running + len(started)), dtype=np.int64)
        columns[:, :first] = self._kept.T
        for link, column in zip((*range(L_GROUP), L_CPU), (1, 3, 6, 7, 8, 9, 11)):
            columns[link, first:running] = completed[:, column]
        for link, more in ((L_VERTEX, started[:, 1]), (L_LEG, -1), (L_READY, started[:, 3]),
                           (L_START, started[:, 4]), (L_END, NEVER), (L_BUSY, NEVER), (L_CPU, -1)):
            columns[link, running:] = more
        self._table = columns.T
        # the few that are looked at become numbers one by one
        self._columns = tuple(memoryview(column) for column in columns[:L_BUSY])
        self.ready = self._columns[L_READY]
        self.waited: dict[int, int] = {}

    def begin(self, base: int, dag: int) -> None:
        """Begin a job whose executions have these numbers; the last one there is forgotten."""
        links, n = self.links, self._region[dag]
        if len(links) < base + n:
            links.extend([-1] * (base + n - len(links)))
        links[base:base + n] = [-1] * n

    def sink(self, base: int, vertex: int, job: int, release: int, completed: int) -> None:
        """Note the chain of a sink that has completed."""
        length = len(self._chains)
        self._follow(base, self.links[base + self._offset[vertex]], self._chains)
        self._sinks.append((vertex, job, release, completed))
        self._lengths.append(len(self._chains) - length)

    def _follow(self, base: int, link: int, chain: list[int]) -> None:
        """Add a link and those before it."""
        links, offset, before = self.links, self._offset, self.before
        at, legs, ready, start, end = self._columns
        while link >= 0:
            chain.append(link)
            publishers = before[at[link]]
            if not publishers:
                break
            since, leg = ready[link], legs[link]
            if leg >= 0:
                link = links[base + offset[publishers[leg]]]
                if link >= 0 and start[link] > since:
                    break
                continue
            link = -1
            for publisher in publishers:
                other = links[base + offset[publisher]]
                if other >= 0 and start[other] <= since and (link < 0 or end[other] > end[link]):
                    link = other

    def missed(
        self, kind: int, base: int, vertex: int, job: int, release: int, until: int
    ) -> None:
        """
        Note the chain of a sink that has missed its deadline, as far as the job came.

        :param until: when it completed or was given up, ns.
        """
        if not self.keeps_misses:
            return
        links, offset, end = self.links, self._offset, self._columns[-1]
        at = vertex
        if kind != SINK_LATE:
            while True:
                missing = [v for v in self.before[at] if links[base + offset[v]] < 0]
                if not missing:
                    break
                at = missing[0]
        link = links[base + offset[at]]
        if link < 0 and self.before[at]:    # the last message that it waited for
            link = max((links[base + offset[v]] for v in self.before[at]), key=end.__getitem__)
        length = len(self._of_missed)
        self._follow(base, link, self._of_missed)
        self._missed.append(
            (kind, vertex, job, release, until, at, len(self._of_missed) - length))

    def end_batch(self) -> None:
        """Add up where the time went, and keep what open jobs have."""
        table = self._table
        for link, waited in self.waited.items():
            table[link, L_GROUP] = waited
        if self._sinks:
            self._split(table)
            self._sinks, self._chains, self._lengths = [], [], []
        self.misses = Misses(
            np.array(self._missed, dtype=np.int64).reshape(-1, N_MISS),
            table[np.array(self._of_missed, dtype=np.int64)])
        self._missed, self._of_missed = [], []
        links = np.array(self.links, dtype=np.int64)
        held = np.flatnonzero(links >= 0)
        self._kept = table[links[held]]
        links[held] = np.arange(len(held))
        self.links = links.tolist()

    def _split(self, table: Ints) -> None:
        vertex, job, release, completed = np.array(self._sinks, dtype=np.int64).T
        lengths = np.array(self._lengths, dtype=np.int64)
        chain = table[np.array(self._chains, dtype=np.int64)]
        first = np.cumsum(lengths) - lengths
        of = np.repeat(np.arange(len(lengths)), lengths)
        at, leg, ready, start, end, busy, group, _ = chain.T
        is_last = np.zeros(len(chain), dtype=np.bool_)      # of its chain: it stands first
        is_last[first[lengths > 0]] = True
        after = np.r_[0, ready[:-1]]
        published = np.where(is_last, completed[of], np.minimum(end, after))
        # Where in the execution a pause was is not kept: it counts as far as there is room.
        # Of what still runs nothing more is known.
        pause = np.where(
            leg < 0, 0, np.maximum(0, np.minimum(end - start - busy, published - start)))
        parts = np.zeros((len(Breakdown._fields) + 1, len(lengths)), dtype=np.int64)
        for part, times in enumerate((
                start - ready, published - start - pause, pause,
                np.where(is_last, 0, after - published)), 1):
            np.add.at(parts[part], of, times)
        np.add.at(parts[-1], of, group)
        # what was before the chain
        parts[5] = completed - release
        some = lengths > 0
        begin = (first + lengths - 1)[some]
        lag = ready[begin] - release[some]
        whole = self._is_source[at[begin]]
        parts[0, some], parts[5, some] = np.where(whole, lag, 0), np.where(whole, 0, lag)
        sinks, place = np.unique(vertex, return_inverse=True)
        totals = [sums(place, part, len(sinks)) for part in parts]
        response = completed - release
        for number, sink in enumerate(sinks.tolist()):
            times = self.sinks[sink]
            mine = np.flatnonzero(place == number)
            times.completed += len(mine)
            times.sums = [before + more[number] for before, more in zip(times.sums, totals)]
            times.group += totals[-1][number]
            worst = int(mine[response[mine].argmax()])
            if response[worst] > times.longest:
                times.longest = int(response[worst])
                times.worst = Worst(
                    int(job[worst]), int(release[worst]), int(completed[worst]),
                    chain[first[worst]:first[worst] + lengths[worst]][::-1].tolist(),
                    Breakdown(*parts[:-1, worst].tolist()))

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
                **worst.breakdown._asdict(),
                'waiting_group_ns': sum(link[L_GROUP] for link in worst.chain),
                'chain': [_step_result(task_set, link) for link in worst.chain]}}


def _step_result(task_set: TaskSet, link: list[int]) -> dict[str, Any]:
    vertex, leg, ready, start, end, busy, group, _ = link
    known = leg >= 0
    return {
        'vertex': task_set.vertices[vertex].name, 'ready_ns': ready, 'start_ns': start,
        'end_ns': end if known else None, 'busy_ns': busy if known else None,
        'waiting_group_ns': group if known else None}
