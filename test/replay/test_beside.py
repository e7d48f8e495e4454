# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A long trace is read in a process beside: nothing else changes."""

from __future__ import annotations

import json
from pathlib import Path

from mddag_executor.cli import main as program
from mddag_executor.replay import beside
from msg_graph import loads
import pytest

from .helpers import Chances, MS, SMALL, VirtualRun
from .test_expected import PATHS


@pytest.fixture
def trace(tmp_path: Path) -> Path:
    path = tmp_path / 'a.mcap'
    VirtualRun(path, loads(SMALL + PATHS, 'g.yaml'), 3, workers=2, policy='fifo',
               duration=900 * MS, longest=9 * MS, chances=Chances(undeclared=1))
    return path


def _replayed(trace: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    status = program.main(['replay', str(trace), '--callbacks', '--json', str(trace) + '.json'])
    return status, *capsys.readouterr()


def _beside(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have every trace read beside."""
    monkeypatch.setattr(beside, 'LEAST_EVENTS', 0)
    monkeypatch.setattr(beside, 'processors', lambda: 2)


@pytest.mark.parametrize('cut', (0, 300))
def test_it_tells_the_same(
    trace: Path, cut: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if cut:     # its end is lost
        trace.write_bytes(trace.read_bytes()[:-cut])
    results, shown = [], []
    for _ in range(2):
        shown.append(_replayed(trace, capsys))
        results.append(json.loads(Path(str(trace) + '.json').read_text()))
        _beside(monkeypatch)
    assert results[0] == results[1] and shown[0] == shown[1]
    assert results[0]['paths'] and results[0]['misses']['missed']


def test_errors_are_the_same(
    trace: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _beside(monkeypatch)
    opened = beside.play_beside

    def too_late(*arguments: object) -> object:
        trace.unlink()
        return opened(*arguments)   # type: ignore[arg-type]

    monkeypatch.setattr('mddag_executor.replay.as_recorded.play_beside', too_late)
    status, _, error = _replayed(trace, capsys)
    assert status == 2
    assert error.splitlines() == [
        f'error: {trace}: cannot be read (No such file or directory): check its name, that you '
        'may read it, and the disk it is on']


def test_a_process_that_ends_early_is_said(
    trace: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _beside(monkeypatch)
    monkeypatch.setattr(beside, '_PROGRAM', 'import os; os._exit(3)')
    status, _, error = _replayed(trace, capsys)
    assert status == 2
    assert error == (f'error: {trace}: the process that read it has ended early: see whether it '
                     'ran out of memory\n')
