# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Exports: rows for spreadsheets and data frames, and traces for Perfetto, read back."""

from __future__ import annotations

from collections import Counter
import csv
import io
from pathlib import Path
from typing import Any

from mddag_executor.replay import replay
from mddag_executor.replay.run_writer import write_trace
from mddag_executor.report.export import _harmless, write
import pytest

from . import runs

MS = runs.MS
DEMO = runs.CONFIG.parent / 'bags' / 'demo_short.mcap'


def exported(path: Path, form: str, jobs: bool = False) -> bytes:
    file = io.BytesIO()
    write(form, file, replay(path), 'jobs' if jobs else 'executions')
    return file.getvalue()


def read_csv(data: bytes) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(data.decode(), newline='')))


def test_rows_come_in_the_order_of_their_releases(tmp_path: Path) -> None:
    task_set = runs.autoware()
    load, run = runs.simulated(task_set, ms=500, utilisation=1.2, preemptive=True)
    path = tmp_path / 'run.mcap'
    write_trace(path, task_set, load, run)

    def releases(jobs: bool) -> list[int]:
        return [int(row['release_ns']) for row in read_csv(exported(path, 'csv', jobs))]

    for jobs in (False, True):
        assert releases(jobs) == sorted(releases(jobs))
    parsed = Parsed(exported(path, 'pftrace'))
    groups = {name: [start for parent, start in parsed.begins if parent == name]
              for name in ('workers', 'jobs by sink')}
    assert all(len(times) > 100 and times == sorted(times) for times in groups.values())


def test_csv_is_harmless(tmp_path: Path) -> None:
    path = runs.by_hand(tmp_path / 'run.mcap', hostile=True)
    data = exported(path, 'csv')
    assert b'\x1b' not in data
    assert read_csv(data)[6]['vertex'] == runs.HOSTILE.replace('\x1b', '\\x1b')
    assert [_harmless(text) for text in ('=1+1', '+1', '-1', '@x', '/n:a')] == [
        "'=1+1", "'+1", "'-1", "'@x", '/n:a']


@pytest.mark.parametrize('jobs', [False, True])
def test_parquet_and_csv_hold_the_same(jobs: bool) -> None:
    parquet = pytest.importorskip('pyarrow.parquet', reason='pyarrow is not installed')
    table = parquet.read_table(io.BytesIO(exported(DEMO, 'parquet', jobs)))
    rows = read_csv(exported(DEMO, 'csv', jobs))
    assert table.column_names == list(rows[0])
    assert table.num_rows == len(rows) > 500

    def plain(value: Any) -> str:
        if isinstance(value, bool):
            return str(value).lower()
        if isinstance(value, float):
            return f'{value:.9f}'
        return '' if value is None else str(value)

    for ours, theirs in zip(table.to_pylist(), rows):
        assert {key: plain(value) for key, value in ours.items()} == theirs


def test_the_rows_are_those_of_the_replay() -> None:
    outcome = replay(DEMO)
    result = outcome.result()
    jobs = read_csv(exported(DEMO, 'csv', jobs=True))
    for dag_name, dag in result['dags'].items():
        for name, sink in dag['sinks'].items():
            mine = [row for row in jobs if (row['dag'], row['sink']) == (dag_name, name)]
            verdicts = Counter(row['verdict'] for row in mine)
            assert verdicts['in_time'] + verdicts['late'] == sink['completed']
            assert verdicts['late'] + verdicts['overdue'] == sink['late']
            responses = [int(row['response_ns']) for row in mine if row['response_ns']]
            assert (min(responses), max(responses)) == (
                sink['response_ns']['min'], sink['response_ns']['max'])
    executions = read_csv(exported(DEMO, 'csv'))
    declared = [row for row in executions if row['dag']]
    busy = sum(int(row['executing_ns']) for row in declared)
    assert busy == sum(use['busy_ns'] for use in result['callbacks'].values())
    assert all(row['release_ns'] for row in declared)


# --- Perfetto ------------------------------------------------------------------------------------


