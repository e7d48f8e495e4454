# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Traces for Perfetto, read back with Perfetto's own messages, in the order of its viewer."""

from collections import Counter
import io
from typing import NamedTuple

from mddag_executor import replay
from mddag_executor.report.perfetto import write_perfetto
import pytest

from . import runs

messages = pytest.importorskip('perfetto.protos.perfetto.trace.perfetto_trace_pb2')

MS = runs.MS
DEMO = runs.CONFIG.parent / 'bags' / 'demo_short.mcap'
BEGIN, END, INSTANT = range(1, 4)


class Slice(NamedTuple):
    """A slice or an instant: names of its track and of the group of that, name, start, end."""

    group: str
    track: str
    name: str
    start: int
    end: int


class Trace:
    """
    What the viewer shows of a recording: slices, instants, and what each arrow connects.

    :ivar flows: names of the slices at both ends, and their starts.
    """

    def __init__(self, path):
        file = io.BytesIO()
        write_perfetto(file, replay(path))
        trace = messages.Trace()
        trace.ParseFromString(file.getvalue())
        names = {each.iid: each.name for packet in trace.packet
                 for each in packet.interned_data.event_names}
        tracks = {packet.track_descriptor.uuid: packet.track_descriptor
                  for packet in trace.packet if packet.HasField('track_descriptor')}
        open_slices = {}
        sent = {}
        self.slices = []
        self.flows = []
        # the viewer sorts by time, and leaves what is at the same time in the order of the file
        for packet in sorted((packet for packet in trace.packet if packet.HasField('track_event')),
                             key=lambda packet: packet.timestamp):
            event, now = packet.track_event, packet.timestamp
            track = tracks[event.track_uuid]
            group = tracks[track.parent_uuid].name if track.parent_uuid else ''
            name = names[event.name_iid] if event.name_iid else event.name
            if event.type == BEGIN:
                assert event.track_uuid not in open_slices, 'slices of a track overlap'
                open_slices[event.track_uuid] = name, now
                self.flows += ((sent[flow], (name, now)) for flow in event.terminating_flow_ids)
                sent.update((flow, (name, now)) for flow in event.flow_ids)
            else:
                name, start = (name, now) if event.type == INSTANT else open_slices.pop(
                    event.track_uuid)
                self.slices.append(Slice(group, track.name, name, start, now))
        assert not open_slices


def test_by_hand(tmp_path):
    trace, start = Trace(runs.by_hand(tmp_path / 'run.mcap')), runs.START
    assert {(track, name, (begin - start) // MS, (end - start) // MS)
            for _, track, name, begin, end in trace.slices} > {
        ('worker 1', '/filter:run', 37, 40), ('spare threads', 'extra', 41, 43),
        ('/filter:run', 'job 2 (late)', 30, 40), ('/filter:run', 'job 2', 37, 40),
        ('missed deadlines', '/filter:run missed', 38, 38)}
    assert Counter(each.group for each in trace.slices) == {
        'workers': 7, '/driver, every 10 ms': 6, 'undeclared': 1, 'jobs by sink': 3, '': 1}
    assert [(sent[0], taken[0]) for sent, taken in trace.flows] == [
        ('/driver:tick', '/filter:run')] * 3


def test_the_demo():
    result, trace = replay(DEMO), Trace(DEMO)
    edges = {(dag.vertices[a].name, dag.vertices[b].name)
             for dag in result.task_set.dags for a, b in dag.edges}
    flows = Counter((sent[0], taken[0]) for sent, taken in trace.flows)
    assert set(flows) <= edges and len(flows) > 0.9 * len(edges) and flows.total() > 1000
    assert all(sent[1] <= taken[1] for sent, taken in trace.flows)
    sinks = [sink for dag in result.result()['dags'].values() for sink in dag['sinks'].values()]
    assert sum(each.group == 'jobs by sink' and each.start < each.end
               for each in trace.slices) == sum(sink['completed'] for sink in sinks)
    declared = {vertex.name for vertex in result.task_set.vertices}
    assert sum(each.end - each.start for each in trace.slices
               if each.group == 'workers' and each.name in declared) == sum(
        use['busy_ns'] for use in result.result()['callbacks'].values())
