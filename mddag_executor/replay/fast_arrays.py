# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The arrays of the compiled replay: made, made larger, and read (see ``fast_work``)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import Any

from mddag_executor.replay import fast_work as fw
from mddag_executor.replay.fast_work import Work
from mddag_executor.replay.judge import Judge
from mddag_executor.replay.mapping import Mapping
from mddag_executor.replay.own_paths import OwnPaths
from mddag_executor.replay.path_flows import Flows
from mddag_executor.replay.paths import hops
from mddag_executor.replay.usage import Usage
from msg_graph import TaskSet
import numpy as np

_HOPS = {'trigger': fw.TRIGGER, 'topic': fw.TOPIC, 'variable': fw.VARIABLE}
_TABLES = (
    'threads', 'ongoing', 'slots', 'recent', 'callbacks', 'pairs', 'path_jobs', 'publishers')
_RUNS = 3       # of a vertex in a job that are kept at least
FIRST_STEPS = 1 << 16
"""Steps of flows that there is room for at first."""
_MOST_PLACES = 2 ** 16
_MOST_NUMBERS = 2 ** 24     # that are kept of all jobs


def array(values: Sequence[Any]) -> Any:
    """Return an array of numbers."""
    return np.array(values, dtype=np.int64)


def _rows(lists: Sequence[Sequence[int]]) -> tuple[Any, Any]:
    """Return where each list begins (and the last ends) in their concatenation, and that."""
    return (array([0, *accumulate(map(len, lists))]),
            array([value for each in lists for value in each]))


def zeros(*shape: int) -> Any:
    """Return an array of zeros."""
    return np.zeros(shape, dtype=np.int64)


class Declined(Exception):
    """Something is for the plain replay; inside of the compiled one only."""


class Numbers:
    """
    The numbers that places of paths, topics and nodes have.

    :param task_set: the declaration that judges.
    """

    def __init__(self, task_set: TaskSet) -> None:
        self._task_set = task_set
        self._hops = [hops(task_set, path) for path in task_set.paths]
        named = [topic for c in task_set.callbacks for topic in (*c.topics, *c.publishes)]
        named += [topic for path in self._hops for hop in path for topic in sorted(hop.topics)]
        self._topics = {topic: i for i, topic in enumerate(dict.fromkeys(named))}
        self._other = len(self._topics)
        self._nodes = {node: i for i, node in enumerate(
            dict.fromkeys(c.node for c in task_set.callbacks))}
        # by callback, its places; all places of a path follow one another
        self._places: dict[str, list[int]] = {}
        self._first_place = [0]
        for path in task_set.paths:
            for position, key in enumerate(path.callbacks):
                self._places.setdefault(key, []).append(self._first_place[-1] + position)
            self._first_place.append(self._first_place[-1] + len(path.callbacks))

    def topic(self, name: str) -> int:
        """Return the number of a topic plus one, 0 for no name."""
        return 1 + self._topics.get(name, self._other) if name else 0

    def columns(self) -> dict[str, Any]:
        """Return the arrays of paths as they are at first."""
        task_set = self._task_set
        n = self._first_place[-1]
        hop_topics, publish_topics = zeros(n, self._other + 1), zeros(n, self._other + 1)
        position, kind, sync, last = (zeros(n) for _ in range(4))
        for first, path, path_hops in zip(self._first_place, task_set.paths, self._hops):
            for i, key in enumerate(path.callbacks):
                position[first + i] = i
                sync[first + i] = task_set.callback(key).kind == 'sync'
                last[first + i] = i == len(path_hops)
                if i:
                    kind[first + i] = _HOPS[path_hops[i - 1].kind]
                for topic in path_hops[i - 1].topics if i else ():
                    hop_topics[first + i, self._topics[topic]] = 1
                for topic in path_hops[i].topics if i < len(path_hops) else ():
                    publish_topics[first + i, self._topics[topic]] = 1
        nodes: list[list[int]] = [[] for _ in self._nodes]
        node_of = {c.key: c.node for c in task_set.callbacks}
        for key, places in self._places.items():
            nodes[self._nodes[node_of[key]]] += places
        node_places, node_place = _rows(nodes)
        return {
            **self._vertices(publish_topics), 'place_position': position, 'place_hop': kind,
            'place_sync': sync, 'place_last': last, 'hop_topics': hop_topics,
            'publish_topics': publish_topics, 'node_places': node_places,
            'node_place': node_place, 'place_started': zeros(n) - 1, 'place_done': zeros(n) - 1,
            'place_published': zeros(n) - 1}

    def _vertices(self, publish_topics: Any) -> dict[str, Any]:
        vertices = self._task_set.vertices
        v_places, v_place = _rows([self._places.get(v.callback.key, []) for v in vertices])
        v_topics, v_topic = _rows(
            [[self._topics[t] for t in v.callback.topics] for v in vertices])
        v_publishes, v_publish = _rows(
            [[self._topics[t] for t in v.callback.publishes] for v in vertices])
        v_befores, v_before = _rows([
            [i - v.index + p for p in v.predecessors] for i, v in enumerate(vertices)])
        runs, most = zeros(len(vertices)), zeros(len(vertices))
        message_at = zeros(len(v_place), self._other + 1) - 1
        wide = width = 0
        for i, vertex in enumerate(vertices):
            if vertex.index == 0:
                width = 0       # another DAG: other jobs
            places = range(v_places[i], v_places[i + 1])
            if places:
                runs[i] = width
                most[i] = max(_RUNS, 2 * len(vertex.callback.topics))
                width += 1 + int(most[i]) * (1 + len(places))
                for j in places:
                    for topic in np.flatnonzero(publish_topics[v_place[j]]).tolist():
                        message_at[j, topic] = width
                        width += 1
            wide = max(wide, width)
        rows = fw.KEEP_JOBS if self._task_set.paths else 1
        if rows * wide > _MOST_NUMBERS or self._first_place[-1] >= _MOST_PLACES:
            raise Declined
        return {
            'v_places': v_places, 'v_place': v_place, 'v_topics': v_topics, 'v_topic': v_topic,
            'v_publishes': v_publishes, 'v_publish': v_publish, 'v_befores': v_befores,
            'v_before': v_before, 'v_runs': runs, 'v_most': most, 'message_at': message_at,
            'jobs': np.empty((rows, wide), dtype=np.int64), 'job_ring': zeros(rows, 2)}

    def publishers(self, paths: OwnPaths) -> list[tuple[int, int, int]]:
        """Return what is known of publishers: address, and topic and node plus one."""
        return [
            (address, self.topic(topic) if topic in paths.book.topics else 0,
             1 + self._nodes.get(node, -1))
            for address, (node, topic) in paths.publishers.items()]

    def flows(self, work: Work) -> Flows:
        """Return what counts the flows along the paths."""
        columns: list[list[int]] = [[] for _ in self._task_set.dags]
        for v, vertex in enumerate(self._task_set.vertices):
            width = int(work.v_places[v + 1] - work.v_places[v])
            if not width:
                continue
            runs = int(work.v_runs[v]) + 1      # behind their number; before each its ready time
            columns[vertex.dag] += [
                runs + k * (1 + width) + 1 + j
                for k in range(int(work.v_most[v])) for j in range(width)]
            messages = work.message_at[work.v_places[v]:work.v_places[v + 1]]
            columns[vertex.dag] += messages[messages >= 0].tolist()
        return Flows(self._task_set.paths, self._hops, self._first_place,
                     [array(each) for each in columns])


