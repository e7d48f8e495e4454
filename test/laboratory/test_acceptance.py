# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Acceptance ratios by bin, and their confidence intervals."""

from __future__ import annotations

from mddag_executor.laboratory.acceptance import Acceptance, BINS, bins_of, WIDE_BINS, wilson
import numpy as np
import pytest


@pytest.mark.parametrize(('utilisation', 'centre'), [
    (0.0, 0.5), (0.5, 0.5), (0.52499, 0.5), (0.5251, 0.55), (0.5749, 0.55), (0.5751, 0.6),
    (0.7, 0.7), (0.92501, 0.95), (0.97499, 0.95), (0.97501, 1.0), (1.0, 1.0), (3.0, 1.0)])
def test_bins(utilisation: float, centre: float) -> None:
    assert BINS[bins_of(np.array([utilisation]))[0]] == centre


@pytest.mark.parametrize(('utilisation', 'centre'), [
    (0.0, 0.05), (0.0749, 0.05), (0.0751, 0.1), (0.5, 0.5), (0.97499, 0.95), (0.97501, 1.0),
    (3.0, 1.0)])
def test_wide_bins(utilisation: float, centre: float) -> None:
    assert WIDE_BINS[bins_of(np.array([utilisation]), WIDE_BINS)[0]] == centre


@pytest.mark.parametrize(('accepted', 'runs', 'low', 'high'), [
    # Figures of R's binom.confint(method = 'wilson').
    (0, 10, 0.0, 0.2775328), (5, 10, 0.2365931, 0.7634069), (10, 10, 0.7224672, 1.0),
    (88, 100, 0.8019, 0.9300)])
def test_wilson(accepted: int, runs: int, low: float, high: float) -> None:
    assert wilson(accepted, runs) == pytest.approx((low, high), abs=1e-4)


def test_wilson_covers_the_truth() -> None:
    """Of many samples about 95 % have the true ratio in their interval."""
    drawn = np.random.Generator(np.random.Philox(1)).binomial(60, 0.9, 4000)
    covered = [low <= 0.9 <= high for low, high in (wilson(int(k), 60) for k in drawn)]
    assert 0.92 < np.mean(covered) < 0.98


def test_acceptance() -> None:
    bins = np.array([0, 0, 2, 2, 2, 10])
    accepted = np.array([True, True, True, False, False, False])
    found = Acceptance(bins, accepted)
    assert found.ratio[:4] == [1.0, None, pytest.approx(1 / 3), None]
    assert found.ratio[10] == 0.0
    assert found.interval[1] is None and found.interval[2] == wilson(1, 3)
    assert found.total == 0.5
