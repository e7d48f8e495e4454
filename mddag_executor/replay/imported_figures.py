# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What is collected while an imported run is played: flows along paths, and where it drifted."""

from __future__ import annotations

from mddag_executor.replay.communications import Communications
from mddag_executor.replay.drift import declared_keys, undeclared
from mddag_executor.replay.happenings import Batch, Handlers
from mddag_executor.replay.imported_run import ImportedRun
from mddag_executor.replay.linker import Execution, KEEP, LinkObserver, Publication
from mddag_executor.replay.paths import PathBook
from mddag_executor.trace.census import Census
from msg_graph import TaskSet
from msg_graph.drift import Drift, drift, Observed, Releases
import numpy as np


def observers_of(
    run: ImportedRun, paths: bool
) -> tuple[Communications, ImportedPaths | None, ImportedDrift | None]:
    """Return what collects the figures of a run; paths and drift only where ``paths`` says so."""
    if not paths:
        return Communications(), None, None
    return Communications(), ImportedPaths(run), ImportedDrift(run)


class ImportedPaths(LinkObserver):
    """Collects the flows along the declared paths of an imported run."""

    def __init__(self, run: ImportedRun) -> None:
        self.book = PathBook(run.task_set, kept=KEEP)
        self._target = run.targets
        self._order = 0
        self._told: list[list[tuple[int, ...]]] = [[], [], [], []]
        self._number = 0

    def take(self, batch: Batch) -> None:
        """Hand over what came since the last batch."""
        self.book.tell(self._order + 1, *(
            np.array(rows, dtype=np.int64).reshape(len(rows), width)
            for rows, width in zip(self._told, (7, 4, 7, 4))))
        self._order, self._told = 0, [[], [], [], []]

    def _tell(self, what: int, run: Execution | None, *row: int) -> None:
        """Note what a callback did, if it is on a path."""
        target = None if run is None else self._target.get(run.callback.number)
        if run is None or target is None or target.callback.key not in self.book.on_path:
            return
        self._order += 1
        self._told[what].append(
            (self._order, self.book.callbacks[target.callback.key], *row))

    def began(self, run: Execution, message: Publication | None) -> None:
        """Note what an execution runs for."""
        self._number += 1
        run.number = self._number
        target = self._target.get(run.callback.number)
        topic = '' if target is None else target.topic
        self._tell(0, run, run.number, run.start,
                   self.book.topics.get(topic, -2) if topic else -1,
                   -1 if message is None else message.number, -1)

    def over(self, run: Execution) -> None:
        """Note the end of an execution."""
        self._tell(1, run, run.number, run.end)

    def sent(self, message: Publication) -> None:
        """Note a publication."""
        self._number += 1
        message.number = self._number
        publisher, run = message.publisher, message.run
        if (publisher is None or publisher.node is None
                or publisher.topic not in self.book.topics):
            return
        node, topic = publisher.node.name, self.book.topics[publisher.topic]
        target = None if run is None else self._target.get(run.callback.number)
        if target is not None and run is not None and target.callback.node == node:
            self._tell(2, run, -1, run.number, topic, message.number, message.time)
        else:
            self._order += 1
            self._told[2].append((
                self._order, -1, self.book.nodes.get(node, -1), -1, topic, message.number,
                message.time))

    def took(self, run: Execution, message: Publication) -> None:
        """Note a message that a callback took itself."""
        self._tell(3, run, run.number, message.number)


class ImportedDrift(LinkObserver):
    """
    Collects, while an imported run is played, what tells where it drifted.

    Such a recording has no jobs; the starts of a source's callback count as its releases.
    """

    def __init__(self, run: ImportedRun) -> None:
        self._census = Census(keep_times=0)
        self._declared = bool(run.task_set.dags)

    def raw_handlers(self) -> Handlers:
        """Return the methods for who there is, and for what callbacks do."""
        return dict.fromkeys(self._census.handlers, self._census.take) if self._declared else {}

    def drift(self, judge: TaskSet) -> list[Drift]:
        """Return where the run and a declaration disagree."""
        if not self._declared:
            return []
        observed = Observed(
            nodes=set(self._census.publishers), undeclared=undeclared(self._census, judge))
        first, last = [], []
        sources = {dag.vertices[dag.source].callback.key for dag in judge.dags}
        for address, key in declared_keys(self._census, judge).items():
            runs = self._census.runs.get(address)
            if runs is None:
                continue
            observed.ran[key] = observed.ran.get(key, 0) + runs.count
            observed.got[key] = observed.ran[key]
            observed.publishes[key] = {*observed.publishes.get(key, ()), *runs.publishes}
            if key in sources:
                observed.releases[key] = Releases(runs.count, runs.first, runs.last)
            first.append(runs.first)
            last.append(runs.last)
        observed.duration_ns = max(last) - min(first) if first else 0
        return drift(judge, observed)
