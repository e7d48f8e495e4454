# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Two runs side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mddag_executor.replay import replay
from mddag_executor.report.diff import callbacks_table, compare, sinks_table
import msg_graph
import pytest

from . import runs

MS = runs.MS


@pytest.fixture
def result(tmp_path: Path) -> dict[str, Any]:
    return replay(runs.by_hand(tmp_path / 'run.mcap')).result()


def changed(result: dict[str, Any], **sink: Any) -> dict[str, Any]:
    before = result['dags']['/driver']['sinks']['/filter:run']
    return {**result, 'dags': {'/driver': {'sinks': {'/filter:run': {**before, **sink}}}}}


def test_a_run_is_no_worse_than_itself(result: dict[str, Any]) -> None:
    difference = compare(result, result, 0.0)
    sink = difference['dags']['/driver']['sinks']['/filter:run']
    assert sink['a'] == sink['b'] and set(sink['change_ns'].values()) == {0}
    assert difference['worse'] is sink['worse'] is False


@pytest.mark.parametrize(('sink', 'tolerance', 'worse'), [
    ({'late': 2}, None, True),
    ({'late': 0}, None, False),
    ({'completed': 6, 'late': 2}, None, False),         # the same share
    ({'completed': 6, 'late': 3}, None, True),
    ({'expired': 1}, None, True),
    ({'response_ns': {'min': 1, 'median': 2, 'p99': 11 * MS, 'max': 11 * MS}}, None, False),
    ({'response_ns': {'min': 1, 'median': 2, 'p99': 11 * MS, 'max': 11 * MS}}, 0.1, False),
    ({'response_ns': {'min': 1, 'median': 2, 'p99': 11 * MS + 1, 'max': 12 * MS}}, 0.1, True),
    ({'response_ns': {'min': 1, 'median': 2, 'p99': 9 * MS, 'max': 12 * MS}}, 0.0, False),
    ({'response_ns': None}, 0.0, False)])
def test_what_is_worse(
    result: dict[str, Any], sink: dict[str, Any], tolerance: float | None, worse: bool
) -> None:
    assert compare(result, changed(result, **sink), tolerance)['worse'] is worse


def test_what_only_one_run_has(result: dict[str, Any], tmp_path: Path) -> None:
    graph = runs.GRAPH.replace('deadline: 8ms', 'deadline: 5ms').replace('name: whole', 'name: w')
    other = replay(runs.by_hand(tmp_path / 'other.mcap'), msg_graph.loads(graph)).result()
    difference = compare(result, other)
    assert 'worse, deadline in B 5 ms' in sinks_table(difference)
    lacking = {**result, 'dags': {}}
    assert 'only in A' in sinks_table(compare(result, lacking))
    difference = compare(lacking, result)
    assert 'only in B' in sinks_table(difference) and not difference['worse']
    assert difference['dags']['/driver']['sinks']['/filter:run']['a'] is None
    assert 'driver:tick' in callbacks_table(compare({**result, 'callbacks': {}}, result))
