# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Explains the missed deadlines of a recording: see ``causes``.

Theory of operation
-------------------
A miss has the chain of its sink (see ``chains``) or, if the job ended early, of the vertex that
the job reached.  The usual time of a callback or release is its median over the whole recording.
Stops of the machine are recorded by the executor up to one slice late, so a stop begins with the
last event before it.
"""

from __future__ import annotations

from collections import defaultdict
from functools import cached_property
from typing import Any, TYPE_CHECKING

from mddag_executor.analysis.behind import behind, Members, ran_at
from mddag_executor.analysis.causes import (
    Busy,
    CAUSES,
    delayed_by,
    DROPPED_RUNS,
    DROPS,
    find,
    HANGS_NS,
    INTERPRETER,
    MACHINE,
    MISSED,
    Never,
    NO_MESSAGE,
    PARTS,
    Pool,
    RAN_LONG,
    RAN_USUALLY,
    SKIPPED,
    STARTED,
    Usual,
    WAITED,
)
from mddag_executor.analysis.chains import Chains, LINKS
from mddag_executor.analysis.deadlines import Judged
from mddag_executor.analysis.drift import gone_at, keys_of
from mddag_executor.analysis.spans import crowded, Spans
from mddag_executor.analysis.usage import in_groups, ran
from mddag_executor.core import legs_of
from mddag_executor.core.policies import SIMULATED_ONLY
from mddag_executor.core.state import SINK_LATE
from mddag_executor.core.stops import LEAST_NS
from mddag_executor.core.tally import VERDICTS
from mddag_executor.recording.columns import concatenate, in_parts, Ints, Mask, rows, Table
from mddag_executor.recording.joins import different, distinct, equal_pairs, groups, sort_by
from mddag_executor.recording.recording import Recording
from mddag_executor.recording.tables import VERTEX
from msg_graph.model import topological_order
import numpy as np

if TYPE_CHECKING:
    from mddag_executor.results.replays import (
        Behind,
        ExplainResult,
        ExplainResultRare,
        LatePath,
        MissedJob,
        Misses,
        MissesRare,
        MissPart,
    )

_NO_END = 2 ** 62
_FIRST_PROCESS = -2
"""In a run that other executors share, the place of the first process; threads have 0 and up."""
_STEPS = 32     # per octave
_ROUGHLY_NS = 1_000_000
"""A demotion this shortly before the latest start may be because of lateness."""


class Explanation:
    """The causes of the missed deadlines of a recording."""

    def __init__(self, recording: Recording, judged: Judged, chains: Chains) -> None:
        self._recording, self._task_set = recording, recording.task_set
        self._tables, self._who = judged.tables, recording.names
        # without misses there is nothing to explain
        self._executions = recording.executions[:None if len(judged.missed) else 0]
        self._rows = ran(self._executions)
        run = recording.run
        # by process; of others it is not known which threads share their work
        self._workers = run.own_processes
        if not (run.imported or self._workers):
            self._workers = {0: run.head.workers}
        if not run.imported and run.head.policy in SIMULATED_ONLY:
            self._workers = {}
        # whether what waited at the end is recorded
        self._knows_waiting = run.imported or run.shut_down and run.processes == 1
        # where callbacks may delay each other: of another executor it is not known which threads
        # share its work
        self._place = self._executions['process'].astype(np.int64)
        own = recording.own_executions[:len(self._place)]
        if run.imported:
            self._place = np.where(own, _FIRST_PROCESS - self._place, self._executions['worker'])
        #: Begin and end of each stop of the machine.
        self.stops = self._stops()
        missed, links = self._missed(judged, chains)
        pool, usual = self._pool(missed), self._usual()
        missed['outranked'] = self._outranked(missed, links, usual)
        self._never = Never(
            *self._dropped(), self._started(chains.waited.group), self._unpublished(missed),
            np.array([*(v.callback.driven_by is not None for v in self._task_set.vertices),
                      False]),
            self._gone(), self._knows_waiting)
        self.found = find(
            missed, links, pool, usual, self._never,
            np.array([*self._tables.dag_of, 0], dtype=np.int64),
            np.array([*self._tables.sink_deadline, 0], dtype=np.int64),
            np.array([*(not v.predecessors for v in self._task_set.vertices), False]))
        # number of misses by sink and cause
        self._counts = np.zeros((len(self._task_set.vertices) + 1, len(CAUSES)), dtype=np.int64)
        np.add.at(self._counts, (missed['sink'], self.found.causes), 1)
        self._in_stops = dict.fromkeys(self.stops, 0)
        machine = self.found.causes == MACHINE
        for stop in sorted(pool.stalls, key=lambda stop: stop[0] - stop[1]):    # longest first
            mine = machine & delayed_by(missed, stop)
            machine &= ~mine    # each miss counts once
            self._in_stops[stop] += int(mine.sum())

    # --- input -----------------------------------------------------------------------------------

    def _missed(self, judged: Judged, chains: Chains) -> tuple[Table, Table]:
        """Return the misses, and the links of their chains."""
        verdicts = judged.missed
        missed = rows(MISSED, len(verdicts), **{
            name: verdicts[name] for name in ('kind', 'sink', 'job', 'release', 'until')})
        demotions = self._recording.demotions
        demotion, _ = equal_pairs(
            (demotions['vertex'], demotions['job']), (missed['sink'], missed['job']))
        missed['demoted'] = np.append(demotions['time'], _NO_END)[demotion]
        links: list[Table] = []
        for dag in distinct(verdicts['dag']).tolist():
            mine = np.flatnonzero(verdicts['dag'] == dag)
            missed['at'][mine], missed['in_job'][mine], of_dag = chains.of_misses(
                dag, verdicts[mine])
            of_dag['of'] = mine[of_dag['of']]
            links.append(of_dag)
        every = concatenate([rows(LINKS), *links])
        every = every[sort_by(every['of'])]
        missed['length'] = np.bincount(every['of'], minlength=len(missed))
        return missed, every

    def _pool(self, missed: Table) -> Pool:
        """Return what ran and what stalled during the misses."""
        table, rows = self._executions, self._rows
        first = int(min(table['start'][rows].min(initial=_NO_END),
                        missed['release'].min(initial=_NO_END)))
        # by vertex the place of its last execution
        imported = self._recording.run.imported
        one = not imported and self._recording.run.processes == 1
        of_vertex = np.full(len(self._task_set.vertices) + 1, 0 if one else -1)
        of_vertex[table['vertex'][rows]] = self._place[rows]
        places = {*([0] if one else ()), *distinct(self._place[rows]).tolist()}
        of_threads = {place for place in places if imported and place > _FIRST_PROCESS}
        threads = {
            thread: Spans(*crowded(table['start'][each], table['end'][each], 1))
            for thread in of_threads for each in [rows[self._place[rows] == thread]]
        } if imported else None
        hangs, blocked = self._hangs()
        return Pool(
            {place: self._busy(rows[self._place[rows] == place], place, hangs)
             for place in places - of_threads},
            [stop for stop in self.stops if stop[1] >= first], any(self._workers.values()),
            self._place, of_vertex, threads, hangs, blocked, *self._busy_programs(),
            self._answers())

    def _hangs(self) -> tuple[Mask, dict[int, Spans]]:
        """Return which executions never ended, and by vertex when they blocked its group."""
        table = self._executions
        found = np.zeros(len(table), dtype=np.bool_)
        unfinished = self._recording.unfinished
        if not len(unfinished) or not len(table):
            return found, {}
        mine = np.flatnonzero(np.isin(table['start'], unfinished['start']) & (
            table['end'] - table['start'] >= HANGS_NS))
        known, _ = equal_pairs(*(
            (each['callback'], each['start']) for each in (unfinished, table[mine])))
        mine = mine[known >= 0]
        found[mine] = True
        group = np.array([self._who.groups.get(each, -1)
                          for each in table['callback'][mine].tolist()], dtype=np.int64)
        return found, {vertex: Spans(table['start'][members], table['end'][members])
                       for vertex, of in self._groups.items() if of >= 0
                       and len(members := mine[group == of])}

    def _busy_programs(self) -> tuple[dict[int, Spans], dict[int, Spans]]:
        """Return ``programs`` and ``gaps`` of ``Pool``."""
        programs, gaps = (defaultdict[int, list[tuple[Ints, Ints]]](list) for _ in range(2))
        for closed in self._recording.closed_times():
            vertices = distinct(self._recording.executions['vertex'][closed.executions])
            for vertex in vertices[vertices >= 0].tolist():
                # it may have run in several processes
                programs[vertex].append(closed.times)
                gaps[vertex].append(closed.halts)
        return ({vertex: _any_of(times) for vertex, times in programs.items()},
                {vertex: _any_of(times) for vertex, times in gaps.items()})

    def _busy(self, rows: Ints, place: int, hangs: Mask) -> Busy:
        """Return when executions occupied all workers, and when they may have held the GIL."""
        process = _FIRST_PROCESS - place if self._recording.run.imported else place
        table = self._executions
        on_workers = rows[table['worker'][rows] >= 0]
        start, end = table['start'][on_workers], table['end'][on_workers]
        holding = rows[self._may_hold(rows, hangs)]
        since, until = table['began'][holding], table['end'][holding]
        return Busy(
            Spans(*crowded(start, end, max(1, self._workers.get(process, 1)))),
            Spans(*(crowded(since, until, 1) if len(holding) else crowded(start, end, 1))),
            Spans(*crowded(since, until, 2)))

    def _may_hold(self, rows: Ints, hangs: Mask) -> Mask:
        """Return which executions held the GIL, or may have held it because it is not recorded."""
        table = self._executions
        holds, known = table['holds_gil'][rows], table['cpu'][rows] >= 0
        if not self._recording.run.declared:
            return holds | ~known
        return np.where(
            table['vertex'][rows] < 0, holds | ~known, holds & (table['completes'][rows] > 0)) | (
            hangs & (table['worker'] >= 0))[rows]

    def _answers(self) -> Mask:
        """Return which executions of driven syncs messages of other topics started."""
        driven = {v: each.callback.driven_by for v, each in enumerate(self._task_set.vertices)
                  if each.callback.driven_by is not None}
        found = np.zeros(len(self._executions), dtype=np.bool_)
        if driven:
            numbers, which = self._recording.callbacks()
            topics = [self._recording.names.topic(number) for number in numbers.tolist()]
        for vertex, topic in driven.items():
            mine = np.flatnonzero(self._executions['vertex'] == vertex)
            found[mine] = np.array([each not in ('', topic) for each in topics])[which[mine]]
        return found

    def _usual(self) -> Usual:
        """Return the usual times of callbacks and releases."""
        recording = self._recording.whole or self._recording
        task_set = self._task_set
        table = recording.executions[:None if len(self._executions) else 0]
        place = np.array([*task_set.places_of_vertices(), 0], dtype=np.int64)
        longest = [_NO_END if v.callback.execution_time is None
                   else v.callback.execution_time.quantiles_ns[-1] for v in task_set.vertices]
        # the last message of a sync vertex starts it; the others are only stored
        rows = self._rows if self._recording.whole is None else ran(table)
        whole = rows[(table['completes'][rows] == VERTEX) & (table['vertex'][rows] >= 0)]
        of = place[table['vertex'][whole]]
        count = len(task_set.callbacks) + 1
        runs = medians(of, table['end'][whole] - table['began'][whole], count)
        cpu = table['cpu'][whole]
        computed = medians(of[cpu >= 0], cpu[cpu >= 0], count)
        releases = recording.releases
        lags = medians(
            releases['dag'], releases['noticed'] - releases['release'], len(task_set.dags) + 1)
        return Usual(np.minimum(runs[place], np.array([*longest, 0])), computed[place], lags)

    def _outranked(self, missed: Table, links: Table, usual: Usual) -> Mask:
        """
        Return which misses were demoted while they could still be in time.

        These made way for more important work.  The latest start is that of the callback that
        waited then, by the usual times of it and of those after it.  The executor estimates these
        times itself, so a demotion shortly before is not counted.
        """
        # the last one is that of undeclared callbacks, to which nothing gives way
        importance = np.array(self._tables.importance)
        found: Mask = (missed['demoted'] < _NO_END) & (
            importance[missed['sink']] < importance[:-1].max(initial=0))
        waits = links[found[links['of']]]
        waits = waits[(waits['ready'] <= missed['demoted'][waits['of']])
                      & (waits['start'] >= missed['demoted'][waits['of']])]
        at = missed['at'].copy()
        at[waits['of']] = waits['vertex']
        for sink in distinct(missed['sink'][found]).tolist():
            mine = np.flatnonzero(found & (missed['sink'] == sink))
            left = missed['release'][mine] + self._tables.sink_deadline[sink] - missed[
                'demoted'][mine]
            needed = self._longest(usual.runs, sink)[at[mine]]
            found[mine] = left > needed + np.maximum(_ROUGHLY_NS, needed // 4)
        return found

    def _longest(self, runs: Ints, sink: int) -> Ints:
        """Return by vertex that leads to a sink the usual time until the sink is completed."""
        dag = self._task_set.dags[self._tables.dag_of[sink]]
        first, found = self._tables.first_vertex[dag.index], dict[int, int]()
        for v in reversed(topological_order(dag)):
            after = [found[first + each] for each in dag.vertices[v].successors
                     if first + each in found]
            if first + v == sink or after:
                found[first + v] = int(runs[first + v]) + max(after, default=0)
        return np.array([found.get(v, 0) for v in range(len(runs))])

    def _dropped(self) -> tuple[Table, dict[int, tuple[Ints, Ints]]]:
        """Return the dropped executions; and those without a job by vertex (``dropped_at``)."""
        drops, reasons = self._recording.drops, self._recording.names.drop_reasons
        place = np.array([*self._task_set.places_of_vertices(), -1])
        causes, aborted = (np.array(each or [0])[drops['reason']] for each in (
            [DROPS.get(reason, WAITED) for reason in reasons],
            [reason == 'aborted' for reason in reasons]))
        without = np.flatnonzero((drops['job'] < 0) & (drops['vertex'] >= 0))
        without = without[sort_by(drops['time'][without])]
        of = place[drops['vertex'][without]]
        return rows(DROPPED_RUNS, len(drops), cause=causes, aborted=aborted, **{
            name: drops[name] for name in ('vertex', 'job', 'time')}), {
            vertex: (drops['time'][mine], causes[mine])
            for vertex in np.flatnonzero(np.isin(place[:-1], of)).tolist()
            for mine in [without[of == place[vertex]]]}

    def _gone(self) -> Ints:
        """Return by vertex when it lost an entity that it lacked until the end."""
        gone = gone_at(self._recording.names, keys_of(self._recording))
        return np.array([*(gone.get(v.callback.key, _NO_END) for v in self._task_set.vertices),
                         _NO_END], dtype=np.int64)

    def _unpublished(self, missed: Table) -> Mask:
        """
        Return which misses lack a message that was not published at the vertex that they reached.

        The callback before completed in this job and did not publish the topic.
        """
        recording, table = self._recording, self._executions
        found = np.zeros(len(missed), dtype=np.bool_)
        if not recording.names.publishers:
            return found    # a simulated run: its callbacks always publish
        job = recording.jobs.places_of(
            np.array([*self._tables.dag_of, -1])[missed['at']], missed['in_job'])
        topic_of = {number: each.topic for number, each in recording.names.publishers.items()}
        for vertex in distinct(missed['at']).tolist():
            mine = np.flatnonzero(missed['at'] == vertex)
            for publisher, topic in self._topics(vertex):
                ran = np.flatnonzero(table['vertex'] == publisher)
                completed = self._jobs_of(ran[table['completes'][ran] == VERTEX])
                sent = recording.publications
                sent = sent[np.isin(sent['execution'], ran)]
                numbers, which = different(sent['publisher'])
                published = self._jobs_of(sent['execution'][np.array([
                    topic_of.get(each, '') in ('', topic) for each in numbers.tolist()],
                    dtype=np.bool_)[which]])
                found[mine] |= completed[job[mine]] & ~published[job[mine]]
        return found

    def _jobs_of(self, executions: Ints) -> Mask:
        """Return by place of a job (see ``Jobs``) whether any of some executions is of it."""
        found = np.zeros(len(self._recording.jobs) + 1, dtype=np.bool_)
        found[self._recording.job_places[executions]] = True
        found[-1] = False   # no job
        return found

    def _topics(self, vertex: int) -> list[tuple[int, str]]:
        """Return the vertices that publish for a vertex, and the topic of each."""
        one = self._task_set.vertices[vertex]
        first = self._tables.first_vertex[one.dag]
        return [(first + before, one.callback.topics[place]) for place, before in legs_of(
            one, self._task_set.dags[one.dag].vertices) if one.callback.topics]

    def _started(self, in_group: Ints) -> Table:
        """Return executions that were started, and sources that waited until a drop or the end."""
        recording, table = self._recording, self._executions
        which = np.flatnonzero((table['vertex'] >= 0) & (table['start'] >= 0))
        started = rows(STARTED, len(which), group=in_group[which], **{
            name: table[name][which] for name in ('vertex', 'leg', 'job', 'ready', 'start')})
        drops, reasons = recording.drops, recording.names.drop_reasons
        is_source = np.array([*(not v.predecessors for v in self._task_set.vertices), False])
        drops = drops[is_source[drops['vertex']] & np.array([
            reason in ('aborted', 'newer') for reason in reasons] or [False])[drops['reason']]]
        # by place of a job its drop; the last one is written last
        drop = np.full(len(recording.jobs) + 1, -1)
        drop[recording.jobs.places_of(
            np.array([*self._tables.dag_of, -1])[drops['vertex']], drops['job'])] = np.arange(
            len(drops))
        mine = np.flatnonzero(drop[:-1] >= 0)
        waits = self._open_sources(started)
        if not len(mine) + len(waits):
            return started
        # a release that was skipped at the time of the abort was skipped before it
        dropped = drops[drop[mine]]
        sources = concatenate([waits, rows(
            STARTED, len(mine), vertex=dropped['vertex'], job=dropped['job'],
            ready=recording.jobs.noticed[mine], start=dropped['time'] + 1)])
        sources['group'] = self._in_groups(sources)
        return concatenate([started, sources])

    def _open_sources(self, started: Table) -> Table:
        """Return the sources that waited when the recording was cut off, which does not say so."""
        recording = self._recording
        if self._knows_waiting:
            return rows(STARTED)
        jobs, ends = recording.jobs, recording.job_ends
        dags = np.repeat(np.arange(len(jobs.first) - 1), np.diff(jobs.first))
        source = np.array([*self._tables.source], dtype=np.int64)[dags]
        is_open = np.ones(len(jobs) + 1, dtype=np.bool_)
        is_open[jobs.places(ends)] = False
        for table in (started, recording.drops):
            is_open[jobs.places_of(
                np.array([*self._tables.dag_of, -1])[table['vertex']], table['job'])] = False
        mine = np.flatnonzero(is_open[:-1])
        return rows(STARTED, len(mine), vertex=source[mine], job=jobs.number[mine],
                    ready=jobs.noticed[mine], start=recording.end + 1)

    def _in_groups(self, waits: Table) -> Ints:
        """Return how long the callback groups of waiting vertices were busy meanwhile, ns."""
        of_vertex = self._groups
        group = np.array([of_vertex.get(vertex, -1) for vertex in waits['vertex'].tolist()],
                         dtype=np.int64)
        busy = np.zeros(len(waits), dtype=np.int64)
        for number, _, starts, ends in in_groups(self._recording):
            mine = group == number
            busy[mine] = Spans(starts, ends).within(waits['ready'][mine], waits['start'][mine])
        return busy

    def _stops(self) -> list[tuple[int, int]]:
        """Return the stops of the machine, each from the last event before it."""
        recording, table = self._recording, self._recording.executions
        stops = recording.stops[recording.stops['end'] - recording.stops['start'] >= LEAST_NS]
        if not len(stops):
            return []
        begins = np.sort(stops['start'])
        # by begin the last event up to it, and by the end of all the later ones
        last = np.full(len(begins) + 1, -_NO_END)
        for times in (*(table[name] for name in ('ready', 'start', 'end')),
                      recording.releases['noticed'], recording.publications['time']):
            for part in in_parts(times):
                np.maximum.at(last, np.searchsorted(begins, part), part)
        last = np.maximum.accumulate(last)[np.searchsorted(begins, stops['start'])]
        near = last >= np.maximum(0, stops['start'] - LEAST_NS)
        found = zip(np.where(near, last, stops['start']).tolist(), stops['end'].tolist())
        return sorted(found)

    @cached_property
    def behind(self) -> Table:
        """Return the callbacks that ran longest while parts of misses waited: ``BEHIND``."""
        return behind(
            self.found, ran_at(self._executions, self._rows, self._place),
            *(Members(self._by_vertex(of), of) for of in (self._who.groups, self._who.programs)))

    @cached_property
    def _vertices(self) -> dict[int, int]:
        """Return by callback the vertex that it ran as last."""
        numbers, _ = self._recording.callbacks()
        of = self._recording.vertices_of_callbacks(self._rows)
        return {callback: vertex for callback, vertex in zip(numbers.tolist(), of.tolist())
                if vertex >= 0}

    @cached_property
    def _groups(self) -> dict[int, int]:
        """Return by vertex the callback group of its callback; -1 for a reentrant one."""
        return self._by_vertex(self._who.groups)

    def _by_vertex(self, of: dict[int, int]) -> dict[int, int]:
        """Return by vertex what is known of its callback, or -1."""
        return {vertex: of.get(callback, -1) for callback, vertex in self._vertices.items()}

    def names_of(self, callbacks: Ints) -> list[str]:
        """Return the names of callbacks that ran, given by their numbers."""
        numbers, which = different(callbacks)
        vertices, ran_as = self._task_set.vertices, self._vertices
        names = [vertices[ran_as[number]].callback.key if number in ran_as
                 else self._who.name(number) for number in numbers.tolist()]
        return [names[each] for each in which.tolist()]

    # --- results ---------------------------------------------------------------------------------

    def summary(self) -> Misses:
        """Return the number of misses by cause, in total and by sink, and the stops."""
        names = [v.name for v in self._task_set.vertices]
        more: MissesRare = {}
        if assumed := self._assumed():
            more['interpreter_assumed'] = assumed
        return {
            'missed': int(self._counts.sum()),
            'causes': dict(zip(CAUSES, self._counts.sum(axis=0).tolist())),
            'sinks': {names[v]: dict(zip(CAUSES, self._counts[v].tolist()))
                      for v in self._tables.sinks if self._counts[v].any()},
            'stalls': [{'at_ns': begin, 'length_ns': end - begin,
                        'misses': self._in_stops[begin, end]} for begin, end in self.stops],
            **more}

    def _assumed(self) -> int:
        """Return the number of misses by the interpreter, if it is not recorded who held it."""
        parts, table = self.found.parts, self._executions
        waits = np.flatnonzero((parts['cause'] == INTERPRETER) & (
            self.found.causes[parts['miss']] == INTERPRETER))
        held = self._rows[table['holds_gil'][self._rows] & (table['cpu'][self._rows] >= 0)]
        known = np.zeros(len(waits), dtype=np.int64)
        for place in distinct(parts['place'][waits]).tolist():
            mine, rows = (np.flatnonzero(each == place) for each in (
                parts['place'][waits], self._place[held]))
            spans = Spans(*crowded(table['began'][held[rows]], table['end'][held[rows]], 1))
            known[mine] = spans.within(
                parts['begin'][waits[mine]], parts['end'][waits[mine]])
        return len(distinct(parts['miss'][waits[known < parts['ns'][waits]]]))

    def result(
        self, sink: int | None = None, job: int | None = None,
        requirements: dict[str, dict[str, LatePath]] | None = None,
    ) -> ExplainResult:
        """
        Return the result format of ``explain --json``.

        :param sink: a global vertex, to explain its misses only; ``job``: likewise.
        :param requirements: where the time of late results of paths went.
        """
        more: ExplainResultRare = {}
        if requirements:
            more['requirements'] = requirements
        wanted = np.ones(len(self.found.misses), dtype=np.bool_)
        for column, value in (('sink', sink), ('job', job)):
            if value is not None:
                wanted &= self.found.misses[column] == value
        return {**self.summary(), 'jobs': self._jobs(np.flatnonzero(wanted)), **more}

    def _jobs(self, which: Ints) -> list[MissedJob]:
        """Return what is known of some misses."""
        missed, vertices = self.found.misses[which], self._task_set.vertices
        of = np.flatnonzero(np.isin(self.found.parts['miss'], which))
        parts, miss = self._parts(of), self.found.parts['miss'][of]
        first, until = (np.searchsorted(miss, which, side).tolist() for side in ('left', 'right'))
        found: list[MissedJob] = []
        for i, (kind, sink, number, release, until_ns, cause) in enumerate(zip(*(
                each.tolist() for each in (
                    *missed.columns('kind', 'sink', 'job', 'release', 'until'),
                    self.found.causes[which])))):
            deadline = release + self._tables.sink_deadline[sink]
            found.append({
                'dag': self._task_set.dags[self._tables.dag_of[sink]].name, 'job': number,
                'sink': vertices[sink].name, 'verdict': VERDICTS[kind],
                'release_ns': release, 'deadline_ns': deadline, 'until_ns': until_ns,
                'late_ns': until_ns - deadline if kind == SINK_LATE else None,
                'cause': CAUSES[cause], 'parts': parts[first[i]:until[i]]})
        return found

    def _parts(self, which: Ints) -> list[MissPart]:
        """Return what is known of some parts of misses."""
        parts, names = self.found.parts[which], [v.name for v in self._task_set.vertices]
        waits = self.behind[np.isin(self.behind['part'], which)]
        others: list[Behind] = [{'callback': name, 'ns': ns} for name, ns in zip(
            self.names_of(waits['callback']), waits['ns'].tolist())]
        first, until = (np.searchsorted(waits['part'], which, side) for side in ('left', 'right'))
        vertex, cause = parts['vertex'], parts['cause']
        found: list[MissPart] = [
            {'vertex': names[v], 'cause': PARTS[c], 'ns': ns, 'behind': others[begin:end]}
            for v, c, ns, begin, end in zip(*(
                each.tolist() for each in (vertex, cause, parts['ns'], first, until)))]
        at = np.flatnonzero(cause == SKIPPED)
        for i, job in zip(at.tolist(), self._never.waiting(
                vertex[at], parts['end'][at]).tolist()):
            found[i]['waiting_job'] = job
        at = np.flatnonzero(np.isin(cause, NO_MESSAGE))
        for i, topics in zip(at.tolist(), self._missing(
                vertex[at], self.found.misses['in_job'][parts['miss'][at]])):
            found[i]['topics'] = topics
        return found

    def _missing(self, vertices: Ints, jobs: Ints) -> list[list[str]]:
        """Return the topics whose messages vertices of jobs have not got."""
        found: list[list[str]] = [[] for _ in range(len(jobs))]
        for vertex in distinct(vertices).tolist():
            one, mine = self._task_set.vertices[vertex], np.flatnonzero(vertices == vertex)
            legs = [*legs_of(one, self._task_set.dags[one.dag].vertices)]
            if not one.callback.topics:
                continue
            got = [self._never.got(vertex, leg, jobs[mine]).tolist() for leg in range(len(legs))]
            for i, has in zip(mine.tolist(), zip(*got)):
                found[i] = sorted({
                    one.callback.topics[place] for (place, _), has_it in zip(legs, has)
                    if not has_it})
        return found

    def misses_of(self, verdicts: Table) -> Ints:
        """Return by verdict its row in ``found.misses``; -1: it is not a miss."""
        row, _ = equal_pairs(*(
            (each['sink'], each['job']) for each in (self.found.misses, verdicts)))
        return row

    def longest_behind(self) -> list[str]:
        """Return by miss the callback that it waited for longest; '' if it did not wait."""
        waits = self.behind[sort_by(self.behind['callback'])]   # the first of equal ones counts
        most = most_of(self.found.parts['miss'][waits['part']], waits['callback'], waits['ns'])
        found = [''] * len(self.found.misses)
        for miss, name in zip(most['group'].tolist(), self.names_of(most['value'])):
            found[miss] = name
        return found

    def worst(self) -> MissedJob | None:
        """Return the latest job; if none completed, the first miss."""
        every = self.found.misses
        if not len(every):
            return None
        deadline = np.array([*self._tables.sink_deadline, 0], dtype=np.int64)
        late = np.where(every['kind'] == SINK_LATE, every['until'] - every['release']
                        - deadline[every['sink']], -1)
        return self._jobs(late.argmax(keepdims=True))[0]

    def mostly(self) -> list[dict[str, Any]]:
        """
        Return by sink and cause the number of misses, and where most of their time went.

        ``ns`` is the mean time of the misses with this cause, ``vertex`` where most of it went,
        and ``behind`` the callback that they waited for longest, None if they did not wait.
        """
        missed, causes, parts, too_short = self.found
        n_causes = len(CAUSES)
        key = missed['sink'] * n_causes + causes
        of, kind, waits = parts['miss'], parts['cause'], self.behind
        counts = (kind == causes[of]) | (kind == SKIPPED) | (
            (kind == RAN_USUALLY) & (causes[of] == RAN_LONG) & too_short[of])
        at = most_of(key[of[counts]], parts['vertex'][counts], parts['ns'][counts])
        waits = waits[counts[waits['part']]]
        after = most_of(key[of[waits['part']]], waits['callback'], waits['ns'])
        where = {group: (value, total) for group, value, total in at.tolist()}
        behind = dict(zip(after['group'].tolist(), self.names_of(after['value'])))
        order = sort_by(key)
        begins, until = groups(key[order])
        keys, n, first = key[order[begins]], until - begins, order[begins]
        found, vertices = [], self._task_set.vertices
        in_order = sort_by(keys // n_causes, -n, first)
        for each, count in zip(keys[in_order].tolist(), n[in_order].tolist()):
            sink, cause = divmod(each, n_causes)
            vertex, total = where.get(each, (None, 0))
            found.append({
                'dag': self._task_set.dags[self._tables.dag_of[sink]].name,
                'sink': vertices[sink].name, 'cause': CAUSES[cause], 'missed': count,
                'ns': total // count,
                'vertex': None if vertex is None else vertices[vertex].name,
                'behind': behind.get(each)})
        return found


MOST = np.dtype([('group', 'i8'), ('value', 'i8'), ('total', 'i8')])
"""Columns: a group, the value with the largest sum in it, and the sum of all of its values."""


def most_of(group: Ints, value: Ints, amount: Ints) -> Table:
    """Return by group the value whose amounts have the largest sum; of equal ones the first."""
    if not len(group):
        return rows(MOST)
    order = sort_by(group, value)
    begins = np.flatnonzero(np.append(True, (np.diff(group[order]) != 0) | (
        np.diff(value[order]) != 0)))
    first, sums = order[begins], np.add.reduceat(amount[order], begins)
    rank = sort_by(group[first], -sums, first)
    begins, _ = groups(group[first[rank]])
    most = first[rank[begins]]
    return rows(MOST, len(most), group=group[most], value=value[most],
                total=np.add.reduceat(sums[rank], begins))


def medians(numbers: Any, times: Ints, count: int) -> Ints:
    """Return the median time of each of ``count`` numbers, exact to 3 %; 0 without times."""
    counts = np.zeros((count, 64 * _STEPS), dtype=np.int64)
    steps = (np.log2(np.maximum(times, 1)) * _STEPS).astype(np.int64)
    np.add.at(counts, (numbers, steps), 1)
    below = np.cumsum(counts, axis=1)
    middle = (2 * below >= below[:, -1:]).argmax(axis=1)
    found = np.exp2(np.minimum((middle + 0.5) / _STEPS, 62))    # 64 bits
    return np.where(below[:, -1] > 0, found, 0).astype(np.int64)


def _any_of(times: list[tuple[Ints, Ints]]) -> Spans:
    starts, ends = map(np.concatenate, zip(*times))
    return Spans(*crowded(starts, ends, 1))
