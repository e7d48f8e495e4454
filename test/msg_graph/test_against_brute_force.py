# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Random declarations, derived twice: by the package and by definition."""

from collections import Counter

from hypothesis import given
from msg_graph import GraphError, loads
import yaml

from ..conftest import examples
from .brute import all_violations, as_yaml, components, expand, name_of_dag, rank
from .random_declarations import declarations


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
