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
* waiting: from ready to the start of the execution, for a worker, for the callback group (while
  another callback of the group ran), or for the program (while another callback of a program ran
  that runs its callbacks one at a time);
* executing: from the start until the next vertex was ready or the execution ended, whichever was
  first;
* suspended: the gaps within an execution in which a coroutine waited;
* transport: from the end of an execution until the next vertex was ready;
* unknown: the time before the first recorded link.

An execution of a driven sync (``driven_by``) may have been ready before the driving message was
published.  Its waiting counts from that publication.

A vertex has one execution in a job: the one that completed it, otherwise the last one that started
before the job ended.  If that one never completed, it is unknown when it ended and which message
started it; the message of the publisher that ended last is assumed.

So the chain up to a vertex does not depend on the sink.  The parts are summed for all jobs of a
DAG at once, vertex by vertex, in topological order.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any, cast, NamedTuple, TYPE_CHECKING

from mddag_executor.analysis.deadlines import Judged
from mddag_executor.analysis.usage import OtherWaits
from mddag_executor.core import legs_of, NEVER
from mddag_executor.core.state import SINK_COMPLETED, SINK_LATE
from mddag_executor.recording.columns import concatenate, Ints, Mask, rows, Table
from mddag_executor.recording.joins import rows_by, sort_by
from mddag_executor.recording.tables import EXECUTIONS, LEG
from msg_graph import TaskSet
from msg_graph.model import topological_order
import numpy as np

if TYPE_CHECKING:
    from mddag_executor.results.replays import Breakdown, ChainLink, ResponseParts, WorstJob

LINKS = np.dtype([
    ('of', 'i8'), ('vertex', 'i8'), ('leg', 'i8'), ('ready', 'i8'), ('start', 'i8'),
    ('end', 'i8'), ('busy', 'i8'), ('group', 'i8'), ('program', 'i8'), ('cpu', 'i8'),
    ('row', 'i8')])
"""
Columns of a link of a chain.

``of`` is the number of the chain; ``leg`` is the leg that completed the vertex (-1: it never
completed). Times of the execution: ready, first start, last end, total time of its pieces, waiting
for the callback group and for the program, CPU time (-1: unknown), ns; ``row`` of the execution.
"""

PARTS = ('release_lag', 'waiting', 'executing', 'suspended', 'transport', 'unknown',
         'waiting_group', 'waiting_program')
"""The parts of a response time; the last two are parts of ``waiting``."""
RESPONSE_PARTS = np.dtype([
    ('dag', 'i2'), ('sink', 'i4'), ('job', 'i8'), ('release', 'i8'), ('completed', 'i8'),
    *((name, 'i8') for name in PARTS)])
"""Columns of the parts of the response time of a completed sink, ns."""

_USED = ['completes', 'leg', 'ready', 'began', 'end', 'busy', 'cpu']
"""The columns of executions that links have."""


class _Chain(NamedTuple):
    """
    The chains of all jobs of a DAG up to the execution of one vertex.

    :ivar known: whether there is an execution; its ``start``, ``end`` and ``pause`` (all gaps).
    :ivar first: when the first link was ready; ``is_whole``: whether it is the source.
    :ivar sums: waiting, executing, suspended, waiting for groups and for programs, up to the
        start.
    """

    known: Mask
    start: Ints
    end: Ints
    pause: Ints
    first: Ints
    is_whole: Mask
    sums: Ints

    def until(self, time: Ints) -> Ints:
        """Return the sums up to a time: the next vertex was ready, or the sink ended."""
        published = np.minimum(self.end, time)
        # where in the execution a pause was is not recorded: it counts as far as it fits
        pause = np.maximum(0, np.minimum(self.pause, published - self.start))
        sums = self.sums.copy()
        sums[1] += published - self.start - pause
        sums[2] += pause
        return sums

    def after(self, before: _Chain, ready: Ints) -> tuple[Mask, _Chain]:
        """Return which jobs have this link after the chains of publishers, and the chains."""
        good = self.known & before.known & (before.start <= ready)
        return good, self._replace(
            first=np.where(good, before.first, self.first), is_whole=good & before.is_whole,
            sums=self.sums + np.where(good, before.until(ready), 0))


