# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What the drift rules (``msg_graph.drift``) need to know of a recorded run, collected meanwhile.

Theory of operation
-------------------
A callback's declared key is that of the vertices that it ran as, and where it never ran as a
vertex (its messages fitted nothing), what the declaration has for its node and what starts it
(``msg_graph.binding``).  Runs in another declaration's terms are matched by that key.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Set

from mddag_executor.replay.happenings import (
    Batch,
    different,
    Ints,
    Observer,
    PUBLISHED,
    RAN,
    RELEASED,
    STARTED,
)
from mddag_executor.replay.mapping import declared_keys
from mddag_executor.replay.run import Run
from msg_graph import TaskSet
from msg_graph.drift import Drift, drift, Observed, Releases
import numpy as np

_MIX = 0x9E3779B97F4A7C1


class DriftObserver(Observer):
    """Collects, while a run is played, what shows where it and its declaration disagree."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._sources = [d.vertices[d.source].callback.key for d in run.task_set.dags]
        self._keys = [v.callback.key for v in run.task_set.vertices]
        self._releases: dict[str, Releases] = {}
        self._key: dict[int, str] = {}      # by callback
        self._ran: Counter[int] = Counter()
        self._dropped: Counter[str] = Counter()
        self._publishes: set[tuple[int, int]] = set()       # publisher and callback

    def was_dropped(self, vertex: int, job: int, reason: str) -> None:
        """Count it, as it was got."""
        if vertex >= 0:
            self._dropped[self._keys[vertex]] += 1

    def take(self, batch: Batch) -> None:
        """Count releases and executions, and note who publishes what."""
        released, started, ran = (batch.columns(kind) for kind in (RELEASED, STARTED, RAN))
        for dag in different(released[:, 0]):
            mine = released[released[:, 0] == dag, 2]
            releases = self._releases.setdefault(self._sources[dag], Releases())
            releases.add(int(mine.min()))
            releases.add(int(mine.max()))
            releases.count += len(mine) - 2
        self._count(started[:, 5])
        self._count(ran[(ran[:, 2] < 0) & (ran[:, 8] != 0), 0])
        latest = started[::-1]
        for row in np.unique(latest[:, 5], return_index=True)[1].tolist():
            self._key[int(latest[row, 5])] = self._keys[int(latest[row, 1])]
        sent = batch.columns(PUBLISHED)[:, :2]
        sent = sent[sent[:, 1] != -1]
        first = np.unique(sent[:, 1] * _MIX + sent[:, 0], return_index=True)[1]
        self._publishes.update(map(tuple, sent[first].tolist()))

    def _count(self, callbacks: Ints) -> None:
        for callback, count in zip(*(
                each.tolist() for each in np.unique(callbacks, return_counts=True))):
            self._ran[callback] += count

    def drift(self, judge: TaskSet) -> list[Drift]:
        """
        Return where the run and a declaration disagree; all events have passed.

        :param judge: the declaration, the recorded one or another.
        """
        run, who = self._run, self._run.who
        keys = {**declared_keys(who, run.recorded_set), **self._key}
        ran: Counter[str] = Counter()
        publishes: defaultdict[str, Set[str]] = defaultdict(set)
        for callback, key in keys.items():
            ran[key] += self._ran[callback]
        for number, callback in self._publishes:
            publisher = who.every_publisher.get(number)
            if callback in keys and publisher is not None and publisher.node is not None:
                publishes[keys[callback]] |= {publisher.topic}
        declared = declared_keys(who, judge)
        return drift(judge, Observed(
            0 if run.start is None else max(0, run.end - run.start), self._releases,
            dict(ran + self._dropped), dict(ran), publishes, set(who.names_of_nodes) or None,
            [each.entity for each in who.made
             if each.entity is not None and each.number not in declared]))
