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

from collections import Counter, defaultdict
from collections.abc import Iterator
from functools import cached_property
from typing import Any, TYPE_CHECKING

from mddag_executor.analysis.causes import (
    behind,
    Busy,
    CAUSES,
    delayed_by,
    find,
    HANGS_NS,
    MACHINE,
    Members,
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
)
from mddag_executor.analysis.chains import Chains, LINKS
from mddag_executor.analysis.deadlines import Judged
from mddag_executor.analysis.spans import crowded, Spans
from mddag_executor.analysis.usage import in_groups, ran
from mddag_executor.core import legs_of
from mddag_executor.core.policies import SIMULATED_ONLY
from mddag_executor.core.state import SINK_LATE
from mddag_executor.core.stops import LEAST_NS
from mddag_executor.core.tally import VERDICTS
from mddag_executor.recording.columns import concatenate, in_parts, Ints, Mask, rows, Table
from mddag_executor.recording.joins import different, distinct, rows_by, sort_by
from mddag_executor.recording.recording import Recording
from mddag_executor.recording.tables import VERTEX
from msg_graph.model import topological_order
import numpy as np

if TYPE_CHECKING:
    from mddag_executor.results.replays import (
        ExplainResult,
        ExplainResultRare,
        LatePath,
        MissedJob,
        Misses,
        MissPart,
    )

