# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
From a declaration to DAG tasks: the rules of the model, applied to the whole graph.

Theory of operation
-------------------
Source: Yano and Azumi, "Multi-Deadline DAG Scheduling Model for Autonomous Driving Systems" (RTSS
2024 work in progress), and the callback semantics of ROS 2.

Rules 1, 2, 3 and 6 concern callbacks (``_Links``), the others make vertices.

1. *Trigger edges* come from topics: from each callback that publishes a topic to each subscription
   or sync callback that the topic starts. *Queue edges* (``reads``) start no callback; they only
   serve end-to-end analysis.
2. A *source* is a timer, or a subscription, service or sync with ``driven_by`` with a ``period:``,
   whose messages come from outside of the graph. A topic that starts any other callback must be
   published in the graph. Only a source declares a period, a DAG's name and other properties of a
   whole DAG.
3. Callbacks and topics must form no cycle. All rules below follow one topological order of both
   together. So a topic with many publishers and many subscribers costs their sum, not their
   product.
4. *OR*: a subscription callback runs once for each message. So it, and each callback after it, has
   one vertex for each vertex of each publisher of its topic. *AND*: a sync callback is one vertex,
   after all vertices of all publishers of all its topics. A sync with ``driven_by`` is like a
   subscription of that topic; its other topics are queue edges, and may come from outside of the
   graph.
5. Hence a vertex that is not a sync has one predecessor and lies in the same DAG. A sync joins
   only vertices of one DAG: two sources joined by a sync are an error. So every vertex leads back
   to exactly one source, and each weakly connected component is the vertices of one source.
6. A *sink* is a callback that starts no other callback. By rule 4, either all vertices of a
   callback are sinks or none is. Each sink has a deadline, shorter or longer than the period, or
   says that it has none; no other callback has one.
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
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
import gc
from graphlib import CycleError, TopologicalSorter
from itertools import pairwise
from os import fspath, PathLike
from typing import Any

from msg_graph.blanks import open_blanks
from msg_graph.declaration import parse_declaration
from msg_graph.errors import (
    Collector,
    combine_errors,
    did_you_mean,
    for_each,
    GraphError,
    listed,
    nearest,
    quoted,
)
from msg_graph.language import CALLBACK_KEYS, Entry
from msg_graph.model import Callback, Dag, Path, QueueEdge, TaskSet, Vertex
from msg_graph.yamltext import decode, MAX_BYTES

MAX_SIZE = 200_000
"""The most vertices and edges of a declaration."""


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
        with gc_paused():
            return _derived(
                *parse_declaration(text, name, None if path is None else fspath(path)),
                without_deadline)
    except GraphError as error:
        blanks = open_blanks(text, name)
        raise (combine_errors(blanks) if blanks else error) from None


