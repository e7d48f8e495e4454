# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Explains the missed deadlines of a run while it is played: see ``causes`` and ``stalls``.

Theory of operation
-------------------
A job waits behind callbacks that may end only after it, and what is usual is known late.  So what
happened is kept for a while, in blocks of ``BLOCK`` pieces, and a miss is explained when it is
``LATER_NS`` old, with the block before it and all that came since.  What is usual is counted over
the whole run so far.  A run of less than a block is explained as a whole.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any

from mddag_executor.core import POLICIES
from mddag_executor.core.state import SINK_LATE
from mddag_executor.core.tally import VERDICTS
from mddag_executor.replay.causes import (
    behind,
    CAUSES,
    delayed_by,
    find,
    Found,
    MACHINE,
    Never,
    P_CAUSE,
    P_MISS,
    P_NS,
    P_VERTEX,
    PARTS,
    Pool,
    RAN_LONG,
    RAN_USUALLY,
    to_explain,
    Usual,
)
from mddag_executor.replay.chains import (
    M_JOB,
    M_KIND,
    M_RELEASE,
    M_SINK,
    M_UNTIL,
    Misses,
)
from mddag_executor.replay.happenings import (
    Batch,
    COMPLETED,
    Ints,
    Observer,
    PUBLISHED,
    RAN,
    RELEASED,
    STARTED,
)
from mddag_executor.replay.judge import Judge
from mddag_executor.replay.own import OwnRun, STOP
from mddag_executor.replay.run import Run
from mddag_executor.replay.stalls import crowded, Spans, Stretch
from mddag_executor.replay.stalls import find as find_stalls
import numpy as np

BLOCK = 65_536
LATER_NS = 1_000_000_000
_NO_END = 2 ** 62
_MOST_DROPS = 1_000_000
# What is kept, and how many columns it has.
_PIECES, _TOOK, _RELEASED, _STARTED, _TIMES, _STOPS, _HELD = range(7)
_WIDTHS = (5, 3, 3, 4, 1, 2, 2)
# Columns of pieces.
_CALLBACK, _VERTEX, _WORKER, _START, _END = range(5)     # worker -1: it lent its worker


class Typical:
    """Medians of many times, by number of what they are of; exact to 3 %."""

    _STEPS = 32     # an octave

    def __init__(self, count: int) -> None:
        self._counts = np.zeros((count, 64 * self._STEPS), dtype=np.int64)

    def add(self, numbers: Ints, times: Ints) -> None:
        """Add times, ns."""
        steps = (np.log2(np.maximum(times, 1)) * self._STEPS).astype(np.int64)
        np.add.at(self._counts, (numbers, steps), 1)

    def medians(self) -> Ints:
        """Return the medians; 0 where there is no time."""
        below = np.cumsum(self._counts, axis=1)
        middle = (2 * below >= below[:, -1:]).argmax(axis=1)
        return np.where(below[:, -1] > 0, np.exp2((middle + 0.5) / self._STEPS), 0).astype(
            np.int64)


