# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Response times of paths while flows come in: like all at once, in little memory."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.core import quantile
from mddag_executor.replay import paths, replay
from mddag_executor.replay.path_flows import CaseBook, NEVER
from mddag_executor.replay.spread import QUANTILE_ERROR, Spread
from mddag_executor.trace import reading
from msg_graph import loads
import numpy as np
import pytest

from .cases_by_hand import slow_cases
from .flows import note_steps
from .helpers import Chances, MS, PATHS, SMALL, VirtualRun

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


def told(records: list[Record], batches: list[int]) -> CaseBook:
    """Tell a book some records in batches (by record), with the tightest bounds that hold."""
    book = CaseBook()
    for batch in range(max(batches, default=-1) + 1):
        now = [record for record, n in zip(records, batches) if n == batch]
        later = [record for record, n in zip(records, batches) if n > batch]
        book.add(
            np.array([start for start, _ in now], dtype=np.int64),
            np.array([-1 if end is None else end for _, end in now], dtype=np.int64),
            min((start for start, _ in later), default=NEVER),
            min((end for _, end in later if end is not None), default=NEVER))
    return book


def check(records: list[Record], batches: list[int]) -> None:
    found = told(records, batches).finished().result()
    every = {**found['response_time'], 'data_age': found['data_age']}
    expected = {case: [time for _, time in responses]
                for case, responses in slow_cases(records).items()}
    arrived = [(start, end) for start, end in records if end is not None and end >= start]
    expected['data_age'] = [
        end - max(first for first, output in arrived if output == end)
        for end in {end for _, end in arrived}]
    for case, figures in every.items():
        assert figures == statistics(expected[case]), case
    assert found['reaction_time'] == found['response_time']['worst_with_external_latency']


@given(RECORDS)
def test_all_at_once(records: list[Record]) -> None:
    check(records, [0] * len(records))


@given(st.data(), st.one_of(RECORDS, LONG))
def test_in_any_batches(data: st.DataObject, records: list[Record]) -> None:
    check(records, [data.draw(st.integers(0, 6)) for _ in records])


@given(LONG)
def test_in_the_order_in_which_they_are_over(records: list[Record]) -> None:
    records.sort(key=lambda record: max(record[0], record[1] or 0))
    check(records, list(range(len(records))))


def test_response_times_of_some_flows() -> None:
    # 10 -> 30; 20 is overtaken; 40 -> 70; 50 is lost; 60 -> 90, and 60 -> 120 again
    book = told([(10, 30), (20, None), (40, 70), (50, None), (60, 90), (60, 120)], [0] * 6)
    found = book.finished().result()
    cases = found['response_time']
    assert cases['all'] == {
        'count': 4, 'min': 30, 'mean': 38, 'median': 30, 'p99': 50, 'max': 50}
    assert cases['best'] == statistics([30, 30])
    assert cases['worst'] == statistics([50, 40])
    assert cases['worst_with_external_latency'] == statistics([50, 50])
    assert found['data_age'] == statistics([20, 30, 30, 60])


def test_what_is_over_is_forgotten() -> None:
    """Flows of a pipeline, each over before the tenth after it begins: nothing is heaped up."""
    book = CaseBook()
    for k in range(0, 100_000, 1000):
        start = np.arange(k, k + 1000, dtype=np.int64) * 10
        end = np.where(start % 70 == 0, -1, start + 95)
        book.add(start, end, (k + 1000) * 10, (k + 1000) * 10)
        assert len(book._start) + len(book._input) < 50
    found = book.finished().result()
    assert found['response_time']['all']['count'] > 99_000
    assert found['data_age']['quantiles_within'] == QUANTILE_ERROR
    assert len(book.every._bins) < 1000


@given(st.lists(st.integers(-2**62, 2**62) | st.integers(-5000, 5000), max_size=60),
       st.integers(0, 40), st.integers(1, 9))
def test_a_spread(times: list[int], keep: int, size: int) -> None:
    spread = Spread(keep)
    for i in range(0, len(times), size):
        spread.add(np.array(times[i:i + size], dtype=np.int64))
    found, expected = spread.result(), statistics(times)
    if expected is None or found is None or len(times) <= keep:
        assert found == expected
        return
    within = found.pop('quantiles_within')
    for key, value in expected.items():
        near = abs(value) * within if key in ('median', 'p99') else 0
        assert abs(found[key] - value) <= near, key


# --- the whole way -------------------------------------------------------------------------------

def all_paths(trace: Path) -> str:
    return json.dumps(replay(trace).result()['paths'], indent=0)


@pytest.mark.parametrize('seed', range(3))
def test_a_forest_that_is_kept_small(
    tmp_path: Path, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    trace = tmp_path / 'a.mcap'
    VirtualRun(trace, loads(SMALL + PATHS, 'g.yaml'), seed, duration=4000 * MS,
               chances=Chances(undeclared=1))
    expected = all_paths(trace)
    monkeypatch.setattr(paths, 'LAG_NS', 0)
    monkeypatch.setattr(paths, 'SETTLE', 50)
    monkeypatch.setattr(paths, 'KEPT', 30)
    monkeypatch.setattr(reading, '_BATCH', 1)
    settled = note_steps(monkeypatch)
    assert all_paths(trace).split('\n') == expected.split('\n')
    assert len(settled) > 20 and max(settled) < 1200