class Chains:
    """
    The chains of a judged recording.

    :ivar waited: for what the executions waited.
    """

    def __init__(self, judged: Judged, executions: Table, waited: OtherWaits) -> None:
        if not len(executions):     # row -1 must exist
            executions = rows(EXECUTIONS, 1, vertex=-1)
            waited = OtherWaits(*np.zeros((2, 1), dtype=np.int64))
        self._judged, self._executions, self.waited = judged, executions, waited
        self._first = judged.tables.first_vertex
        #: By DAG, vertex and leg the vertex that publishes its message.
        self._legs = [
            [[before for _, before in legs_of(vertex, dag.vertices)] for vertex in dag.vertices]
            for dag in judged.task_set.dags]
        #: By DAG and vertex whether it is a driven sync.
        self._is_driven = [
            np.array([vertex.callback.driven_by is not None for vertex in dag.vertices])
            for dag in judged.task_set.dags]
        # the last one is -1, none
        self._started = np.append((executions['vertex'] >= 0) & (executions['start'] >= 0), False)
        self._is_other = self._started.copy()
        for jobs in judged.jobs:
            self._is_other[jobs.done] = False
        self._dags: dict[int, tuple[Any, Any]] = {}
        self._breakdown: dict[int, Breakdown] = {}
        #: Where the response times went, while they are collected.
        self._parts: list[Table] | None = None

    # --- links -----------------------------------------------------------------------------------

    @cached_property
    def _others(self) -> list[Ints]:
        """Return by DAG the executions that completed no vertex, in the order of their starts."""
        table, which = self._executions, np.flatnonzero(self._is_other)
        which = which[sort_by(table['start'][which])]
        return [which[mine] for mine in rows_by(table['dag'][which], len(self._legs))]

    def _rows(self, dag: int) -> Any:
        """Return by vertex and job the row of the execution, -1: none."""
        jobs, others = self._judged.jobs[dag], self._others[dag]
        found = jobs.done.T.copy()
        found[~self._started[found]] = -1       # only its completion is recorded
        table = self._executions[['job', 'vertex', 'start']][others]
        job, vertex = jobs.rows_of(table['job']), table['vertex'] - self._first[dag]
        mine = np.flatnonzero(job >= 0)
        mine = mine[(table['start'][mine] <= jobs.until[job[mine]]) & (
            found[vertex[mine], job[mine]] < 0)]
        found[vertex[mine], job[mine]] = others[mine]       # the last one is written last
        return found

    def _links(self, dag: int, vertex: Any, row: Ints) -> Table:
        """Return executions of vertices as links."""
        table = self._executions[_USED][row]
        n_legs = np.array([max(1, len(legs)) for legs in self._legs[dag]])[vertex]
        # a sync waits for its other messages
        running = self._is_other[row] & (table['completes'] != LEG)
        known = (table['leg'] >= 0) & (table['leg'] < n_legs)   # otherwise the last one
        found = rows(
            LINKS, len(row), vertex=vertex + self._first[dag], ready=table['ready'],
            start=table['began'], group=self.waited.group[row], program=self.waited.program[row],
            row=row,
            leg=np.where(running, -1, np.where(known, table['leg'], n_legs - 1)),
            cpu=np.where(running, -1, table['cpu']))
        for name in ('end', 'busy'):
            found[name] = np.where(running, NEVER, table[name])
        return found

    def _of_dag(self, dag: int) -> tuple[Any, Any]:
        """
        Find the chains of a DAG, and the breakdown of its sinks.

        :return: by vertex and job the row of the execution, and the previous vertex of the chain;
            -1: none.
        """
        if dag in self._dags:
            return self._dags[dag]
        task, row = self._judged.task_set.dags[dag], self._rows(dag)
        before = np.full(row.shape, -1, dtype=np.int16)
        self._dags[dag] = row, before
        chains: dict[int, _Chain] = {}
        for v in topological_order(task):
            links, legs = self._links(dag, v, row[v]), self._legs[dag][v]
            ready, start, end, leg = (
                links[name].copy() for name in ('ready', 'start', 'end', 'leg'))
            pause = np.where(leg < 0, 0, end - start - links['busy'])
            zero = np.zeros_like(ready)
            chain = _Chain(
                row[v] >= 0, start, end, pause, ready, np.ones_like(ready, np.bool_),
                np.array([start - ready, zero, zero, links['group'], links['program']]))
            if legs:
                leg, published = _published([chains[each] for each in legs], leg, ready)
                if self._is_driven[dag][v]:
                    ready = np.where(published.known, _answers_from(
                        ready, start, published.end), ready)
                    chain.sums[0] = start - ready
                    np.minimum(chain.sums[3:], start - ready, out=chain.sums[3:])
                good, chain = chain.after(published, ready)
                before[v] = np.where(good, np.array(legs)[leg], -1)
            if v in task.sinks:
                self._completed(dag, v, chain)
            chains[v] = chain
        return row, before

    def _follow(self, dag: int, which: Ints, vertex: Ints, job: Ints) -> Iterator[Table]:
        """Yield the links of chains from last to first; ``which``: numbers of the chains."""
        row, before = self._of_dag(dag)
        while len(which):
            links = self._links(dag, vertex, row[vertex, job])
            links['of'] = which
            driven, vertex = self._is_driven[dag][vertex], before[vertex, job]
            ended = self._executions['end'][row[vertex, job]]
            links['ready'] = np.where(driven & (vertex >= 0), _answers_from(
                links['ready'], links['start'], ended), links['ready'])
            for name in ('group', 'program'):
                links[name] = np.where(driven, np.minimum(
                    links[name], links['start'] - links['ready']), links[name])
            yield links
            more = vertex >= 0
            which, vertex, job = which[more], vertex[more], job[more]

    # --- misses ----------------------------------------------------------------------------------

    def of_misses(self, dag: int, missed: Table) -> tuple[Ints, Ints, Table]:
        """
        Return the chains of the misses of a DAG, as far as their jobs got.

        :param missed: verdicts.
        :return: the last vertex that each job reached; the job in which it went on there: a later
            one, if a driven sync was completed by the answer to that one; and the links, whose
            ``of`` is the row in ``missed``.
        """
        legs = self._legs[dag]
        width = max(1, *map(len, legs))
        before = np.array([each + [-1] * (width - len(each)) for each in legs])
        row = self._of_dag(dag)[0][:, missed['row']].T
        row[self._executions['began'][row] > missed['until'][:, None]] = -1
        # a sync that has not got all of its messages has run, but is where the job ended
        unfinished = (row < 0) | (
            self._is_other[row] & (self._executions['completes'][row] == LEG))
        end = np.where(self._is_other[row], NEVER, self._executions['end'][row])
        every, at = np.arange(len(missed)), missed['sink'] - self._first[dag]
        back = np.flatnonzero(missed['kind'] != SINK_LATE)
        while len(back):
            publishers = before[at[back]]
            missing = (publishers >= 0) & unfinished[back[:, None], publishers]
            some = missing.any(axis=1)
            back, first = back[some], missing[some].argmax(axis=1)
            at[back] = publishers[some, first]
        # the last message that the vertex waited for
        publishers = before[at]
        ends = np.where((publishers >= 0) & (row[every[:, None], publishers] >= 0),
                        end[every[:, None], publishers], -1)
        waits = (row[every, at] < 0) & (publishers[:, 0] >= 0)
        last = np.where(waits, publishers[every, ends.argmax(axis=1)], at)
        which = np.flatnonzero(row[every, last] >= 0)
        found = list(self._follow(dag, which, last[which], missed['row'][which]))
        job = np.where(row[every, last] >= 0, self._executions['job'][row[every, last]],
                       missed['job'])
        return at + self._first[dag], job, concatenate([rows(LINKS), *found])

    # --- breakdown -------------------------------------------------------------------------------

    def breakdown(self) -> dict[int, Breakdown]:
        """Return by sink the breakdown of its completed jobs: means, and the worst job."""
        for dag in range(len(self._legs)):
            self._of_dag(dag)
        return self._breakdown

    def response_parts(self) -> Table:
        """Return where the response time of each completed sink went: ``RESPONSE_PARTS``."""
        self._dags.clear()      # the parts are not kept, as most analyses only need their sums
        self._parts = [rows(RESPONSE_PARTS)]
        self.breakdown()
        found, self._parts = self._parts, None
        return concatenate(found)

    def _completed(self, dag: int, v: int, chain: _Chain) -> None:
        """Note where the response times of a sink went."""
        sink = self._first[dag] + v
        done = self._judged.of_sink(sink)
        done = done[done['kind'] <= max(SINK_COMPLETED)]
        if not len(done):
            return
        known, parts = _parts(done, chain)
        if self._parts is not None:
            self._parts.append(parts)
        self._breakdown[sink] = self._broken_down(dag, v, done['row'], known, parts)

    def _broken_down(
        self, dag: int, v: int, job: Ints, known: Mask, parts: Table
    ) -> Breakdown:
        """Return the means of the parts of the response times of a sink, and the worst job."""
        worst = int((parts['completed'] - parts['release']).argmax())
        links = self._follow(
            dag, np.flatnonzero(known[worst:worst + 1]), np.array([v]), job[worst:worst + 1])
        return {
            'mean': cast('ResponseParts', {
                f'{name}_ns': round(int(parts[name].sum()) / len(parts)) for name in PARTS}),
            'worst': cast('WorstJob', {
                'job': int(parts['job'][worst]), 'release_ns': int(parts['release'][worst]),
                'completed_ns': int(parts['completed'][worst]),
                **{f'{name}_ns': int(parts[name][worst]) for name in PARTS},
                'chain': [_step_result(self._judged.task_set, each[0]) for each in links][::-1]})}

    def links(self) -> Table:
        """
        Return the links of the chains of all verdicts, as far as the jobs got: ``LINKS``.

        ``of`` is the row of the verdict; the links of a chain come in their order.
        """
        verdicts, found = self._judged.verdicts, [rows(LINKS)]
        done = verdicts['kind'] <= max(SINK_COMPLETED)
        for dag in range(len(self._legs)):
            mine = verdicts['dag'] == dag
            which = np.flatnonzero(mine & done)
            sink, job = verdicts['sink'][which] - self._first[dag], verdicts['row'][which]
            known = self._of_dag(dag)[0][sink, job] >= 0
            found += self._follow(dag, which[known], sink[known], job[known])
            which = np.flatnonzero(mine & ~done)
            _, _, links = self.of_misses(dag, verdicts[which])
            links['of'] = which[links['of']]
            found.append(links)
        every = concatenate(found)[::-1]    # each chain was followed from its end
        return every[sort_by(every['of'])]