class Explainer(Observer):
    """
    Finds out why deadlines were missed; comes after the judge.

    :param jobs: whether to keep what is found of each job; else causes are counted only.
    """

    def __init__(self, run: Run, judge: Judge, jobs: bool = False) -> None:
        task_set = run.task_set
        self._task_set, self._tables = task_set, judge.tables
        self._chains = judge.chains
        self._chains.keeps_misses = True
        self._who = run.who
        self._keeps = jobs
        policy = POLICIES.get(run.head.policy)
        # of several processes it is not known whose workers were busy
        self._workers = run.head.workers if isinstance(run, OwnRun) and run.processes == 1 \
            and not (policy is not None and policy.polling) else 0
        vertices = task_set.vertices
        self._place = np.array([*task_set.places_of_vertices(), 0], dtype=np.int64)
        longest = [_NO_END if v.callback.execution_time is None
                   else v.callback.execution_time.quantiles_ns[-1] for v in vertices]
        self._longest = np.array([*longest, 0], dtype=np.int64)
        self._is_source = np.array([not v.predecessors for v in vertices] + [False])
        self._is_timer = np.array(
            [d.vertices[d.source].callback.kind == 'timer' for d in task_set.dags] + [False])
        self._runs = Typical(len(task_set.callbacks) + 1)
        self._cpu = Typical(len(task_set.callbacks) + 1)
        self._lags = Typical(len(task_set.dags) + 1)
        self._kept: list[list[Ints]] = [[] for _ in _WIDTHS]
        self._n_new = 0
        self._misses: list[Misses] = []
        self._dropped: dict[tuple[int, int], str] = {}
        self._vertex_of: dict[int, int] = {}
        self._until = self._since = -_NO_END
        self._noticed = _NO_END     # from then on stops are recorded
        #: Begin and end of each stall so far.
        self.stalls: list[tuple[int, int]] = []
        self._found: list[tuple[Found, dict[int, list[tuple[int, int]]]]] = []
        # by sink and cause how many, and by stall
        self._counts = np.zeros((len(vertices) + 1, len(CAUSES)), dtype=np.int64)
        self._in_stalls: dict[tuple[int, int], int] = {}

    # --- input -----------------------------------------------------------------------------------

    def was_dropped(self, vertex: int, job: int, reason: str) -> None:
        """Keep why it was dropped."""
        self._dropped[vertex, job] = reason
        if len(self._dropped) > _MOST_DROPS:
            del self._dropped[next(iter(self._dropped))]

    def take(self, batch: Batch) -> None:
        """Keep what is needed to explain misses; explain a block's."""
        pieces, done, started = (batch.columns(kind) for kind in (RAN, COMPLETED, STARTED))
        done = done[done[:, 10] >= 0]
        released = batch.columns(RELEASED)
        self._keep(_PIECES, pieces[:, [0, 2, 4, 6, 7]])
        # of a sync the last message makes it run; the others are only kept
        last = done[done[:, 4] != 0]
        self._keep(_TOOK, np.column_stack((last[:, 1], last[:, 8] - last[:, 7], last[:, 11])))
        self._keep(_HELD, done[done[:, 12] != 0, 7:9])
        self._keep(_RELEASED, released[:, [0, 2, 3]])
        self._keep(_STARTED, started[:, 1:5])
        self._keep(_TIMES, np.concatenate([
            pieces[:, 6], pieces[:, 7], started[:, 3], started[:, 4], released[:, 3],
            done[:, 5], batch.columns(PUBLISHED)[:, 6]]).reshape(-1, 1))
        if STOP in batch.events:
            stops = batch.events[STOP][1][:, -2:]
            self._keep(_STOPS, stops)
            self._noticed = min(self._noticed, int(stops[:, 1].min()))
        if len(self._chains.misses.rows):
            self._misses.append(self._chains.misses)
        self._n_new += len(pieces)
        if self._n_new >= BLOCK:
            self._explain(int(pieces[:, 7].max()) - LATER_NS)

    def _keep(self, what: int, rows: Ints) -> None:
        if len(rows):
            self._kept[what].append(rows)

    def _table(self, what: int) -> Ints:
        """Return the rows that are kept of a kind, as one array."""
        kept = self._kept[what]
        if not kept:
            return np.empty((0, _WIDTHS[what]), dtype=np.int64)
        if len(kept) > 1:
            kept[:] = [np.concatenate(kept)]
        return kept[0]

    # --- explaining ------------------------------------------------------------------------------

    def finish(self) -> None:
        """Explain what is left, once the run is over."""
        self._explain(_NO_END)

    def _explain(self, until: int) -> None:
        """Explain the misses up to a time."""
        self._n_new = 0
        took, released = self._table(_TOOK), self._table(_RELEASED)
        self._runs.add(self._place[took[:, 0]], took[:, 1])
        known = took[took[:, 2] >= 0]
        self._cpu.add(self._place[known[:, 0]], known[:, 2])
        self._lags.add(released[:, 0], released[:, 2] - released[:, 1])
        self._kept[_TOOK].clear()
        usual = Usual(np.minimum(self._runs.medians()[self._place], self._longest),
                      self._cpu.medians()[self._place], self._lags.medians())
        pieces = self._table(_PIECES)
        if len(pieces):
            self._look_for_stalls(pieces, usual, until)
        due = [each for each in self._misses if each.rows[:, M_UNTIL].max() <= until]
        self._misses = [each for each in self._misses if each.rows[:, M_UNTIL].max() > until]
        if due:
            self._one(Misses(*(np.concatenate(each) for each in zip(*due))), pieces, usual)
        self._forget(until)

    def _look_for_stalls(self, pieces: Ints, usual: Usual, until: int) -> None:
        released, times = self._table(_RELEASED), self._table(_TIMES)
        more = np.where(
            pieces[:, _VERTEX] >= 0,
            pieces[:, _END] - pieces[:, _START] - usual.runs[pieces[:, _VERTEX]], 0)
        self.stalls += find_stalls(Stretch(
            times[:, 0], released[self._is_timer[released[:, 0]], 1:],
            self._table(_STARTED)[:, 2:],
            np.column_stack((pieces[:, [_START, _END]], more)), self._table(_STOPS),
            self._noticed), self._until, until)
        self._until = until

    def _one(self, misses: Misses, pieces: Ints, usual: Usual) -> None:
        """Explain some misses, and count their causes."""
        start, end = pieces[pieces[:, _WORKER] >= 0][:, [_START, _END]].T
        first = min(pieces[:, _START].min(initial=_NO_END), misses.rows[:, M_RELEASE].min())
        since, held = self._table(_HELD).T
        pool = Pool(
            Spans(*crowded(start, end, max(1, self._workers))),
            Spans(*(crowded(since, held, 1) if len(held) else crowded(start, end, 1))),
            Spans(*crowded(since, held, 2)),
            [stall for stall in self.stalls if stall[1] >= first],
            self._workers > 0)
        found = find(
            misses, pool, usual, Never(self._dropped, self._table(_STARTED)),
            np.array([*self._tables.dag_of, 0], dtype=np.int64),
            np.array([*self._tables.sink_deadline, 0], dtype=np.int64), self._is_source)
        rows = found.misses
        np.add.at(self._counts, (rows[:, M_SINK], found.causes), 1)
        machine = found.causes == MACHINE
        for stall in sorted(pool.stalls, key=lambda stall: stall[0] - stall[1]):    # longest first
            mine = machine & delayed_by(rows, stall)
            machine &= ~mine    # each miss counts once
            self._in_stalls[stall] = self._in_stalls.get(stall, 0) + int(mine.sum())
        if self._keeps:
            self._found.append((found, self._behind(found, pieces)))

    def _behind(self, found: Found, pieces: Ints) -> dict[int, list[tuple[int, int]]]:
        chosen = to_explain(found)
        if not len(chosen):
            return {}
        declared = pieces[pieces[:, _VERTEX] >= 0]
        for callback, vertex in np.unique(declared[:, :2], axis=0).tolist():
            self._vertex_of[callback] = vertex
        of_vertex = {vertex: callback for callback, vertex in self._vertex_of.items()}
        groups = self._who.groups

        def same_group(vertex: int, callback: int) -> bool:
            return groups.get(of_vertex.get(vertex, 0), -1) == groups.get(callback, -2)

        callbacks, which = np.unique(pieces[:, _CALLBACK], return_inverse=True)
        order = np.argsort(which, kind='stable')
        borders = np.searchsorted(which[order], np.arange(len(callbacks) + 1)).tolist()
        runs, on_workers = {}, {}
        for callback, first, last in zip(callbacks.tolist(), borders, borders[1:]):
            mine = pieces[order[first:last]]
            runs[callback] = on_workers[callback] = Spans(mine[:, _START], mine[:, _END])
            if (mine[:, _WORKER] < 0).any():
                mine = mine[mine[:, _WORKER] >= 0]
                on_workers[callback] = Spans(mine[:, _START], mine[:, _END])
        return behind(found.parts, chosen, runs, on_workers, same_group)

    def _forget(self, until: int) -> None:
        """Forget what is older than the block before."""
        since, self._since = self._since, until
        for what, column in ((_PIECES, _END), (_RELEASED, 2), (_STARTED, 3), (_TIMES, 0),
                             (_STOPS, 1), (_HELD, 1)):
            rows = self._table(what)
            self._kept[what] = [rows[rows[:, column] >= since]]

    # --- results ---------------------------------------------------------------------------------

    def summary(self) -> dict[str, Any]:
        """Return how many misses there are of each cause, in all and by sink, and the stalls."""
        names = [v.name for v in self._task_set.vertices]
        return {
            'missed': int(self._counts.sum()),
            'causes': dict(zip(CAUSES, self._counts.sum(axis=0).tolist())),
            'sinks': {names[v]: dict(zip(CAUSES, self._counts[v].tolist()))
                      for v in self._tables.sinks if self._counts[v].any()},
            'stalls': [{'at_ns': begin, 'length_ns': end - begin,
                        'misses': self._in_stalls.get((begin, end), 0)}
                       for begin, end in self.stalls]}

    def result(self, sink: int | None = None, job: int | None = None) -> dict[str, Any]:
        """
        Return the result format of ``explain --json``.

        :param sink: the global vertex of the only sink whose jobs are wanted.
        :param job: the only job.
        """
        jobs = [each for found, waited in self._found
                for each in self._jobs(found, waited, sink, job)]
        return {**self.summary(), 'jobs': jobs}

    def _jobs(
        self, found: Found, waited: dict[int, list[tuple[int, int]]], sink: int | None,
        job: int | None,
    ) -> Iterator[dict[str, Any]]:
        rows = found.misses
        wanted = np.ones(len(rows), dtype=np.bool_)
        for column, value in ((M_SINK, sink), (M_JOB, job)):
            if value is not None:
                wanted &= rows[:, column] == value
        first = np.searchsorted(found.parts[:, P_MISS], np.arange(len(rows) + 1)).tolist()
        parts, causes = found.parts.tolist(), found.causes.tolist()
        vertices, names = self._task_set.vertices, self._names()
        for miss in np.flatnonzero(wanted).tolist():
            kind, vertex, number, release, until, *_ = rows[miss].tolist()
            deadline = self._tables.sink_deadline[vertex]
            yield {
                'dag': self._task_set.dags[self._tables.dag_of[vertex]].name, 'job': number,
                'sink': vertices[vertex].name, 'verdict': VERDICTS[kind],
                'release_ns': release, 'deadline_ns': release + deadline, 'until_ns': until,
                'late_ns': until - release - deadline if kind == SINK_LATE else None,
                'cause': CAUSES[causes[miss]], 'parts': [
                    self._part(parts[i], waited.get(i, ()), names)
                    for i in range(first[miss], first[miss + 1])]}

    def _part(
        self, part: list[int], waited: Iterable[tuple[int, int]], names: dict[int, str]
    ) -> dict[str, Any]:
        return {
            'vertex': self._task_set.vertices[part[P_VERTEX]].name, 'cause': PARTS[part[P_CAUSE]],
            'ns': part[P_NS], 'behind': [
                {'callback': names[callback], 'ns': took} for callback, took in waited]}

    def _names(self) -> dict[int, str]:
        """Return what the callbacks are called behind which something waited."""
        vertices = self._task_set.vertices
        addresses = {callback for _, waited in self._found for each in waited.values()
                     for callback, _ in each}
        return {
            address: vertices[self._vertex_of[address]].callback.key
            if address in self._vertex_of else self._who.name(address) for address in addresses}

    def worst(self) -> dict[str, Any] | None:
        """Return the job that was most late; of those that never completed, the first."""
        rows = [found.misses for found, _ in self._found]
        if not rows:
            return None
        every = np.concatenate(rows)
        deadline = np.array([*self._tables.sink_deadline, 0], dtype=np.int64)
        late = np.where(every[:, M_KIND] == SINK_LATE, every[:, M_UNTIL] - every[:, M_RELEASE]
                        - deadline[every[:, M_SINK]], -1)
        sink, job = every[late.argmax(), [M_SINK, M_JOB]].tolist()
        jobs: list[dict[str, Any]] = self.result(sink, job)['jobs']
        return jobs[0]

    def mostly(self) -> list[dict[str, Any]]:
        """
        Return for each sink and cause how many misses, and where most of that time went.

        ``ns`` is the mean time of the misses with that cause, ``vertex`` where most of it went,
        ``behind`` the callback behind which they waited longest, None where they did not wait.
        """
        counts: Counter[tuple[int, int]] = Counter()
        at: dict[tuple[int, int], Counter[int]] = {}
        after: dict[tuple[int, int], Counter[int]] = {}
        for found, waited in self._found:
            sinks = found.misses[:, M_SINK].tolist()
            causes = found.causes.tolist()
            counts.update(zip(sinks, causes))
            of, kind = found.parts[:, P_MISS], found.parts[:, P_CAUSE]
            cause = found.causes[of]
            mine = np.flatnonzero((kind == cause) | (
                (kind == RAN_USUALLY) & (cause == RAN_LONG) & found.too_short[of]))
            for i, part in zip(mine.tolist(), found.parts[mine].tolist()):
                key = sinks[part[P_MISS]], causes[part[P_MISS]]
                at.setdefault(key, Counter())[part[P_VERTEX]] += part[P_NS]
                for callback, took in waited.get(i, ()):
                    after.setdefault(key, Counter())[callback] += took
        names, vertices = self._names(), self._task_set.vertices
        return [{
            'dag': self._task_set.dags[self._tables.dag_of[sink]].name,
            'sink': vertices[sink].name, 'cause': CAUSES[cause], 'missed': n,
            'ns': sum(at.get(key, {}).values()) // n,
            'vertex': vertices[max(at[key], key=at[key].__getitem__)].name if key in at else None,
            'behind': names[max(after[key], key=after[key].__getitem__)] if key in after else None}
            for key, n in sorted(counts.items(), key=lambda item: (item[0][0], -item[1]))
            for sink, cause in [key]]
