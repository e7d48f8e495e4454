# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The load of a recorded run: releases, execution times and what took time between them.

Theory of operation
-------------------
* The jobs are those that were released, in that order.  A source is ready when it was in the
  recording, which is a little after a timer's release, or long after that of a message whose
  header carries it.
* The executor looks for timers in rounds and dispatches no job of a round before it has noticed
  all of it: a more urgent one may follow.  A timer that was due when the one before it was noticed
  is of the same round.
* The execution time of a vertex in a job is what its execution took, the pieces of a coroutine
  added up.  Where it did not complete (the job was dropped, expired, or open at the end) it is the
  median of the callback's executions in the recording, or else the declared mean.
* A job that expired when it was released never ran: its timer was noticed later than its next
  period.  That depends on the machine, not on the scheduler, so it is skipped again.
* Of a sync vertex that is the leg that made it whole.  The legs before it, which only keep their
  message, load the workers as what no DAG declares does: each piece is a job of the undeclared
  DAG, ready when it was in the recording.  Callback groups of undeclared callbacks are not kept.
* Where CPU times are recorded, an execution time is what the execution would have taken alone (see
  ``alone``), and the load says what it computed and whether it held the interpreter: as recorded,
  or as the declaration says.
* *Transport*: a message is there some time after the callback that published it has ended (or
  before that: it published early).  That is the time from its end to the successor's readiness.
* *Dispatch*: the time from when an execution could have started to when it did (see
  ``dispatches``).  It is added to the execution time, because the worker is taken.
* In other processes than recorded, what notices timers and messages does so anew, as
  ``simulate.intakes`` says: it takes what it took in the recording (see ``noticed``).  A job whose
  timer was noticed too late is not skipped then.
* Where there is no such time in a job, the median of the edge, or of all executions, stands in.
* What was not published is not published again: if an execution completed without publishing on a
  topic on which its callback published in other jobs, and no execution followed in that job, the
  edge never comes true.  What could only run after that has no execution time.

Without overheads (``overheads=False``) transport and dispatch take no time and a timer's source is
ready at its release: what an ideal executor on the same machine would do.

Inside the engine a job's index is its place among the recorded jobs of its DAG; ``jobs`` has the
indices that were recorded.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from itertools import accumulate
from typing import Any, NamedTuple, TYPE_CHECKING

from mddag_executor.core import legs_of, NEVER, quantile, Tables
from mddag_executor.memory import give_back
from mddag_executor.replay.alone import alone, colder, ENOUGH, Recorded
from mddag_executor.replay.dispatches import Dispatches
from mddag_executor.replay.entities import Entities
from mddag_executor.replay.happenings import Observer
from mddag_executor.replay.noticed import Noticed
from mddag_executor.simulate import Load
from mddag_executor.simulate.deliveries import DELAY_NS
from mddag_executor.simulate.intakes import Costs
from mddag_executor.simulate.load import edge_numbers, edges_of, FAILS, RUNS, SKIPPED
from msg_graph import Dag, TaskSet
from msg_graph.model import topological_order
import numpy as np

_UNKNOWN = -1
_NO_GROUP, _UNTOLD = -1, -2


class RecordedLoad(NamedTuple):
    """
    A load made from a recording.

    ``jobs`` has, by DAG, the recorded index of each job; ``demand`` the execution times of all
    declared jobs, ns; ``estimated`` counts vertices of jobs whose execution time was not recorded,
    ``executions`` all of them; ``unknown`` names callbacks of which no time is known at all.
    ``dispatches`` is what of ``load.costs`` is dispatch; it is empty without overheads.
    ``dispatch_ns`` and ``transport_ns`` are medians of what was measured, None where nothing was.
    """

    load: Load
    jobs: Sequence[Sequence[int]]
    demand: int
    executions: int
    estimated: int
    unknown: list[str]
    dispatch_ns: int | None = None
    transport_ns: int | None = None
    dispatches: Any = ()
    intakes: Costs | None = None


_JOB, _VERTEX, _EDGE = range(3)
_COLUMNS = {
    'release': (_JOB, 'q'), 'noticed': (_JOB, 'q'), 'round': (_JOB, 'q'),
    'took': (_VERTEX, 'q'), 'start': (_VERTEX, 'q'), 'end': (_VERTEX, 'q'),
    'cpu': (_VERTEX, 'q'), 'dispatch': (_VERTEX, 'i'), 'held': (_VERTEX, 'h'),
    'arrived': (_EDGE, 'q'), 'sent': (_EDGE, 'b')}
