# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The links between callbacks that topics and queue edges make, and what must hold for them.

This is the part of the rules that concerns callbacks; ``derive`` numbers the rules and makes the
vertices.
"""

from __future__ import annotations

from collections import deque

from msg_graph.declaration import Declaration, Entry, PathEntry
from msg_graph.errors import Collector, did_you_mean, GraphError, listed, shown
from msg_graph.model import Callback, Path, QueueEdge


class Links:
    """Who publishes what, and whom it starts; callbacks by their places in the file."""

    def __init__(self, declaration: Declaration) -> None:
        self.file = declaration.file
        self.entries = declaration.entries
        self.callbacks = [entry.callback for entry in declaration.entries]
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
        found = Collector()
        for entry in self.entries:
            with found:
                self._check_trigger(entry)
        found.check()

    def _check_trigger(self, entry: Entry) -> None:
        callback = entry.callback
        if callback.kind == 'service' and callback.period_ns is None:
            raise entry.fields.error(
                'service', 'a service is a source, and it has no period',
                "add 'period:' with the time between two requests")
        # header_stamp says of a timer what its messages carry on to other processes
        if callback.kind == 'timer' and callback.release_from == 'source_timestamp':
            raise entry.fields.error(
                'release_from', 'a timer is released when it is due',
                "remove 'release_from:', or start the callback by a subscription")
        if self.is_source(callback):
            self._check_source(entry)
        else:
            self._check_started(entry)

    def _check_source(self, entry: Entry) -> None:
        callback = entry.callback
        if callback.kind == 'sync':
            raise entry.fields.error(
                'period', 'a sync callback joins topics, so it cannot be a source',
                "remove 'period:' and declare who publishes its topics")
        for topic in callback.topics:
            if topic in self.publishers:
                publisher = self.callbacks[self.publishers[topic][0]].key
                raise entry.fields.error(
                    'period', f'only a source has a period, but {shown(publisher)} publishes '
                    f'{shown(topic)}',
                    "remove 'period:', or take the topic out of that callback's 'publishes:'")

    def _check_started(self, entry: Entry) -> None:
        for key in ('dag', 'max_active_jobs', 'on_miss'):
            if entry.fields.has(key):
                raise self._only_source(entry, key)
        if entry.callback.release_from != 'arrival':
            raise self._only_source(entry, 'release_from')
        for topic in entry.callback.topics:
            if topic not in self.publishers:
                remedy = "add it to a 'publishes:'"
                if entry.callback.kind == 'subscription':
                    remedy += ", or add 'period:' if it comes from outside of the graph"
                raise GraphError(
                    entry.fields.file, entry.fields.line_of(entry.callback.kind, topic),
                    f'{entry.fields.entry}: nobody publishes {shown(topic)}',
                    did_you_mean(topic, self.publishers, remedy))

    def _only_source(self, entry: Entry, key: str) -> GraphError:
        return entry.fields.error(
            key, f"'{key}:' is for the source of a DAG, and a topic of this graph starts this one",
            'move it to the source callback')

    def order(self) -> list[int]:
        """Return the callbacks in a topological order; a cycle is an error (rule 3)."""
        open_topics = [
            0 if self.is_source(callback) else len(callback.topics) for callback in self.callbacks]
        open_publishers = {topic: len(places) for topic, places in self.publishers.items()}
        ready = deque(place for place, count in enumerate(open_topics) if count == 0)
        order = []
        while ready:
            place = ready.popleft()
            order.append(place)
            for topic in self.callbacks[place].publishes:
                open_publishers[topic] -= 1
                if open_publishers[topic]:
                    continue
                for started in self.started.get(topic, ()):
                    open_topics[started] -= 1
                    if open_topics[started] == 0:
                        ready.append(started)
        if len(order) < len(self.callbacks):
            raise self._cycle_error(set(range(len(self.callbacks))).difference(order))
        return order

    def _cycle_error(self, stuck: set[int]) -> GraphError:
        """Return the error about one cycle among the callbacks that wait for each other."""
        cycle = self._cycle(stuck)
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
        return GraphError(
            self.entries[cut].fields.file, self.entries[cut].fields.line_of(callback.kind, topic),
            f'callbacks start each other in a cycle: {" -> ".join(keys)}',
            f'cut it with a queue edge: in {shown(callback.key)} list {shown(topic)} under '
            f"'reads:' and {how}")

    def _cycle(self, stuck: set[int]) -> list[int]:
        """Walk back from publisher to publisher until one comes again; return that cycle."""
        place = min(stuck)
        seen: dict[int, int] = {}
        walk: list[int] = []
        while place not in seen:
            seen[place] = len(walk)
            walk.append(place)
            place = next(
                publisher for topic in self.callbacks[place].topics
                for publisher in self.publishers[topic] if publisher in stuck)
        return walk[seen[place]:][::-1]

    def check_deadlines(self) -> None:
        """Check that sinks, and nothing else, have deadlines (rule 6)."""
        found = Collector()
        for entry in self.entries:
            with found:
                self._check_deadline(entry)
        found.check()

    def _check_deadline(self, entry: Entry) -> None:
        callback = entry.callback
        topic = next((t for t in callback.publishes if t in self.started), None)
        if topic is None:
            if callback.deadline_ns is None:
                raise entry.fields.error(
                    None, 'it is a sink (it starts no other callback) and has no deadline',
                    "add 'deadline:'")
        elif callback.deadline_ns is not None:
            after = self.callbacks[self.started[topic][0]].key
            raise entry.fields.error(
                'deadline', f'it has a deadline but is no sink: it starts {shown(after)} by '
                f'{shown(topic)}',
                'move the deadline to the sinks after it, or read that topic by a queue edge '
                "('reads:')")

    def queue_edges(self) -> tuple[QueueEdge, ...]:
        """Return the queue edges, each with its writers (rule 1)."""
        found = Collector()
        edges = []
        for entry in self.entries:
            for read in entry.callback.reads:
                with found:
                    edges.append(self._queue_edge(entry, read))
        found.check()
        return tuple(edges)

    def _queue_edge(self, entry: Entry, read: str) -> QueueEdge:
        callback = entry.callback
        topic = read if read.startswith('/') else None
        if topic is not None:
            writers = tuple(self.callbacks[p].key for p in self.publishers.get(topic, ()))
        else:
            writer = f'{callback.node}:{read}'
            writers = (writer,) if writer in self.by_key else ()
        if not writers:
            raise self._read_error(entry, read)
        return QueueEdge(callback.key, topic, writers)

    def _read_error(self, entry: Entry, read: str) -> GraphError:
        line = entry.fields.line_of('reads', read)
        if read.startswith('/'):
            return GraphError(
                entry.fields.file, line,
                f'{entry.fields.entry}: it reads {shown(read)}, which nobody publishes',
                did_you_mean(read, self.publishers, "add it to a 'publishes:'"))
        siblings = [c.name for c in self.callbacks if c.node == entry.callback.node]
        return GraphError(
            entry.fields.file, line,
            f'{entry.fields.entry}: it reads the unknown callback {shown(read)}',
            did_you_mean(read, siblings, f'name a callback of its node: {listed(siblings)}'))

    def paths(self, declaration: Declaration) -> tuple[Path, ...]:
        """Return the declared paths; each step must be a trigger or queue edge (rule 1)."""
        found = Collector()
        for entry in declaration.paths:
            with found:
                self._check_path(entry)
        found.check()
        return tuple(entry.path for entry in declaration.paths)

    def _check_path(self, entry: PathEntry) -> None:
        keys = entry.path.callbacks
        for key in keys:
            if key not in self.by_key:
                raise GraphError(
                    entry.fields.file, entry.fields.line_of('callbacks', key),
                    f'{entry.fields.entry}: unknown callback {shown(key)}',
                    did_you_mean(key, self.by_key, 'name a declared callback'))
        for before, after in zip(keys, keys[1:]):
            if not self._linked(self.by_key[before], self.by_key[after]):
                raise GraphError(
                    entry.fields.file, entry.fields.line_of('callbacks', after),
                    f'{entry.fields.entry}: no trigger or queue edge leads from '
                    f'{shown(before)} to {shown(after)}',
                    "name the callbacks between them, or add what is missing to 'reads:'")

    def _linked(self, before: Callback, after: Callback) -> bool:
        if before.node == after.node and before.name in after.reads:
            return True
        return not set(before.publishes).isdisjoint(after.topics + after.reads)
