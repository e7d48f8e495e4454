# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What the drift rules need to know of a recorded run, collected while it is replayed.

Theory of operation
-------------------
``WatchedRecording`` is a recording that looks at its own events as they pass to whoever replays
it, so that a trace is read only once. The rules are in ``msg_graph.drift``.

A callback's declared key is that of the vertices that it was dispatched as, and where it never ran
as a vertex (its messages fitted nothing), what the declaration has for its node and what starts
it (``msg_graph.binding``). Runs in another declaration's terms are matched by that key.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
import os

from mddag_executor.replay.recording import Recording, TASK_SET
from mddag_executor.trace.census import Address, Census, Event
from msg_graph import TaskSet
from msg_graph.binding import Binder, Entity
from msg_graph.drift import Drift, drift, Observed, Releases

_RELEASE, _DISPATCH, _DROP = 'mddag:job_release', 'mddag:dispatch', 'mddag:drop'


class WatchedRecording(Recording):
    """A recording that can tell, once its events have passed, what drifted."""

    def __init__(self, path: str | os.PathLike[str], name: str | None = None) -> None:
        super().__init__(path, name)
        self._sources = [dag.vertices[dag.source].callback.key for dag in self.task_set.dags]
        self._keys = [[v.callback.key for v in dag.vertices] for dag in self.task_set.dags]
        self.forget()

    def forget(self) -> None:
        """Forget all events that have passed."""
        self._census = Census()
        self._observed = Observed()
        self._key: dict[Address, str] = {}
        self._executions: Counter[Address] = Counter()
        self._dropped: Counter[Address] = Counter()
        self._first: int | None = None
        self._last = 0

    def events(self, names: Iterable[str]) -> Iterator[Event]:
        """Yield the named events in the order of time; look at these and at others."""
        wanted = set(names)
        for event in super().events({*wanted, *self.names()}):
            name = event[0]
            if None not in event:
                self.take(event)
                if name != TASK_SET and event[1] > self._last:
                    self._last = event[1]
            if name in wanted:
                yield event

    def names(self) -> set[str]:
        """Return the full names of the events that it looks at."""
        return {*self._census.handlers, _RELEASE, _DISPATCH, _DROP}

    def take(self, event: Event) -> None:
        """Look at an event that has all its fields."""
        name = event[0]
        handler = self._census.handlers.get(name)
        if handler is not None:
            handler(event)
        elif name == _RELEASE:
            self._released(event)
        elif name == _DISPATCH:
            self._dispatched(event)
        elif name == _DROP:
            self._dropped[event[2], event[4]] += 1

    def published(self, callback: Address, publisher: Address) -> None:
        """Take in that a callback has published, which no event has told."""
        self._census.published(callback, publisher)

    def counted(
        self, executions: Mapping[Address, int], vertices: Mapping[Address, tuple[int, int]],
        releases: Sequence[Sequence[int]], first: int, last: int,
    ) -> None:
        """
        Take in what was counted of releases and dispatches, which no event has told.

        :param vertices: DAG and vertex that a callback was dispatched as.
        :param releases: of each DAG their number, the first and the last.
        :param first: when the first of them was recorded, -1 for none; `last`: the last event.
        """
        self._executions.update(executions)
        for callback, (dag, vertex) in vertices.items():
            self._key[callback] = self._keys[dag][vertex]
        for source, each in zip(self._sources, releases):
            if each[0]:
                self._observed.releases[source] = Releases(*each)
        self._first = first if first >= 0 else None
        self._last = max(self._last, last)

    def _released(self, event: Event) -> None:
        dag = event[4]
        if 0 <= dag < len(self._sources):
            self._observed.releases.setdefault(self._sources[dag], Releases()).add(event[6])
            if self._first is None:
                self._first = event[1]

    def _dispatched(self, event: Event) -> None:
        callback, dag, vertex = (event[2], event[4]), event[5], event[6]
        self._executions[callback] += 1
        if 0 <= dag < len(self._keys) and 0 <= vertex < len(self._keys[dag]):
            self._key[callback] = self._keys[dag][vertex]
        if self._first is None:
            self._first = event[1]

    def drift(self, judge: TaskSet) -> list[Drift]:
        """
        Return where the run and a declaration disagree; all events have passed.

        :param judge: the declaration, the recorded one or another.
        """
        observed, publishes = self._observed, dict[str, set[str]]()
        keys = {**declared_keys(self._census, self.task_set), **self._key}
        got, ran = Counter[str](), Counter[str]()
        for callback, key in keys.items():
            ran[key] += self._executions[callback]
            got[key] += self._executions[callback] + self._dropped[callback]
            runs = self._census.runs.get(callback)
            publishes.setdefault(key, set()).update(runs.publishes if runs else ())
        observed.duration_ns = 0 if self._first is None else max(0, self._last - self._first)
        observed.got, observed.ran = dict(got), dict(ran)
        observed.publishes = dict(publishes)
        observed.nodes = set(self._census.publishers) or None
        observed.undeclared = _undeclared(self._census, judge)
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


def _undeclared(census: Census, judge: TaskSet) -> list[Entity]:
    """Return what a declaration does not name."""
    declared = declared_keys(census, judge)
    return [Entity(e.node, e.kind, e.start, e.period_ns) for e in census.entities()
            if e.callback not in declared]


def drift_of_import(census: Census, judge: TaskSet) -> list[Drift]:
    """
    Return where a recording of another executor and a declaration disagree.

    Such a recording has no jobs; the starts of a source's callback count as its releases.
    """
    observed = Observed(
        nodes=set(census.publishers), undeclared=_undeclared(census, judge))
    first, last = [], []
    sources = {dag.vertices[dag.source].callback.key for dag in judge.dags}
    for address, key in declared_keys(census, judge).items():
        runs = census.runs.get(address)
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