def _parts(done: Table, chain: _Chain) -> tuple[Mask, Table]:
    """
    Return by completed result whether its chain is known, and where its response time went.

    :param done: verdicts about one sink; ``chain``: the chains of all jobs up to it.
    """
    columns: Any = [each[..., done['row']] for each in chain]
    chain, completed, release = _Chain(*columns), done['completed'], done['release']
    waiting, executing, suspended, group, program = np.where(
        chain.known, chain.until(completed), 0)
    first = np.where(chain.known, chain.first, completed)
    lag = np.where(chain.known & chain.is_whole, first - release, 0)
    return chain.known, Table({
        'dag': done['dag'], 'sink': done['sink'], 'job': done['job'], 'release': release,
        'completed': completed, 'release_lag': lag, 'waiting': waiting, 'executing': executing,
        'suspended': suspended,
        'transport': completed - first - waiting - executing - suspended,
        'unknown': first - release - lag, 'waiting_group': group, 'waiting_program': program})


def _published(several: Sequence[_Chain], leg: Ints, ready: Ints) -> tuple[Ints, _Chain]:
    """
    Return by job the leg whose message started a vertex, and the chain of its publisher.

    :param several: chains of the publishers of all legs.
    :param leg: -1: unknown; ``ready``: when the vertex was ready.
    """
    found = several[0]
    if len(several) > 1:
        ended = [np.where(each.known & (each.start <= ready), each.end, -1) for each in several]
        leg = np.where(leg < 0, np.argmax(ended, axis=0), leg)
        for number, each in enumerate(several):
            found = _Chain(*(np.where(leg == number, new, old) for new, old in zip(each, found)))
    return np.maximum(leg, 0), found


def _answers_from(ready: Ints, start: Ints, published: Ints) -> Ints:
    """
    Return from when on executions of a driven sync wait to complete a job.

    The message of another topic may have come before the driving message was published.
    """
    found: Ints = np.maximum(ready, np.minimum(published, start))
    return found


def _step_result(task_set: TaskSet, link: Any) -> ChainLink:
    known = link['leg'] >= 0
    return {
        'vertex': task_set.vertices[int(link['vertex'])].name, 'ready_ns': int(link['ready']),
        'start_ns': int(link['start']), 'end_ns': int(link['end']) if known else None,
        'busy_ns': int(link['busy']) if known else None,
        'waiting_group_ns': int(link['group']) if known else None,
        'waiting_program_ns': int(link['program']) if known else None}
