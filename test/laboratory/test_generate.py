# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Random task sets."""

from collections import Counter
from dataclasses import replace

from hypothesis import given
import hypothesis.strategies as st
from mddag_executor.errors import UsageError
from mddag_executor.laboratory.generate import generate, Options
from mddag_executor.laboratory.shapes import MOST_COPIES
from msg_graph import loads
from msg_graph.model import load_of
import pytest

from ..conftest import examples


def pairs(low, high):
    return st.tuples(st.integers(low, high), st.integers(low, high)).map(
        lambda pair: (min(pair), max(pair)))


@st.composite
def any_options(draw):
    dags, workers = draw(pairs(1, 5)), draw(st.integers(1, 8))
    vertices = draw(pairs(1, 12))
    most_per_dag = draw(st.floats(0.2, 3.0))
    most = dags[0] * most_per_dag / workers
    sinks = draw(pairs(1, max(1, vertices[0] - 1)))
    return Options(
        dags=dags, vertices=vertices, sinks=(sinks[0], draw(st.integers(sinks[1], 12))),
        edge_probability=draw(st.floats(0.0, 1.0)),
        or_share=draw(st.sampled_from([0.0, 0.5, 1.0])),
        utilisation=most * draw(st.floats(0.1, 1.0)), workers=workers,
        most_per_dag=most_per_dag,
        periods_ns=tuple(draw(st.lists(
            st.integers(2_000, 200_000).map(lambda us: us * 1000), min_size=1, max_size=4))),
        tightness=tuple(sorted(draw(st.tuples(st.floats(0.1, 3.0), st.floats(0.1, 3.0))))),
        seed=draw(st.integers(0, 2 ** 70)))


@examples(150)
@given(options=any_options())
def test_every_task_set_is_what_was_asked_for(options):
    try:
        text = generate(options, 3)
    except UsageError as error:
        assert 'less than 1 us' in str(error)
        return
    assert generate(options, 3) == text
    task_set = loads(text, 'random.yaml')
    assert task_set.workers == options.workers
    assert options.dags[0] <= len(task_set.dags) <= options.dags[1]
    each = [load_of(dag) or 0.0 for dag in task_set.dags]
    rounding = sum(1 / dag.period_ns for dag in task_set.dags)  # a DAG's time is in whole ns
    assert sum(each) == pytest.approx(options.utilisation * options.workers, abs=rounding)
    assert max(each) <= options.most_per_dag + rounding
    for dag in task_set.dags:
        assert dag.period_ns in options.periods_ns
        callbacks = Counter(vertex.callback.key for vertex in dag.vertices)
        sinks = {dag.vertices[sink].callback.key for sink in dag.sinks}
        assert options.vertices[0] <= len(callbacks) <= options.vertices[1]
        assert options.sinks[0] <= len(sinks) <= max(1, min(options.sinks[1], len(callbacks) - 1))
        assert max(callbacks.values()) <= (MOST_COPIES if options.or_share else 1)
        for sink in dag.sinks:
            low, high = (dag.period_ns * factor for factor in options.tightness)
            deadline = dag.vertices[sink].deadline_ns or 0
            off = 1000 + high * 1e-6 + len(dag.vertices)
            assert low - off <= deadline <= high + off or deadline == 1000


@pytest.mark.parametrize(('change', 'problem'), [
    ({'dags': (0, 3)}, '--dags 0: it is out of range: give 1 to 1000'),
    ({'dags': (5, 3)}, '--dags 5:3: the first is larger: write the smaller one first'),
    ({'tightness': (0.0, 1.0)}, '--tightness 0: it is out of range: give above 0 to 1000'),
    ({'utilisation': 0.9, 'dags': (3, 3)},
     '--utilisation 0.9: a load of 3.6 does not fit into 3 DAGs of at most 1: '),
    ({'utilisation': 1e-6}, '--utilisation 1e-06: it leaves a callback less than 1 us: give more'),
])
def test_impossible(change, problem):
    with pytest.raises(UsageError) as caught:
        generate(replace(Options(), **change))
    assert str(caught.value).startswith(problem)
