# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What the drift rules need to know of a recorded run, collected while it is replayed.

Theory of operation
-------------------
``OwnDrift`` observes a run of this executor.  The rules are in ``msg_graph.drift``.

A callback's declared key is that of the vertices that it was dispatched as, and where it never ran
as a vertex (its messages fitted nothing), what the declaration has for its node and what starts
it (``msg_graph.binding``). Runs in another declaration's terms are matched by that key.
"""

from __future__ import annotations

from collections import Counter

from mddag_executor.replay.happenings import (
    Batch,
    different,
    Event,
    FIELD,
    Handlers,
    Ints,
    NOW,
    Observer,
    PROCESS,
    PUBLISHED,
)
from mddag_executor.replay.own import OwnRun
from mddag_executor.trace.census import ADDRESS, Address, Census
from msg_graph import TaskSet
from msg_graph.binding import Binder, Entity
from msg_graph.drift import Drift, drift, Observed, Releases
import numpy as np

_RELEASE, _DISPATCH, _DROP = 'mddag:job_release', 'mddag:dispatch', 'mddag:drop'
_PUBLISH = 'ros2:rclcpp_publish'
_MIX = 0x9E3779B97F4A7C1


class OwnDrift(Observer):
    """Collects, while a trace of this executor is played, what shows where it drifted."""

    def __init__(self, run: OwnRun) -> None:
        self._run = run
        self._sources = [dag.vertices[dag.source].callback.key for dag in run.recorded_set.dags]
        self._keys = [[v.callback.key for v in dag.vertices] for dag in run.recorded_set.dags]
        self._census = run.who
        self._observed = Observed()
        self._key: dict[Address, str] = {}
        self._executions: Counter[Address] = Counter()
        self._dropped: Counter[Address] = Counter()
        self._first: int | None = None

    def handlers(self) -> Handlers:
        """Return the method for what is dropped."""
        return {_DROP: self._drop}

    def _drop(self, event: Event) -> None:
        self._dropped[event[2], event[4]] += 1

    def take(self, batch: Batch) -> None:
        """Count releases, dispatches and who publishes what."""
        first: list[tuple[int, int]] = []
        if _RELEASE in batch.events:
            places, rows = batch.events[_RELEASE]
            known = (rows[:, FIELD] >= 0) & (rows[:, FIELD] < len(self._sources))
            for dag in different(rows[known, FIELD]):
                mine = rows[rows[:, FIELD] == dag, FIELD + 2]
                releases = self._observed.releases.setdefault(self._sources[dag], Releases())
                releases.add(int(mine.min()))
                releases.add(int(mine.max()))
                releases.count += len(mine) - 2
            first += zip(places[known][:1].tolist(), rows[known][:1, NOW].tolist())
        if _DISPATCH in batch.events:
            places, rows = batch.events[_DISPATCH]
            for pid in different(rows[:, PROCESS]):
                self._dispatched(pid, rows[rows[:, PROCESS] == pid, FIELD:FIELD + 3])
            first += zip(places[:1].tolist(), rows[:1, NOW].tolist())
        if first and self._first is None:
            self._first = min(first)[1]
        if _PUBLISH in batch.events:
            self._publish(batch)

    def _dispatched(self, pid: int, rows: Ints) -> None:
        callbacks, counts = np.unique(rows[:, 0], return_counts=True)
        for callback, count in zip(callbacks.tolist(), counts.tolist()):
            self._executions[pid, callback & ADDRESS] += count
        dag, vertex = rows[:, 1], rows[:, 2]
        sizes = np.array([len(keys) for keys in self._keys] + [0])
        known = (dag >= 0) & (dag < len(self._keys)) & (vertex >= 0)
        known &= vertex < sizes[np.where(known, dag, -1)]
        latest = rows[known][::-1]
        _, last = np.unique(latest[:, 0], return_index=True)
        for callback, of, place in latest[last].tolist():
            self._key[pid, callback & ADDRESS] = self._keys[of][place]

    def _publish(self, batch: Batch) -> None:
        """Note which callbacks publish what."""
        pid = batch.events[_PUBLISH][1][:, PROCESS]
        publisher, callback = batch.columns(PUBLISHED)[:, :2].T
        pairs = (callback * _MIX + publisher) * _MIX + pid
        _, first = np.unique(pairs[callback != -1], return_index=True)
        for row in np.flatnonzero(callback != -1)[first].tolist():
            self._census.published((int(pid[row]), int(callback[row]) & ADDRESS),
                                   (int(pid[row]), int(publisher[row]) & ADDRESS))

    def drift(self, judge: TaskSet) -> list[Drift]:
        """
        Return where the run and a declaration disagree; all events have passed.

        :param judge: the declaration, the recorded one or another.
        """
        observed, publishes = self._observed, dict[str, set[str]]()
        keys = {**declared_keys(self._census, self._run.recorded_set), **self._key}
        got, ran = Counter[str](), Counter[str]()
        for callback, key in keys.items():
            ran[key] += self._executions[callback]
            got[key] += self._executions[callback] + self._dropped[callback]
            runs = self._census.runs.get(callback)
            publishes.setdefault(key, set()).update(runs.publishes if runs else ())
        observed.duration_ns = 0 if self._first is None else max(
            0, self._run.last - self._first)
        observed.got, observed.ran = dict(got), dict(ran)
        observed.publishes = dict(publishes)
        observed.nodes = set(self._census.publishers) or None
        observed.undeclared = undeclared(self._census, judge)
        return drift(judge, observed)


def declared_keys(census: Census, task_set: TaskSet) -> dict[Address, str]:
    """Return the declared keys of callbacks, by what starts them."""
    binder = Binder(task_set)
    found: dict[Address, str] = {}
    for entity in census.entities():
        callback = binder.bind(
            Entity(entity.node, entity.kind, entity.start, entity.period_ns))
        if callback is not None and entity.callback is not None:
            found[entity.callback] = callback.key
    return found


def undeclared(census: Census, judge: TaskSet) -> list[Entity]:
    """Return what a declaration does not name."""
    declared = declared_keys(census, judge)
    return [Entity(e.node, e.kind, e.start, e.period_ns) for e in census.entities()
            if e.callback not in declared]
