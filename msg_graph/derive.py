# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
From a declaration to DAG tasks: the rules of the model, applied to the whole graph.

Theory of operation
-------------------
Source: Yano and Azumi, "Multi-Deadline DAG Scheduling Model for Autonomous Driving Systems" (RTSS
2024 work in progress), and the callback semantics of ROS 2.

Rules 1, 2, 3 and 6 concern callbacks (``Links``), the others make vertices.

1. *Trigger edges* come from topics: from each callback that publishes a topic to each subscription
   or sync callback that the topic starts. *Queue edges* (``reads``) start no callback; they only
   serve end-to-end analysis.
2. A *source* is a timer, or a subscription or service with a ``period:``, whose messages come from
   outside of the graph. A topic that starts any other callback must be published in the graph.
   Only a source declares a period, a DAG's name and other properties of a whole DAG.
3. Callbacks and topics must form no cycle. All rules below follow one topological order of both
   together. So a topic with many publishers and many subscribers costs their sum, not their
   product.
4. *OR*: a subscription callback runs once for each message. So it, and each callback after it, has
   one vertex for each vertex of each publisher of its topic. *AND*: a sync callback is one vertex,
   after all vertices of all publishers of all its topics.
5. Hence a vertex that is no sync has one predecessor and lies in the same DAG. A sync joins
   only vertices of one DAG: two sources joined by a sync are an error. So every vertex leads back
   to exactly one source, and each weakly connected component is the vertices of one source.
6. A *sink* is a callback that starts no other callback. By rule 4, either all vertices of a
   callback are sinks or none is. Each sink has a deadline, shorter or longer than the period; no
   other callback has one.
7. DAGs are numbered in the order of their sources in the file; the vertices of a DAG in the order
   of their callbacks in the file, those of one callback in the order of the publishers' vertices.
   The edges of a vertex follow the order of the topics that it publishes, those of one topic the
   vertex index. A DAG has the name of ``dag:``, else that of its source's node, or, if several
   sources of the node have no ``dag:``, ``/node/callback``.
8. Errors are collected in stages, so that none is a consequence of another: trigger and queue
   edges; then cycles, deadlines and paths; then the vertices.
9. The number of vertices and edges is bounded before they are made, because rule 4 multiplies.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
import gc
from graphlib import CycleError, TopologicalSorter
from os import fspath, PathLike
from typing import Any

from msg_graph.declaration import Declaration, parse_declaration
from msg_graph.draft import with_blanks
from msg_graph.errors import Collector, did_you_mean, for_each, GraphError, listed, shown
from msg_graph.model import Callback, Dag, Path, QueueEdge, TaskSet, Vertex
from msg_graph.yamltext import decode, MAX_BYTES

MAX_VERTICES = 100_000
MAX_EDGES = 1_000_000


def load(path: str | PathLike[str]) -> TaskSet:
    """
    Return the task set of a declaration file.

    :raises GraphError: the file cannot be read, is not YAML, or breaks a rule of the language or
        of the model.
    """
    name = fspath(path)
    try:
        with open(path, 'rb') as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise GraphError(name, None, 'no such file or directory', 'check the path') from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else None
        raise GraphError(
            name, None, f'the file cannot be read ({reason or error})',
            'give the path of a declaration') from None
    return loads(data, name, name)


def loads(
    text: str | bytes, name: str = '<string>', path: str | PathLike[str] | None = None, *,
    without_deadline: list[str] | None = None,
) -> TaskSet:
    """
    Return the task set of a declaration.

    :param text: the YAML; bytes must be UTF-8.
    :param name: the name used in errors.
    :param path: its file, if it may include others from its folder.
    :param without_deadline: receives the keys of the sinks without a deadline; None: they are
        errors.
    :raises GraphError: it is not YAML, or breaks a rule of the language or of the model.
    """
    text = decode(text, name) if isinstance(text, bytes) else text
    try:
        with no_garbage():
            return derive_task_set(
                parse_declaration(text, name, None if path is None else fspath(path)),
                without_deadline)
    except GraphError as error:
        raise with_blanks(error, text, name) from None


