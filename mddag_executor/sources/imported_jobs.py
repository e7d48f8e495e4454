# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The jobs of an imported recording, found by the causes of executions.

Theory of operation
-------------------
Events are named by their position in the order of time.

1. *Jobs.*  Each execution of a source begins a job.  Any other execution belongs to the job of the
   execution that published its message, as a successor of that vertex.  An execution for a message
   that is not recorded, or that was published for no job, counts as undeclared.
2. *Expiry.*  A job that has not completed `EXPIRE_AFTER_NS` after its latest deadline, with no
   execution running, has expired, as in the executor's core: when the next source starts, in the
   order of the jobs of a DAG.  Open jobs at the end of the recording are judged at the last event.
3. *Doubts.*  A job that has not completed counts as late or expired only if the recording shows
   it.  It is withdrawn, not judged, if, at or after its release,

   * a callback of one of its uncompleted vertices ran for an unknown job: its message is unknown,
     or its start or end is not recorded.  If the message's source timestamp is known but its
     publication is not, this only affects jobs without a recorded publication with source
     timestamp to this callback;
   * a callback whose initialisation is not recorded ran, which may be one of its uncompleted
     vertices, since their callback is not in the recording;
   * events are missing in a gap that had not ended at its release, and had begun when it
     expired.

   It is also withdrawn if a callback of one of its uncompleted vertices ever ran for a message
   between computers whose clocks differ by an unknown time (`imported_clocks`).
4. *Several messages of an execution.*  If an execution publishes a topic several times, the
   callbacks after it run several times in the job.  A vertex completes with the last of them; the
   earlier ones count like messages of a sync that are only stored (`LEG`).
5. *Skipped releases.*  If it is recorded when a timer was due (`undeclared_run`), a release that
   was skipped because the execution before it had not started is a job that expires at once, as in
   a run with a declaration.  It comes right after the job of that execution.
6. *Driven syncs* (`driven_by`).  The message of the driving topic belongs to a job; the execution
   that answers it (`core.driven`) completes the vertex, and belongs to the job as well.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from typing import NamedTuple

from mddag_executor.core import EXPIRE_AFTER_NS, legs_of, Tables
from mddag_executor.core.driven import Awaiting
from mddag_executor.core.tables import DRIVEN
from mddag_executor.recording.columns import concatenate, Ints, Mask, rows, Table
from mddag_executor.recording.joins import distinct, equal_pairs, groups, rows_by, sort_by
from mddag_executor.recording.mapping import Target
from mddag_executor.recording.tables import (
    EXPIRED,
    JOB_ENDS,
    LEG,
    RELEASES,
    UNKNOWN,
    VERTEX,
    WITHDRAWN,
)
from mddag_executor.sources.links import Links
from msg_graph import Dag, TaskSet
import numpy as np

_NEVER = 2 ** 62
"""A position after all events."""
_ANY, _NOT_FOUND = -2, -3
"""Instead of a vertex: any of them; any of those whose callbacks are not in the recording."""
SKIPPED = np.dtype([('after', 'i8'), ('release', 'i8'), ('noticed', 'i8')])
"""
Columns of a skipped release: the row of the release before it, when it was due, and when it was
noticed.
"""


class _Job(NamedTuple):
    """A job as one vertex: the vertex, and the row of its release."""

    vertex: int
    row: int


