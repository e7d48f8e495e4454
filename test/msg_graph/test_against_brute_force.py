# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Random declarations, derived twice: by the package and by definition."""

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st
from msg_graph import GraphError, loads
import yaml

from ..conftest import examples
from .brute import all_violations, as_yaml, components, expand, name_of_dag, rank, Spec

TOPICS = [f'/t{i}' for i in range(4)]


@st.composite
def declarations(draw):
    """
    Draw a declaration that is right more often than not.

    Callbacks subscribe to what those drawn before them publish and get deadlines where they
    belong; then a few entries may be spoilt, and the order of the file is shuffled.
    """
    specs = []
    for i in range(draw(st.integers(1, 7))):
        published = sorted({topic for spec in specs for topic in spec.publishes})
        starts = ['timer', 'outside', 'service'] if i == 0 else ['timer', 'outside']
        starts += ['subscription'] * (9 if published else 0) + ['sync'] * 8 * (len(published) > 1)
        start = draw(st.sampled_from(starts))
        topics = []
        if start == 'subscription':
            topics = [draw(st.sampled_from(published))]
        elif start == 'sync':
            topics = draw(st.lists(
                st.sampled_from(published), min_size=2, max_size=3, unique=True))
        elif start == 'outside':
            topics = ['/outside']
        # Only topics of higher numbers than those that start it: no cycle, unless spoilt.
        free = TOPICS[max((TOPICS.index(t) + 1 for t in topics if t in TOPICS), default=0):]
        publishes = draw(st.lists(
            st.sampled_from(free), min_size=int(i < 4), max_size=2, unique=True)) if free else []
        node = draw(st.sampled_from(['/a', '/b/c']))
        dag = draw(st.sampled_from([None, 'd', *[f'd{i}'] * 5])) if start in (
            'timer', 'outside', 'service') else None
        specs.append(Spec(node, f'c{i}', start, topics, publishes, [], False, dag))
    for spec in specs:
        started = {t for s in specs if s.start in ('subscription', 'sync') for t in s.topics}
        spec.deadline = not started.intersection(spec.publishes)
        published = sorted({topic for s in specs for topic in s.publishes})
        known = published + [s.name for s in specs if s.node == spec.node]
        spec.reads = draw(st.lists(st.sampled_from(known), max_size=2, unique=True))
    if draw(st.booleans()):
        _spoil(draw, draw(st.sampled_from(specs)))
    return draw(st.permutations(specs))


def _spoil(draw, spec):
    what = draw(st.sampled_from([
        'deadline', 'publish', 'loop', 'loop', 'subscribe', 'reads', 'silent', 'outside']))
    topic = draw(st.sampled_from(TOPICS))
    if what == 'deadline':
        spec.deadline = not spec.deadline
    elif what == 'publish' and topic not in spec.publishes:
        spec.publishes.append(topic)
    elif what == 'loop' and spec.topics and spec.topics[0] not in spec.publishes:
        spec.publishes.append(spec.topics[0])
    elif what == 'subscribe' and topic not in spec.topics and spec.topics:
        spec.topics[0] = topic
    elif what == 'reads':
        spec.reads = [draw(st.sampled_from([topic, 'c0', 'nobody']))]
    elif what == 'silent':
        spec.publishes = []
    elif what == 'outside' and spec.start == 'subscription':
        spec.start = 'outside'


def provenance(dag, places):
    """Return the DAG's vertices by index, each written as what it is."""
    found = {}

    def write(index):
        if index not in found:
            vertex = dag.vertices[index]
            found[index] = (
                places[vertex.callback.key], frozenset(write(p) for p in vertex.predecessors))
        return found[index]

    return [write(index) for index in range(len(dag.vertices))]


def check_names(tasks):
    """Names say the callback, the DAG where there is a choice, and a number where needed."""
    vertices = [v for dag in tasks.dags for v in dag.vertices]
    assert len({v.name for v in vertices}) == len(vertices)
    of_key = Counter(v.callback.key for v in vertices)
    of_dag = Counter((v.callback.key, v.dag) for v in vertices)
    for v in vertices:
        expected = v.callback.key
        if of_key[v.callback.key] > 1:
            expected += f'@{tasks.dags[v.dag].name}'
        if of_dag[v.callback.key, v.dag] > 1:
            base, _, number = v.name.rpartition('#')
            assert base == expected
            assert 1 <= int(number) <= of_dag[v.callback.key, v.dag]
        else:
            assert v.name == expected


def check_same(tasks, specs):
    vertices = expand(specs)
    parts = components(vertices)
    assert [c.key for c in tasks.callbacks] == [spec.key for spec in specs]
    places = {spec.key: i for i, spec in enumerate(specs)}
    parts.sort(key=lambda part: [v[0] for v in part if not v[1]])
    assert len(tasks.dags) == len(parts)
    for index, (dag, part) in enumerate(zip(tasks.dags, parts)):
        source, = (v for v in part if not v[1])
        spec = specs[source[0]]
        assert (dag.index, dag.name) == (index, name_of_dag(spec, specs))
        assert dag.period_ns == (20_000_000 if spec.start == 'service' else 10_000_000)
        written = provenance(dag, places)
        assert written == sorted(part, key=rank)
        assert written[dag.source] == source
        expected = {
            (written.index(before), i) for i, v in enumerate(written) for before in v[1]}
        assert list(dag.edges) == sorted(expected)
        sinks = [i for i in range(len(written)) if not any(a == i for a, _ in expected)]
        assert list(dag.sinks) == sinks
        for i, vertex in enumerate(dag.vertices):
            assert (vertex.dag, vertex.index) == (index, i)
            assert list(vertex.predecessors) == sorted(a for a, b in expected if b == i)
            listed = specs[written[i][0]].publishes
            assert list(vertex.successors) == sorted(
                (b for a, b in expected if a == i),
                key=lambda b: (min(listed.index(topic) for topic in specs[written[b][0]].topics
                                   if topic in listed), b))
            assert vertex.deadline_ns == (7_000_000 if i in sinks else None)
    queue = [(e.reader, e.topic, list(e.writers)) for e in tasks.queue_edges]
    assert queue == [
        (spec.key, read if read.startswith('/') else None,
         [s.key for s in specs if read in s.publishes or (
             s.node == spec.node and s.name == read)])
        for spec in specs for read in spec.reads]
    check_names(tasks)


@examples(300)
@given(declarations())
def test_same_as_by_definition(specs):
    text = yaml.safe_dump(as_yaml(specs))
    broken = all_violations(specs)
    try:
        tasks = loads(text)
    except GraphError as error:
        assert any(rule in error.problem for rule in broken), (str(error), broken, text)
        assert error.line is not None
    else:
        assert not broken, (broken, text)
        check_same(tasks, specs)