@contextmanager
def gc_paused() -> Iterator[None]:
    """
    Switch the cyclic garbage collector of the whole process off, for all of its threads.

    Reading a declaration or a recording makes hundreds of thousands of objects and no garbage;
    the collector would take up to a quarter of the time.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def _derived(
    declared: TaskSet, entries: dict[str, Entry], without_deadline: list[str] | None
) -> TaskSet:
    links = _Links(declared.callbacks, entries)
    errors = Collector()
    errors.attempt(for_each, declared.callbacks, links.check_start)
    queue_edges = errors.attempt(
        for_each, [(each, read) for each in declared.callbacks
                   for read in (*each.reads, *each.other_topics)], links.queue_edge)
    errors.check()
    order = errors.attempt(links.order)
    errors.attempt(
        for_each, declared.callbacks, lambda each: links.check_end(each, without_deadline))
    errors.attempt(for_each, declared.paths, links.check_path)
    errors.check()
    return replace(
        declared, queue_edges=tuple(edge for edge in queue_edges if edge.writers),
        dags=_dags(links, _vertices(links, order)))


class _Links:
    """Publishers and subscribers by topic; callbacks are places in the file."""

    def __init__(self, callbacks: Sequence[Callback], entries: dict[str, Entry]) -> None:
        self.entries = entries
        self.callbacks = callbacks
        self._by_key = {callback.key: callback for callback in self.callbacks}
        self.publishers: dict[str, list[int]] = {}
        self._started: dict[str, list[int]] = {}
        for place, callback in enumerate(self.callbacks):
            for topic in callback.publishes:
                self.publishers.setdefault(topic, []).append(place)
            for topic in callback.triggers:
                self._started.setdefault(topic, []).append(place)

    def check_start(self, callback: Callback) -> None:
        """Check sources, and that the topics of all other callbacks are published (rule 2)."""
        error = self.entries[callback.key].error
        is_source = _is_source(callback)
        if callback.kind == 'service' and not is_source:
            raise error('service', 'a service is a source, and it has no period',
                        "add 'period:' with the time between two requests")
        # for a timer, header_stamp describes the messages it sends to other processes
        if callback.kind == 'timer' and callback.release_from == 'source_timestamp':
            raise error('release_from', 'a timer is released when it is due',
                        "remove 'release_from:', or start the callback by a subscription")
        if callback.once and callback.kind != 'timer':
            raise error('once', 'only a timer can fire once',
                        "remove 'once:'; a source that comes now and then has 'sporadic: true'")
        if callback.once and callback.sporadic:
            raise error('once', 'a timer fires once, or now and then, not both',
                        "remove 'once:' if the timer is made again or reset, else 'sporadic:'")
        if not callback.judged and (callback.tolerate or callback.importance != 'normal'):
            key = 'tolerate' if callback.tolerate else 'importance'
            raise error(key, 'it has no deadline that could be missed',
                        f"remove '{key}:', or give it a deadline")
        if callback.kind == 'sync' and is_source and callback.driven_by is None:
            raise error('period', 'a sync callback joins topics, so it cannot be a source',
                        "remove 'period:' and declare the publishers of its topics, or say which "
                        "topic drives it: 'sync: {topics: [...], driven_by: ...}'")
        if not is_source and any(topic in self.publishers for topic in callback.triggers):
            self._check_keys(callback, ('sink',), 'a topic of this graph starts this one',
                             'move it to the source callback')
        for topic in callback.triggers:
            publishers = self.publishers.get(topic)
            if is_source and publishers:
                publisher = self.callbacks[publishers[0]].key
                raise error('period', 'only a source has a period, but '
                            f'{quoted(publisher)} publishes {quoted(topic)}',
                            "remove 'period:', or take the topic out of that callback's "
                            "'publishes:'")
            if not is_source and not publishers:
                remedy = "add it to a 'publishes:'"
                if callback.kind == 'subscription' or callback.driven_by:
                    remedy += ", or add 'period:' if it comes from outside of the graph"
                raise error(callback.kind, f'no callback publishes {quoted(topic)}',
                            self._similar_topic(callback, topic, remedy), item=topic)

    def _similar_topic(self, callback: Callback, topic: str, otherwise: str) -> str:
        """Return the remedy for a topic that is not published: where a similar one is."""
        similar = nearest(topic, self.publishers)
        if similar is None:
            return otherwise
        publisher = self.callbacks[self.publishers[similar][0]]
        entry = self.entries[publisher.key]
        line = entry.line_of(
            'may_publish' if similar in publisher.may_publish else 'publishes', similar)
        place = f'line {line}' if entry.file == self.entries[callback.key].file else (
            f'{entry.file}:{line}')
        return f'did you mean {quoted(similar)} of {quoted(publisher.key)} ({place})?'

    def check_end(self, callback: Callback, without: list[str] | None) -> None:
        """Check that exactly the sinks have deadlines (rule 6); or collect those without."""
        topic = next((t for t in callback.publishes if t in self._started), None)
        if topic is not None:
            after = self.callbacks[self._started[topic][0]].key
            self._check_keys(callback, ('source',) if _is_source(callback) else (),
                             f'this callback starts {quoted(after)} by {quoted(topic)}',
                             "move it to the sinks after it, or read that topic by a queue edge "
                             "('reads:')")
        elif not callback.judged:
            pass
        elif callback.deadline_ns is None and without is not None:
            without.append(callback.key)
        elif callback.deadline_ns is None:
            raise self.entries[callback.key].error(
                None, 'it is a sink (it starts no other callback) and has no deadline',
                "add 'deadline:', or 'deadline: none' if nothing depends on when it ends")

    def _check_keys(
        self, callback: Callback, may_be: tuple[str, ...], why: str, remedy: str
    ) -> None:
        """Refuse keys for sources and sinks on other callbacks, unless they say the default."""
        entry = self.entries[callback.key]
        for key in entry:
            kind, of = CALLBACK_KEYS[key].kind, CALLBACK_KEYS[key].of
            if of and not set(of).intersection(may_be) and entry.get(key) != kind.missing:
                raise entry.error(key, f"'{key}:' is for a {' or a '.join(of)}, and {why}", remedy)

    def queue_edge(self, reading: tuple[Callback, str]) -> QueueEdge:
        """Return the queue edge of a callback that reads a topic or variable (rule 1)."""
        callback, read = reading
        error = self.entries[callback.key].error
        if read.startswith('/'):
            writers = tuple(self.callbacks[place].key for place in self.publishers.get(read, ()))
            if not writers and read in callback.reads:
                raise error('reads', f'it reads {quoted(read)}, which no callback publishes',
                            self._similar_topic(callback, read, "add it to a 'publishes:'"),
                            item=read)
            return QueueEdge(callback.key, read, writers)
        writer = f'{callback.node}:{read}'
        if writer not in self._by_key:
            siblings = [each.name for each in self.callbacks if each.node == callback.node]
            raise error(
                'reads', f'it reads the unknown callback {quoted(read)}',
                did_you_mean(read, siblings, f'name a callback of its node: {listed(siblings)}'),
                item=read)
        return QueueEdge(callback.key, None, (writer,))

    def check_path(self, path: Path) -> None:
        """Check that each step of a path is a trigger or queue edge (rule 1)."""
        error = self.entries[path.name].error
        for key in path.callbacks:
            if key not in self._by_key:
                raise error('callbacks', f'unknown callback {quoted(key)}',
                            did_you_mean(key, self._by_key, 'name a declared callback'), item=key)
        for before, after in pairwise(map(self._by_key.__getitem__, path.callbacks)):
            reads_variable = before.node == after.node and before.name in after.reads
            if not reads_variable and set(before.publishes).isdisjoint(
                    after.topics + after.reads):
                raise error(
                    'callbacks', 'no trigger or queue edge leads from '
                    f'{quoted(before.key)} to {quoted(after.key)}',
                    "name the callbacks between them, or add what is missing to 'reads:'",
                    item=after.key)

    def order(self) -> list[int]:
        """Return the callbacks in a topological order; a cycle is an error (rule 3)."""
        before: dict[Any, Iterable[Any]] = dict(self.publishers)
        before.update((place, () if _is_source(callback) else callback.triggers)
                      for place, callback in enumerate(self.callbacks))
        try:
            return [each for each in TopologicalSorter(before).static_order()
                    if isinstance(each, int)]
        except CycleError as error:
            cycle = [each for each in error.args[1] if isinstance(each, int)]
            raise self._cyclic(list(dict.fromkeys(cycle))) from None

    def _cyclic(self, cycle: list[int]) -> GraphError:
        """Return the error about callbacks of which each starts the next, the last the first."""
        first = cycle.index(min(cycle))
        keys = [self.callbacks[place].key for place in cycle[first:] + cycle[:first + 1]]
        if len(keys) > 9:
            keys[8:-1] = [f'… ({len(keys) - 9} more)']
        callback = self.callbacks[cycle[first]]
        return self.entries[callback.key].error(
            callback.kind, f'callbacks start each other in a cycle: {" -> ".join(keys)}',
            "cut it with a queue edge: start one of them by a timer, and list the topic that "
            "started it under its 'reads:'")


def _is_source(callback: Callback) -> bool:
    return callback.period_ns is not None


@dataclass(eq=False, slots=True)
class _Vertex:
    """A vertex in the making; callbacks are places in the file, ``index`` is that in its DAG."""

    callback: int
    source: int
    before: list[_Vertex]
    after: list[_Vertex] = field(default_factory=list)
    index: int = -1


def _vertices(links: _Links, order: list[int]) -> list[list[_Vertex]]:
    """Make the vertices of each callback, after those of its publishers (rules 4 and 5)."""
    vertices: list[list[_Vertex]] = [[] for _ in links.callbacks]
    size = 0
    for place in order:
        callback = links.callbacks[place]
        publishers = set() if _is_source(callback) else {
            publisher for topic in callback.triggers for publisher in links.publishers[topic]}
        count = sum(len(vertices[publisher]) for publisher in publishers)
        is_sync = callback.kind == 'sync' and callback.driven_by is None
        size += count + (count if publishers and not is_sync else 1)
        if size > MAX_SIZE:
            raise links.entries[callback.key].error(
                None, f'with it the DAGs have more than {MAX_SIZE} vertices and edges',
                'a callback runs once for each publisher before it: use fewer publishers for '
                "one topic, or read some by a queue edge ('reads:')")
        before = [vertex for publisher in sorted(publishers) for vertex in vertices[publisher]]
        if not before:
            vertices[place] = [_Vertex(place, place, [])]
        elif is_sync:
            _check_one_source(links, callback, before)
            vertices[place] = [_Vertex(place, before[0].source, before)]
        else:
            vertices[place] = [_Vertex(place, each.source, [each]) for each in before]
    return vertices


def _check_one_source(links: _Links, callback: Callback, before: list[_Vertex]) -> None:
    other = next((v for v in before if v.source != before[0].source), None)
    if other is None:
        return
    published = links.callbacks[other.callback].publishes
    topic = next(topic for topic in callback.topics if topic in published)
    first, second = (quoted(links.callbacks[v.source].key) for v in (before[0], other))
    raise links.entries[callback.key].error(
        'sync', f'it joins two sources, {first} and {second}, but a DAG has one',
        f"say which topic drives it: 'sync: {{topics: [{', '.join(callback.topics)}], driven_by: "
        f"{callback.topics[0]}}}'; the others become queue edges", item=topic)


def _dags(links: _Links, vertices: list[list[_Vertex]]) -> tuple[Dag, ...]:
    """Sort the vertices into DAGs and number both (rules 5 and 7)."""
    members: dict[int, list[_Vertex]] = {
        place: [] for place, callback in enumerate(links.callbacks) if _is_source(callback)}
    for of_callback in vertices:
        for vertex in of_callback:
            vertex.index = len(members[vertex.source])
            members[vertex.source].append(vertex)
    names = _dag_names(links, list(members))
    is_single = [len(of_callback) == 1 for of_callback in vertices]
    return tuple(
        _dag(links.callbacks, place, names[place], index, of_dag, is_single)
        for index, (place, of_dag) in enumerate(members.items()))


def _dag_names(links: _Links, sources: list[int]) -> dict[int, str]:
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
                f'its DAG has the name {quoted(name)}, as that of {quoted(other)}',
                "give it another one with 'dag:'")
        taken[name] = source
        names[source] = name
    return names


def _dag(
    callbacks: Sequence[Callback], source: int, name: str, index: int, members: list[_Vertex],
    is_single: list[bool],
) -> Dag:
    """Return a DAG; ``is_single`` says by callback whether it is only one vertex of all DAGs."""
    for vertex in members:
        for before in vertex.before:
            before.after.append(vertex)
    number_here = Counter(vertex.callback for vertex in members)
    seen: Counter[int] = Counter()
    vertices = []
    for vertex in members:
        callback = callbacks[vertex.callback]
        vertex_name = callback.key if is_single[vertex.callback] else f'{callback.key}@{name}'
        if number_here[vertex.callback] > 1:
            seen[vertex.callback] += 1
            vertex_name += f'#{seen[vertex.callback]}'
        topics = {topic: place for place, topic in enumerate(callback.publishes)}
        after = sorted(vertex.after, key=lambda v: min(
            topics[topic] for topic in callbacks[v.callback].triggers if topic in topics))
        vertices.append(Vertex(
            name=vertex_name, callback=callback, dag=index, index=vertex.index,
            predecessors=tuple(sorted(v.index for v in vertex.before)),
            successors=tuple(v.index for v in after), deadline_ns=callback.deadline_ns))
    first = callbacks[source]
    assert first.period_ns is not None
    return Dag(
        name=name, index=index, period_ns=first.period_ns, vertices=tuple(vertices),
        source=next(v.index for v in members if v.callback == source),
        sinks=tuple(v.index for v in vertices if not v.successors and v.callback.judged),
        edges=tuple((v.index, after) for v in vertices for after in sorted(v.successors)),
        release_from=first.release_from, on_late=first.on_late,
        max_active_jobs=first.max_active_jobs)