class ImportedJobs:
    """
    The jobs of an imported recording.

    :param targets: by callback of ``links`` its declared callback, if any.
    :param first: by run of a callback the first run of its execution.
    :param distrusted: by run of a callback whether the clock of its sender is unknown.
    :ivar sources: the executions of sources, one for each row of ``releases``.
    :ivar releases: the jobs; ``ends``: the expired and withdrawn ones.
    """

    def __init__(self, task_set: TaskSet, links: Links, targets: Sequence[Target | None],
                 first: Ints, distrusted: Mask) -> None:
        self._dags, self._links, self._first = task_set.dags, links, first
        self._distrusted = distrusted
        self._tables = Tables.build(task_set, legs=True)
        #: A vertex of each declared callback; and by callback of ``links``, if it is declared.
        self._vertices = {v.callback.key: each for each, v in enumerate(task_set.vertices)}
        self._declared = np.array([
            UNKNOWN if each is None else self._vertices[each.callback.key]
            for each in targets], dtype=np.int64)
        #: By callback whether it is of a driven sync, for a topic that does not drive it.
        self._is_other = np.array([
            each is not None and each.topic in each.callback.other_topics for each in targets],
            dtype=np.bool_)
        self._targets = targets
        self._index(targets)
        runs = links.runs
        source = self._source[runs['callback']]
        self.sources = np.flatnonzero((source >= 0) & (first == np.arange(len(runs))))
        source = source[self.sources]
        dag = np.array(self._tables.dag_of)[source]
        self.releases = rows(RELEASES, len(dag), dag=dag, noticed=runs['start'][self.sources])
        #: By DAG the rows of its jobs.
        self._jobs = rows_by(dag, len(self._dags))
        for mine in self._jobs:
            self.releases['job'][mine] = np.arange(len(mine))
        #: By run of a callback the row of its job, its vertex and leg.
        self._row, self._vertex = np.full((2, len(runs)), UNKNOWN)
        self._row[self.sources], self._vertex[self.sources] = np.arange(len(dag)), source
        self._leg = np.zeros(len(runs), dtype=np.int64)
        #: By run whether it answers a job, if it is of a driven sync; whether this is a guess.
        self._answers, self._guessed = np.zeros((2, len(runs)), dtype=np.bool_)
        self._follow_messages()

    def _index(self, targets: Sequence[Target | None]) -> None:
        """Index the graph: sources by callback, successors and legs by vertex and callback."""
        shape = self._tables.n_vertices + 1, len(targets)     # the last row: no vertex
        self._source = np.full(len(targets), UNKNOWN)
        self._after = np.full(shape, UNKNOWN, dtype=np.int32)
        self._leg_of = np.zeros(shape, dtype=np.int32)
        leg_topic = np.array([UNKNOWN if each is None else each.leg for each in targets])
        for dag, begin in zip(self._dags, self._tables.first_vertex):
            for vertex in dag.vertices:
                mine = self._declared == self._vertices[vertex.callback.key]
                if vertex.callback.driven_by is not None:
                    mine &= ~self._is_other
                if vertex.index == dag.source:
                    self._source[mine] = begin + vertex.index
                for leg, (topic, before) in enumerate(legs_of(vertex, dag.vertices)):
                    self._after[begin + before, mine] = begin + vertex.index
                    self._leg_of[begin + before, mine & (leg_topic == topic)] = leg

    def _follow_messages(self) -> None:
        """Find the jobs of the other executions (rule 1)."""
        runs, sent = self._links.runs, self._links.messages['run']
        sender = np.append(sent, UNKNOWN)[runs['message']]
        here, callback = np.arange(len(runs)), runs['callback']
        mine = (self._declared[callback] >= 0) & (self._source[callback] < 0) & (
            self._first == here) & ~self._is_other[callback]
        # no message is received before it was published: clocks differ, or times are damaged
        self._distrusted = self._distrusted | (sender >= here)
        #: Executions of an unknown job.
        self._unknown = np.flatnonzero(mine & ((sender < 0) | self._distrusted))
        todo = np.flatnonzero(mine & (sender >= 0) & ~self._distrusted)
        while len(todo):
            cause = self._first[sender[todo]]
            vertex = self._after[self._vertex[cause], callback[todo]]
            found = vertex >= 0
            if not found.any():
                if not self._answer():
                    break
                continue
            new, cause = todo[found], cause[found]
            self._vertex[new], self._row[new] = vertex[found], self._row[cause]
            self._leg[new] = self._leg_of[self._vertex[cause], callback[new]]
            todo = todo[~found]
        self._answer()
        for column in (self._vertex, self._row, self._leg):
            column[:] = column[self._first]

    def _answer(self) -> bool:
        """Find the executions that answer driven syncs (rule 6); return whether there are more."""
        before = int(self._answers.sum())
        runs, messages = self._links.runs, self._links.messages
        names = [*self._links.topics, '']
        for callback in {each.callback.key: each.callback for each in self._targets
                         if each is not None and each.callback.driven_by is not None}.values():
            mine = np.array([each is not None and each.callback.key == callback.key
                             for each in self._targets], dtype=np.bool_)[runs['callback']]
            mine &= self._first == np.arange(len(runs))
            sent = np.flatnonzero((messages['run'] >= 0) & mine[messages['run']])
            published: dict[int, list[tuple[str, int]]] = {}
            for run, topic, header in zip(
                    messages['run'][sent].tolist(), self._links.topic_of[sent].tolist(),
                    messages['header'][sent].tolist()):
                published.setdefault(run, []).append((names[topic], header))
            stamps = np.append(messages['header'], 0)[runs['message']]
            stamps = np.where(stamps != 0, stamps, runs['stated'])
            which = np.flatnonzero(mine)
            times = [*zip(runs['at'][which].tolist(), which.tolist(), [True] * len(which)),
                     *zip(runs['end_at'][which].tolist(), which.tolist(), [False] * len(which))]
            awaiting: Awaiting[_Job] = Awaiting(callback)
            job_of: dict[int, _Job | None] = {}
            for at, run, starts in sorted(times):
                target = self._targets[runs['callback'][run]]
                is_other = bool(self._is_other[runs['callback'][run]])
                if starts:
                    awaiting.hear(target.topic if target is not None else '')
                    job_of[run] = awaiting.newest(lambda _: True) if is_other else None
                    if not is_other and self._row[run] >= 0:
                        job = _Job(int(self._vertex[run]), int(self._row[run]))
                        job_of[run] = job
                        awaiting.receive(job, int(stamps[run]))
                    continue
                answered, sent_by = job_of.get(run), published.get(run, [])
                for topic, header in sent_by if is_other else ():
                    answered = awaiting.named(topic, header, answered)
                is_guess = is_other and answered is not None and awaiting.is_guess(answered)
                if at >= 0 and answered is not None and awaiting.is_answer(
                        {topic for topic, _ in sent_by}) and awaiting.answer(answered):
                    self._answers[run], self._guessed[run] = True, is_guess
                    self._vertex[run], self._row[run] = answered
        return int(self._answers.sum()) > before

    def fill(self, table: Table, release: Ints, last: Mask, skipped: Table) -> None:
        """
        Fill in the jobs of executions, and find the ends of jobs.

        :param release: of each job.
        :param last: by run of a callback whether its execution ends with it.
        :param skipped: skipped releases: ``SKIPPED``.
        """
        runs, known = self._links.runs, self._row >= 0
        self.releases['release'] = release
        self.releases['process'] = table['process'][self.sources]
        table['vertex'], table['leg'] = self._vertex, self._leg
        table['guessed'] = self._guessed
        table['ready'] = table['ready'][self._first]
        table['job'], table['dag'] = UNKNOWN, UNKNOWN
        for name in ('job', 'dag'):
            table[name][known] = self.releases[name][self._row[known]]
        done = np.flatnonzero(known & last)
        done = done[sort_by(runs['end_at'][done])]
        whole = self._whole(done)
        driven = np.array(self._tables.driven)[self._vertex[done]] & DRIVEN != 0
        whole &= ~driven | self._answers[done]
        cell = self._row[done[whole]] * len(self._after) + self._vertex[done[whole]]
        _, last_of = np.unique(cell[::-1], return_index=True)
        table['completes'][done] = LEG
        table['completes'][done[whole][::-1][last_of]] = VERTEX     # rule 4
        closed = self._closed()
        position = np.append(runs['at'][self.sources], _NEVER)
        self.ends, ends = self._find_ends(
            closed, position, done[table['completes'][done] == VERTEX])
        # at the same event ends come before releases
        at = np.concatenate([position[ends], position[:-1], runs['end_at'][done]])
        rank = np.empty(len(at), dtype=np.int64)
        rank[sort_by(at)] = np.arange(1, len(at) + 1)
        self.ends['order'], self.releases['order'], table['order'][done] = np.split(
            rank, np.cumsum([len(ends), len(release)]))
        if len(skipped):
            self._add_skipped(table, skipped)

    def _add_skipped(self, table: Table, skipped: Table) -> None:
        """Add the jobs of skipped releases (rule 5), and number all jobs."""
        skipped = skipped[sort_by(self.releases['order'][skipped['after']], skipped['release'])]
        after = skipped['after']
        # the release and the end of each follow that release in the order of all events
        place = self.releases['order'][after] + 2 * np.arange(len(skipped)) + 1
        before = self.releases['order'][after]
        for of in (self.releases, self.ends, table):
            of['order'] += np.where(
                of['order'] >= 0, 2 * np.searchsorted(before, of['order']), 0).astype(
                    of['order'].dtype)
        process, dag = (self.releases[name][after] for name in ('process', 'dag'))
        ended = self._rows_of(self.ends)
        releases = concatenate([self.releases, rows(
            RELEASES, len(skipped), process=process, dag=dag, release=skipped['release'],
            noticed=skipped['noticed'], order=place)])
        for mine in rows_by(releases['dag'], len(self._dags)):
            mine = mine[sort_by(releases['order'][mine])]
            releases['job'][mine] = np.arange(len(mine))
        known = self._row >= 0
        table['job'][known] = releases['job'][self._row[known]]
        self.ends['job'] = releases['job'][ended]
        ends = concatenate([self.ends, rows(
            JOB_ENDS, len(skipped), process=process, dag=dag,
            job=releases['job'][len(self.releases):], time=skipped['noticed'], reason=EXPIRED,
            order=place + 1)])
        self.releases = releases[sort_by(releases['order'])]
        self.ends = ends[sort_by(ends['order'])]

    def _rows_of(self, ends: Table) -> Ints:
        """Return the rows of ``releases`` of ended jobs."""
        found = np.full(len(ends), UNKNOWN)
        for dag, mine in enumerate(rows_by(ends['dag'], len(self._dags))):
            found[mine] = self._jobs[dag][ends['job'][mine]]
        return found

    def _whole(self, done: Ints) -> Mask:
        """Return whether executions complete their vertices: the last leg of a sync does."""
        vertex = self._vertex[done]
        n_legs = np.array(self._tables.n_legs)[vertex]
        whole: Mask = n_legs == 1
        several = np.flatnonzero(~whole)
        several = several[sort_by(self._row[done[several]], vertex[several])]
        row, vertex = self._row[done[several]], vertex[several]
        cell, leg = row * len(self._after) + vertex, self._leg[done[several]]
        begins, until = groups(cell)
        full = until - begins >= n_legs[several[begins]]
        whole[several[begins[full] + n_legs[several[begins[full]]] - 1]] = True
        # legs of which several messages came
        pairs = np.sort(cell * (leg.max(initial=0) + 1) + leg)
        again = distinct(pairs[1:][pairs[1:] == pairs[:-1]] // (leg.max(initial=0) + 1))
        legs: dict[int, set[int]] = {}
        for place in np.flatnonzero(np.isin(cell, again)).tolist():
            each, so_far = several[place], legs.setdefault(int(cell[place]), set())
            so_far.add(int(leg[place]))
            whole[each] = len(so_far) == n_legs[each]
            if whole[each]:
                del legs[int(cell[place])]
        return whole

    def _closed(self) -> Ints:
        """Return by job the source execution at whose start it has expired (rule 2)."""
        runs, release = self._links.runs, self.releases['release']
        closed = np.arange(1, len(release) + 1)
        for mine, deadline in zip(self._jobs, self._tables.dag_deadline):
            oldest = np.maximum.accumulate(release[mine])
            closed[mine] = np.maximum(closed[mine], np.searchsorted(
                self.releases['noticed'], oldest + deadline + EXPIRE_AFTER_NS, 'right'))
        ended = np.where(runs['end_at'] >= 0, runs['end_at'], _NEVER)
        at, _, run, _ = self._links.lost.T
        ended[run[run >= 0]] = at[run >= 0]
        known = self._row >= 0
        began, ended, row = runs['at'][known], ended[known], self._row[known]
        position = np.append(runs['at'][self.sources], _NEVER)
        while True:     # not while an execution runs
            now = position[closed[row]]
            running = (began < now) & (now < ended) & (now < _NEVER)
            if not running.any():
                return closed
            np.maximum.at(
                closed, row[running], np.searchsorted(position[:-1], ended[running]))

    def _find_ends(self, closed: Ints, position: Ints, done: Ints) -> tuple[Table, Ints]:
        """
        Return the ends of jobs that have not completed, and at which source executions.

        :param done: executions that completed vertices, in the order of their ends.
        """
        open_ones, withdrawn = np.zeros((2, len(closed)), dtype=np.bool_)
        doubts = _Doubts(
            self._links, self._declared, self._row, self._unknown, self._distrusted,
            set(self._vertices.values()) - set(self._declared.tolist()))
        dags, release, job = (self.releases[name] for name in ('dag', 'release', 'job'))
        until = position[closed]
        row, at = self._row[done], self._links.runs['end_at'][done]
        for dag, begin, mine in zip(self._dags, self._tables.first_vertex, self._jobs):
            here = np.flatnonzero(dags[row] == dag.index)[::-1]     # the first is assigned last
            completed = np.full((len(mine), len(dag.vertices)), _NEVER)
            completed[job[row[here]], self._vertex[done[here]] - begin] = at[here]
            undone = completed >= until[mine][:, None]
            open_ones[mine] = undone[:, list(dag.sinks)].any(axis=1)
            keys = [self._vertices[vertex.callback.key] for vertex in dag.vertices]
            withdrawn[mine] = doubts.of(dag, keys, mine, release[mine], until[mine], undone)
        withdrawn &= open_ones
        ended = np.flatnonzero(withdrawn | (open_ones & (closed < len(closed))))
        ended = ended[sort_by(closed[ended], dags[ended])]
        doubted, at = withdrawn[ended], closed[ended]
        time = np.append(self.releases['noticed'], UNKNOWN)[at]
        return rows(
            JOB_ENDS, len(ended), process=self.releases['process'][ended], dag=dags[ended],
            job=job[ended],
            time=np.where(doubted, UNKNOWN, time),
            reason=np.where(doubted, WITHDRAWN, EXPIRED)), at


class _Doubts:
    """
    Signs of missing events (rule 3).

    :param declared: by callback a vertex of its declared callback.
    :param row: by run of a callback the row of its job.
    :param unknown: executions for an unknown job.
    :param distrusted: by run of a callback whether the clock of its sender is unknown.
    :param not_found: the vertices whose callbacks are not in the recording.
    """

    def __init__(
        self, links: Links, declared: Ints, row: Ints, unknown: Ints, distrusted: Mask,
        not_found: Set[int],
    ) -> None:
        self._not_found = not_found
        nameless = np.array([each.kind == 'unknown' or (each.kind != 'other' and each.node is None)
                             for each in links.callbacks], dtype=np.bool_)
        declared = np.where(nameless, _NOT_FOUND, declared)
        unknown = np.append(unknown, np.flatnonzero(nameless[links.runs['callback']]))
        runs, messages = links.runs[unknown], links.messages
        at, callback, _, time = links.lost.T
        self._of = np.append(np.append(declared, _ANY)[callback], declared[runs['callback']])
        #: Whether a publication is missing, but its message's source timestamp is known.
        distrusted = distrusted[unknown]
        self._unsent = np.append(
            np.zeros(len(at), np.bool_),
            ((runs['message'] >= 0) | (runs['stamp'] != 0)) & ~distrusted & ~nameless[
                runs['callback']])
        # by an unknown clock, the callback may have run in any job
        self._at = np.append(at, np.where(distrusted, -1, runs['at']))
        self._time = np.append(time, np.where(distrusted, _NEVER, runs['start']))
        # the publications of jobs
        self._topics = links.topics
        job = np.append(row, UNKNOWN)[messages['run']]
        sent = np.flatnonzero((job >= 0) & ((messages['stamp'] != 0) | messages['within']))
        self._sent = job[sent], links.topic_of[sent]
        self._sent_at = np.append(messages['at'][sent], _NEVER)

    def of(self, dag: Dag, keys: Sequence[int], jobs: Ints, release: Ints, until: Ints,
           undone: Mask) -> Mask:
        """
        Return which jobs of a DAG are in doubt.

        :param keys: by vertex that of its callback in ``declared``.
        :param jobs: their rows; ``until``: the positions at which they end.
        :param undone: by job and vertex whether it has not completed.
        """
        doubted = self._latest(_ANY, False, until) >= release
        for vertex, key in zip(dag.vertices, keys):
            still = undone[:, vertex.index]
            doubted |= still & (self._latest(key, False, until) >= release)
            if key in self._not_found:
                doubted |= still & (self._latest(_NOT_FOUND, False, until) >= release)
            still = still & (self._latest(key, True, until) >= release)
            for topic in vertex.callback.topics if still.any() else ():
                number = np.full(len(jobs), self._topics.get(topic, UNKNOWN))
                sent, _ = equal_pairs(self._sent, (jobs, number))
                doubted |= still & (self._sent_at[sent] >= until)
        return doubted

    def _latest(self, of: int, unsent: bool, until: Ints) -> Ints:
        """Return the latest time of such signs by position; ``UNKNOWN``: none yet."""
        mine = np.flatnonzero((self._of == of) & (self._unsent == unsent))
        mine = mine[sort_by(self._at[mine])]
        time = np.append(UNKNOWN, np.maximum.accumulate(self._time[mine]))
        found: Ints = time[np.searchsorted(self._at[mine], until, 'right')]
        return found
