# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Splits the response time of a job along its critical chain.

Theory of operation
-------------------
The critical chain of a completed sink is found backwards. A vertex became ready when the last
message that it needed arrived; the vertex that published this message is the previous link; the
first link is the source.  The response time (completion minus release) is the sum of:

* release lag: from the release until the source was ready (timer latency or, with `release_from:
  header_stamp`, the transport of the sensor's message);
* waiting: from ready to the start of the execution, for a worker or for the callback group (while
  another callback of the group ran);
* executing: from the start until the next vertex was ready or the execution ended, whichever was
  first;
* suspended: the gaps within an execution in which a coroutine waited;
* transport: from the end of an execution until the next vertex was ready;
* unknown: the time before the first recorded link.

A callback that publishes early may still run when the sink completes.  Its execution then counts
until its message arrived; which of its legs ran is unknown.

All chains of a DAG are followed at once, link by link.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from mddag_executor.core import legs_of, NEVER
from mddag_executor.core.state import SINK_COMPLETED, SINK_LATE
from mddag_executor.recording.tables import EXECUTIONS, Ints, LEG, Mask, pick, rows, sort_by, Table
from mddag_executor.replay.deadlines import Judged
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


LINKS = np.dtype([
    ('of', 'i8'), ('vertex', 'i8'), ('leg', 'i8'), ('ready', 'i8'), ('start', 'i8'),
    ('end', 'i8'), ('busy', 'i8'), ('group', 'i8'), ('cpu', 'i8')])
"""
Columns of a link of a chain.

``of`` is the number of the chain; ``leg`` is the leg that completed the vertex (-1: still
running). Times of the execution: ready, first start, last end, total time of its pieces, waiting
for the callback group, CPU time (-1: unknown), ns.
"""


class _Dag(NamedTuple):
    """The vertices of a DAG; by leg the local number of the vertex that publishes its message."""

    first: int
    before: Ints
    n_legs: Ints
    is_source: Mask


class Chains:
    """
    The chains of a judged recording.

    :ivar waited: by execution how long its first piece waited for its callback group, ns.
    """

    def __init__(self, judged: Judged, executions: Table, waited: Ints) -> None:
        if not len(executions):     # row -1 must exist
            executions, waited = rows(EXECUTIONS, 1), np.zeros(1, dtype=np.int64)
        self._judged, self._executions, self.waited = judged, executions, waited
        self._has_start = np.append(executions['start'] >= 0, False)    # for no row
        self._dags = [self._dag(dag, first) for dag, first in zip(
            judged.task_set.dags, judged.tables.first_vertex)]
        self._started: dict[int, tuple[Ints, Ints, Ints]] = {}

    @staticmethod
    def _dag(dag: Any, first: int) -> _Dag:
        legs = [[before for _, before in legs_of(vertex, dag.vertices)] for vertex in dag.vertices]
        width = max(1, *map(len, legs))
        return _Dag(
            first, np.array([each + [-1] * (width - len(each)) for each in legs]),
            np.array(list(map(len, legs))), np.array([not each for each in legs]))

    # --- links -----------------------------------------------------------------------------------

    def link(
        self, dag: int, row: Ints, vertex: Ints, order: Ints, time: Ints
    ) -> tuple[Ints, Mask]:
        """
        Find the executions of (local) vertices of jobs at positions in the order of events.

        :param time: times of these positions, ns.
        :return: rows of executions, -1: none; and whether the vertex had not completed yet.
        """
        jobs = self._judged.jobs[dag]
        found = np.where(jobs.done_order[row, vertex] < order, jobs.done[row, vertex], -1)
        running = ~self._has_start[found]
        found[running] = -1
        if running.any():
            found[running] = self._running(dag, row[running], vertex[running], time[running])
        return found, running

    def _running(self, dag: int, row: Ints, vertex: Ints, time: Ints) -> Ints:
        """Return the executions that started last; -1: none started."""
        cells, starts, links = self._starts(dag)
        cell = row * len(self._dags[dag].n_legs) + vertex
        at = np.searchsorted(cells, cell, 'right') - 1
        while True:
            late = (at >= 0) & (starts[at] > time) if len(cells) else np.zeros(
                len(at), dtype=np.bool_)
            late &= cells[at] == cell if len(cells) else False
            if not late.any():
                break
            at[late] -= 1
        if not len(cells):
            return np.full(len(row), -1)
        there = (at >= 0) & (cells[at] == cell)
        return np.where(there, links[at], -1)

    def _starts(self, dag: int) -> tuple[Ints, Ints, Ints]:
        """
        Return by job and vertex the start times, and the rows of these executions.

        A resumed piece without a recorded first piece gets the row of its execution.
        """
        found = self._started.get(dag)
        if found is None:
            table, of = self._executions, self._dags[dag]
            mine = np.flatnonzero((table['dag'] == dag) & (table['start'] >= 0))
            row = self._judged.jobs[dag].rows_of(table['job'][mine])
            mine, row = mine[row >= 0], row[row >= 0]
            cell = row * len(of.n_legs) + table['vertex'][mine] - of.first
            start = table['start'][mine].astype(np.int64)
            order = sort_by(cell, start)
            cell, start, mine = cell[order], start[order], mine[order]
            ready = table['ready'][mine]
            goes_on = np.zeros(len(mine), dtype=np.bool_)
            goes_on[1:] = (cell[1:] == cell[:-1]) & (ready[1:] == ready[:-1])
            first = np.maximum.accumulate(np.where(goes_on, 0, np.arange(len(mine))))
            found = self._started[dag] = cell, start, mine[first]
        return found

    def _links(self, dag: int, table: Table, running: Mask) -> Table:
        """Return executions as links; the end of a running execution is unknown."""
        running = running & (table['completes'] != LEG)     # a sync waits for its other messages
        found = np.zeros(len(table), dtype=LINKS)
        found['vertex'], found['ready'] = table['vertex'], table['ready']
        n_legs = self._dags[dag].n_legs[found['vertex'] - self._dags[dag].first]
        known = (table['leg'] >= 0) & (table['leg'] < n_legs)   # otherwise the last one
        found['leg'] = np.where(
            running, -1, np.where(known, table['leg'], np.maximum(n_legs, 1) - 1))
        found['start'] = np.where(running, table['start'], table['began'])
        for name in ('end', 'busy'):
            found[name] = np.where(running, NEVER, table[name])
        found['cpu'] = np.where(running, -1, table['cpu'])
        return found

    def follow(
        self, dag: int, row: Ints, order: Ints, time: Ints, link: Ints, running: Mask
    ) -> Iterator[tuple[Ints, Table]]:
        """
        Yield the links of chains from last to first: numbers of the chains, and links.

        :param link: rows of the executions that end the chains; -1: no chain.
        """
        of, which = self._dags[dag], np.flatnonzero(link >= 0)
        link, running = link[which], running[which]
        table = pick(self._executions, link)
        while len(which):
            links = self._links(dag, table, running)
            links['of'], links['group'] = which, self.waited[link]
            yield which, links
            local = links['vertex'] - of.first
            known = ~of.is_source[local]
            which, links, local = which[known], links[known], local[known]
            since, leg = links['ready'], links['leg']
            publisher = of.before[local, np.maximum(leg, 0)]
            link, running = self.link(dag, row[which], publisher, order[which], time[which])
            # the publisher of the message is unknown
            for i in np.flatnonzero(leg < 0).tolist():
                link[i], running[i] = self._latest(
                    dag, row[which[i]], of.before[local[i], :of.n_legs[local[i]]],
                    order[which[i]], time[which[i]], since[i])
            table = pick(self._executions, link)
            good = (link >= 0) & (_started(table, running) <= since)
            which, link, running, table = which[good], link[good], running[good], pick(table, good)

    def _latest(
        self, dag: int, row: Any, publishers: Ints, order: Any, time: Any, since: Any
    ) -> tuple[int, bool]:
        """Return the publisher that ended last, of those that had started."""
        n = len(publishers)
        link, running = self.link(dag, np.full(n, row), publishers, np.full(n, order),
                                  np.full(n, time))
        table = pick(self._executions, link)
        end = np.where(running, NEVER, table['end'])
        end[(link < 0) | (_started(table, running) > since)] = -1
        best = int(end.argmax()) if n else 0
        if not n or end[best] < 0:
            return -1, False
        return int(link[best]), bool(running[best])

    # --- misses ----------------------------------------------------------------------------------

    def of_misses(self, dag: int, missed: Table) -> tuple[Ints, Table]:
        """
        Return the chains of the misses of a DAG, as far as their jobs got.

        :param missed: verdicts.
        :return: the last vertex that each job reached, and the links; ``of`` is the row in
            ``missed``.
        """
        of, row = self._dags[dag], missed['row']
        # right after a completion, or right before an early end
        order = missed['order'] + (missed['kind'] == SINK_LATE)
        time, n, size = missed['until'], len(missed), len(of.n_legs)
        every, running = self.link(
            dag, np.repeat(row, size), np.tile(np.arange(size), n), np.repeat(order, size),
            np.repeat(time, size))
        end = np.where(running, NEVER, self._executions['end'][every])
        every, end = every.reshape(n, size), end.reshape(n, size)
        running = running.reshape(n, size)
        everyone, at = np.arange(n), missed['sink'] - of.first
        back = np.flatnonzero(missed['kind'] != SINK_LATE)
        while len(back):
            publishers = of.before[at[back]]
            missing = (publishers >= 0) & (every[back[:, None], publishers] < 0)
            some = missing.any(axis=1)
            back, first = back[some], missing[some].argmax(axis=1)
            at[back] = publishers[some, first]
        link, runs = every[everyone, at], running[everyone, at]
        # the last message that the vertex waited for
        publishers = of.before[at]
        ends = np.where(publishers >= 0, end[everyone[:, None], publishers], -1)
        ends[(publishers >= 0) & (every[everyone[:, None], publishers] < 0)] = -1
        last = publishers[everyone, ends.argmax(axis=1)]
        waits = (link < 0) & ~of.is_source[at]
        link = np.where(waits, every[everyone, last], link)
        runs = np.where(waits, running[everyone, last], runs)
        found = [links for _, links in self.follow(dag, row, order, time, link, runs)]
        return at + of.first, np.concatenate(found) if found else np.empty(0, dtype=LINKS)

    # --- breakdown -------------------------------------------------------------------------------

    def breakdown(self) -> dict[int, dict[str, Any]]:
        """Return by sink the breakdown of its completed jobs: means, and the worst job."""
        found: dict[int, dict[str, Any]] = {}
        judged = self._judged
        for sink, verdicts in zip(judged.tables.sinks, judged.by_sink()):
            done = verdicts[verdicts['kind'] <= max(SINK_COMPLETED)]
            if len(done):
                found[sink] = self._of_sink(sink, done)
        return found

    def _of_sink(self, sink: int, done: Table) -> dict[str, Any]:
        dag = int(done['dag'][0])
        worst = int((done['completed'] - done['release']).argmax())
        parts, group = self._split(dag, done, self._followed(dag, sink, done))
        chain = [links[0] for _, links in self._followed(dag, sink, done[worst:worst + 1])][::-1]
        n = len(done)
        return {
            'mean': {**{name: round(int(part.sum()) / n) for name, part in parts.items()},
                     'waiting_group_ns': round(int(group.sum()) / n)},
            'worst': {
                'job': int(done['job'][worst]), 'release_ns': int(done['release'][worst]),
                'completed_ns': int(done['completed'][worst]),
                **{name: int(part[worst]) for name, part in parts.items()},
                'waiting_group_ns': int(group[worst]),
                'chain': [_step_result(self._judged.task_set, link) for link in chain]}}

    def _followed(self, dag: int, sink: int, done: Table) -> Iterator[tuple[Ints, Table]]:
        """Follow the chains of a completed sink, from right after each completion."""
        row, order, time = done['row'], done['order'] + 1, done['completed']
        vertex = np.full(len(done), sink - self._dags[dag].first)
        return self.follow(dag, row, order, time, *self.link(dag, row, vertex, order, time))

    def _split(
        self, dag: int, done: Table, followed: Iterator[tuple[Ints, Table]]
    ) -> tuple[dict[str, Ints], Ints]:
        """Return the parts of response times, and their waiting for callback groups."""
        of = self._dags[dag]
        n = len(done)
        parts = {name: np.zeros(n, dtype=np.int64) for name in Breakdown._fields}
        lag, waiting, executing, suspended, transport, unknown = parts.values()
        group = np.zeros(n, dtype=np.int64)
        until, release = done['completed'].copy(), done['release']
        begun = np.zeros(n, dtype=np.bool_)     # whether the chain reaches the source
        for place, (which, links) in enumerate(followed):
            ready, start, end = links['ready'], links['start'], links['end']
            published = np.minimum(end, until[which]) if place else until[which]
            # The position of a pause within the execution is not recorded: it counts as far as it
            # fits.
            pause = np.where(links['leg'] < 0, 0, np.maximum(
                0, np.minimum(end - start - links['busy'], published - start)))
            waiting[which] += start - ready
            executing[which] += published - start - pause
            suspended[which] += pause
            transport[which] += until[which] - published
            group[which] += links['group']
            until[which] = ready
            begun[which] = of.is_source[links['vertex'] - of.first]
        rest = until - release
        lag[begun], unknown[~begun] = rest[begun], rest[~begun]
        return parts, group


def _started(table: Table, running: Mask) -> Ints:
    """Return when executions started: running ones are their last pieces."""
    found: Ints = np.where(running, table['start'], table['began'])
    return found


def _step_result(task_set: TaskSet, link: Any) -> dict[str, Any]:
    known = link['leg'] >= 0
    return {
        'vertex': task_set.vertices[int(link['vertex'])].name, 'ready_ns': int(link['ready']),
        'start_ns': int(link['start']), 'end_ns': int(link['end']) if known else None,
        'busy_ns': int(link['busy']) if known else None,
        'waiting_group_ns': int(link['group']) if known else None}