"""What is known by job, by job and vertex, or by job and edge; ns, or unknown (``sent``: 1)."""


class _Jobs:
    """
    The jobs of one DAG.

    Each of ``_COLUMNS`` is an attribute: flat, of array, and of numpy once all jobs are there (see
    ``LoadBuilder._close``).
    """

    def __init__(self, dag: Dag, n_edges: int) -> None:
        for name, (_, code) in _COLUMNS.items():
            setattr(self, name, array(code))
        self.size = len(dag.vertices)
        self.n_edges = n_edges
        self.publishers = [v.index for v in dag.vertices for _ in v.successors]     # by edge
        self.numbers: list[int] = []
        self.row: dict[int, int] = {}
        self.new_row = [
            (getattr(self, name), array(code, [_UNKNOWN]) * (
                n_edges if by == _EDGE else self.size))
            for name, (by, code) in _COLUMNS.items() if by != _JOB]

    if TYPE_CHECKING:
        def __getattr__(self, name: str) -> Any:
            """Say that there are the columns, too."""

    def rows(self, name: str) -> Any:
        """Return a column as an array with a row for each job."""
        return np.asarray(getattr(self, name)).reshape(
            len(self.numbers), self.n_edges if _COLUMNS[name][0] == _EDGE else self.size)

    def add(self, job: int, release: int, now: int, number: int) -> None:
        """Add a job, and the round of timers that it was noticed in (or none)."""
        self.row[job] = len(self.numbers)
        self.numbers.append(job)
        self.release.append(release)
        self.noticed.append(max(release, now))
        self.round.append(number)
        for column, new in self.new_row:
            column.extend(new)