def make_work(
    mapping: Mapping, judge: Judge, usage: Usage, paths: OwnPaths, numbers: Numbers
) -> Work:
    """Return the arrays of a replay that begins."""
    scalars = zeros(fw.N_SCALARS)
    scalars[[fw.BEGIN, fw.FIRST]] = -1
    scalars[fw.COUNTED] = -1
    scalars[fw.REGION] = max(judge.tables.n_region)
    scalars[fw.COMPARE] = judge.compare
    scalars[fw.HAS_PATHS] = bool(paths.book)
    tables = judge.tables
    n = tables.n_vertices
    widest = max((len(dag.vertices) for dag in mapping.task_set.dags), default=0)
    steps = FIRST_STEPS if paths.book else 1
    return Work(
        scalars=scalars, counts=zeros(fw.N_TABLES),
        **{name: zeros(256, width) for name, width in zip(_TABLES, fw.WIDTHS)},
        recent_ring=zeros(fw.KEEP_RECENT, 2), **_mapped(mapping), **_befores(judge),
        judge_newest=zeros(tables.n_dags + 1) - 1, released=zeros(tables.n_dags),
        use_of=array(usage.number_by_vertex()), use=zeros(len(usage.every()), fw.N_USE),
        workers=zeros(fw.MOST_WORKERS + 1, 2), group_busy=zeros(16 * fw.KEEP_BUSY, 2),
        group_count=zeros(16), chain=zeros(256, fw.N_CHAIN), walk=zeros(widest + 1),
        sinks=zeros(n + 1, fw.N_SINK), worst=zeros((n + 1) * (widest + 1), fw.N_CHAIN),
        misses=zeros(8192 + 4 * n, 6), **numbers.columns(),
        steps=np.empty((steps, fw.N_STEP), dtype=np.int64), rows=zeros(0, 1),
        pieces=zeros(0, fw.N_PIECE))


class Header:
    """
    Where arrays are, for compiled code.

    :param arrays: which live, and stay where they are, as long as this object.
    """

    def __init__(self, *arrays: Any) -> None:
        self._arrays = arrays
        self._words = array([
            word for each in arrays
            for word in (each.ctypes.data, len(each), each.shape[-1])])

    @property
    def address(self) -> int:
        """Return where this is told."""
        return int(self._words.ctypes.data)


def _mapped(mapping: Mapping) -> dict[str, Any]:
    map_first, map_vertex = _rows(mapping.vertex)
    map_legs, legs = _rows([legs for dag in mapping.leg for legs in dag])
    n = len(mapping.dag)
    return {'map_dag': array(mapping.dag), 'map_first': map_first, 'map_vertex': map_vertex,
            'map_legs': map_legs, 'legs': legs, 'newest': zeros(n) - 1, 'releases': zeros(n, 3)}


def _befores(judge: Judge) -> dict[str, Any]:
    before_legs, before = _rows(judge.chains.before)
    return {'before_legs': before_legs, 'before': before}


def grown(work: Work, executions: int, copy: Callable[..., None]) -> Work:
    """
    Return the arrays with more room where there is little.

    :param executions: how many the core's state has.
    :param copy: ``fast_kernel.copy_table``, compiled.
    """
    larger: dict[str, Any] = {}
    for number, name in enumerate(_TABLES):
        table = getattr(work, name)
        if 2 * work.counts[number] + 4 >= len(table):
            larger[name] = zeros(4 * len(table), table.shape[1])
            old, new = Header(table), Header(larger[name])
            copy(old.address, new.address)
    work.scalars[fw.FULL] = 0
    need = executions + int(work.scalars[fw.REGION])
    if need > len(work.chain):
        larger['chain'] = zeros(2 * need, fw.N_CHAIN)
        larger['chain'][:len(work.chain)] = work.chain
    return work._replace(**larger)
