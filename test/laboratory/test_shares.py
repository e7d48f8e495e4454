# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How a whole is dealt out at random: sums, bounds, and that nothing is favoured."""

from __future__ import annotations

from hypothesis import example, given
import hypothesis.strategies as st
from mddag_executor.laboratory.generate_options import GenerateError
from mddag_executor.laboratory.shares import deal, Dice, dirichlet_rescale
import pytest

LIMITS = st.lists(st.floats(0.01, 2.0), min_size=1, max_size=30)


@given(limits=LIMITS, part=st.floats(0.0, 1.0), seed=st.integers(0, 10 ** 6))
@example(limits=[0.375, 0.390625, 0.5, 0.5, 0.5, 0.015625], part=0.5, seed=42)
def test_dirichlet_rescale_keeps_sum_and_bounds(
    limits: list[float], part: float, seed: int
) -> None:
    total = sum(limits) * part
    shares = dirichlet_rescale(Dice(str(seed)), total, limits)
    assert sum(shares) == pytest.approx(total, abs=1e-8)
    for share, limit in zip(shares, limits):
        assert 0.0 <= share <= limit * (1 + 1e-9)


@pytest.mark.parametrize('total', [0.7, 1.2, 1.5, 1.9, 2.6])
def test_dirichlet_rescale_is_as_uniform_as_throwing_away(total: float) -> None:
    """Quantiles of the largest of three shares are those of UUniFast-Discard."""
    dice = Dice('uniform')
    count, limits = 4000, [1.0, 1.0, 1.0]
    stretched = sorted(max(dirichlet_rescale(dice, total, limits)) for _ in range(count))
    discarded: list[float] = []
    while len(discarded) < count:
        first = total * (1 - dice.number() ** 0.5)      # UUniFast
        second = (total - first) * dice.number()
        shares = (first, second, total - first - second)
        if max(shares) <= 1.0:
            discarded.append(max(shares))
    discarded.sort()
    # The two-sided Kolmogorov-Smirnov statistic; 0.043 is exceeded by chance once in a thousand.
    ours = theirs = gap = 0
    while ours < count and theirs < count:
        if stretched[ours] <= discarded[theirs]:
            ours += 1
        else:
            theirs += 1
        gap = max(gap, abs(ours - theirs))
    assert gap / count < 0.043


def test_shares_are_the_same_for_all_places() -> None:
    dice = Dice('places')
    sums = [0.0] * 4
    for _ in range(2000):
        for place, share in enumerate(dirichlet_rescale(dice, 2.5, [1.0] * 4)):
            sums[place] += share / 2000
    assert sums == pytest.approx([0.625] * 4, abs=0.02)


def test_no_room() -> None:
    with pytest.raises(GenerateError, match='a load of 3 does not fit into DAGs of 2 in all'):
        deal(Dice(''), 3.0, [1.0, 1.0])


def test_dice_are_the_same_everywhere() -> None:
    """Literals: another version of Python, or another machine, must give the same files."""
    dice = Dice('mddag 0 0')
    assert [dice.whole(1, 6) for _ in range(10)] == FIRST


FIRST = [5, 5, 4, 4, 2, 5, 4, 2, 4, 3]


@pytest.mark.parametrize('limits', [[1.0, 0.0, 1.0], [1.0, 1e-12, 1.0], [0.0, 0.5], [1.0, 1e-5]])
@pytest.mark.parametrize('part', [0.1, 0.49, 0.9, 1.0])
def test_dirichlet_rescale_with_no_room_for_one(limits: list[float], part: float) -> None:
    total = part * sum(limits)
    for seed in range(10):
        shares = dirichlet_rescale(Dice(str(seed)), total, limits)
        assert sum(shares) == pytest.approx(total)
        assert all(0 <= share <= limit for share, limit in zip(shares, limits))
