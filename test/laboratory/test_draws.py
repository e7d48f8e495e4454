# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Execution times for many runs: tables and measured values, one draw for each vertex and run."""

from __future__ import annotations

import io
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.errors import InputError
from mddag_executor.laboratory.draws import Draws, feasible, read_samples, utilisations
from msg_graph import ExecutionTime, loads, TaskSet
import numpy as np
import pytest

from ..core.task_sets import examples

GRAPH = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: a, timer: 10ms, dag: one, publishes: [/a], execution_time: {quantiles_us: [5, 9]}}
      - {name: b, timer: 20ms, dag: two, publishes: [/a], execution_time: 2ms}
      - name: c
        subscription: /a
        deadline: 4ms
        execution_time: {quantiles_us: [100, 900], percent: [50, 100]}
"""


@pytest.fixture
def task_set() -> TaskSet:
    """Give two DAGs of two vertices each, which share the callback c."""
    return loads(GRAPH, 'graph.yaml')


def table(values: list[int], percent: list[float]) -> TaskSet:
    text = GRAPH.replace('{quantiles_us: [5, 9]}', str({
        'quantiles_us': [value / 1000 for value in values], 'percent': percent}))
    return loads(text, 'graph.yaml')


@examples(100)
@given(st.lists(st.integers(1, 10 ** 9), min_size=1, max_size=6),
       st.lists(st.floats(0, 100), min_size=6, max_size=6, unique=True),
       st.integers(0, 2 ** 64 - 1))
def test_tables_are_drawn_as_one_by_one(
    values: list[int], percent: list[float], seed: int
) -> None:
    """The columns hold to the bit what ExecutionTime.draw gives for the same numbers."""
    quantiles = sorted(values)
    task_set = table(quantiles, sorted(percent)[:len(quantiles)])
    drawn = Draws(task_set, seed).times(5, 4)
    for row in range(4):
        generator = np.random.Generator(
            np.random.Philox(key=np.array([seed, 5 + row], dtype=np.uint64)))
        for vertex, u in zip(task_set.vertices, generator.random(4)):
            times = vertex.callback.execution_time
            assert isinstance(times, ExecutionTime)
            column = task_set.vertices.index(vertex)
            assert drawn[row, column] == max(1, times.draw(float(u)))


def test_a_run_is_the_same_in_any_chunk(task_set: TaskSet) -> None:
    draws = Draws(task_set, 7)
    whole = draws.times(0, 20)
    parts = np.concatenate([draws.times(0, 3), draws.times(3, 1), draws.times(4, 16)])
    assert (whole == parts).all()
    assert (Draws(task_set, 8).times(0, 20) != whole).any()


def test_vertices_of_one_callback_are_drawn_apart(task_set: TaskSet) -> None:
    names = [vertex.name for vertex in task_set.vertices]
    first, second = (names.index(f'/n:c@{dag.name}') for dag in task_set.dags)
    drawn = Draws(task_set, 0).times(0, 50)
    assert (drawn[:, first] != drawn[:, second]).any()


def test_measured_values_are_rounded_up_to_us(task_set: TaskSet, tmp_path: Path) -> None:
    path = tmp_path / 'samples.npz'
    np.savez(path, **{'/n:a': [0, 1, 1000, 1001], '/n:b': [2_000_000.5], '/n:c': [5, 7]})
    samples = read_samples(task_set, path, 'samples.npz')
    assert samples['/n:a'].tolist() == [1000, 1000, 1000, 2000]
    assert samples['/n:b'].tolist() == [2_001_000]
    drawn = Draws(task_set, 0, samples).times(0, 4000)
    values, counts = np.unique(drawn[:, 0], return_counts=True)
    assert values.tolist() == [1000, 2000]
    assert counts[0] / 4000 == pytest.approx(0.75, abs=0.03)  # 4 standard deviations


def npz(**arrays: object) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)  # type: ignore[arg-type]
    return file.getvalue()


def npy(array: object) -> bytes:
    file = io.BytesIO()
    np.save(file, np.asarray(array), allow_pickle=True)
    return file.getvalue()


GOOD = {'/n:a': [1], '/n:b': [1], '/n:c': [1]}


@pytest.mark.parametrize(('content', 'problem'), [
    (b'', 'this is no .npz file'),
    (b'mddag: 1', 'this is no .npz file'),
    (npz(**GOOD)[:-30], 'this is no .npz file'),
    (npy([1, 2]), 'this is a single array, not an .npz file'),
    (npz(**{'/n:a': [1], '/n:b': [1]}), 'no values for /n:c: add an array of that name'),
    (npz(**{**GOOD, '/n:b': []}), 'the values of /n:b are no list of numbers'),
    (npz(**{**GOOD, '/n:b': [[1]]}), 'the values of /n:b are no list of numbers'),
    (npz(**{**GOOD, '/n:b': ['x']}), 'the values of /n:b are no list of numbers'),
    (npz(**{**GOOD, '/n:b': np.array([{}])}), 'the values of /n:b are damaged or no numbers'),
    (npz(**{**GOOD, '/n:b': [1, -1]}), 'a value of /n:b is negative or no number of ns'),
    (npz(**{**GOOD, '/n:b': [1, float('nan')]}), 'a value of /n:b is negative or no number'),
    (npz(**{**GOOD, '/n:b': [10 ** 18]}), 'a value of /n:b is negative or no number of ns'),
])
def test_bad_samples(
    task_set: TaskSet, tmp_path: Path, content: bytes, problem: str
) -> None:
    path = tmp_path / 'samples.npz'
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_samples(task_set, path, 'samples.npz')
    assert str(caught.value).startswith(f'samples.npz: {problem}')
    assert '\n' not in str(caught.value)


def test_damaged_values(task_set: TaskSet, tmp_path: Path) -> None:
    content = bytearray(npz(**{key: np.arange(1000) for key in GOOD}))
    content[4000] ^= 0xFF
    path = tmp_path / 'samples.npz'
    path.write_bytes(content)
    with pytest.raises(InputError, match='are damaged or no numbers'):
        read_samples(task_set, path, 'samples.npz')


def test_utilisation_and_bound(task_set: TaskSet) -> None:
    """By hand: periods 10 and 20 ms, both sinks with a deadline of 4 ms."""
    ms = 1_000_000
    times = np.array([
        [1, 2, 1, 3], [2, 2, 1, 3], [3, 2, 1, 1], [1, 1, 2, 3]], dtype=np.int64) * ms
    assert utilisations(task_set, times, 2).tolist() == pytest.approx(
        [0.25, 0.3, 0.3, 0.225])
    assert feasible(task_set, times, 2, 100 * ms).tolist() == [True, True, False, False]
    assert feasible(task_set, times, 2, 3 * ms).all()  # no deadline within


def test_bound_by_demand() -> None:
    """Deadlines of 40 ms: within 100 ms are those of 7 jobs of one DAG and 4 of the other."""
    ms = 1_000_000
    task_set = loads(GRAPH.replace('4ms', '40ms'), 'graph.yaml')
    times = np.array([[5, 2, 3, 4], [5, 6, 3, 4], [1, 2, 3, 50]], dtype=np.int64) * ms
    # 7 * 7 + 4 * 7 = 77, 7 * 11 + 4 * 7 = 105 of 100 ms; the last has a path of 53 ms
    assert feasible(task_set, times, 1, 100 * ms).tolist() == [True, False, False]
    assert feasible(task_set, times, 2, 100 * ms).tolist() == [True, True, False]