_NO_END = 2 ** 62
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
        # of each process
        self._workers = 0 if run.imported or run.head.policy in SIMULATED_ONLY else (
            run.head.workers if run.processes == 1 else run.workers_each)
        # where callbacks may delay each other: of another executor it is not known which threads
        # share its work
        self._place = self._executions['worker' if run.imported else 'process'].astype(
            np.int64)
        #: Begin and end of each stop of the machine.
        self.stops = self._stops()
        self._to_sinks: dict[int, dict[int, int]] = {}
        missed, links = self._missed(judged, chains)
        pool, usual = self._pool(missed), self._usual()
        missed['outranked'] = self._outranked(missed, links, usual)
        self._never = Never(
            *self._dropped(), self._started(chains.waited), self._unpublished(missed))
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
        demoted = {(vertex, job): time for vertex, job, time in zip(*(
            self._recording.demotions[name].tolist() for name in ('vertex', 'job', 'time')))}
        missed['demoted'] = [demoted.get(key, _NO_END) for key in zip(
            missed['sink'].tolist(), missed['job'].tolist())]
        links: list[Table] = []
        for dag in distinct(verdicts['dag']).tolist():
            mine = np.flatnonzero(verdicts['dag'] == dag)
            at, of_dag = chains.of_misses(dag, verdicts[mine])
            missed['at'][mine] = at
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
        threads = {
            thread: Spans(*crowded(table['start'][each], table['end'][each], 1))
            for thread in distinct(self._place[rows]).tolist()
            for each in [rows[self._place[rows] == thread]]
        } if imported else None
        hangs, blocked = self._hangs()
        return Pool(
            {-1: self._busy(rows, hangs)} if imported else {
                place: self._busy(rows[self._place[rows] == place], hangs)
                for place in {*([0] if one else ()), *distinct(self._place[rows]).tolist()}},
            [stop for stop in self.stops if stop[1] >= first], self._workers > 0,
            self._place, of_vertex, threads, hangs, blocked, self._busy_programs(),
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
        known = set(unfinished[['callback', 'start']].tolist())
        mine = mine[[key in known for key in table[['callback', 'start']][mine].tolist()]]
        found[mine] = True
        group = np.array([self._who.groups.get(each, -1)
                          for each in table['callback'][mine].tolist()], dtype=np.int64)
        return found, {vertex: Spans(table['start'][members], table['end'][members])
                       for vertex, of in self._groups.items() if of >= 0
                       and len(members := mine[group == of])}

    def _busy_programs(self) -> dict[int, Spans]:
        """Return by vertex when callbacks of its program ran, if that runs one at a time."""
        spans = {number: Spans(*crowded(runs['start'], runs['end'], 1))
                 for number, runs in self._recording.runs_of_programs().items()}
        return {vertex: spans[number]
                for vertex, number in self._by_vertex(self._who.programs).items()
                if number in spans}

    def _busy(self, rows: Ints, hangs: Mask) -> Busy:
        """Return when executions occupied all workers, and when they may have held the GIL."""
        table = self._executions
        on_workers = rows[table['worker'][rows] >= 0]
        start, end = table['start'][on_workers], table['end'][on_workers]
        # callbacks that ran undeclared may also have held it: a trace does not say
        holding = rows[(table['holds_gil'][rows] & (table['completes'][rows] > 0))
                       | (table['vertex'][rows] < 0)
                       | (hangs & (table['worker'] >= 0))[rows]
                       ] if self._recording.run.declared else rows
        since, until = table['began'][holding], table['end'][holding]
        return Busy(
            Spans(*crowded(start, end, max(1, self._workers))),
            Spans(*(crowded(since, until, 1) if len(holding) else crowded(start, end, 1))),
            Spans(*crowded(since, until, 2)))

    def _answers(self) -> Mask:
        """Return which executions of driven syncs messages of other topics started."""
        driven = {v: each.callback.driven_by for v, each in enumerate(self._task_set.vertices)
                  if each.callback.driven_by is not None}
        found = np.zeros(len(self._executions), dtype=np.bool_)
        mine = np.flatnonzero(np.isin(self._executions['vertex'], [*driven]))
        topic = self._recording.names.topic
        found[mine] = [topic(callback) not in ('', driven[vertex]) for vertex, callback in zip(
            *(self._executions[name][mine].tolist() for name in ('vertex', 'callback')))]
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
        for miss in np.flatnonzero(found).tolist():
            sink, release, demoted = (
                int(missed[name][miss]) for name in ('sink', 'release', 'demoted'))
            left = release + self._tables.sink_deadline[sink] - demoted
            needed = self._longest(usual.runs, sink).get(int(at[miss]), 0)
            found[miss] = left > needed + max(_ROUGHLY_NS, needed // 4)
        return found

    def _longest(self, runs: Ints, sink: int) -> dict[int, int]:
        """Return by vertex that leads to a sink the usual time until the sink is completed."""
        if sink not in self._to_sinks:
            dag = self._task_set.dags[self._tables.dag_of[sink]]
            first, found = self._tables.first_vertex[dag.index], dict[int, int]()
            for v in reversed(topological_order(dag)):
                after = [found[first + each] for each in dag.vertices[v].successors
                         if first + each in found]
                if first + v == sink or after:
                    found[first + v] = int(runs[first + v]) + max(after, default=0)
            self._to_sinks[sink] = found
        return self._to_sinks[sink]

    def _dropped(self) -> tuple[dict[tuple[int, int], tuple[str, int]], dict[int, Ints]]:
        """Return why and when executions were dropped, by vertex and job; and without a job."""
        drops, reasons = self._recording.drops, self._recording.names.drop_reasons
        place = np.array([*self._task_set.places_of_vertices(), -1])
        without = drops[(drops['job'] < 0) & (drops['vertex'] >= 0)]
        of = place[without['vertex']]
        return {(vertex, job): (reasons[reason], time) for vertex, job, reason, time in zip(
            *(drops[name].tolist() for name in ('vertex', 'job', 'reason', 'time')))}, {
            vertex: np.sort(without['time'][of == place[vertex]])
            for vertex in np.flatnonzero(np.isin(place[:-1], of)).tolist()}

    def _unpublished(self, missed: Table) -> set[tuple[int, int]]:
        """
        Return by vertex and job the callbacks that lack a message which was not published.

        The callback before completed in this job and did not publish the topic.
        """
        recording, table = self._recording, self._executions
        if not recording.names.publishers:
            return set()    # a simulated run: its callbacks always publish
        wanted = {(vertex, job) for vertex, job in zip(
            missed['at'].tolist(), missed['job'].tolist())}
        legs = {vertex: self._topics(vertex) for vertex, _ in wanted}
        before = {publisher for each in legs.values() for publisher, _ in each}
        of = np.flatnonzero(np.isin(table['vertex'], list(before)))
        completed = set(zip(*(table[name][of[table['completes'][of] == VERTEX]].tolist()
                              for name in ('vertex', 'job'))))
        sent = recording.publications
        sent = sent[np.isin(sent['execution'], of)]
        published: defaultdict[tuple[int, int], set[str]] = defaultdict(set)
        for vertex, job, number in zip(*(
                table[name][sent['execution']].tolist() for name in ('vertex', 'job')),
                sent['publisher'].tolist()):
            publisher = recording.names.publishers.get(number)
            published[vertex, job].add('' if publisher is None else publisher.topic)
        return {(vertex, job) for vertex, job in wanted for publisher, topic in legs[vertex]
                if (publisher, job) in completed and topic not in published[publisher, job]
                and '' not in published[publisher, job]}

    def _topics(self, vertex: int) -> list[tuple[int, str]]:
        """Return the vertices that publish for a vertex, and the topic of each."""
        one = self._task_set.vertices[vertex]
        first = self._tables.first_vertex[one.dag]
        return [(first + before, one.callback.topics[place]) for place, before in legs_of(
            one, self._task_set.dags[one.dag].vertices) if one.callback.topics]

    def _started(self, in_group: Ints) -> Table:
        """Return the executions that were started, and sources that waited until a drop."""
        recording, table = self._recording, self._executions
        which = np.flatnonzero((table['vertex'] >= 0) & (table['start'] >= 0))
        started = rows(STARTED, len(which), group=in_group[which], **{
            name: table[name][which] for name in ('vertex', 'leg', 'job', 'ready', 'start')})
        dropped = {
            (self._tables.dag_of[vertex], job): (vertex, time)
            for _, vertex, job, time, reason in recording.drops.tolist()
            if recording.names.drop_reasons[reason] in ('aborted', 'newer')
            and not self._task_set.vertices[vertex].predecessors}
        if not dropped:
            return started
        # a release that was skipped at the time of the abort was skipped before it
        waited = [(vertex, job, noticed, time + 1) for dag, job, noticed in zip(*(
            recording.releases[name].tolist() for name in ('dag', 'job', 'noticed')))
            if (dag, job) in dropped for vertex, time in [dropped[dag, job]]]
        sources = rows(STARTED, len(waited), **dict(zip(
            ('vertex', 'job', 'ready', 'start'), zip(*waited))))
        sources['group'] = self._in_groups(sources)
        return concatenate([started, sources])

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
    def _waited(self) -> dict[int, list[tuple[int, int]]]:
        """Return by part of a miss the callbacks that it waited for, and how long."""
        table, rows = self._executions, self._rows
        callbacks, which = different(table['callback'][rows])
        runs, on_workers = {}, {}
        for callback, at in zip(callbacks.tolist(), rows_by(which, len(callbacks))):
            places = self._place[rows[at]]
            for place in distinct(places).tolist():
                mine = rows[at[places == place]]
                runs[callback, place], on_workers[callback, place] = (
                    Spans(table['start'][each], table['end'][each])
                    for each in (mine, mine[table['worker'][mine] >= 0]))
        return behind(self.found, runs, on_workers, *(Members(self._by_vertex(of), of) for of in (
            self._who.groups, self._who.programs)))

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

    @cached_property
    def _names(self) -> dict[int, str]:
        """Return the names of the callbacks that others waited for."""
        vertices, ran_as = self._task_set.vertices, self._vertices
        callbacks = {callback for each in self._waited.values() for callback, _ in each}
        return {
            callback: vertices[ran_as[callback]].callback.key if callback in ran_as
            else self._who.name(callback) for callback in callbacks}

    # --- results ---------------------------------------------------------------------------------

    def summary(self) -> Misses:
        """Return the number of misses by cause, in total and by sink, and the stops."""
        names = [v.name for v in self._task_set.vertices]
        return {
            'missed': int(self._counts.sum()),
            'causes': dict(zip(CAUSES, self._counts.sum(axis=0).tolist())),
            'sinks': {names[v]: dict(zip(CAUSES, self._counts[v].tolist()))
                      for v in self._tables.sinks if self._counts[v].any()},
            'stalls': [{'at_ns': begin, 'length_ns': end - begin,
                        'misses': self._in_stops[begin, end]} for begin, end in self.stops]}

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
        return {**self.summary(), 'jobs': list(self._jobs(sink, job)), **more}

    def _jobs(self, sink: int | None, job: int | None) -> Iterator[MissedJob]:
        missed, parts = self.found.misses, self.found.parts
        wanted = np.ones(len(missed), dtype=np.bool_)
        for column, value in (('sink', sink), ('job', job)):
            if value is not None:
                wanted &= missed[column] == value
        if not wanted.any():
            return
        first = np.searchsorted(parts['miss'], np.arange(len(missed) + 1)).tolist()
        vertices = self._task_set.vertices
        for miss in np.flatnonzero(wanted).tolist():
            kind, vertex, number, release, until, *_ = missed[miss].item()
            deadline = self._tables.sink_deadline[vertex]
            yield {
                'dag': self._task_set.dags[self._tables.dag_of[vertex]].name, 'job': number,
                'sink': vertices[vertex].name, 'verdict': VERDICTS[kind],
                'release_ns': release, 'deadline_ns': release + deadline, 'until_ns': until,
                'late_ns': until - release - deadline if kind == SINK_LATE else None,
                'cause': CAUSES[self.found.causes[miss]], 'parts': [
                    self._part(i, number)
                    for i in range(first[miss], first[miss + 1])]}

    def _part(self, place: int, job: int) -> MissPart:
        part = self.found.parts[place]
        found: MissPart = {
            'vertex': self._task_set.vertices[int(part['vertex'])].name,
            'cause': PARTS[part['cause']], 'ns': int(part['ns']), 'behind': [
                {'callback': self._names[callback], 'ns': took}
                for callback, took in self._waited.get(place, ())]}
        if part['cause'] == SKIPPED:
            found['waiting_job'] = int(self._never.waiting(
                part['vertex'][None], part['end'][None])[0])
        if part['cause'] in NO_MESSAGE:
            found['topics'] = self._missing(int(part['vertex']), job)
        return found

    def _missing(self, vertex: int, job: int) -> list[str]:
        """Return the topics whose messages a vertex of a job has not got."""
        one, started = self._task_set.vertices[vertex], self._never.started
        got = set(started['leg'][(started['vertex'] == vertex) & (started['job'] == job)].tolist())
        legs = legs_of(one, self._task_set.dags[one.dag].vertices)
        return sorted({one.callback.topics[place] for leg, (place, _) in enumerate(legs)
                       if leg not in got and one.callback.topics})

    def behind(self) -> dict[int, list[tuple[str, int]]]:
        """Return by part of a miss the callbacks that ran while it waited, and how long, ns."""
        return {part: [(self._names[callback], took) for callback, took in waits]
                for part, waits in sorted(self._waited.items())}

    def causes(self) -> dict[tuple[int, int], str]:
        """Return the cause of each miss, by global vertex of the sink and job."""
        missed = self.found.misses
        return {(sink, job): CAUSES[cause] for sink, job, cause in zip(
            missed['sink'].tolist(), missed['job'].tolist(), self.found.causes.tolist())}

    def longest_behind(self) -> dict[tuple[int, int], str]:
        """Return by sink and job the callback that the miss waited for longest, if it waited."""
        waits: defaultdict[int, Counter[int]] = defaultdict(Counter)
        of = self.found.parts['miss']
        for part, callbacks in self._waited.items():
            for callback, took in callbacks:
                waits[int(of[part])][callback] += took
        missed = self.found.misses
        return {(int(missed['sink'][miss]), int(missed['job'][miss])):
                self._names[max(took, key=lambda callback: (took[callback], -callback))]
                for miss, took in waits.items()}

    def worst(self) -> MissedJob | None:
        """Return the latest job; if none completed, the first miss."""
        every = self.found.misses
        if not len(every):
            return None
        deadline = np.array([*self._tables.sink_deadline, 0], dtype=np.int64)
        late = np.where(every['kind'] == SINK_LATE, every['until'] - every['release']
                        - deadline[every['sink']], -1)
        worst = every[late.argmax()]
        return next(self._jobs(int(worst['sink']), int(worst['job'])))

    def mostly(self) -> list[dict[str, Any]]:
        """
        Return by sink and cause the number of misses, and where most of their time went.

        ``ns`` is the mean time of the misses with this cause, ``vertex`` where most of it went,
        and ``behind`` the callback that they waited for longest, None if they did not wait.
        """
        at: defaultdict[tuple[int, int], Counter[int]] = defaultdict(Counter)
        after: defaultdict[tuple[int, int], Counter[int]] = defaultdict(Counter)
        missed, causes, parts, too_short = self.found
        sinks, cause_of = missed['sink'].tolist(), causes.tolist()
        of, kind = parts['miss'], parts['cause']
        mine = np.flatnonzero((kind == causes[of]) | (kind == SKIPPED) | (
            (kind == RAN_USUALLY) & (causes[of] == RAN_LONG) & too_short[of]))
        for i, miss, vertex, ns in zip(mine.tolist(), *(
                parts[name][mine].tolist() for name in ('miss', 'vertex', 'ns'))):
            key = sinks[miss], cause_of[miss]
            at[key][vertex] += ns
            for callback, took in self._waited.get(i, ()):
                after[key][callback] += took
        found, vertices = [], self._task_set.vertices
        for key, n in sorted(Counter(zip(sinks, cause_of)).items(),
                             key=lambda item: (item[0][0], -item[1])):
            sink, cause = key
            where, waited = (each[key].most_common(1) for each in (at, after))
            found.append({
                'dag': self._task_set.dags[self._tables.dag_of[sink]].name,
                'sink': vertices[sink].name, 'cause': CAUSES[cause], 'missed': n,
                'ns': at[key].total() // n,
                'vertex': vertices[where[0][0]].name if where else None,
                'behind': self._names[waited[0][0]] if waited else None})
        return found


def medians(numbers: Any, times: Ints, count: int) -> Ints:
    """Return the median time of each of ``count`` numbers, exact to 3 %; 0 without times."""
    counts = np.zeros((count, 64 * _STEPS), dtype=np.int64)
    steps = (np.log2(np.maximum(times, 1)) * _STEPS).astype(np.int64)
    np.add.at(counts, (numbers, steps), 1)
    below = np.cumsum(counts, axis=1)
    middle = (2 * below >= below[:, -1:]).argmax(axis=1)
    found = np.exp2(np.minimum((middle + 0.5) / _STEPS, 62))    # 64 bits
    return np.where(below[:, -1] > 0, found, 0).astype(np.int64)
