# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `replay` on imported recordings."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ..cli.helpers import caller
from ..replay.recorded import four_jobs, MS

call = caller('replay')

GRAPH = """\
mddag: 1
nodes:
  - node: /camera
    callbacks: [{name: grab, timer: 100ms, publishes: [/image]}]
  - node: /detect
    callbacks: [{name: detect, subscription: /image, deadline: 8ms}]
paths:
  - {name: seen, callbacks: ['/camera:grab', '/detect:detect']}
"""


@pytest.fixture
def trace(tmp_path: Path) -> Path:
    """Give a recording of four jobs; the last one is late."""
    (tmp_path / 'graph.yaml').write_text(GRAPH)
    return four_jobs(tmp_path / 'drive.mcap')


def test_with_a_graph(trace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    graph, out = trace.with_name('graph.yaml'), trace.with_name('out.json')
    status, text, errors = call(capsys, trace, graph, '--fail-on-miss', '--json', out)
    assert (status, errors) == (1, '')
    assert '4 sink jobs due, 3 in time (75.00 %), 1 late, 0 expired' in text
    assert 'imported: 2 threads ran callbacks' in text
    rows = [line.split() for line in text.splitlines()]
    assert any(row[:6] == ['seen', '4', 'of', '4', 'all', '3'] for row in rows)
    assert any(row[:2] == ['worst-with-external-latency', '2'] for row in rows)
    assert 'Callbacks in the recording' not in text
    result = json.loads(out.read_text())
    assert result['paths']['seen']['data_age']['max'] == 2 * MS
    assert result['first_miss']['job'] == 3


def test_with_callbacks_and_report(trace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = trace.with_name('report.html')
    status, text, errors = call(
        capsys, trace, trace.with_name('graph.yaml'), '--callbacks', '--report', report)
    assert (status, errors) == (0, '')
    assert '/detect subscription /image' in text
    assert report.stat().st_size > 10_000


def test_without_a_graph(trace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, text, errors = call(capsys, trace)
    assert (status, errors) == (0, '')
    rows = [line.split() for line in text.splitlines()]
    assert ['/camera', 'timer', '100ms', '4'] in [row[:4] for row in rows]
    assert ['/image', '/camera', '/detect', 'subscription', '/image', '4', '4'] in [
        row[:7] for row in rows]
    assert 'DAG' not in text


def test_rescheduled(trace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, text, errors = call(
        capsys, trace, trace.with_name('graph.yaml'), '--reschedule', '--workers', 1,
        '--policy', 'rad')
    assert (status, errors) == (0, '')
    assert 'policy rad, 1 worker' in text
    status, _, errors = call(capsys, trace, '--reschedule')
    assert (status, errors.count('\n')) == (2, 1)
    assert errors.startswith(f'error: {trace}: it was imported') and 'GRAPH' in errors
