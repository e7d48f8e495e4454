# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verdicts of a recording, computed from its tables.

Theory of operation
-------------------
The rules are rules 1, 2, 6, 8, 9, 11, 13 and 14 of the scheduler core (``core.rules``), applied to
all jobs at once; ``test/analysis/test_deadlines.py`` compares both implementations.

1. A vertex completes when the last of its legs completes; in an imported recording, with the
   execution that is marked as the last one of the job (``imported_jobs``).
2. A job ends when all its sinks have completed, or earlier if it is recorded as expired, aborted
   or failed.  Later completions do not count.
3. A sink that completed by its absolute deadline is in time, later it is late.  If the job ended
   before, the sink gets the verdict of that end.  If the run ended after the deadline, the sink is
   overdue.  A sink is not due, and gets no verdict, if a vertex before it completed without
   publishing a topic of ``may_publish`` that leads to it.
4. Jobs released before ``judge_from`` or outside ``judged_releases`` are not judged.
5. A driven sync (``driven_by``) completes with the execution that answered its job, which is the
   one that is recorded as completing.  A job whose driving message was received, and that was not
   answered itself, is completed by the first answer to a job with a later driving message.  Its
   vertices after the sync complete with those of later jobs.
6. A change of the vertices that a process expects (``hosted``) applies to jobs released after it.

The executor's recorded misses must equal the computed ones.  If they differ, the recording is
incomplete or this program is wrong; ``Judged.differences`` reports it.
"""

from __future__ import annotations

from collections import Counter
from functools import cached_property
from typing import Any, NamedTuple

from mddag_executor.core import NEVER, Tables, Tally
from mddag_executor.core.state import (
    ABORTED,
    COMPLETED,
    ELSEWHERE,
    EXPIRED,
    FAILED,
    HERE,
    LATE,
    LEADS_OUT,
    OUTDATED,
    SINK_ABORTED,
    SINK_COMPLETED,
    SINK_DEMOTED,
    SINK_DROPPED,
    SINK_EXPIRED,
    SINK_FAILED,
    SINK_IN_TIME,
    SINK_LATE,
    SINK_MISSED,
    SINK_NOT_DUE,
)
from mddag_executor.core.tables import DRIVEN
from mddag_executor.memory import give_back
from mddag_executor.recording import tables as recorded
from mddag_executor.recording.columns import concatenate, Ints, Mask, rows, Table
from mddag_executor.recording.joins import different, distinct, rows_by, sort_by
from mddag_executor.recording.recorded_jobs import Jobs
from mddag_executor.recording.recording import Recording
from mddag_executor.text import counted
from msg_graph.model import optional_edges, topological_order
import numpy as np
import numpy.typing as npt

VERDICTS = np.dtype([
    ('kind', 'i1'), ('dag', 'i2'), ('sink', 'i4'), ('job', 'i8'), ('release', 'i8'),
    ('deadline', 'i8'), ('completed', 'i8'), ('until', 'i8'), ('row', 'i4'), ('order', 'i8')])
"""
Columns of the table of verdicts: one row per judged job and sink, in order.