@contextmanager
def no_garbage() -> Iterator[None]:
    """
    Switch the cyclic garbage collector off.

    Reading a declaration makes hundreds of thousands of objects and no garbage; the collector
    would take a quarter of the time.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def derive_task_set(
    declaration: Declaration, without_deadline: list[str] | None = None
) -> TaskSet:
    """
    Return the task set of a declaration.

    :param without_deadline: receives the keys of the sinks without a deadline; None: they are
        errors.
    """
    links = Links(declaration)
    found = Collector()
    order: list[int] = []
    queue_edges: tuple[QueueEdge, ...] = ()
    paths: tuple[Path, ...] = ()
    with found:
        links.check_triggers()
    with found:
        queue_edges = links.queue_edges()
    found.check()
    with found:
        order = links.order()
    with found:
        links.check_deadlines(without_deadline)
    with found:
        paths = links.paths(declaration)
    found.check()
    expansion = _Expansion(links)
    for callback in order:
        expansion.expand(callback)
    return TaskSet(
        dags=_dags(links, expansion),
        callbacks=tuple(declaration.callbacks),
        queue_edges=queue_edges,
        paths=paths,
        workers=declaration.workers,
        file=declaration.file,
        text=declaration.text,
        processes=declaration.processes,
    )


class Links:
    """Publishers and subscribers by topic; callbacks are places in the file."""

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
        """Return whether a job starts with this callback (rule 2), after ``check_triggers``."""
        return callback.period_ns is not None

    def check_triggers(self) -> None:
        """Check sources, and that the topics of all other callbacks are published (rule 2)."""
        for_each(self.callbacks, self._check_trigger)

    def _check_trigger(self, callback: Callback) -> None:
        if callback.kind == 'service' and callback.period_ns is None:
            raise self.entries[callback.key].error(
                'service', 'a service is a source, and it has no period',
                "add 'period:' with the time between two requests")
        # for a timer, header_stamp describes the messages it sends to other processes
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
                "remove 'period:' and declare the publishers of its topics")
        for topic in callback.topics:
            if topic in self.publishers:
                publisher = self.callbacks[self.publishers[topic][0]].key
                raise self.entries[callback.key].error(
                    'period', f'only a source has a period, but {shown(publisher)} publishes '
                    f'{shown(topic)}',
                    "remove 'period:', or take the topic out of that callback's 'publishes:'")

    def _check_started(self, callback: Callback) -> None:
        for key in ('dag', 'max_active_jobs', 'on_late'):
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
                    callback.kind, f'no callback publishes {shown(topic)}',
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
        with suppress(CycleError):  # callbacks outside of a cycle are sorted nevertheless
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
        # order of the file, which most likely leads back.
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
        """Yield cycles without a common callback by walking back from publisher to publisher."""
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
        """Check that exactly the sinks have deadlines (rule 6); or collect those without."""
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
        if topic is not None:
            self._check_no_sink(callback)

    def _check_no_sink(self, callback: Callback) -> None:
        entry = self.entries[callback.key]
        for key in ('importance', 'tolerate'):
            if entry.has(key):
                raise entry.error(
                    key, f"'{key}:' is for a sink, and this callback starts another one",
                    'move it to the sinks after it')
        if entry.has('keep') and not self.is_source(callback):
            raise entry.error(
                'keep', "'keep:' is for a source or a sink, and this callback is neither",
                "move it, or give the topic's QoS a depth of 1")

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
                    'reads', f'it reads {shown(read)}, which no callback publishes',
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


@dataclass
class _Expansion:
    """Vertices of all DAGs as columns, made callback by callback in topological order (rule 4)."""

    links: Links
    callback: list[int] = field(default_factory=list)
    predecessors: list[list[int]] = field(default_factory=list)
    source: list[int] = field(default_factory=list)
    of_callback: dict[int, list[int]] = field(default_factory=dict)
    edges: int = 0

    def expand(self, place: int) -> None:
        """Make the vertices of one callback, after those of its publishers."""
        callback = self.links.callbacks[place]
        if self.links.is_source(callback):
            self._bound(place, 1, 0)
            self.of_callback[place] = [self._add(place, [], place)]
            return
        publishers = self.links.publishers
        before = sorted({p for topic in callback.topics for p in publishers[topic]})
        count = sum(len(self.of_callback[publisher]) for publisher in before)
        self._bound(place, 1 if callback.kind == 'sync' else count, count)
        vertices = [v for publisher in before for v in self.of_callback[publisher]]
        if callback.kind == 'sync':
            self._check_one_source(place, vertices)
            self.of_callback[place] = [self._add(place, vertices, self.source[vertices[0]])]
        else:
            self.of_callback[place] = [self._add(place, [v], self.source[v]) for v in vertices]

    def _add(self, place: int, predecessors: list[int], source: int) -> int:
        self.callback.append(place)
        self.predecessors.append(predecessors)
        self.source.append(source)
        return len(self.callback) - 1

    def _bound(self, place: int, vertices: int, edges: int) -> None:
        self.edges += edges
        for what, count, most in (
            ('vertices', len(self.callback) + vertices, MAX_VERTICES),
            ('edges', self.edges, MAX_EDGES),
        ):
            if count > most:
                raise self.links.entries[self.links.callbacks[place].key].error(
                    None, f'with it the DAGs have {count} {what}, more than {most}',
                    'a callback runs once for each publisher before it: use fewer publishers for '
                    "one topic, or read some by a queue edge ('reads:')")

    def _check_one_source(self, place: int, vertices: list[int]) -> None:
        first = self.source[vertices[0]]
        other = next((v for v in vertices if self.source[v] != first), None)
        if other is None:
            return
        callback = self.links.callbacks[place]
        published = self.links.callbacks[self.callback[other]].publishes
        topic = next(topic for topic in callback.topics if topic in published)
        keys = [self.links.callbacks[source].key for source in (first, self.source[other])]
        raise self.links.entries[callback.key].error(
            'sync',
            f'it joins two sources, {shown(keys[0])} and {shown(keys[1])}, but a DAG has one',
            f"read {shown(topic)} by a queue edge: take it out of 'sync:' and list it under "
            "'reads:'", item=topic)


def _dags(links: Links, expansion: _Expansion) -> tuple[Dag, ...]:
    """Sort the vertices into DAGs and number both (rules 5 and 7)."""
    members: dict[int, list[int]] = {
        place: [] for place, callback in enumerate(links.callbacks) if links.is_source(callback)}
    for place in range(len(links.callbacks)):
        for vertex in expansion.of_callback[place]:
            members[expansion.source[vertex]].append(vertex)
    names = _dag_names(links, list(members))
    return tuple(
        _dag(links, expansion, source, names[source], index, vertices)
        for index, (source, vertices) in enumerate(members.items()))


def _dag_names(links: Links, sources: list[int]) -> dict[int, str]:
    """Return the name of each source's DAG (rule 7)."""
    names: dict[int, str] = {}
    taken: dict[str, int] = {}
    unnamed = Counter(callback.node for callback in map(links.callbacks.__getitem__, sources)
                      if callback.dag is None)
    for source in sources:
        callback = links.callbacks[source]
        name = callback.dag or callback.node
        if callback.dag is None and unnamed[callback.node] > 1:
            name = f'{callback.node}/{callback.name}'
        if name in taken:
            other = links.callbacks[taken[name]].key
            raise links.entries[callback.key].error(
                'dag' if callback.dag else None,
                f'its DAG has the name {shown(name)}, as that of {shown(other)}',
                "give it another one with 'dag:'")
        taken[name] = source
        names[source] = name
    return names


