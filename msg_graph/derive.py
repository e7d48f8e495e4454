# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
DAG tasks from declared callbacks: the rules of the model, applied to the whole graph.

Theory of operation
-------------------
Source: Yano and Azumi, "Multi-Deadline DAG Scheduling Model for Autonomous Driving Systems" (RTSS
2024 work in progress), and the callback semantics of ROS 2.

Rules 1, 2, 3 and 6 concern callbacks and are in ``links``, the others, which make vertices, here.

1. *Trigger edges* come from topics: from each callback that publishes a topic to each subscription
   or sync callback that the topic starts. *Queue edges* (``reads``) start nothing; they are kept
   for end-to-end analysis and take no part in what follows.
2. A *source* is a timer, or a subscription or service with a ``period:``, whose messages come from
   outside of the graph. Every topic that starts any other callback must be published in the graph.
   Only a source has a period, a DAG's name and what else concerns a whole DAG.
3. Callbacks and topics must form no cycle. All rules below go along one topological order of
   both together, so that a topic with many publishers and many subscribers costs their sum, not
   their product.
4. *OR*: a subscription callback runs once for each message, so it has one vertex for each vertex
   of each publisher of its topic, and so have the callbacks after it. *AND*: a sync callback is
   one vertex, after all vertices of all publishers of all its topics.
5. Hence a vertex that is no sync has one predecessor and lies in its DAG. A sync joins what must
   lie in one DAG already: two sources joined by a sync are an error. So every vertex leads back to
   exactly one source, and the weakly connected components are the vertices of one source each.
6. A *sink* is a callback that starts none; as rule 4 gives each subscriber a vertex for each
   vertex of its publisher, all vertices of a callback are sinks or none is. Each sink has a
   deadline, shorter or longer than the period, and nothing else has one.
7. DAGs are numbered by their sources' places in the file. The vertices of a DAG are numbered by
   their callbacks' places in the file, several of one callback in the order of the vertices that
   start them, that is of the publishers. The edges of a vertex are listed in the order of the
   topics that it publishes, those of one topic by index.
8. Errors are collected in stages, as far as none is a consequence of another: who starts whom and
   who reads what; then cycles, deadlines and paths; then what the vertices show.
9. The number of vertices and edges is bounded before they are made, as rule 4 multiplies.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from msg_graph.declaration import Declaration
from msg_graph.errors import Collector, shown
from msg_graph.links import Links
from msg_graph.model import Dag, Path, QueueEdge, TaskSet, Vertex

MAX_VERTICES = 100_000
MAX_EDGES = 1_000_000


def derive_task_set(
    declaration: Declaration, without_deadline: list[str] | None = None
) -> TaskSet:
    """
    Return the task set of a declaration.

    :param without_deadline: takes the keys of the sinks that have no deadline; None: they are
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
        """Make the vertices of one callback; those of its publishers exist."""
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
    names: dict[int, str] = {}
    taken: dict[str, int] = {}
    for source in sources:
        callback = links.callbacks[source]
        name = callback.dag or callback.node
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
        on_miss=first.on_miss,
        max_active_jobs=first.max_active_jobs,
    )