class Parsed:
    """A Perfetto trace as its viewer sees it: tracks with slices, instants, flows."""

    def __init__(self, data: bytes) -> None:
        pb2 = pytest.importorskip(
            'perfetto.protos.perfetto.trace.perfetto_trace_pb2',
            reason='perfetto is not installed')
        trace = pb2.Trace()
        trace.ParseFromString(data)
        assert trace.SerializeToString() == data or len(trace.packet) > 0
        self.tracks = {p.track_descriptor.uuid: p.track_descriptor for p in trace.packet
                       if p.HasField('track_descriptor')}
        names: dict[int, str] = {}
        keys: dict[int, str] = {}
        events: dict[int, list[tuple[int, int, int, Any, str, dict[str, Any]]]] = {}
        event_type = pb2.TrackEvent
        order = {event_type.TYPE_SLICE_END: 0, event_type.TYPE_INSTANT: 1,
                 event_type.TYPE_SLICE_BEGIN: 2}
        self.counts: list[tuple[str, int, int]] = []
        self.begins: list[tuple[str, int]] = []     # as they stand in the file: group, start
        for place, packet in enumerate(trace.packet):
            names.update((e.iid, e.name) for e in packet.interned_data.event_names)
            keys.update((e.iid, e.name) for e in packet.interned_data.debug_annotation_names)
            if not packet.HasField('track_event'):
                continue
            event = packet.track_event
            notes = {keys[n.name_iid]: n.string_value or n.int_value
                     for n in event.debug_annotations}
            if event.type == event_type.TYPE_SLICE_BEGIN:
                self.begins.append((self.path(event.track_uuid).split(' > ')[0], packet.timestamp))
            if event.type == event_type.TYPE_COUNTER:
                self.counts.append((self.path(event.track_uuid), packet.timestamp,
                                    event.counter_value))
                continue
            name = event.name or (names[event.name_iid] if event.name_iid else '')
            events.setdefault(event.track_uuid, []).append(
                (packet.timestamp, order[event.type], place, event, name, notes))
        first = next(p for p in trace.packet if p.HasField('track_event'))
        assert first.sequence_flags & 1 and {p.trusted_packet_sequence_id
                                             for p in trace.packet} == {1}
        self.slices: list[tuple[str, str, int, int, dict[str, Any], Any]] = []
        self.instants: list[tuple[str, int, str, dict[str, Any]]] = []
        self.deadlines: list[tuple[str, int, str, dict[str, Any]]] = []
        for uuid, found in events.items():
            self._pair(uuid, sorted(found, key=lambda e: e[2]))

    def _pair(self, uuid: int, found: list[Any]) -> None:
        last = -1
        begun: Any = None
        for time, kind, _, event, name, notes in found:
            track = self.path(uuid)
            if kind == 1:
                (self.deadlines if track.endswith(' deadline') else self.instants).append(
                    (track, time, name, notes))
                continue
            assert time >= last, 'slices of a track are in order and do not overlap'
            last = time
            if kind == 2:
                assert begun is None
                begun = (time, event, name, notes)
            else:
                assert begun is not None
                self.slices.append((track, begun[2], begun[0], time, begun[3], begun[1]))
                begun = None
        assert begun is None

    def path(self, uuid: int) -> str:
        track = self.tracks[uuid]
        return (self.path(track.parent_uuid) + ' > ' if track.parent_uuid else '') + track.name


