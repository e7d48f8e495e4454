# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The cases of a path's response times, against a slow search through all records."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.core import quantile
from mddag_executor.replay.paths import figures
from mddag_executor.replay.spread import spread
import numpy as np

from .cases_by_hand import slow_cases

Record = tuple[int, int | None]
RECORDS = st.lists(st.tuples(
    st.integers(0, 15), st.one_of(st.none(), st.integers(0, 25))), max_size=14)
LONG = st.lists(st.tuples(
    st.integers(0, 60), st.one_of(st.none(), st.integers(0, 80))), max_size=50)


def statistics(times: list[int]) -> dict[str, Any] | None:
    if not times:
        return None
    ordered = sorted(times)
    return {'count': len(ordered), 'min': ordered[0],
            'mean': round(sum(ordered) / len(ordered)), 'median': quantile(ordered, 0.5),
            'p99': quantile(ordered, 0.99), 'max': ordered[-1]}


def told(records: list[Record]) -> dict[str, Any]:
    return figures(
        np.array([start for start, _ in records], dtype=np.int64),
        np.array([-1 if end is None else end for _, end in records], dtype=np.int64))


@given(st.one_of(RECORDS, LONG))
def test_cases(records: list[Record]) -> None:
    found = told(records)
    every = {**found['response_time'], 'data_age': found['data_age']}
    expected = {case: [time for _, time in responses]
                for case, responses in slow_cases(records).items()}
    arrived = [(start, end) for start, end in records if end is not None and end >= start]
    expected['data_age'] = [
        end - max(first for first, output in arrived if output == end)
        for end in {end for _, end in arrived}]
    for case, times in every.items():
        assert times == statistics(expected[case]), case
    assert found['reaction_time'] == found['response_time']['worst_with_external_latency']


def test_response_times_of_some_flows() -> None:
    # 10 -> 30; 20 is overtaken; 40 -> 70; 50 is lost; 60 -> 90, and 60 -> 120 again
    found = told([(10, 30), (20, None), (40, 70), (50, None), (60, 90), (60, 120)])
    cases = found['response_time']
    assert cases['all'] == {
        'count': 4, 'min': 30, 'mean': 38, 'median': 30, 'p99': 50, 'max': 50}
    assert cases['best'] == statistics([30, 30])
    assert cases['worst'] == statistics([50, 40])
    assert cases['worst_with_external_latency'] == statistics([50, 50])
    assert found['data_age'] == statistics([20, 30, 30, 60])


@given(st.lists(st.integers(-2**62, 2**62) | st.integers(-5000, 5000), max_size=60))
def test_a_spread(times: list[int]) -> None:
    assert spread(np.array(times, dtype=np.int64)) == statistics(times)
