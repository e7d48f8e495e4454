# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The rules of the model once more, straight from their definition and without regard to cost.

A vertex is written as what it is: `(callback, frozenset of the vertices that start it)`. Vertices
are found by trying everything until nothing new appears, cycles by transitive closure, DAGs as
connected components. Nothing is shared with `msg_graph`.
"""

from dataclasses import dataclass, field
from itertools import product
from typing import Any

Vertex = tuple[int, frozenset[Any]]


@dataclass
class Spec:
    """A callback of a random declaration; `place` in the list is its place in the file."""

    node: str
    name: str
    start: str  # timer | outside | service | subscription | sync
    topics: list[str] = field(default_factory=list)
    publishes: list[str] = field(default_factory=list)
    reads: list[str] = field(default_factory=list)
    deadline: bool = False
    dag: str | None = None

    @property
    def key(self):
        """Return node and name."""
        return f'{self.node}:{self.name}'

    @property
    def is_source(self):
        """Tell whether a job starts here."""
        return self.start in ('timer', 'outside', 'service')


def name_of_dag(source, specs):
    """Return the name of the DAG that a source starts."""
    alike = [spec for spec in specs
             if spec.is_source and spec.node == source.node and not spec.dag]
    return source.dag or (source.node if len(alike) == 1 else f'{source.node}/{source.name}')


def violations(specs):
    """Return which rules the declared callbacks break."""
    found = set()
    published = {topic for spec in specs for topic in spec.publishes}
    for spec in specs:
        if spec.start in ('subscription', 'sync') and not published.issuperset(spec.topics):
            found.add('no callback publishes')
        if spec.start == 'outside' and published.intersection(spec.topics):
            found.add('only a source has a period')
        for read in spec.reads:
            if read.startswith('/') and read not in published:
                found.add('which no callback publishes')
            if not read.startswith('/') and not any(
                    other.node == spec.node and other.name == read for other in specs):
                found.add('unknown callback')
    starts = {(a, b) for a, b in product(range(len(specs)), repeat=2) if _starts(specs, a, b)}
    for a, spec in enumerate(specs):
        is_sink = not any((a, b) in starts for b in range(len(specs)))
        if is_sink and not spec.deadline:
            found.add('has no deadline')
        if spec.deadline and not is_sink:
            found.add('is for a sink')
    for via in range(len(specs)):
        starts |= {(a, b) for a, b in product(range(len(specs)), repeat=2)
                   if (a, via) in starts and (via, b) in starts}
    if any(a == b for a, b in starts):
        found.add('in a cycle')
    names = [name_of_dag(spec, specs) for spec in specs if spec.is_source]
    if len(set(names)) < len(names):
        found.add('its DAG has the name')
    return found


def all_violations(specs):
    """Return which rules the declared callbacks or the vertices made of them break."""
    found = violations(specs)
    if found.isdisjoint({'in a cycle', 'no callback publishes', 'only a source has a period'}):
        parts = components(expand(specs))
        if any(sum(not vertex[1] for vertex in part) != 1 for part in parts):
            found.add('joins two sources')
    return found


def _starts(specs, a, b):
    return not specs[b].is_source and bool(set(specs[a].publishes) & set(specs[b].topics))


def expand(specs):
    """Return all vertices of a declaration that breaks none of the rules above."""
    vertices = {(i, frozenset()) for i, s in enumerate(specs) if s.is_source}
    while True:
        new = set(vertices)
        for i, spec in enumerate(specs):
            before = frozenset(v for v in vertices if _starts(specs, v[0], i))
            if spec.start == 'subscription':
                new |= {(i, frozenset([v])) for v in before}
            elif spec.start == 'sync' and before:
                # what was found for it in an earlier, incomplete round is void
                new = {v for v in new if v[0] != i}
                new.add((i, before))
        new = {v for v in new if v[1] <= new}
        if new == vertices:
            return vertices
        vertices = new


def components(vertices):
    """Return the weakly connected components."""
    neighbours = {v: set() for v in vertices}
    for vertex in vertices:
        for before in vertex[1]:
            neighbours[vertex].add(before)
            neighbours[before].add(vertex)
    found = []
    left = set(vertices)
    while left:
        part, reach = set(), {next(iter(left))}
        while reach:
            part |= reach
            reach = {n for v in reach for n in neighbours[v]} - part
        left -= part
        found.append(part)
    return found


def rank(vertex):
    """Return what vertices of one DAG are ordered by: callback, then what starts it."""
    return (vertex[0], sorted(rank(before) for before in vertex[1]))


def as_yaml(specs):
    """Return the declaration as plain data; each callback has an entry of its node."""
    nodes = []
    for spec in specs:
        callback = {'name': spec.name}
        if spec.start == 'timer':
            callback['timer'] = '10ms'
        elif spec.start == 'service':
            callback |= {'service': '/ask', 'period': '20 ms'}
        elif spec.start == 'sync':
            callback['sync'] = spec.topics
        else:
            callback['subscription'] = spec.topics[0]
            if spec.start == 'outside':
                callback['period'] = '0.01s'
        if spec.deadline:
            callback['deadline'] = '7ms'
        for key in ('publishes', 'reads', 'dag'):
            if getattr(spec, key):
                callback[key] = getattr(spec, key)
        nodes.append({'node': spec.node, 'callbacks': [callback]})
    return {'mddag': 1, 'nodes': nodes}
