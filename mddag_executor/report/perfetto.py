# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A recording for Perfetto's viewer (https://ui.perfetto.dev), in its own format.

Theory of operation
-------------------
Tracks are in groups:

* *workers*: one per worker, with its executions; arrows (flows) go from the publishing execution
  to the execution that its message started (of several pieces, to and from the last);
* *callbacks*: a group per DAG with a track per callback, with its executions by job;
* *jobs*: one per sink, with each job from its release to its completion there, and one with an
  instant at each deadline;
* *missed deadlines*: an instant for each;
* *ready callbacks*: a counter of callbacks that wait for a worker or their group.

Executions of one track may overlap (a reentrant group, overlapping jobs): then it has several
tracks of one name, because Perfetto requires slices of a track to nest. An execution goes to the
first of them that is free when it starts.

A trace is a sequence of packets in protobuf's encoding; field numbers are those of Perfetto's
``trace_packet.proto``. Names of events are in the first packet of an event (interned); a flag in
each packet says that it needs them. Times are the recording's, in nanoseconds.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, BinaryIO

from mddag_executor.core import legs_of
from mddag_executor.core.state import SINK_IN_TIME
from mddag_executor.core.tally import VERDICTS
from mddag_executor.recording.tables import NOTHING, sort_by, VERTEX
from mddag_executor.replay import Replay
from mddag_executor.report.export import executions
from mddag_executor.report.text import format_ns, printable
import numpy as np

_SEQUENCE = 1
_CLEARED, _NEEDED = 1, 2        # SEQ_INCREMENTAL_STATE_CLEARED, SEQ_NEEDS_INCREMENTAL_STATE
_WORKERS, _CALLBACKS, _JOBS, _MISSED, _READY = range(1, 6)
_BEGIN, _END, _INSTANT, _COUNTER = range(1, 5)
_EXPLICIT = 3
_MASK = 2 ** 64 - 1
# Fields of messages, by number.
_PACKET = 1
_TIMESTAMP, _SEQUENCE_ID, _TRACK_EVENT, _INTERNED, _FLAGS, _TRACK = 8, 10, 11, 12, 13, 60
_TYPE, _UUID, _NAME_IID, _NAME, _NOTE, _FLOW, _FLOW_ENDS, _VALUE = 9, 11, 10, 23, 4, 47, 48, 30
_PENDING_BYTES = 1 << 20


def varint(value: int) -> bytes:
    """Return a number in protobuf's encoding."""
    value &= _MASK
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def number(field: int, value: int) -> bytes:
    """Return a field with a number."""
    return varint(field << 3) + varint(value)


def text(field: int, value: str) -> bytes:
    """Return a field with a text."""
    return message(field, value.encode('utf-8', 'backslashreplace'))


def message(field: int, content: bytes) -> bytes:
    """Return a field with a message."""
    return varint(field << 3 | 2) + varint(len(content)) + content


def _fixed(field: int, value: int) -> bytes:
    return varint(field << 3 | 1) + (value & _MASK).to_bytes(8, 'little')


def write_perfetto(file: BinaryIO, replay: Replay) -> None:
    """Write a recording as a Perfetto trace."""
    _Writer(file, replay).write()


