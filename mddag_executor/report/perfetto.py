# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A run for Perfetto's viewer (https://ui.perfetto.dev), in its own format.

Theory of operation
-------------------
Tracks stand in groups:

* *workers*: one for each worker, with what it ran; arrows (flows) go from the execution that
  published to the one that its message started (of several pieces, to and from the last);
* *callbacks*: in a group for each DAG one for each callback, with its executions by job;
* *jobs*: one for each sink, with each job from its release to its completion there, and one with
  an instant at each deadline;
* *missed deadlines*: an instant for each;
* *ready callbacks*: a counter of those that wait for a worker or their group.

Executions of one track may overlap (a reentrant group, jobs that overlap): then it has several
tracks of one name, as Perfetto demands that slices of a track nest.  An execution goes to the
first of them that is free when it starts.  So executions have to come by their start, and jobs by
their release (``export.Ordered``).

Names stand in the file once (interned); each packet says with a flag that it needs them.  Times
are the trace's, in nanoseconds.
"""

from __future__ import annotations

from array import array
from typing import Any, BinaryIO

from mddag_executor.core import legs_of, Tables
from mddag_executor.report.export import JobRow, Ran, Target
from mddag_executor.report.text import format_ns, printable
from msg_graph import TaskSet
import numpy as np
from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import Trace, TracePacket, TrackEvent

_SEQUENCE = 1
_CLEARED, _NEEDED = 1, 2        # SEQ_INCREMENTAL_STATE_CLEARED, SEQ_NEEDS_INCREMENTAL_STATE
_WORKERS, _CALLBACKS, _JOBS, _MISSED, _READY = range(1, 6)
_MASK = 2 ** 64 - 1


class PerfettoTarget(Target):
    """
    Writes a run as a Perfetto trace, packet by packet.

    :param file: where to; a trace is the packets one after the other.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._uuid = _READY
        # by kind and number: the end of the last slice and the uuid of each of its tracks
        self._lanes: dict[tuple[Any, ...], list[list[int]]] = {}
        self._dag_groups: dict[int, int] = {}
        self._names: dict[str, int] = {}
        self._keys: dict[str, int] = {}
        self._first = True
        # by execution: when it became ready, and when it started
        self._ready, self._started = array('q'), array('q')

    def begin(self, task_set: TaskSet, tables: Tables) -> None:
        """Write what there is whatever the run was."""
        self._task_set = task_set
        # by global vertex: the edges to its successors, and by leg those of its message
        self._out: list[list[int]] = []
        self._into: list[list[int]] = []
        number = 0
        for dag in task_set.dags:
            edges: dict[tuple[int, int], int] = {}
            for vertex in dag.vertices:
                for after in vertex.successors:
                    edges[vertex.index, after] = number
                    number += 1
                self._out.append([edges[vertex.index, after] for after in vertex.successors])
            self._into.extend(
                [edges[before, vertex.index] for _, before in legs_of(vertex, dag.vertices)]
                for vertex in dag.vertices)
        self._n_edges = number
        for uuid, name in ((_WORKERS, 'workers'), (_CALLBACKS, 'callbacks'),
                           (_JOBS, 'jobs by sink'), (_MISSED, 'missed deadlines')):
            self._describe(uuid, name, None, uuid)
        self._describe(_READY, 'ready callbacks', None, _READY, counts=True)

    def execution(self, ran: Ran) -> None:
        """Write an execution on the track of its worker and on that of its callback."""
        row, piece = ran.row, ran.piece
        if row.waiting_ns:
            self._ready.append(row.ready_ns)
            self._started.append(row.start_ns)
        name = f'worker {row.worker}' if row.worker >= 0 else 'spare threads'
        rank = row.worker if row.worker >= 0 else 1 << 20
        track = self._lane(('worker', row.worker), name, _WORKERS, rank, piece.start, piece.end)
        event = self._begin(track, row.vertex)
        if row.dag is not None and row.job is not None:
            self._note(event, 'DAG', row.dag)
            self._note(event, 'job', row.job)
        if row.waiting_ns is not None:
            self._note(event, 'waiting_ns', row.waiting_ns)
        if row.release_ns is not None:
            self._note(event, 'since_release_ns', row.start_ns - row.release_ns)
            self._note(event, 'reference_slack_ns', row.slack_ns or 0)
        if ran.legs:
            self._flows(event, ran)
        self._put(piece.start, event)
        self._end(track, piece.end)
        key = ('callback', piece.vertex if piece.vertex >= 0 else -1 - piece.callback)
        track = self._lane(key, row.vertex, self._group(piece.dag), piece.vertex + 1, piece.start,
                           piece.end)
        event = self._begin(track, row.vertex if row.job is None else f'job {row.job}')
        self._put(piece.start, event)
        self._end(track, piece.end)

    def _flows(self, event: Any, ran: Ran) -> None:
        """Let the flows of the messages that it took end here, and those that it sends begin."""
        vertex = ran.piece.vertex
        base = ran.piece.job * self._n_edges + 1
        into = self._into[vertex]
        for leg in ran.legs:
            if leg < len(into):
                event.terminating_flow_ids.append(base + into[leg] & _MASK)
        if ran.whole:
            event.flow_ids.extend(base + edge & _MASK for edge in self._out[vertex])

    def verdict(self, row: JobRow, vertex: int) -> None:
        """Write a job on the track of its sink, and a missed deadline where all of them are."""
        text = f'job {row.job}' + ('' if row.verdict == 'in_time' else f' ({row.verdict})')
        if row.completed_ns is not None and row.completed_ns >= row.release_ns:
            track = self._lane(('sink', vertex), row.sink, _JOBS, vertex, row.release_ns,
                               row.completed_ns)
            event = self._begin(track, text)
            self._note(event, 'deadline_ns', row.deadline_ns)
            self._note(event, 'slack_ns', row.slack_ns or 0)
            self._put(row.release_ns, event)
            self._end(track, row.completed_ns)
        track = self._lane(('deadline', vertex), f'{row.sink} deadline', _JOBS, vertex, 0, 0)
        event = self._event(TrackEvent.TYPE_INSTANT, track, f'job {row.job}')
        self._put(row.deadline_ns, event)
        if row.verdict == 'in_time':
            return
        event = self._event(TrackEvent.TYPE_INSTANT, _MISSED, f'{row.sink} missed')
        self._note(event, 'DAG', row.dag)
        self._note(event, 'job', row.job)
        self._note(event, 'verdict', row.verdict)
        self._note(event, 'deadline_ns', row.deadline_ns)
        if row.slack_ns is not None:
            self._note(event, 'late_by_ns', -row.slack_ns)
        self._put(row.deadline_ns if row.completed_ns is None else row.completed_ns, event)

    def finish(self) -> None:
        """Write how many callbacks were ready over time, which is known only now."""
        times = np.concatenate([self._ready, self._started])
        step = np.repeat([1, -1], len(self._ready))
        when, place = np.unique(times, return_inverse=True)
        change = np.zeros(len(when), dtype=np.int64)
        np.add.at(change, place, step)
        for time, count in zip(when.tolist(), np.cumsum(change).tolist()):
            event = self._event(TrackEvent.TYPE_COUNTER, _READY, None)
            event.counter_value = count
            self._put(time, event)

    # --- tracks ----------------------------------------------------------------------------------

    def _group(self, dag: int) -> int:
        """Return the track that holds a DAG's callbacks."""
        if dag not in self._dag_groups:
            if dag < 0:
                name = 'undeclared'
            else:
                one = self._task_set.dags[dag]
                name = f'{one.name}, every {format_ns(one.period_ns)}'
            self._dag_groups[dag] = self._new(name, _CALLBACKS, dag + 1)
        return self._dag_groups[dag]

    def _lane(
        self, key: tuple[Any, ...], name: str, parent: int, rank: int, start: int, end: int
    ) -> int:
        """Return a track of a name that is free from a time on, and take it."""
        lanes = self._lanes.setdefault(key, [])
        for lane in lanes:
            if lane[0] <= start:
                lane[0] = end
                return lane[1]
        lanes.append([end, self._new(name, parent, rank)])
        return lanes[-1][1]

    def _new(self, name: str, parent: int, rank: int) -> int:
        self._uuid += 1
        self._describe(self._uuid, name, parent, rank)
        return self._uuid

    def _describe(
        self, uuid: int, name: str, parent: int | None, rank: int, counts: bool = False
    ) -> None:
        packet = TracePacket()
        packet.trusted_packet_sequence_id = _SEQUENCE
        track = packet.track_descriptor
        track.uuid = uuid
        track.name = printable(name)
        if parent is not None:
            track.parent_uuid = parent
        track.sibling_order_rank = rank
        if counts:
            track.counter.SetInParent()
        track.child_ordering = type(track).EXPLICIT
        self._write(packet)

    # --- events ----------------------------------------------------------------------------------

    def _begin(self, track: int, name: str) -> Any:
        return self._event(TrackEvent.TYPE_SLICE_BEGIN, track, name)

    def _end(self, track: int, time: int) -> None:
        self._put(time, self._event(TrackEvent.TYPE_SLICE_END, track, None))

    def _event(self, kind: Any, track: int, name: str | None) -> Any:
        self._packet = packet = TracePacket()
        packet.trusted_packet_sequence_id = _SEQUENCE
        packet.sequence_flags = _NEEDED | (_CLEARED if self._first else 0)
        self._first = False
        event = packet.track_event
        event.type = kind
        event.track_uuid = track
        if name is not None and name.startswith('job '):
            event.name = name       # there are too many of them to keep
        elif name is not None:
            event.name_iid = self._intern(self._names, name, packet.interned_data.event_names)
        return event

    def _note(self, event: Any, key: str, value: int | str) -> None:
        note = event.debug_annotations.add()
        note.name_iid = self._intern(
            self._keys, key, self._packet.interned_data.debug_annotation_names)
        if isinstance(value, int):
            note.int_value = value
        else:
            note.string_value = printable(value)

    def _intern(self, known: dict[str, int], name: str, new: Any) -> int:
        number = known.get(name)
        if number is None:
            number = known[name] = len(known) + 1
            entry = new.add()
            entry.iid = number
            entry.name = printable(name)
        return number

    def _put(self, time: int, event: Any) -> None:
        self._packet.timestamp = max(0, time)
        self._write(self._packet)

    def _write(self, packet: Any) -> None:
        self._file.write(Trace(packet=[packet]).SerializeToString())
