# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The links between callbacks that topics and queue edges make, and what must hold for them.

This is the part of the rules that concerns callbacks; ``derive`` numbers the rules and makes the
vertices.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from graphlib import CycleError, TopologicalSorter
from typing import Any

from msg_graph.declaration import Declaration
from msg_graph.errors import did_you_mean, for_each, GraphError, listed, shown
from msg_graph.model import Callback, Path, QueueEdge


class Links:
    """Who publishes what, and whom it starts; callbacks by their places in the file."""

    def __init__(self, declaration: Declaration) -> None:
        self.entries = declaration.entries
        self.callbacks = declaration.callbacks
        self.by_key = {callback.key: callback for callback in self.callbacks}
        self.publishers: dict[str, list[int]] = {}
        self.started: dict[str, list[int]] = {}
        for place, callback in enumerate(self.callbacks):
            for topic in callback.publishes:
                self.publishers.setdefault(topic, []).append(place)
            for topic in callback.topics:
                self.started.setdefault(topic, []).append(place)

    @staticmethod
    def is_source(callback: Callback) -> bool:
        """Whether a job starts with this callback (rule 2); ``check_triggers`` came first."""
        return callback.period_ns is not None

    def check_triggers(self) -> None:
        """Check sources, and that the topics of all other callbacks are published (rule 2)."""
        for_each(self.callbacks, self._check_trigger)

    def _check_trigger(self, callback: Callback) -> None:
        if callback.kind == 'service' and callback.period_ns is None:
            raise self.entries[callback.key].error(
                'service', 'a service is a source, and it has no period',
                "add 'period:' with the time between two requests")
        # header_stamp says of a timer what its messages carry on to other processes
        if callback.kind == 'timer' and callback.release_from == 'source_timestamp':
            raise self.entries[callback.key].error(
                'release_from', 'a timer is released when it is due',
                "remove 'release_from:', or start the callback by a subscription")
        if self.is_source(callback):
            self._check_source(callback)
        else:
            self._check_started(callback)

    def _check_source(self, callback: Callback) -> None:
        if callback.kind == 'sync':
            raise self.entries[callback.key].error(
                'period', 'a sync callback joins topics, so it cannot be a source',
                "remove 'period:' and declare who publishes its topics")
        for topic in callback.topics:
            if topic in self.publishers:
                publisher = self.callbacks[self.publishers[topic][0]].key
                raise self.entries[callback.key].error(
                    'period', f'only a source has a period, but {shown(publisher)} publishes '
                    f'{shown(topic)}',
                    "remove 'period:', or take the topic out of that callback's 'publishes:'")

    def _check_started(self, callback: Callback) -> None:
        for key in ('dag', 'max_active_jobs', 'on_miss'):
            if self.entries[callback.key].has(key):
                raise self._only_source(callback, key)
        if callback.release_from != 'arrival':
            raise self._only_source(callback, 'release_from')
        for topic in callback.topics:
            if topic not in self.publishers:
                remedy = "add it to a 'publishes:'"
                if callback.kind == 'subscription':
                    remedy += ", or add 'period:' if it comes from outside of the graph"
                raise self.entries[callback.key].error(
                    callback.kind, f'nobody publishes {shown(topic)}',
                    did_you_mean(topic, self.publishers, remedy), item=topic)

    def _only_source(self, callback: Callback, key: str) -> GraphError:
        return self.entries[callback.key].error(
            key, f"'{key}:' is for the source of a DAG, and a topic of this graph starts this one",
            'move it to the source callback')

    def order(self) -> list[int]:
        """Return the callbacks in a topological order; a cycle is an error (rule 3)."""
        before: dict[Any, Iterable[Any]] = dict(self.publishers)
        before.update((place, () if self.is_source(callback) else callback.topics)
                      for place, callback in enumerate(self.callbacks))
        sorter = TopologicalSorter(before)
        with suppress(CycleError):  # it sorts what is not on one all the same
            sorter.prepare()
        order: list[int] = []
        while ready := sorter.get_ready():
            order += [each for each in ready if isinstance(each, int)]
            sorter.done(*ready)
        if len(order) < len(self.callbacks):
            for_each(self._cycles(set(range(len(self.callbacks))).difference(order)),
                     self._refuse_cycle)
        return order

    def _refuse_cycle(self, cycle: list[int]) -> None:
        # The edge to cut: one into a sync, which keeps its other topics, else one against the
        # order of the file, which is most likely the one that leads back.
        edges = [(cycle[i - 1], place) for i, place in enumerate(cycle)]
        publisher, cut = max(
            edges, key=lambda edge: (self.callbacks[edge[1]].kind == 'sync', edge[0] - edge[1]))
        callback = self.callbacks[cut]
        published = self.callbacks[publisher].publishes
        topic = next(topic for topic in callback.topics if topic in published)
        if callback.kind == 'sync':
            how = f"take {shown(topic)} out of its 'sync:'"
        else:
            how = f'start it by a timer or another topic than {shown(topic)}'
        first = cycle.index(cut)
        keys = [self.callbacks[place].key for place in cycle[first:] + cycle[:first + 1]]
        if len(keys) > 9:
            keys[8:-1] = [f'… ({len(keys) - 9} more)']
        entry = self.entries[callback.key]
        raise GraphError(
            entry.file, entry.line_of(callback.kind, topic),
            f'callbacks start each other in a cycle: {" -> ".join(keys)}',
            f'cut it with a queue edge: in {shown(callback.key)} list {shown(topic)} under '
            f"'reads:' and {how}")

    def _cycles(self, stuck: set[int]) -> Iterator[list[int]]:
        """Yield cycles without a common callback: walk back from publisher to publisher."""
        while stuck:
            place: int | None = min(stuck)
            walk: dict[int, None] = {}
            while place is not None and place not in walk:
                walk[place] = None
                place = next((publisher for topic in self.callbacks[place].topics
                              for publisher in self.publishers[topic] if publisher in stuck), None)
            stuck -= walk.keys()
            if place is not None:
                places = list(walk)
                yield places[places.index(place):][::-1]

    def check_deadlines(self, without: list[str] | None) -> None:
        """Check that sinks, and nothing else, have deadlines (rule 6); or collect who has none."""
        for_each(self.callbacks, lambda each: self._check_deadline(each, without))

    def _check_deadline(self, callback: Callback, without: list[str] | None) -> None:
        topic = next((t for t in callback.publishes if t in self.started), None)
        if topic is None:
            if callback.deadline_ns is None and without is not None:
                without.append(callback.key)
            elif callback.deadline_ns is None:
                raise self.entries[callback.key].error(
                    None, 'it is a sink (it starts no other callback) and has no deadline',
                    "add 'deadline:'")
        elif callback.deadline_ns is not None:
            after = self.callbacks[self.started[topic][0]].key
            raise self.entries[callback.key].error(
                'deadline', f'it has a deadline but is no sink: it starts {shown(after)} by '
                f'{shown(topic)}',
                'move the deadline to the sinks after it, or read that topic by a queue edge '
                "('reads:')")

    def queue_edges(self) -> tuple[QueueEdge, ...]:
        """Return the queue edges, each with its writers (rule 1)."""
        return tuple(for_each(
            [(each, read) for each in self.callbacks for read in each.reads],
            self._queue_edge))

    def _queue_edge(self, reading: tuple[Callback, str]) -> QueueEdge:
        callback, read = reading
        if read.startswith('/'):
            writers = tuple(self.callbacks[p].key for p in self.publishers.get(read, ()))
            if not writers:
                raise self.entries[callback.key].error(
                    'reads', f'it reads {shown(read)}, which nobody publishes',
                    did_you_mean(read, self.publishers, "add it to a 'publishes:'"), item=read)
            return QueueEdge(callback.key, read, writers)
        writer = f'{callback.node}:{read}'
        if writer not in self.by_key:
            siblings = [c.name for c in self.callbacks if c.node == callback.node]
            raise self.entries[callback.key].error(
                'reads', f'it reads the unknown callback {shown(read)}',
                did_you_mean(read, siblings, f'name a callback of its node: {listed(siblings)}'),
                item=read)
        return QueueEdge(callback.key, None, (writer,))

    def paths(self, declaration: Declaration) -> tuple[Path, ...]:
        """Return the declared paths; each step must be a trigger or queue edge (rule 1)."""
        return tuple(for_each(declaration.paths, self._path))

    def _path(self, path: Path) -> Path:
        entry, keys = self.entries[path.name], path.callbacks
        for key in keys:
            if key not in self.by_key:
                raise entry.error(
                    'callbacks', f'unknown callback {shown(key)}',
                    did_you_mean(key, self.by_key, 'name a declared callback'), item=key)
        for before, after in zip(keys, keys[1:]):
            if not self._linked(self.by_key[before], self.by_key[after]):
                raise entry.error(
                    'callbacks', 'no trigger or queue edge leads from '
                    f'{shown(before)} to {shown(after)}',
                    "name the callbacks between them, or add what is missing to 'reads:'",
                    item=after)
        return path

    def _linked(self, before: Callback, after: Callback) -> bool:
        if before.node == after.node and before.name in after.reads:
            return True
        return not set(before.publishes).isdisjoint(after.topics + after.reads)