def test_perfetto_by_hand(tmp_path: Path) -> None:
    parsed = Parsed(exported(runs.by_hand(tmp_path / 'run.mcap'), 'pftrace'))
    at = [(track, name, (start - runs.START) / MS, (end - runs.START) / MS)
          for track, name, start, end, _, _ in parsed.slices]
    assert ('workers > worker 0', '/driver:tick', 30, 36) in at
    assert ('workers > worker 1', '/filter:run', 37, 40) in at
    assert ('workers > spare threads', 'extra', 41, 43) in at
    assert ('callbacks > /driver, every 10 ms > /filter:run', 'job 2', 37, 40) in at
    assert ('callbacks > undeclared > extra', 'extra', 41, 43) in at
    assert ('jobs by sink > /filter:run', 'job 2 (late)', 30, 40) in at
    assert ('jobs by sink > /filter:run', 'job 0', 10, 15) in at
    assert len(at) == 7 + 7 + 3
    assert [(track, (time - runs.START) / MS, name) for track, time, name, _ in parsed.instants
            ] == [('missed deadlines', 40, '/filter:run missed')]
    assert parsed.instants[0][3] == {
        'DAG': '/driver', 'job': 2, 'verdict': 'late', 'deadline_ns': runs.START + 38 * MS,
        'late_by_ns': 2 * MS}
    assert [(track, (time - runs.START) / MS, name) for track, time, name, _ in parsed.deadlines
            ] == [('jobs by sink > /filter:run deadline', at, f'job {job}')
                  for job, at in enumerate((18, 28, 38))]
    # only the second callback waits, for 1 ms each time
    assert [(track, (time - runs.START) / MS, count) for track, time, count in parsed.counts] == [
        ('ready callbacks', ready + late, 1 - late) for ready in (11, 22, 36) for late in (0, 1)]
    notes = next(s[4] for s in parsed.slices if s[:2] == ('workers > worker 1', '/filter:run'))
    assert notes == {'DAG': '/driver', 'job': 0, 'waiting_ns': MS, 'since_release_ns': 2 * MS,
                     'reference_slack_ns': 3 * MS}


def test_flows_go_from_publisher_to_subscriber() -> None:
    outcome = replay(DEMO)
    parsed = Parsed(exported(DEMO, 'pftrace'))
    begun: dict[int, tuple[str, int, int]] = {}
    ended: dict[int, tuple[str, int, int]] = {}
    for track, name, start, _, notes, event in parsed.slices:
        if not track.startswith('workers'):
            assert not event.flow_ids and not event.terminating_flow_ids
            continue
        for flow in event.flow_ids:
            assert flow not in begun
            begun[flow] = (name, start, notes['job'])
        for flow in event.terminating_flow_ids:
            assert flow not in ended, 'a message starts one execution'
            ended[flow] = (name, start, notes['job'])
    edges = {(dag.vertices[a].name, dag.vertices[b].name)
             for dag in outcome.task_set.dags for a, b in dag.edges}
    assert set(ended) <= set(begun) and len(ended) > 0.9 * len(begun)
    seen = set()
    for flow, (name, start, job) in ended.items():
        sender, before, of_job = begun[flow]
        assert before <= start and of_job == job
        seen.add((sender, name))
    assert seen <= edges and len(seen) > 0.9 * len(edges)


def test_perfetto_tracks_nest_when_jobs_overlap(tmp_path: Path) -> None:
    """Jobs longer than their period overlap: their tracks are several of one name."""
    task_set = runs.autoware()
    load, run = runs.simulated(task_set, ms=1500, utilisation=1.2, preemptive=True)
    write_trace(tmp_path / 'run.mcap', task_set, load, run)
    parsed = Parsed(exported(tmp_path / 'run.mcap', 'pftrace'))
    names = Counter(track.name for track in parsed.tracks.values())
    assert max(names.values()) > 1
    assert len([s for s in parsed.slices if s[0].startswith('workers')]) \
        == len([s for s in parsed.slices if s[0].startswith('callbacks')])
    assert len(parsed.instants) == sum(
        row['verdict'] != 'in_time'
        for row in read_csv(exported(tmp_path / 'run.mcap', 'csv', jobs=True)))


def test_a_simulated_sync_takes_all_of_its_messages(tmp_path: Path) -> None:
    task_set = runs.autoware()
    load, run = runs.simulated(task_set, ms=600)
    write_trace(tmp_path / 'run.mcap', task_set, load, run)
    parsed = Parsed(exported(tmp_path / 'run.mcap', 'pftrace'))
    sizes = {vertex.name: len(vertex.predecessors) for vertex in task_set.vertices}
    assert max(sizes.values()) > 1
    done = [s for s in parsed.slices if s[0].startswith('workers')]
    for _, name, _, _, _, event in done:
        assert len(event.terminating_flow_ids) == sizes[name]
    begun = {flow for s in done for flow in s[5].flow_ids}
    assert {flow for s in done for flow in s[5].terminating_flow_ids} <= begun