class _Writer:
    """Writes one trace."""

    def __init__(self, file: BinaryIO, replay: Replay) -> None:
        self._file, self._replay = file, replay
        self._recording, self._task_set = replay.recording, replay.task_set
        self._pending: list[bytes] = []
        self._size = 0
        self._uuid = _READY
        # by kind and number: end of the last slice and uuid of each of its tracks
        self._lanes: dict[tuple[Any, ...], list[list[int]]] = {}
        self._groups: dict[int, int] = {}
        self._names: dict[str, int] = {}
        self._keys: dict[str, int] = {}
        self._interned = b''
        head = number(_SEQUENCE_ID, _SEQUENCE)
        self._head = head + number(_FLAGS, _NEEDED)
        self._first_head = head + number(_FLAGS, _NEEDED | _CLEARED)
        self._first = True
        self._edges()

    def _edges(self) -> None:
        """Count the edges: by vertex those to its successors, by leg those of its message."""
        self._out: list[list[int]] = []
        self._into: list[list[int]] = []
        count = 0
        for dag in self._task_set.dags:
            edges: dict[tuple[int, int], int] = {}
            for vertex in dag.vertices:
                for after in vertex.successors:
                    edges[vertex.index, after] = count
                    count += 1
                self._out.append([edges[vertex.index, after] for after in vertex.successors])
            self._into.extend(
                [edges[before, vertex.index] for _, before in legs_of(vertex, dag.vertices)]
                for vertex in dag.vertices)
        self._n_edges = count

    def write(self) -> None:
        for uuid, name in ((_WORKERS, 'workers'), (_CALLBACKS, 'callbacks'),
                           (_JOBS, 'jobs by sink'), (_MISSED, 'missed deadlines')):
            self._describe(uuid, name, None, uuid)
        self._describe(_READY, 'ready callbacks', None, _READY, counts=True)
        self._executions()
        self._verdicts()
        self._flush()

    # --- contents --------------------------------------------------------------------------------

    def _executions(self) -> None:
        columns, rows = executions(self._replay)
        of = {column.name: column for column in columns}
        table = self._recording.executions
        order = sort_by(of['start_ns'].values)
        names = [printable(name) for name in of['vertex'].names]
        dags = [dag.name for dag in self._task_set.dags]
        rows = rows[order]
        released = of['release_ns'].known[order] if of['release_ns'].known is not None else order
        waiting = np.where(of['first'].values, of['waiting_ns'].values, 0)[order]
        waits = waiting > 0
        self._ready(of['ready_ns'].values[order][waits], of['start_ns'].values[order][waits])
        columns_of = [each.tolist() for each in (
            of['vertex'].values[order], of['first'].values[order], of['release_ns'].values[order],
            released, of['slack_ns'].values[order], *(table[name][rows] for name in (
                'callback', 'dag', 'vertex', 'job', 'leg', 'worker', 'ready', 'start', 'end',
                'completes')))]
        for (name, first, release, known, slack, callback, dag, vertex, job, leg, worker, ready,
             start, end, completes) in zip(*columns_of):
            track = self._lane(
                ('worker', worker), f'worker {worker}' if worker >= 0 else 'spare threads',
                _WORKERS, worker if worker >= 0 else 1 << 20, start, end)
            parts = [self._name(names[name])]
            if vertex >= 0:
                parts += (self._note('DAG', dags[dag]), self._note('job', job))
            if first:
                parts.append(self._note('waiting_ns', start - ready))
            if known:
                parts += (self._note('since_release_ns', start - release),
                          self._note('reference_slack_ns', slack))
            if completes != NOTHING and vertex >= 0:
                self._flows(parts, vertex, job, leg, completes == VERTEX)
            self._event(start, _BEGIN, track, *parts)
            self._event(end, _END, track)
            key = 'callback', vertex if vertex >= 0 else -1 - callback
            track = self._lane(
                key, names[name], self._group(dag if vertex >= 0 else -1), vertex + 1, start, end)
            self._event(start, _BEGIN, track, self._name(names[name]) if vertex < 0
                        else text(_NAME, f'job {job}'))
            self._event(end, _END, track)

    def _flows(
        self, parts: list[bytes], vertex: int, job: int, leg: int, whole: bool
    ) -> None:
        """End the flows of received messages, and begin those of sent ones."""
        base, into = job * self._n_edges + 1, self._into[vertex]
        legs: Iterable[int] = range(len(into)) if leg < 0 else (leg,)
        parts += (_fixed(_FLOW_ENDS, base + into[each]) for each in legs if each < len(into))
        if whole:
            parts += (_fixed(_FLOW, base + edge) for edge in self._out[vertex])

    def _ready(self, ready: Any, started: Any) -> None:
        """Write the number of ready callbacks over time."""
        times = np.concatenate([ready, started])
        step = np.repeat([1, -1], len(ready))
        when, place = np.unique(times, return_inverse=True)
        change = np.zeros(len(when), dtype=np.int64)
        np.add.at(change, place, step)
        for time, count in zip(when.tolist(), np.cumsum(change).tolist()):
            self._event(time, _COUNTER, _READY, number(_VALUE, count))

    def _verdicts(self) -> None:
        """Write jobs on the tracks of their sinks, and missed deadlines on their track."""
        verdicts = self._replay.judged.verdicts
        verdicts = verdicts[sort_by(verdicts['release'], verdicts['sink'])]
        names = [vertex.name for vertex in self._task_set.vertices]
        for kind, dag, sink, job, release, deadline, completed, *_ in verdicts.tolist():
            name, verdict = names[sink], VERDICTS[kind]
            label = f'job {job}' + ('' if kind == SINK_IN_TIME else f' ({verdict})')
            if completed >= release:
                track = self._lane(('sink', sink), name, _JOBS, sink, release, completed)
                self._event(release, _BEGIN, track, text(_NAME, label),
                            self._note('deadline_ns', deadline),
                            self._note('slack_ns', deadline - completed))
                self._event(completed, _END, track)
            track = self._lane(('deadline', sink), f'{name} deadline', _JOBS, sink, 0, 0)
            self._event(deadline, _INSTANT, track, text(_NAME, f'job {job}'))
            if kind == SINK_IN_TIME:
                continue
            late = () if completed < 0 else (self._note('late_by_ns', completed - deadline),)
            self._event(
                deadline if completed < 0 else completed, _INSTANT, _MISSED,
                self._name(f'{printable(name)} missed'),
                self._note('DAG', self._task_set.dags[dag].name), self._note('job', job),
                self._note('verdict', verdict), self._note('deadline_ns', deadline), *late)

    # --- tracks ----------------------------------------------------------------------------------

    def _group(self, dag: int) -> int:
        """Return the track of a DAG's callbacks."""
        if dag not in self._groups:
            name = 'undeclared'
            if dag >= 0:
                one = self._task_set.dags[dag]
                name = f'{one.name}, every {format_ns(one.period_ns)}'
            self._groups[dag] = self._new(name, _CALLBACKS, dag + 1)
        return self._groups[dag]

    def _lane(
        self, key: tuple[Any, ...], name: str, parent: int, rank: int, start: int, end: int
    ) -> int:
        """Reserve a track of a name that is free at ``start``; return it."""
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
        track = number(1, uuid) + text(2, printable(name))
        if parent is not None:
            track += number(5, parent)
        if counts:
            track += message(8, b'')
        track += number(11, _EXPLICIT) + number(12, rank)
        self._put(number(_SEQUENCE_ID, _SEQUENCE) + message(_TRACK, track))

    # --- events ----------------------------------------------------------------------------------

    def _name(self, name: str) -> bytes:
        iid = self._names.get(name)
        if iid is None:
            iid = self._names[name] = len(self._names) + 1
            self._interned += message(2, number(1, iid) + text(2, name))
        return number(_NAME_IID, iid)

    def _note(self, key: str, value: int | str) -> bytes:
        iid = self._keys.get(key)
        if iid is None:
            iid = self._keys[key] = len(self._keys) + 1
            self._interned += message(3, number(1, iid) + text(2, key))
        return message(_NOTE, number(1, iid) + (
            number(4, value) if isinstance(value, int) else text(6, printable(value))))

    def _event(self, time: int, kind: int, track: int, *parts: bytes) -> None:
        event = number(_TYPE, kind) + number(_UUID, track) + b''.join(parts)
        packet = number(_TIMESTAMP, max(0, time)) + (
            self._first_head if self._first else self._head) + message(_TRACK_EVENT, event)
        self._first = False
        if self._interned:
            packet += message(_INTERNED, self._interned)
            self._interned = b''
        self._put(packet)

    def _put(self, packet: bytes) -> None:
        self._pending.append(message(_PACKET, packet))
        self._size += len(packet)
        if self._size > _PENDING_BYTES:
            self._flush()

    def _flush(self) -> None:
        self._file.write(b''.join(self._pending))
        self._pending.clear()
        self._size = 0