def _dag(
    links: Links, expansion: _Expansion, source: int, name: str, index: int, members: list[int]
) -> Dag:
    local = {vertex: i for i, vertex in enumerate(members)}
    predecessors = [sorted(local[p] for p in expansion.predecessors[v]) for v in members]
    successors: list[list[int]] = [[] for _ in members]
    for after, befores in enumerate(predecessors):
        for before in befores:
            successors[before].append(after)
    callbacks = [links.callbacks[expansion.callback[vertex]] for vertex in members]
    for callback, after_it in zip(callbacks, successors):
        topics = {topic: n for n, topic in enumerate(callback.publishes)}
        after_it.sort(key=lambda v: min(topics[t] for t in callbacks[v].topics if t in topics))
    times_here = Counter(expansion.callback[vertex] for vertex in members)
    seen: Counter[int] = Counter()
    vertices = []
    for i, member in enumerate(members):
        place = expansion.callback[member]
        callback = callbacks[i]
        seen[place] += 1
        vertex_name = callback.key
        if len(expansion.of_callback[place]) > 1:
            vertex_name += f'@{name}'
        if times_here[place] > 1:
            vertex_name += f'#{seen[place]}'
        vertices.append(Vertex(
            name=vertex_name, callback=callback, dag=index, index=i,
            predecessors=tuple(predecessors[i]), successors=tuple(successors[i]),
            deadline_ns=callback.deadline_ns))
    first = links.callbacks[source]
    assert first.period_ns is not None
    return Dag(
        name=name,
        index=index,
        period_ns=first.period_ns,
        vertices=tuple(vertices),
        source=local[expansion.of_callback[source][0]],
        sinks=tuple(v.index for v in vertices if not v.successors),
        edges=tuple((i, after) for i, each in enumerate(successors) for after in sorted(each)),
        release_from=first.release_from,
        on_late=first.on_late,
        max_active_jobs=first.max_active_jobs,
    )
