# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A report that is told in batches, by the compiled replay, is the one that is told bit by bit."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from mddag_executor.replay.as_recorded import replay_compiled, replay_recording
from mddag_executor.replay.batches import BatchWatcher
from mddag_executor.replay.following import map_recording
from mddag_executor.replay.recording import Recording
from mddag_executor.report import html, timeline
from mddag_executor.report.timeline import Timeline
from msg_graph import loads, TaskSet
import numpy as np
import pytest

from ..replay.helpers import Chances, MS, SMALL, START_TIME, VirtualRun
from ..report import runs

pytest.importorskip('numba')


def state(one: Timeline) -> dict[str, Any]:
    """Return all that a timeline knows."""
    columns = one.columns()
    return {
        'executions': columns.executions.tolist(), 'releases': columns.releases.tolist(),
        'verdicts': columns.verdicts.tolist(), 'gaps': one.gaps(),
        'names': one.undeclared_names(), 'workers': one.workers,
        'counts': (one.n_executions, one.n_missed, one.kept),
        'blocks': [(block.number, block.missed, len(block.executions), len(block.releases),
                    len(block.verdicts)) for block in one._blocks],
        'bins': (one.bins.origin, one.bins.width, one.bins.used, one.bins.busy, one.bins.lent,
                 one.bins.missed)}


def watched(
    trace: Path, compiled: bool, graph: TaskSet | None, most: int, block: int,
    monkeypatch: pytest.MonkeyPatch,
) -> tuple[dict[str, Any], html.ReportData]:
    monkeypatch.setattr(html, 'Timeline', lambda given: Timeline(given, block))
    watch = html.Watch(most)
    assert isinstance(watch, BatchWatcher)
    recording = Recording(trace)
    if compiled:
        outcome = replay_compiled(recording, map_recording(recording, graph), None, watch)
        assert outcome is not None
    else:
        outcome = replay_recording(recording, graph, watcher=watch, compiled=False)
    return state(watch.timeline), html.of_replay(outcome, watch)


@pytest.mark.parametrize(('seed', 'most', 'block'), [
    (0, 10**6, 8192), (1, 10**6, 7), (2, 60, 5), (3, 600, 31), (4, 1000, 100), (5, 1, 1)])
def test_the_same_is_kept(
    tmp_path: Path, seed: int, most: int, block: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Messages are lost, jobs expire and are aborted, coroutines are suspended."""
    trace = tmp_path / 'run.mcap'
    text = SMALL.replace('timer: 20ms,', 'timer: 20ms, on_miss: abort,')
    VirtualRun(trace, loads(text, 'g.yaml'), seed, duration=3000 * MS, longest=14 * MS,
               chances=Chances(undeclared=1))
    monkeypatch.setattr(timeline, 'MOST_UNDECLARED', 1 + seed)
    wide = loads(
        text.replace('deadline: 8ms', 'deadline: 2ms').replace('/imu', '/other'), 'h.yaml')
    for graph in (None, wide):
        plain, plain_data = watched(trace, False, graph, most, block, monkeypatch)
        found, data = watched(trace, True, graph, most, block, monkeypatch)
        for what, expected in plain.items():
            assert found[what] == expected, what
        assert plain['counts'][0] > 300 and plain['counts'][1] > 0
        # a watch's own sums, of the plain replay, do not tell waiting for groups apart
        assert plain_data.usage.callbacks() == {
            key: {**use, 'waiting_group_ns': 0} for key, use in data.usage.callbacks().items()}
        pages = []
        for each in (plain_data, data):
            html_data = html.prepare(each)
            pages.append((html_data.meta, html_data.blob, html_data.misses))
        assert pages[0] == pages[1]


def test_the_page_is_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip('bokeh', reason='Bokeh is not installed')
    trace = runs.by_hand(tmp_path / 'run.mcap', hostile=True)
    texts = []
    for compiled in (False, True):
        _, data = watched(trace, compiled, None, 10**6, 8192, monkeypatch)
        file = io.BytesIO()
        html.write(file, data)
        text = file.getvalue().decode()
        texts.append(text[text.index('<h1>'):text.index('<div class="mddag-plot">')]
                     + text[text.index('<h2>Callbacks</h2>'):text.index('<footer>')])
    assert texts[0] == texts[1]


def test_what_is_declined_is_told_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where compiled code gives up half way, nothing of it is left in the report."""
    from mddag_executor.trace import TraceFile, TraceReader
    trace, odd = tmp_path / 'run.mcap', tmp_path / 'odd.mcap'
    VirtualRun(trace, loads(SMALL, 'g.yaml'), 3, duration=300 * MS)
    with TraceFile(odd) as file:
        for name, *fields in TraceReader(trace).events(sorted=True):
            file.add(name, *fields)
        file.add('mddag:job_release', START_TIME + 10**12, 77, 1, 99, 1, START_TIME)
    plain, _ = watched(odd, False, None, 10**6, 64, monkeypatch)
    watch = html.Watch()
    recording = Recording(odd)
    outcome = replay_recording(recording, None, watcher=watch, compiled=True)
    assert any('not declared' in warning for warning in outcome.warnings)
    assert state(watch.timeline)['executions'] == plain['executions']


def test_sums_of_many_stretches() -> None:
    generator = np.random.default_rng(5)
    for _ in range(20):
        starts = np.sort(generator.integers(0, 10**int(generator.integers(5, 12)), 200)) + 10**9
        ends = starts + generator.integers(0, 10**int(generator.integers(2, 10)), 200)
        one, many = timeline.Bins(), timeline.Bins()
        many.place(int(starts[0]))
        for start, end in zip(starts.tolist(), ends.tolist()):
            one.add(False, start, end)
        for k in range(0, 200, 30):
            many.add_many(False, starts[k:k + 30], ends[k:k + 30])
        assert (one.origin, one.width, one.used, one.busy) == (
            many.origin, many.width, many.used, many.busy)