``kind`` is one of the core's decisions; ``completed`` is -1 if the sink never completed; ``until``
is the time of completion, or of the end of the job; ``row`` is the job's row in ``Jobs``.
"""

_NO_ROWS: Ints = np.empty(0, dtype=np.int64)
_ENDS = {
    recorded.EXPIRED: (EXPIRED, SINK_EXPIRED), recorded.ABORTED: (ABORTED, SINK_ABORTED),
    recorded.FAILED: (FAILED, SINK_FAILED), recorded.OUTDATED: (OUTDATED, SINK_DROPPED)}


class JudgedJobs(NamedTuple):
    """
    The judged jobs of one DAG, one row each, in the order of their releases.

    ``done`` has, by job and vertex, the row of the execution that completed the vertex (-1: none).
    ``ended`` is the position in the order of events at which the job ended early, ``until`` when
    it or the run ended, ns.
    """

    dag: int
    every: Jobs
    number: Ints
    release: Ints
    released: Ints
    done: npt.NDArray[np.int32]
    ended: Ints
    until: Ints

    def rows_of(self, jobs: Any) -> Ints:
        """Return the rows of jobs; -1 for unknown jobs."""
        return self.every.rows_of(self.dag, jobs)


class Judged:
    """
    The verdicts of a recording.

    :ivar verdicts: a table of ``VERDICTS``; ``tally`` has its sums.
    :ivar jobs: the jobs, by DAG.
    :ivar contradictions: events that contradict earlier ones.
    """

    def __init__(self, recording: Recording, skip: int = 0) -> None:
        task_set = recording.task_set
        self._recording, self.task_set, self.skip = recording, task_set, skip
        self.tables = Tables.build(task_set, legs=True)
        self.contradictions = 0
        self._not_due: dict[int, int] = {}
        self._outcomes: list[tuple[int, Ints, Mask]] = []
        #: The first release that is judged.
        self.judge_from = _judge_from(recording, skip)
        ends = [recording.job_ends[mine] for mine in rows_by(
            recording.job_ends['dag'], len(task_set.dags))]
        completions = _completions(recording.executions, len(task_set.dags), np.array([
            bool(recording.run.links or driven & DRIVEN) for driven in self.tables.driven]))
        self.jobs: list[JudgedJobs] = []
        found: list[Table] = []
        for dag in range(len(task_set.dags)):
            jobs, verdicts = self._judge(dag, completions.pop(0), ends[dag])
            self.jobs.append(jobs)
            found += verdicts
        table = concatenate([rows(VERDICTS), *found])
        found.clear()
        self.verdicts = table[sort_by(table['order'])]
        del table
        give_back()     # memory of the completions
        self.tally = self._tally()

    @cached_property
    def missed(self) -> Table:
        """Return the verdicts that are misses, in the order of deadlines."""
        found: Table = self.verdicts[self.verdicts['kind'] != SINK_IN_TIME]
        return found[sort_by(found['deadline'])]

    # --- judging ---------------------------------------------------------------------------------

    def _judge(
        self, dag: int, completions: Ints, ends: Table
    ) -> tuple[JudgedJobs, list[Table]]:
        first, last = self.tables.first_vertex[dag:dag + 2]
        every = self._recording.jobs
        number, release, released = (
            each[every.of_dag(dag)] for each in (every.number, every.release, every.order))
        jobs = JudgedJobs(
            dag, every, number, release, released,
            np.full((len(released), last - first), -1, dtype=np.int32),
            np.full(len(released), NEVER),
            np.full(len(released), self._recording.run.judged_until))
        reason = self._given_up(jobs, ends)
        expected = self._expected(dag, jobs)
        # by job and vertex the position at which it completed
        position = np.full(jobs.done.shape, NEVER)
        duplicates = self._complete(dag, jobs, completions, expected, position)
        for vertex in self.task_set.dags[dag].vertices:
            if vertex.callback.driven_by is not None:
                self._follow(dag, vertex.index, jobs, position)
        sinks = self.tables.sinks[self.tables.first_sink[dag]:self.tables.first_sink[dag + 1]]
        local = np.array(sinks, dtype=np.int64) - first
        here = expected[:, local] == HERE if expected is not None else \
            np.ones((len(released), len(local)), dtype=np.bool_)
        withheld = self._withheld(dag, jobs, position)[:, local]
        order = position[:, local]
        done = (order < jobs.ended[:, None]) & (order < withheld)
        not_due = here & ~done & (withheld < jobs.ended[:, None])
        deadline = jobs.release[:, None] + np.array(
            [self.tables.sink_deadline[sink] for sink in sinks], dtype=np.int64)
        completed = np.full(done.shape, -1)
        completed[done] = self._recording.executions['end'][jobs.done[:, local][done]]
        is_judged = np.array([self.tables.judged[sink] for sink in sinks], dtype='?')
        late = done & (completed > deadline) & is_judged
        dropped, dropped_at = self._dropped(jobs, sinks)
        dropped &= here & ~done & ~not_due & (
            (reason < 0)[:, None] | (dropped_at <= jobs.until[:, None]))
        # position at which the last sink completed
        ended_at = np.where(done, order, np.where(not_due, withheld, NEVER))
        closed = np.where(here & ~dropped, ended_at, -1).max(axis=1, initial=-1)
        if expected is not None:
            done_here = np.where(position < jobs.ended[:, None], position, NEVER)
            closed = np.maximum(closed, np.where(
                expected == LEADS_OUT, done_here, -1).max(axis=1, initial=-1))
        # no sinks here, or not the last completion but a drop closed the job
        closed[(closed < 0) | (reason == recorded.OUTDATED)] = NEVER
        ended = np.minimum(jobs.ended, closed)
        run = self._recording.run
        judged_order, judged_until = run.judged_order, run.judged_until
        open_then = (jobs.released < judged_order) & (ended > judged_order)
        overdue = here & ~dropped & (ended_at > judged_order) & open_then[:, None] & (
            deadline <= judged_until) if self._recording.run.judged else np.zeros_like(done)
        given_up = here & ~done & ~dropped & ~not_due & (jobs.ended < NEVER)[:, None] & (
            reason != recorded.WITHDRAWN)[:, None]
        self.contradictions += int((duplicates[0] < ended[duplicates[1]]).sum())
        self._late_ends(jobs, ends, ended)
        judged = self._is_judged(jobs.release)
        for place, sink in enumerate(sinks):
            self._not_due[sink] = int((not_due[:, place] & judged).sum())
        kinds = np.full(len(jobs.release), SINK_MISSED)
        for of, (_, kind) in _ENDS.items():
            kinds[reason == of] = kind
        at_end = min(judged_order, NEVER)
        choices: tuple[tuple[Any, ...], ...] = (
            (done & here, np.where(late, SINK_LATE, SINK_IN_TIME), order, completed),
            (given_up, kinds[:, None], jobs.ended[:, None], jobs.until[:, None]),
            (dropped, SINK_DROPPED, np.minimum(jobs.ended, at_end)[:, None], dropped_at),
            (overdue, SINK_MISSED, at_end, judged_until))
        verdicts = [
            _verdicts(dag, sinks, jobs, deadline, completed,
                      which & judged[:, None] & is_judged, *columns)
            for which, *columns in choices]
        outcome: Ints = np.where(
            ((late & here) | (overdue | dropped) & is_judged).any(axis=1), LATE, COMPLETED)
        for of, (end, _) in _ENDS.items():
            outcome[(jobs.ended <= closed) & (reason == of)] = end
        over = (ended < NEVER) & ~((jobs.ended <= closed) & (reason == recorded.WITHDRAWN))
        self._outcomes.append((dag, outcome, over & judged))
        return jobs, verdicts

    def _dropped(self, jobs: JudgedJobs, sinks: list[int]) -> tuple[Mask, Ints]:
        """Return by job and sink whether it was dropped for a newer one, and when."""
        recording = self._recording
        dropped = np.zeros((len(jobs.number), len(sinks)), dtype=np.bool_)
        when = np.zeros(dropped.shape, dtype=np.int64)
        if 'newer' in recording.names.drop_reasons:
            drops = recording.drops
            drops = drops[drops['reason'] == [*recording.names.drop_reasons].index('newer')]
            for place, sink in enumerate(sinks):
                mine = drops[drops['vertex'] == sink]
                row = jobs.rows_of(mine['job'])
                dropped[row[row >= 0], place] = True
                when[row[row >= 0], place] = mine['time'][row >= 0]
        return dropped, when

    def _follow(self, dag: int, sync: int, jobs: JudgedJobs, position: Ints) -> None:
        """Complete jobs by the answers of a driven sync to later ones (rule 5)."""
        ran, vertex = self._recording.executions, self.tables.first_vertex[dag] + sync
        which = np.flatnonzero((ran['vertex'] == vertex) & (ran['start'] >= 0))
        row = jobs.rows_of(ran['job'][which])
        received = np.full(len(jobs.number), NEVER)
        np.minimum.at(received, row[row >= 0], ran['start'][which][row >= 0])
        answered_at = np.where(received < NEVER, position[:, sync], NEVER)
        in_order = sort_by(received)
        first = np.minimum.accumulate(answered_at[in_order][::-1])[::-1]
        waiting = (first < NEVER) & (answered_at[in_order] >= NEVER) & (
            received[in_order] < NEVER)
        answers = dict(zip(answered_at.tolist(), range(len(answered_at))))
        vertices = self.task_set.dags[dag].vertices
        after = {sync}
        for v in topological_order(self.task_set.dags[dag]):
            if after.isdisjoint(vertices[v].predecessors) and v != sync:
                continue
            after.add(v)
            own = position[:, v].copy()
            sorted_rows = np.argsort(own, kind='stable')
            for at, job in zip(first[waiting].tolist(), in_order[waiting].tolist()):
                answered = answers[at]
                by, when = answered, max(int(own[answered]), at)
                place = int(np.searchsorted(own, at, 'right', sorter=sorted_rows))
                while place < len(own) and sorted_rows[place] <= job:
                    place += 1
                if place < len(own) and own[sorted_rows[place]] < when:
                    by, when = int(sorted_rows[place]), int(own[sorted_rows[place]])
                if when < min(NEVER, position[job, v]):
                    position[job, v] = when
                    # completed there before the answering execution ended: with that
                    jobs.done[job, v] = jobs.done[answered, sync] if own[by] < when else (
                        jobs.done[by, v])

    def _withheld(self, dag: int, jobs: JudgedJobs, position: Ints) -> Ints:
        """
        Return by job and vertex the position from which on it is known not to be due (NEVER: due).

        That is the position at which a vertex completed that has not published (rule 3).
        """
        vertices, first = self.task_set.dags[dag].vertices, self.tables.first_vertex[dag]
        found = np.full(position.shape, NEVER)
        if not any(vertex.callback.may_publish for vertex in vertices):
            return found
        for v in topological_order(self.task_set.dags[dag]):
            vertex = vertices[v]
            # a vertex that completed before is not withheld, nor are those that it started
            found[position[:, v] < found[:, v], v] = NEVER
            for after, topic in optional_edges(vertex, vertices):
                silent = self._is_silent(first + v, first + after, topic, jobs)
                done, driven = jobs.done[:, v], self.tables.driven[first + v]
                if driven & DRIVEN and self._recording.names.publishers:
                    silent = ~np.isin(done, self._published.get((first + v, topic), _NO_ROWS))
                elif driven:    # it may have completed with an execution of another job
                    of = jobs.rows_of(self._recording.executions['job'][done])
                    silent = np.where((done >= 0) & (of >= 0), silent[of], silent)
                silent_from = np.where(silent, position[:, v], NEVER)
                np.minimum(found[:, after], silent_from, out=found[:, after])
            for after in vertex.successors:
                np.minimum(found[:, after], found[:, v], out=found[:, after])
        return found

    def _is_silent(self, vertex: int, after: int, topic: str, jobs: JudgedJobs) -> Mask:
        """Return by job whether a vertex did not publish a topic that starts another vertex."""
        recording = self._recording
        if recording.names.publishers:
            by = self._published.get((vertex, topic), _NO_ROWS)
            row = jobs.rows_of(recording.executions['job'][by])
            silent = np.ones(len(jobs.number), dtype=np.bool_)
            silent[row[row >= 0]] = False
        else:   # a computed run records no publications, but what was not sent
            row = jobs.rows_of(recording.run.unsent.get((vertex, after), _NO_ROWS))
            silent = np.zeros(len(jobs.number), dtype=np.bool_)
            silent[row[row >= 0]] = True
        return silent

    @cached_property
    def _published(self) -> dict[tuple[int, str], Ints]:
        """Return by vertex and topic of ``may_publish`` the executions that published it."""
        topics = sorted({t for each in self.task_set.callbacks for t in each.may_publish})
        publishers = self._recording.names.publishers
        sent, ran = self._recording.publications, self._recording.executions
        found: dict[tuple[int, str], Ints] = {}
        for topic in topics:
            numbers = [number for number, each in publishers.items() if each.topic == topic]
            which = np.isin(sent['publisher'], numbers) & (sent['execution'] >= 0)
            by = sent['execution'][which]
            vertices, index = different(ran['vertex'][by])
            for vertex, mine in zip(vertices.tolist(), rows_by(index, len(vertices))):
                found[vertex, topic] = by[mine]
        return found

    def _given_up(self, jobs: JudgedJobs, ends: Table) -> Ints:
        """Note when jobs ended early; return the reason."""
        reason = np.full(len(jobs.number), -1)
        ends = ends[sort_by(ends['order'])[::-1]]
        row = jobs.rows_of(ends['job'])
        row, ends = row[row >= 0], ends[row >= 0]
        later = ends['order'] > jobs.released[row]
        row, ends = row[later], ends[later]
        # the first end of several wins: it is written last
        jobs.ended[row], jobs.until[row], reason[row] = (
            ends[name] for name in ('order', 'time', 'reason'))
        return reason

    def _late_ends(self, jobs: JudgedJobs, ends: Table, ended: Ints) -> None:
        """Count ends of jobs that had ended already."""
        if not self._recording.run.same:
            return
        ends = ends[ends['reason'] <= recorded.ABORTED]
        row = jobs.rows_of(ends['job'])
        order, at = ends['order'][row >= 0], row[row >= 0]
        was_open = (order > jobs.released[at]) & (order <= ended[at])
        self.contradictions += len(ends) - int(was_open.sum())

    def _expected(self, dag: int, jobs: JudgedJobs) -> Ints | None:
        """Return by job and vertex whether it is expected; None: all are expected (rule 6)."""
        changes = [(order, vertices) for order, of, vertices in self._recording.run.hosted
                   if of == dag]
        if not changes:
            return None
        from mddag_executor.core import Scheduler
        first, last = self.tables.first_vertex[dag:dag + 2]
        scheduler = Scheduler(self.tables, 1)
        expected = np.full(jobs.done.shape, HERE)
        for order, vertices in changes:
            scheduler.expect(dag, [int(v in vertices) for v in range(first, last)])
            expected[jobs.released > order] = scheduler.state.expected[first:last]
        return expected

    def _complete(
        self, dag: int, jobs: JudgedJobs, completing: Ints, expected: Ints | None, position: Ints
    ) -> tuple[Ints, Ints]:
        """
        Fill in the executions that completed vertices (rule 1), and their positions.

        :param completing: rows of executions, in order.
        :return: positions of duplicate completions, and the rows of their jobs.
        """
        first, ran = self.tables.first_vertex[dag], self._recording.executions
        job, order, vertex = (ran[name][completing] for name in ('job', 'order', 'vertex'))
        row = self._recording.job_places[completing] - jobs.every.first[dag]
        vertex = vertex - first
        known = row >= 0
        known[known] = order[known] > jobs.released[row[known]]
        if not known.all():
            # no such job was released before, or it has ended
            newest = np.maximum.accumulate(np.r_[-1, jobs.number])
            before = newest[np.searchsorted(jobs.released, order)]
            self.contradictions += int((~known & (job > before)).sum())
        known[known] = order[known] < jobs.ended[row[known]]
        if not known.all():
            row, order, vertex, completing = (
                each[known] for each in (row, order, vertex, completing))
        n_legs = np.array(self.tables.n_legs[first:first + jobs.done.shape[1]])
        single = (n_legs[vertex] == 1) | self._recording.run.links
        # the first completion of each vertex wins: it is written last
        places, orders = jobs.done.reshape(-1), position.reshape(-1)
        cell = row * jobs.done.shape[1] + vertex
        duplicate = np.zeros(len(cell), dtype=np.bool_)
        mine = np.flatnonzero(single)[::-1]
        places[cell[mine]] = completing[mine]
        orders[cell[mine]] = order[mine]
        duplicate[mine] = places[cell[mine]] != completing[mine]
        if len(mine) < len(cell):
            self._complete_legs(
                jobs, np.flatnonzero(~single), cell, order, completing, n_legs, duplicate, orders)
        if expected is not None:
            no_legs = np.array(self.tables.n_predecessors[first:first + jobs.done.shape[1]]) > 0
            elsewhere = (expected == ELSEWHERE) & no_legs
            jobs.done[elsewhere], position[elsewhere] = -1, NEVER
        return order[duplicate], row[duplicate]

    def _complete_legs(
        self, jobs: JudgedJobs, mine: Ints, cell: Ints, order: Ints, completing: Ints,
        n_legs: Ints, duplicate: Mask, orders: Ints,
    ) -> None:
        """Fill in the completions of vertices with several legs."""
        leg = self._recording.executions['leg'][completing[mine]].astype(np.int64)
        width, n = int(n_legs.max()), jobs.done.shape[1]
        legs = n_legs[cell[mine] % n]
        good = (leg < legs) & (leg >= recorded.ALL_LEGS)
        mine, leg, legs = mine[good], leg[good], legs[good]
        every = leg == recorded.ALL_LEGS
        number = np.r_[mine[~every], np.repeat(mine[every], legs[every])]
        length = legs[every]
        at = np.r_[leg[~every], np.arange(length.sum()) - np.repeat(
            np.cumsum(length) - length, length)]
        back = np.argsort(number, kind='stable')[::-1]      # in the reverse order of completion
        number, at = number[back], at[back]
        done_leg = np.full((jobs.done.size, width), -1)
        done_leg[cell[number], at] = number
        again = done_leg[cell[number], at] != number
        duplicate[number[again]] = True
        cells = distinct(cell[mine])
        of = done_leg[cells]
        wanted = np.arange(width) < n_legs[cells % n][:, None]
        whole = ((of >= 0) | ~wanted).all(axis=1)
        last = np.where(wanted, of, -1).max(axis=1)[whole]      # numbers are in order
        jobs.done.reshape(-1)[cells[whole]] = completing[last]
        orders[cells[whole]] = order[last]

    def _is_judged(self, release: Ints) -> Mask:
        """Return which releases are judged (rule 4)."""
        begin, end = self._recording.run.judged_releases or (-NEVER, NEVER)
        judged: Mask = (release >= max(begin, self.judge_from)) & (release < end)
        return judged

    # --- results ---------------------------------------------------------------------------------

    def _tally(self) -> Tally:
        tally = Tally(self.task_set, self.tables)
        demotions = self._recording.demotions
        if self.skip:
            jobs = self._recording.jobs
            kept = np.append(jobs.release >= self.judge_from, False)
            demotions = demotions[kept[jobs.places(demotions)]]
        for dag, outcome, over in self._outcomes:
            tally.jobs[dag] = int(self._is_judged(self.jobs[dag].release).sum())
            for end, n in Counter(outcome[over].tolist()).items():
                tally.ends[dag][end] += n
        tally.add_results([tuple(self.verdicts[name] for name in (
            'kind', 'sink', 'job', 'deadline', 'completed'))])
        demoted = Counter(demotions['vertex'].tolist())
        for v in tally.sinks:
            tally.sinks[v].numbers[SINK_DEMOTED] = demoted[v]
            tally.sinks[v].numbers[SINK_NOT_DUE] = self._not_due[v]
        return tally

    @cached_property
    def _by_vertex(self) -> list[Ints]:
        return rows_by(self.verdicts['sink'], len(self.task_set.vertices))

    def of_sink(self, sink: int) -> Table:
        """Return the verdicts of a sink."""
        return self.verdicts[self._by_vertex[sink]]

    def differences(self) -> str | None:
        """
        Return how the recorded misses differ from the computed ones; None if they are equal.

        Only meaningful if the end of the run is recorded: otherwise the trace may end between a
        completion and its verdict.
        """
        if self.skip or not self._recording.run.same:
            return None  # the recorded sums count all jobs
        missed, before = self.missed, self._recording.misses
        columns = ('dag', 'sink', 'job', 'deadline', 'completed')
        found = Counter(zip(*(missed[name].tolist() for name in columns)))
        recorded = Counter(zip(*(before[name].tolist() for name in before.names)))
        if found == recorded:
            return None
        more, less = found - recorded, recorded - found
        example = min([*more, *less], key=lambda miss: miss[3])
        name = 'an undeclared vertex' if example[1] < 0 else self.tally.vertex_name(example[1])
        recorded_misses = counted(len(before), 'recorded miss', 'recorded misses')
        return (f'the replay does not find {less.total()} of {recorded_misses}, and it finds '
                f'{more.total()} that were not recorded: the first is job {example[2]} at {name}')


def _verdicts(
    dag: int, sinks: list[int], jobs: JudgedJobs, deadline: Ints, completed: Ints, which: Mask,
    kind: Any, order: Any, until: Any,
) -> Table:
    """Return some verdicts, a table of ``VERDICTS``; all columns are by job and sink."""
    row, sink = np.nonzero(which)
    kind, order, until = (
        np.broadcast_to(each, which.shape)[which] for each in (kind, order, until))
    return rows(
        VERDICTS, len(row), kind=kind, dag=dag, sink=np.array(sinks, dtype=np.int64)[sink],
        job=jobs.number[row], release=jobs.release[row], deadline=deadline[which],
        completed=np.where(kind <= max(SINK_COMPLETED), completed[which], -1), until=until,
        row=row, order=order)


def _completions(executions: Table, n_dags: int, whole: Mask) -> list[Ints]:
    """
    Return by DAG the executions that completed vertices, in the order of their completions.

    :param whole: by vertex whether only those count that completed it, not those of legs.
    """
    completes, vertex = executions['completes'], executions['vertex']
    done = (completes == recorded.VERTEX) | ((completes != recorded.NOTHING) & ~whole[vertex])
    which = np.flatnonzero(done & (vertex >= 0))
    which = which[sort_by(executions['order'][which])]
    return [which[mine] for mine in rows_by(executions['dag'][which], n_dags)]


def _judge_from(recording: Recording, skip: int) -> int:
    """Return the first release that is judged after a warm-up."""
    begin, releases = recording.run.judge_from, recording.releases
    if begin > -NEVER:
        return begin + skip
    if skip > 0 and len(releases):
        return int(releases['release'][releases['order'].argmin()]) + skip
    return begin
