# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Numbers the jobs of one run whose processes have each numbered their own releases."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from mddag_executor.recording.columns import Ints, Mask, Table
from mddag_executor.recording.joins import rows_by, sort_by
from mddag_executor.recording.tables import UNKNOWN
from msg_graph import Dag, TaskSet
import numpy as np

SAME_RELEASE = 100_000
"""Releases of two processes that differ by at most so much, ns, may be of one job."""
_KEPT = 1024
"""This many last jobs of a DAG are compared with a release."""

Hosted = tuple[int, int, frozenset[int]]
"""A change of the vertices of a DAG that a process runs: position in its order, DAG, vertices."""


class Released(NamedTuple):
    """
    The releases of a process.

    :ivar releases: by time; ``seen_at``: the times of its events, by position in the order.
    :ivar hosted: which vertices it runs, see ``Run.hosted``.
    :ivar machine: number of its machine; ``shift``: what was added to its times, ns.
    """

    releases: Table
    seen_at: Ints
    hosted: Sequence[Hosted]
    machine: int
    shift: int


class Numbered(NamedTuple):
    """
    The jobs of the releases of a process.

    :ivar number: by release the number of its job; ``release``: its time.
    :ivar is_first: whether no other process released the job before.
    :ivar expected: the number of legs that the process has to complete.
    """

    number: Ints
    release: Ints
    is_first: Mask
    expected: Ints


_At = tuple[int, int, int]
"""When an event happened: time, process, position in its order."""


class _Changes:
    """The changes of the vertices of a DAG that processes run, in the order of all events."""

    def __init__(self) -> None:
        self._changes: list[tuple[_At, frozenset[int]]] = []

    def add(self, at: _At, vertices: frozenset[int]) -> None:
        """Add the next change."""
        self._changes.append((at, vertices))

    def times(self, place: int | None = None) -> list[_At]:
        """Return when the vertices change (in one process)."""
        return [at for at, _ in self._changes if place in (None, at[1])]

    def state(self, until: _At | None) -> dict[int, frozenset[int]]:
        """Return by process the vertices that it runs after some change; None: before all."""
        return {} if until is None else {
            at[1]: vertices for at, vertices in self._changes if at <= until}


