# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Random execution times, shares of a load, and acceptance ratios."""

import io

from hypothesis import example, given
from hypothesis import strategies as st
from mddag_executor.errors import InputError
from mddag_executor.laboratory.acceptance import BINS, bins_of, wilson
from mddag_executor.laboratory.draws import Draws, feasible, read_samples, utilisations
from mddag_executor.laboratory.shares import Dice, dirichlet_rescale
from msg_graph import loads
import numpy as np
import pytest

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
def task_set():
    """Give two DAGs of two vertices each, which share the callback c."""
    return loads(GRAPH, 'graph.yaml')


def test_a_run_is_drawn_by_its_number(task_set):
    """Run 5 + r of a seed has the numbers of Philox with the key (seed, 5 + r)."""
    drawn = Draws(task_set, 2 ** 64 - 1).times(5, 4)
    for row in range(4):
        key = np.array([2 ** 64 - 1, 5 + row], dtype=np.uint64)
        uniform = np.random.Generator(np.random.Philox(key=key)).random(4)
        times = [vertex.callback.execution_time for vertex in task_set.vertices]
        assert drawn[row].tolist() == [
            time.draw(float(u)) for time, u in zip(times, uniform, strict=True)]


def npz(**arrays):
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


GOOD = {'/n:a': [1], '/n:b': [1], '/n:c': [1]}
UNFIT = ([], [[1]], ['x'], np.array([{}]), [1, -1], [1, float('nan')], [10 ** 18])


@pytest.mark.parametrize(('content', 'problem'), [
    (b'', 'this is not a .npz file'), (npz(**GOOD)[:-30], 'this is not a .npz file'),
    *((npz(**{**GOOD, '/n:b': values}), 'the values of /n:b are damaged, or not a list of ns')
      for values in UNFIT),
])
def test_bad_samples(task_set, tmp_path, content, problem):
    path = tmp_path / 'samples.npz'
    path.write_bytes(content)
    with pytest.raises(InputError, match=f'samples.npz: {problem}'):
        read_samples(task_set, path, 'samples.npz')


def test_utilisation_and_bound(task_set):
    """By hand: periods 10 and 20 ms, both sinks with a deadline of 4 ms."""
    ms = 1_000_000
    times = np.array([
        [1, 2, 1, 3], [2, 2, 1, 3], [3, 2, 1, 1], [1, 1, 2, 3]], dtype=np.int64) * ms
    assert utilisations(task_set, times, 2).tolist() == pytest.approx(
        [0.25, 0.3, 0.3, 0.225])
    assert feasible(task_set, times, 2, 100 * ms).tolist() == [True, True, False, False]
    assert feasible(task_set, times, 2, 3 * ms).all()  # no deadline within
    # deadlines of 40 ms: within 100 ms are those of 7 jobs of one DAG and 4 of the other
    task_set = loads(GRAPH.replace('4ms', '40ms'), 'graph.yaml')
    times = np.array([[5, 2, 3, 4], [5, 6, 3, 4], [1, 2, 3, 50]], dtype=np.int64) * ms
    # 7 * 7 + 4 * 7 = 77, 7 * 11 + 4 * 7 = 105 of 100 ms; the last has a path of 53 ms
    assert feasible(task_set, times, 1, 100 * ms).tolist() == [True, False, False]
    assert feasible(task_set, times, 2, 100 * ms).tolist() == [True, True, False]


def test_bins():
    edges = [0.0, 0.52499, 0.5251, 0.5749, 0.5751, 0.92501, 0.97499, 0.97501, 3.0]
    assert [BINS[place] for place in bins_of(np.array(edges))] == [
        0.5, 0.5, 0.55, 0.55, 0.6, 0.95, 0.95, 1.0, 1.0]


def test_wilson_covers_the_truth():
    """Of many samples about 95 % have the true ratio in their interval."""
    drawn = np.random.Generator(np.random.Philox(1)).binomial(60, 0.9, 4000)
    covered = [low <= 0.9 <= high for low, high in (wilson(int(k), 60) for k in drawn)]
    assert 0.92 < np.mean(covered) < 0.98


@given(limits=st.lists(st.floats(0.01, 2.0), min_size=1, max_size=30),
       part=st.floats(0.0, 1.0), seed=st.integers(0, 10 ** 6))
@example(limits=[1.0, 0.0, 1.0], part=1.0, seed=0)
@example(limits=[1.0, 1e-12, 1.0], part=0.49, seed=1)
@example(limits=[0.0, 0.5], part=0.9, seed=2)
@example(limits=[1.0, 1e-5], part=0.1, seed=3)
@example(limits=[0.375, 0.390625, 0.5, 0.5, 0.5, 0.015625], part=0.5, seed=42)
def test_dirichlet_rescale_keeps_sum_and_bounds(limits, part, seed):
    total = sum(limits) * part
    shares = dirichlet_rescale(Dice(str(seed)), total, limits)
    assert sum(shares) == pytest.approx(total, abs=1e-8)
    for share, limit in zip(shares, limits):
        assert 0.0 <= share <= limit * (1 + 1e-9)


@pytest.mark.parametrize('total', [0.7, 1.5, 2.6])
def test_dirichlet_rescale_is_as_uniform_as_throwing_away(total):
    """Quantiles of the largest of three shares are those of UUniFast-Discard."""
    dice = Dice('uniform')
    count, limits = 4000, [1.0, 1.0, 1.0]
    stretched = [max(dirichlet_rescale(dice, total, limits)) for _ in range(count)]
    discarded = []
    while len(discarded) < count:
        first = total * (1 - dice.number() ** 0.5)      # UUniFast
        second = (total - first) * dice.number()
        shares = (first, second, total - first - second)
        if max(shares) <= 1.0:
            discarded.append(max(shares))
    # The two-sided Kolmogorov-Smirnov statistic; 0.043 is exceeded by chance once in a thousand.
    ours, theirs = (np.searchsorted(np.sort(some), stretched + discarded, 'right')
                    for some in (stretched, discarded))
    assert np.abs(ours - theirs).max() / count < 0.043
