# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A real CARET recording through the program: whatever it writes says what CARET says."""

from __future__ import annotations

import csv
import json
from typing import Any

from mddag_executor.cli import main as program
from mddag_executor.trace import import_ctf
import pytest

from ..replay.cases_by_hand import slow_cases
from ..replay.test_caret_sample import GRAPH, rows, SESSION

pytest.importorskip('bokeh', reason='Bokeh is not installed')
pytestmark = [
    pytest.mark.skipif(not SESSION.is_dir(), reason='the recording is not there'),
    pytest.mark.needs('babeltrace2')]
FILTER = '/filter_node:callback_0'


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Give a folder with all that the program makes of the recording."""
    path = tmp_path_factory.mktemp('caret')
    trace, graph = path / 'sample.mcap', path / 'graph.yaml'
    graph.write_text(GRAPH)
    import_ctf(SESSION, trace)
    assert program.main([
        'replay', str(trace), str(graph), '--report', str(path / 'report.html'), '--json',
        str(path / 'result.json'), '--junit', str(path / 'junit.xml')]) == 0
    for name in ('executions.csv', 'run.pftrace', 'executions.parquet'):
        assert program.main(['export', str(trace), str(graph), '-o', str(path / name)]) == 0
    return path


def filter_times() -> list[tuple[int, int]]:
    return [(start or 0, end or 0) for start, end in rows('cb_filter_node_callback_0.csv')]


def test_the_result_says_what_caret_says(folder):
    result = json.loads((folder / 'result.json').read_text())
    assert (result['warnings'], result['drift']) == ([], [])
    use = result['callbacks'][FILTER]
    took = [end - start for start, end in filter_times()]
    assert (use['executions'], use['busy_ns'], use['longest_ns']) == (
        len(took), sum(took), max(took))
    cases = slow_cases([(row[0] or 0, row[-1]) for row in rows('demo_target_path.csv')])
    for case, found in result['paths']['target']['response_time'].items():
        times = sorted(time for _, time in cases[case])
        assert (found['count'], found['min'], found['max'], found['mean']) == (
            len(times), times[0], times[-1], round(sum(times) / len(times))), case


def test_exports_have_carets_callback_times(folder):
    with (folder / 'executions.csv').open(newline='') as stream:
        table = [(int(row['start_ns']), int(row['end_ns'])) for row in csv.DictReader(stream)
                 if row['vertex'] == FILTER]
    assert sorted(table) == filter_times()
    parquet = pytest.importorskip('pyarrow.parquet', reason='pyarrow is not installed')
    columns = parquet.read_table(folder / 'executions.parquet').to_pydict()
    assert sorted(
        (start, end) for name, start, end in
        zip(columns['vertex'], columns['start_ns'], columns['end_ns']) if name == FILTER
    ) == filter_times()


def test_perfetto_has_carets_callback_times(folder):
    module = pytest.importorskip(
        'perfetto.protos.perfetto.trace.perfetto_trace_pb2', reason='perfetto is not installed')
    trace: Any = module.Trace()
    trace.ParseFromString((folder / 'run.pftrace').read_bytes())
    # the track of a callback is called like it; its slices like the job
    tracks = {packet.track_descriptor.uuid for packet in trace.packet
              if packet.HasField('track_descriptor')
              and packet.track_descriptor.name.endswith('filter_node:callback_0')}
    assert tracks
    times: dict[int, list[int]] = {1: [], 2: []}     # slices begin and end
    for packet in trace.packet:
        if packet.HasField('track_event') and packet.track_event.track_uuid in tracks:
            times[packet.track_event.type].append(packet.timestamp)
    assert list(zip(sorted(times[1]), sorted(times[2]))) == filter_times()