class JoinedJobs:
    """
    The jobs of a run of several processes (rules 3 and 4 of ``joining``).

    :param legs: by vertex the number of its legs.
    :ivar numbered: by process its releases.
    :ivar hosted: the process and position of each change, and the DAG's vertices in all processes.
    """

    def __init__(self, task_set: TaskSet, processes: Sequence[Released], legs: Ints) -> None:
        self._processes, self._legs = processes, legs
        self._first = np.cumsum([0, *(len(dag.vertices) for dag in task_set.dags)]).tolist()
        self._changes = [_Changes() for _ in task_set.dags]
        self.hosted: list[tuple[int, int, int, frozenset[int]]] = []
        for time, place, order, of, vertices in sorted(
                (int(each.seen_at[hosted[0]]), place, *hosted)
                for place, each in enumerate(processes) for hosted in each.hosted):
            changes = self._changes[of]
            changes.add((time, place, order), vertices)
            self.hosted.append((place, order, of, frozenset[int]().union(
                *changes.state((time, place, order)).values())))
        counts = [len(each.releases) for each in processes]
        self._place = np.repeat(np.arange(len(processes)), counts)
        self._order, self._dag, self._release, noticed = (
            np.concatenate([each.releases[name] for each in processes])
            for name in ('order', 'dag', 'release', 'noticed'))
        #: By release when the core of its process saw it.
        self._time = np.concatenate([
            each.seen_at[each.releases['order']] for each in processes])
        self._stated = self._release < noticed      # otherwise it is a stamp in the future
        n = len(self._place)
        self._number, self._expected = np.full(n, UNKNOWN), np.zeros(n, dtype=np.int64)
        self._is_first = np.zeros(n, dtype=np.bool_)
        in_order = sort_by(self._time, self._place, self._order)
        for dag, mine in zip(task_set.dags, rows_by(self._dag[in_order], len(task_set.dags))):
            rows = in_order[mine]
            self._expect(dag, rows)
            if dag.release_from == 'header_stamp':
                self._by_source(dag, rows)
            self._find(dag, rows)
        until = np.cumsum(counts)[:-1]
        columns = self._number, self._release, self._is_first, self._expected
        self.numbered = [
            Numbered(*each) for each in zip(*(np.split(column, until) for column in columns))]

    def _pieces(self, rows: Ints, changes: Sequence[_At]) -> list[tuple[_At | None, Ints]]:
        """Return the parts of releases between changes, each with the change before it."""
        times, places, orders = self._time[rows], self._place[rows], self._order[rows]
        begins = []
        for time, place, order in changes:
            later = (times > time) | (times == time) & (
                (places > place) | (places == place) & (orders > order))
            begins.append(len(rows) - int(later.sum()))
        return list(zip([None, *changes], np.split(rows, begins)))

    def _expect(self, dag: Dag, rows: Ints) -> None:
        """Note how many legs each process has to complete (rule 4)."""
        changes = self._changes[dag.index]
        every = range(self._first[dag.index], self._first[dag.index + 1])
        for place in range(len(self._processes)):
            mine = rows[self._place[rows] == place]
            for change, piece in self._pieces(mine, changes.times(place)):
                here = changes.state(change).get(place, every)
                self._expected[piece] = self._legs[[*here]].sum()

    def _by_source(self, dag: Dag, rows: Ints) -> None:
        """Let stamps count by the clock of the source's machine."""
        source, changes = self._first[dag.index] + dag.source, self._changes[dag.index]
        for change, piece in self._pieces(rows, changes.times()):
            hosted = changes.state(change)
            sender = next((
                each for place, each in enumerate(self._processes)
                if source in hosted.get(place, ())), None)
            for place, each in enumerate(self._processes):
                machine, shift = (0, each.shift) if sender is None else (
                    sender.machine, sender.shift)
                if source in hosted.get(place, (source,)) or machine == each.machine:
                    continue
                mine = piece[(self._place[piece] == place) & self._stated[piece]]
                self._release[mine] += shift - each.shift

    def _find_clear(self, rows: Ints) -> bool:
        """
        Find the jobs of releases by the times only, if these are clear; return whether they are.

        They are clear if groups of releases are farther apart than ``SAME_RELEASE``, a group has
        at most one release of each process, and groups were first seen in the order of time.
        """
        release, place = self._release[rows], self._place[rows]
        in_time = sort_by(release)
        times = release[in_time]
        begins = np.flatnonzero(np.append(True, np.diff(times) > SAME_RELEASE)[:len(rows)])
        until = np.append(begins[1:], len(rows))
        job = np.empty(len(rows), dtype=np.int64)
        job[in_time] = np.repeat(np.arange(len(begins)), until - begins)
        first = np.empty(len(begins), dtype=np.int64)
        first[job[::-1]] = np.arange(len(rows))[::-1]       # the first one is written last
        pairs = np.sort(job * len(self._processes) + place)
        if ((times[until - 1] - times[begins] > SAME_RELEASE).any()
                or (pairs[1:] == pairs[:-1]).any() or (np.diff(first) < 0).any()
                or (np.maximum.accumulate(job) - job >= _KEPT).any()):
            return False
        self._number[rows] = job
        self._is_first[rows[first]] = True
        return True

    def _find(self, dag: Dag, rows: Ints) -> None:
        """Find the job of each release (rule 3)."""
        stamped = dag.release_from == 'header_stamp'
        if not len(rows) or (not stamped and self._find_clear(rows)):
            return
        far = max(dag.period_ns, SAME_RELEASE)
        releases: list[int] = []        # of the jobs so far
        seen: list[int] = []            # by job the processes that have released it, as bits
        numbers: list[int] = []
        for release, place in zip(self._release[rows].tolist(), self._place[rows].tolist()):
            nearest = earlier = UNKNOWN
            least, bit = SAME_RELEASE, 1 << place
            for job in range(len(releases) - 1, max(0, len(releases) - _KEPT) - 1, -1):
                away = release - releases[job]
                if away > far:
                    break
                if seen[job] & bit:
                    continue
                if -least <= away <= least:
                    nearest, least = job, abs(away)
                elif stamped and earlier < 0 and 0 < away < dag.period_ns:
                    earlier = job
            number = earlier if nearest < 0 else nearest
            if number < 0:
                number = len(releases)
                releases.append(release)
                seen.append(0)
                self._is_first[rows[len(numbers)]] = True
            seen[number] |= bit
            numbers.append(number)
        self._number[rows] = numbers