class LoadBuilder(Observer):
    """
    Collects a load from what happened.

    :param who: who is who, as far as the recording says.
    :param n_workers: how many workers each process was recorded with.
    :param cpus: how many there were; 0: not known.
    :param recorded: by vertex the process that it ran in, from 1; None: all in one.
    """

    def __init__(
        self, task_set: TaskSet, tables: Tables, who: Entities, n_workers: int, cpus: int = 0,
        recorded: Sequence[int] | None = None,
    ) -> None:
        self._task_set = task_set
        self._first = tables.first_vertex
        self._declared_group = tables.group
        self._who = who
        self._tables = tables
        self._process = [*(recorded or [1] * tables.n_vertices), 1]
        self._callbacks = task_set.places_of_vertices()
        self._cpus = cpus
        self._jobs = [_Jobs(dag, n) for dag, n in zip(task_set.dags, edges_of(tables))]
        self._timer = [d.vertices[d.source].callback.kind == 'timer' for d in task_set.dags]
        # when each round of timers ended, and the last one of each process
        self._rounds = array('q')
        self._last_round: dict[int, int] = {}
        # by global vertex and leg: the edge (number in its DAG) that its message makes true
        numbers = edge_numbers(tables)
        self._edges_into = [
            [numbers[first + before, first + vertex.index]
             for _, before in legs_of(vertex, dag.vertices)]
            for dag, first in zip(task_set.dags, tables.first_vertex) for vertex in dag.vertices]
        # by global vertex and topic: the edges that a publication makes true
        self._edges_from: dict[tuple[int, str], list[int]] = {}
        for dag, first in zip(task_set.dags, tables.first_vertex):
            for vertex in dag.vertices:
                for place, before in legs_of(vertex, dag.vertices):
                    self._edges_from.setdefault(
                        (first + before, vertex.callback.topics[place]), []).append(
                            numbers[first + before, first + vertex.index])
        # (time when ready, what it took, its dispatch or -1): undeclared callbacks, and legs that
        # completed nothing
        self._others: list[tuple[int, int, int]] = []
        self._leg: tuple[int, tuple[int, int, int]] | None = None
        self._untaken: tuple[int, int, int] | None = None
        self._dispatches = Dispatches(n_workers)
        self._failed: set[tuple[int, int]] = set()
        self._skipped: set[tuple[int, int]] = set()
        #: By global vertex: the address of the callback that ran as it.
        self.callback_of: dict[int, int] = {}

    def released(self, dag: int, job: int, release: int, now: int) -> None:
        """Add a job."""
        number = _UNKNOWN
        if self._timer[dag]:
            process = self._process[self._tables.source[dag]]
            number = self._last_round.get(process, _UNKNOWN)
            if number < 0 or release > self._rounds[number]:
                number = self._last_round[process] = len(self._rounds)
                self._rounds.append(now)
            self._rounds[number] = now
        self._jobs[dag].add(job, release, now, number)

    def ran(
        self, callback: int, dag: int, vertex: int, job: int, worker: int, ready: int, start: int,
        end: int, first: int,
    ) -> None:
        """Find out how late a piece was dispatched; keep what is undeclared."""
        row = -1 if vertex < 0 else self._jobs[dag].row.get(job, -1)
        if row >= 0 and not self._edges_into[vertex]:
            ready = max(ready, self._round_end(self._jobs[dag], row))
        group: int | None = self._who.groups.get(callback, _UNTOLD)
        if group == _UNTOLD and vertex >= 0 and self._declared_group[vertex] >= 0:
            group = _UNTOLD - 1 - self._declared_group[vertex]
        if group in (_NO_GROUP, _UNTOLD):
            group = None
        number = self._dispatches.add(worker, group, ready if first else start, start, end,
                                      self._process[vertex])
        if vertex < 0:
            self._others.append((ready if first else start, end - start, number))
            return
        self.callback_of.setdefault(vertex, callback)
        if first and row >= 0:
            jobs = self._jobs[dag]
            jobs.dispatch[row * jobs.size + vertex - self._first[dag]] = number

    def _round_end(self, jobs: _Jobs, row: int) -> int:
        number = jobs.round[row]
        return _UNKNOWN if number < 0 else self._rounds[number]

    def completed(
        self, dag: int, vertex: int, job: int, leg: int, whole: bool, end: int, ready: int,
        start: int, ended: int, busy: int, number: int, cpu: int, held: int,
    ) -> None:
        """Note an execution's times."""
        jobs = self._jobs[dag]
        row = jobs.row.get(job)
        if number < 0 or row is None:
            self._untaken = dag, vertex, job    # a leg that a simulator notes before it runs
            return
        same = self._leg is not None and self._leg[0] == number
        several = same or self._untaken == (dag, vertex, job)
        if self._leg is not None and not same:
            self._others.append(self._leg[1])
        self._leg = None
        edges = self._edges_into[vertex]
        if leg < len(edges):
            jobs.arrived[row * jobs.n_edges + edges[leg]] = ready
        if not whole:
            self._leg = number, (ready, busy, -1)
            return
        place = row * jobs.size + vertex - self._first[dag]
        jobs.took[place] = busy
        jobs.cpu[place] = cpu
        jobs.held[place] = held
        jobs.start[place] = start
        jobs.end[place] = ended
        if several:
            self._all_at_once(jobs, row, edges)
        if not edges and ready >= jobs.release[row]:
            jobs.noticed[row] = ready

    def _all_at_once(self, jobs: _Jobs, row: int, edges: list[int]) -> None:
        """Where one execution stands for all legs, only the last message's time is known."""
        ends = [jobs.end[row * jobs.size + jobs.publishers[edge]] for edge in edges]
        for edge, end in zip(edges, ends):
            if end < max(ends):
                jobs.arrived[row * jobs.n_edges + edge] = end

    def published(
        self, publisher: int, callback: int, dag: int, vertex: int, job: int, ready: int, now: int
    ) -> None:
        """Note which edges a job's publication made true."""
        known = self._who.every_publisher.get(publisher)
        if vertex < 0 or known is None:
            return
        jobs = self._jobs[dag]
        row = jobs.row.get(job)
        if row is not None:
            for edge in self._edges_from.get((vertex, known.topic), ()):
                jobs.sent[row * jobs.n_edges + edge] = 1

    def ended(self, dag: int, job: int, aborted: bool, now: int) -> None:
        """Keep what was skipped."""
        jobs = self._jobs[dag]
        row = jobs.row.get(job)
        if not aborted and row is not None and jobs.noticed[row] == now:
            self._skipped.add((dag, row))

    def failed(self, dag: int, vertex: int, job: int, now: int) -> None:
        """Keep what failed: it does so again."""
        row = self._jobs[dag].row.get(job)
        if row is not None:
            self._failed.add((vertex, row))

    def times(self) -> list[list[int]]:
        """Return by DAG and vertex what an execution takes, 0 where nothing says it."""
        typical = self._typical()
        return [[typical.get(vertex.callback.key, 0) for vertex in dag.vertices]
                for dag in self._task_set.dags]

    def build(
        self, overheads: bool = True, process: Sequence[int] | None = None, workers: int = NEVER,
        anew: bool = False,
    ) -> RecordedLoad:
        """
        Return what was collected.

        :param process: by vertex the process that it is to run in; None: as recorded.
        :param workers: how many each process is to have, if that is fewer than in the recording.
        :param anew: whether intakes are to notice timers and messages anew, not as recorded; so
            they do only where CPU times say how long others computed.
        """
        if self._leg is not None:
            self._others.append(self._leg[1])
            self._leg = None
        self._close()
        process = process or self._process
        anew = anew and bool((self._whole['cpu'] >= 0).any())
        every, usual, warmth, late, intakes = self._alone(workers, anew)
        if anew:
            self._skipped.clear()
        unsent = self._unsent()
        delays, transport = self._transports(overheads, process, intakes)
        if unsent:
            delays[np.concatenate([each.ravel() for each in unsent])] = NEVER
        self._drop('start', 'end', 'arrived', 'sent')
        estimated, unknown = self._estimate(process, unsent)
        took, cpu, held = (self._whole.pop(name) for name in ('took', 'cpu', 'held'))
        demand, executions = int(took.sum()), len(took)
        if overheads:
            took += late
        if intakes is not None:     # who dispatches computes, too
            cpu[cpu >= 0] += late[cpu >= 0]
            took += intakes.send_ns * self._by_execution(self._sends(process))
        others = sorted(self._others)
        more = np.zeros(len(others), dtype=np.int64)
        costs = np.concatenate([took, np.array([
            max(0, took) + (int(every[number]) if number >= 0 else 0)
            for _, took, number in others], dtype=np.int64)])
        bases = [0, *accumulate(len(jobs.numbers) * jobs.size for jobs in self._jobs)]
        columns: dict[str, Any] = {
            'holds': np.concatenate([held, more]) if held.any() else [],
            'computed': np.concatenate([cpu, more + _UNKNOWN]) if (cpu >= 0).any() else [],
            # where as many run beside one another, workers go on as they did
            'warmth': np.concatenate([warmth, more]) if overheads and workers < NEVER else [],
            'delays': delays, 'delay_stride': [jobs.n_edges for jobs in self._jobs],
            'delay_base': [0, *accumulate(
                len(jobs.numbers) * jobs.n_edges for jobs in self._jobs[:-1])]}
        load = self._load(costs, bases, [ready for ready, _, _ in others],
                          overheads and not anew)._replace(
            fates=self._fates(bases, len(costs)), **columns)
        return RecordedLoad(
            load, [jobs.numbers for jobs in self._jobs], demand, executions, estimated, unknown,
            usual, transport, late if overheads else late[:0], intakes)

    def _close(self) -> None:
        """Put the columns of all DAGs' jobs together, and leave each DAG its part of them."""
        self._whole: dict[str, Any] = {}
        for jobs in self._jobs:
            jobs.row.clear()
            jobs.new_row.clear()
        for name in _COLUMNS:
            parts = [np.asarray(getattr(jobs, name)) for jobs in self._jobs]
            whole = self._whole[name] = np.concatenate(parts)
            for jobs, part in zip(self._jobs, np.split(whole, np.cumsum([*map(len, parts)]))):
                setattr(jobs, name, part)

    def _drop(self, *columns: str) -> None:
        """Forget columns: of long runs they are large."""
        for name in columns:
            del self._whole[name]
            for jobs in self._jobs:
                delattr(jobs, name)

    def _unsent(self) -> list[Any]:
        """Return by DAG, job and edge whether it was not published, as far as that is known."""
        found = []
        for jobs in self._jobs:
            sent, arrived, end = map(jobs.rows, ('sent', 'arrived', 'end'))
            completed = end[:, jobs.publishers] >= 0
            found.append((sent < 0) & (arrived < 0) & completed & (sent >= 0).any(axis=0))
        return found

    def _never_ready(self, dag: Dag, unsent: Any) -> Any:
        """Return by job and vertex what cannot run, because an edge before it is unsent."""
        first = self._first[dag.index]
        found = np.zeros((len(unsent), len(dag.vertices)), dtype=np.bool_)
        if unsent.any():
            for v in topological_order(dag):
                edges = self._edges_into[first + v]
                found[:, v] = unsent[:, edges].any(axis=1) | found[
                    :, list(dag.vertices[v].predecessors)].any(axis=1)
        return found

    def _estimate(self, process: Sequence[int], unsent: list[Any]) -> tuple[int, list[str]]:
        """
        Fill in what was not recorded of executions: what they took and computed.

        :param unsent: by DAG, job and edge whether it never comes true.
        :return: how many there are, and the callbacks of which no time is known at all.
        """
        typical = self._typical()
        unknown: dict[str, None] = {}
        estimated = 0
        for dag, jobs, edges in zip(self._task_set.dags, self._jobs, unsent):
            took, cpu, held = map(jobs.rows, ('took', 'cpu', 'held'))
            took[[row for of, row in self._skipped if of == dag.index]] = 0
            took[(took < 0) & self._never_ready(dag, edges)] = 0
            missing = took < 0
            estimated += int(missing.sum())
            held[held < 0] = 0
            for vertex in dag.vertices:
                v, key = vertex.index, vertex.callback.key
                if missing[:, v].any():
                    if key not in typical:
                        unknown[key] = None
                    took[missing[:, v], v] = typical.get(key, 0)
                known = cpu[:, v] >= 0
                if known.any():     # those that did not complete are like the others
                    share = cpu[known, v].sum() / max(1, took[known, v].sum())
                    cpu[missing[:, v], v] = took[missing[:, v], v] * min(1.0, share)
                    held[missing[:, v], v] = held[known, v].mean() >= 0.5
                if vertex.callback.holds_interpreter is not None:
                    held[:, v] = vertex.callback.holds_interpreter
                    if vertex.callback.holds_interpreter:
                        cpu[~known, v] = took[~known, v]
                held[:, v] *= process[self._first[dag.index] + v]
        return estimated, list(unknown)

    def _fates(self, bases: list[int], executions: int) -> list[int]:
        """Return which executions failed, or were skipped; empty: none."""
        fates = [RUNS] * executions if self._failed or self._skipped else []
        for vertex, row in self._failed:
            dag = self._tables.dag_of[vertex]
            fates[bases[dag] + row * self._jobs[dag].size + vertex - self._first[dag]] = FAILS
        for dag, row in self._skipped:
            source = self._tables.source[dag] - self._first[dag]
            fates[bases[dag] + row * self._jobs[dag].size + source] = SKIPPED
        return fates

    def _by_execution(self, by_vertex: Sequence[int]) -> Any:
        numbers = np.array(by_vertex, dtype=np.int32)   # there may be millions
        return np.concatenate([
            np.tile(numbers[first:first + jobs.size], len(jobs.numbers))
            for first, jobs in zip(self._first, self._jobs)])

    def _alone(
        self, workers: int, anew: bool
    ) -> tuple[Any, int | None, Any, Any, Costs | None]:
        """
        Make times those that executions would have taken alone (see ``alone``).

        ``took`` becomes what their callbacks take.

        :return: how late executions were, by number, the last one what is usual; that; and by
            execution what it takes more since its worker had slept (see ``Load.warmth``), and
            what the executor takes for it; and what intakes take, if ``anew``.
        """
        intakes = None
        number, took, start, cpu, held = (
            self._whole[name] for name in ('dispatch', 'took', 'start', 'cpu', 'held'))
        locks = (held > 0) & (cpu >= 0)
        every = self._dispatches.late(number[locks & (number >= 0)])
        warm = np.append(self._dispatches.warm(), True)[number]
        known = number[number >= 0]
        usual = quantile(memoryview(np.sort(every[known])), 0.5) if len(known) else None
        every = np.append(every, usual or 0)     # number -1
        late = every[number]
        del self._dispatches, number, known
        self._drop('dispatch')
        if workers < NEVER:
            self._notice_sooner(start - late, workers)
        ran: Any = (took >= 0) & (start >= 0)
        if ran.all():
            ran = slice(None)   # which copies nothing: there may be millions
        warmth = np.zeros(len(took) * (workers < NEVER), dtype=np.int64)
        if (cpu[ran] >= 0).any():
            recorded = Recorded(
                start[ran] - late[ran], took[ran] + late[ran], cpu[ran], locks[ran],
                self._by_execution(self._process)[ran],
                self._by_execution(self._callbacks)[ran], warm[ran])
            give_back()
            beyond = recorded
            if anew:
                noticed = self._noticed()
                intakes = noticed.costs(recorded)
                beyond = recorded.beside(noticed.executions(intakes))
            cost = alone(beyond, self._cpus, workers)[:len(recorded.took)]
            del beyond
            if workers < NEVER:
                warmth[ran] = colder(recorded.callback, recorded.warm, cost)
            # what is less than recorded: it began late, or it stood still later
            began = recorded.took - cost
            del recorded
            began = np.minimum(began, np.maximum(0, late[ran] - (usual or 0)))
            took[ran] = np.maximum(0, cost - late[ran] + began)
            late[ran] = cost - took[ran]
        return every, usual, warmth, late, intakes

    def _notice_sooner(self, could: Any, workers: int) -> None:
        """
        Take off rounds what they were late since more executions ran than can when they were due.

        They become as late as those others are for which just as many ran as can: rank by rank.

        :param could: when executions could have started.
        """
        number, noticed, start, end = (
            self._whole[name] for name in ('round', 'noticed', 'start', 'end'))
        of = np.flatnonzero(number >= 0)
        due, ends, home = self._when_due()
        process = self._by_execution(self._process)
        taken = ends - due
        for here in np.unique(home):
            mine = (start >= 0) & (end >= 0) & (process == here)
            running = (np.searchsorted(np.sort(could[mine]), due, 'right')
                       - np.searchsorted(np.sort(end[mine]), due, 'right'))
            those = np.flatnonzero((running > workers) & (home == here))
            those = those[np.argsort(taken[those], kind='stable')]
            usual = taken[(running == workers) & (home == here)]
            if len(usual) >= ENOUGH and len(those):
                ranks = (np.arange(len(those)) + 0.5) / len(those)
                more = np.maximum(0, taken[those] - np.quantile(usual, ranks))
                ends[those] -= np.rint(more).astype(np.int64)
        self._rounds = array('q', ends.tobytes())
        noticed[of] = np.minimum(noticed[of], ends[number[of]])

    def _when_due(self) -> tuple[Any, Any, Any]:
        """Return when each round of timers was due, and ended, and in which process it was."""
        number, release = self._whole['round'], self._whole['release']
        of = np.flatnonzero(number >= 0)
        ends = np.array(self._rounds, dtype=np.int64)
        due, home = np.full(len(ends), NEVER), np.zeros(len(ends), dtype=np.int64)
        np.minimum.at(due, number[of], release[of])
        home[number[of]] = np.repeat(
            [self._process[source] for source in self._tables.source[:-1]],
            [len(jobs.round) for jobs in self._jobs])[of]
        return due, ends, home

    def _noticed(self) -> Noticed:
        """Return what the intakes noticed in the recording."""
        due, ends, home = self._when_due()
        columns = [np.stack((due, ends, home, np.ones_like(due)))]
        to = [[self._process[b] for a, b in edge_numbers(self._tables)
               if self._tables.dag_of[a] == dag.index] for dag in self._task_set.dags]
        for jobs, crosses, places in zip(self._jobs, self._crossings(self._process), to):
            end, arrived = map(jobs.rows, ('end', 'arrived'))
            for edge, (crossed, _) in enumerate(crosses):
                sent = np.minimum(end[:, jobs.publishers[edge]], arrived[:, edge])
                known = sent >= 0
                if crossed:
                    columns.append(np.stack((
                        sent[known], arrived[known, edge], np.full(known.sum(), places[edge]),
                        np.zeros(known.sum(), dtype=np.int64))))
        came = np.concatenate(columns, axis=1)
        return Noticed(came[0], came[1], came[2], came[3] > 0)

    def _sends(self, process: Sequence[int]) -> list[int]:
        """Return by vertex whether it is to send to other processes, less whether it did."""
        found = [0] * self._tables.n_vertices
        for how, sign in ((process, 1), (self._process, -1)):
            for before in {a for a, b in edge_numbers(self._tables) if how[a] != how[b]}:
                found[before] += sign
        return found

    def _load(
        self, costs: Any, bases: list[int], others: list[int], overheads: bool
    ) -> Load:
        # time when ready, DAG, place of the job in its DAG, release
        parts = [np.array(
            [(ready, len(self._jobs), place, ready) for place, ready in enumerate(others)],
            dtype=np.int64).reshape(-1, 4)]
        rounds = np.array([*self._rounds, _UNKNOWN], dtype=np.int64)    # the last of none
        for dag, jobs in zip(self._task_set.dags, self._jobs):
            ideal = self._timer[dag.index] and not overheads
            ready: Any = jobs.release if ideal else np.maximum(jobs.noticed, rounds[jobs.round])
            parts.append(np.column_stack((
                ready, np.full(len(ready), dag.index), np.arange(len(ready)), jobs.release)))
        columns = np.concatenate(parts).T
        ready, dags, rows, release = columns[:, np.lexsort(columns[::-1])]
        return Load(
            ready, dags, rows, costs, bases, [*(jobs.size for jobs in self._jobs), 1], release)

    def _transports(
        self, overheads: bool, process: Sequence[int], intakes: Costs | None
    ) -> tuple[Any, int | None]:
        """
        Return the transports by job, and the median of all that were measured.

        Where an edge is to cross from one process to another and did not, or did and is not to,
        it takes what is usual of such edges.
        """
        delays: list[Any] = []
        measured: dict[bool, list[Any]] = {False: [np.zeros(0)], True: [np.zeros(0)]}
        changed: list[tuple[Any, bool]] = []
        for jobs, crosses in zip(self._jobs, self._crossings(process)):
            start, end, arrived = map(jobs.rows, ('start', 'end', 'arrived'))
            ended = end[:, jobs.publishers]
            found = arrived - ended
            known = (arrived >= start[:, jobs.publishers]) & (ended >= 0)
            for edge, (before, after) in enumerate(crosses):
                column = found[known[:, edge], edge]
                found[~known[:, edge], edge] = np.median(column) if len(column) else 0
                measured[before].append(column)
                if intakes is not None and after:
                    found[:, edge] = intakes.delay_ns
                elif before != after:
                    changed.append((found[:, edge], after))
            delays.append(found)
        usual = {after: np.concatenate(each) for after, each in measured.items()}
        for view, after in changed:
            times = usual[after]
            view[:] = np.median(times) if len(times) else DELAY_NS * after
        flat = np.concatenate([each.ravel() for each in delays] or [np.zeros(0, dtype=np.int64)])
        everything = np.concatenate(list(usual.values()))
        return (flat if overheads else np.zeros_like(flat),
                int(np.median(everything)) if len(everything) else None)

    def _crossings(self, process: Sequence[int]) -> list[list[tuple[bool, bool]]]:
        """Return by DAG for each edge whether it left its process, and whether it is to."""
        found: list[list[tuple[bool, bool]]] = [[] for _ in self._jobs]
        was = self._process
        for a, b in edge_numbers(self._tables):
            found[self._tables.dag_of[a]].append((was[a] != was[b], process[a] != process[b]))
        return found

    def _typical(self) -> dict[str, int]:
        """Return by callback the median of its recorded times, or else the declared mean."""
        recorded: dict[str, list[Any]] = {}
        for dag, jobs in zip(self._task_set.dags, self._jobs):
            for vertex in dag.vertices:
                recorded.setdefault(vertex.callback.key, []).append(
                    np.array(jobs.took[vertex.index::jobs.size]))
        typical = {
            c.key: c.execution_time.mean_ns
            for c in self._task_set.callbacks if c.execution_time is not None}
        for key, parts in recorded.items():
            times = np.sort(np.concatenate(parts))
            times = times[times >= 0]
            if len(times):
                typical[key] = quantile(memoryview(times), 0.5)
        return typical
