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
* *jobs by sink*: one per sink, with each job from its release to its completion there;
* *missed deadlines*: an instant for each.

Executions of one track may overlap (a reentrant group, overlapping jobs): then it has several
tracks of one name, because Perfetto requires slices of a track to nest. An execution goes to the
first of them that is free when it starts.

A trace is a sequence of packets in protobuf's encoding; field numbers are those of Perfetto's
``trace_packet.proto``. The first packet has the names of events (interned); a flag in each other
packet says that it needs them. Times are the recording's, in nanoseconds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, BinaryIO

from mddag_executor.analysis.as_recorded import Replay
from mddag_executor.core import legs_of
from mddag_executor.core.state import SINK_IN_TIME
from mddag_executor.core.tally import VERDICTS
from mddag_executor.recording.columns import Ints
from mddag_executor.recording.joins import sort_by
from mddag_executor.recording.tables import NOTHING, VERTEX
from mddag_executor.report.columns import executions
from mddag_executor.report.protobuf import Bytes, fixed, joined, message, number, texts, where
from mddag_executor.report.text import format_ns, printable
import numpy as np

_SEQUENCE = 1
_CLEARED, _NEEDED = 1, 2        # SEQ_INCREMENTAL_STATE_CLEARED, SEQ_NEEDS_INCREMENTAL_STATE
_TOP = 'workers', 'callbacks', 'jobs by sink', 'missed deadlines'
_WORKERS, _CALLBACKS, _JOBS, _MISSED = range(1, 5)
_BEGIN, _END, _INSTANT = range(1, 4)
_EXPLICIT = 3
# Fields of messages, by number.
_PACKET = 1
_TIMESTAMP, _SEQUENCE_ID, _TRACK_EVENT, _INTERNED, _FLAGS, _TRACK = 8, 10, 11, 12, 13, 60
_TYPE, _UUID, _NAME_IID, _NAME, _NOTE, _FLOW, _FLOW_ENDS = 9, 11, 10, 23, 4, 47, 48
_NOTES = 'DAG', 'job', 'waiting_ns', 'since_release_ns', 'deadline_ns', 'slack_ns', 'verdict'
_KINDS = [VERDICTS[kind] for kind in sorted(VERDICTS)]
_BATCH = 1 << 14


def write_perfetto(file: BinaryIO, replay: Replay) -> None:
    """Write a recording as a Perfetto trace."""
    _Writer(file, replay).write()


def _batches(columns: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for begin in range(0, len(next(iter(columns.values()))), _BATCH):
        yield {name: values[begin:begin + _BATCH] for name, values in columns.items()}


def _lanes(of: Ints, start: Ints, end: Ints) -> Ints:
    """Return the lane of each slice, the first one of its track that is free at its start."""
    ends: dict[int, list[int]] = {}
    lanes = np.empty(len(of), dtype=np.int64)
    for i, (track, begin, until) in enumerate(zip(of.tolist(), start.tolist(), end.tolist())):
        busy = ends.setdefault(track, [])
        lane = next((lane for lane, each in enumerate(busy) if each <= begin), len(busy))
        busy[lane:lane + 1] = [until]
        lanes[i] = lane
    return lanes


def _padded(rows: Sequence[Sequence[int]]) -> Ints:
    """Return a table; -1 fills short rows, and the last one, which is that of no vertex."""
    width = max(map(len, rows), default=0)
    return np.array([[*row, *[-1] * (width - len(row))] for row in (*rows, ())], dtype=np.int64)


class _Writer:
    """Writes one trace."""

    def __init__(self, file: BinaryIO, replay: Replay) -> None:
        self._file, self._replay = file, replay
        self._recording, self._task_set = replay.recording, replay.task_set
        dags = self._task_set.dags
        self._dag_names = [printable(dag.name) for dag in dags] or ['']
        # by vertex the vertices that get its messages; by vertex and leg the one that sent it
        firsts = replay.judged.tables.first_vertex
        self._after = _padded([[first + after for after in vertex.successors]
                               for first, dag in zip(firsts, dags) for vertex in dag.vertices])
        self._before = _padded([[first + before for _, before in legs_of(vertex, dag.vertices)]
                                for first, dag in zip(firsts, dags) for vertex in dag.vertices])
        self._uuid = 0
        self._groups: dict[int, int] = {}
        self._head = number(_SEQUENCE_ID, _SEQUENCE), number(_FLAGS, _NEEDED)

    def write(self) -> None:
        columns, rows = executions(self._replay)
        self._columns = {column.name: column for column in columns}
        self._names = [printable(name) for name in self._columns['vertex'].names]
        n_declared = len(self._task_set.vertices)
        interned = [*self._names, *(f'{name} missed' for name in self._names[:n_declared])]
        self._put(
            self._head[0], number(_FLAGS, _NEEDED | _CLEARED), message(_INTERNED, *(
                message(field, number(1, i), texts(2, [name]))
                for field, names in ((2, interned), (3, _NOTES))
                for i, name in enumerate(names, 1))))
        for rank, name in enumerate(_TOP, 1):
            self._track(name, 0, rank)
        self._executions(rows)
        self._verdicts()

    # --- contents --------------------------------------------------------------------------------

    def _executions(self, rows: Ints) -> None:
        of = self._columns
        order = sort_by(of['start_ns'].values)
        table = self._recording.executions[rows[order]]
        start, end, declared = table['start'], table['end'], table['vertex'] >= 0
        name, first, release, slack, waiting = (of[key].values[order] for key in (
            'vertex', 'first', 'release_ns', 'slack_ns', 'waiting_ns'))
        known = of['release_ns'].known
        assert known is not None

        names = self._recording.names.workers

        def of_worker(row: int) -> tuple[str, int, int]:
            worker = int(table['worker'][row])
            if worker < 0:
                return 'spare threads', _WORKERS, 1 << 20
            return (printable(names[worker]) if worker < len(names) else f'worker {worker}',
                    _WORKERS, worker)

        def of_callback(row: int) -> tuple[str, int, int]:
            dag = int(table['dag'][row]) if declared[row] else -1
            return self._names[name[row]], self._group(dag), int(table['vertex'][row]) + 1

        columns = {
            **{key: table[key] for key in (
                'dag', 'vertex', 'job', 'leg', 'start', 'end', 'completes')},
            'name': name, 'first': first, 'waiting': waiting, 'slack': slack,
            'since': start - release, 'known': known[order],
            'on_worker': self._tracks(table['worker'], start, end, of_worker),
            'on_callback': self._tracks(
                np.where(declared, table['vertex'], -1 - table['callback']), start, end,
                of_callback)}
        for each in _batches(columns):
            declared, named = each['vertex'] >= 0, number(_NAME_IID, each['name'] + 1)
            self._write(
                self._event(
                    each['start'], _BEGIN, each['on_worker'], named,
                    where(declared, *self._of_job(each)),
                    where(each['first'], self._note('waiting_ns', each['waiting'])),
                    where(each['known'], self._note('since_release_ns', each['since']),
                          self._note('slack_ns', each['slack'])),
                    *self._flows(each)),
                self._event(each['end'], _END, each['on_worker']),
                self._event(
                    each['start'], _BEGIN, each['on_callback'], where(~declared, named),
                    where(declared, self._job_name(each['job']))),
                self._event(each['end'], _END, each['on_callback']))

    def _of_job(self, each: dict[str, Any]) -> tuple[Bytes, Bytes]:
        return (self._word('DAG', self._dag_names, np.maximum(each['dag'], 0)),
                self._note('job', each['job']))

    def _flows(self, each: dict[str, Any]) -> Iterator[Bytes]:
        """Yield the ends of the flows of received messages, and begins of those of sent ones."""
        vertex, leg, n = each['vertex'].astype(np.int64), each['leg'], len(self._after)
        done, base = (each['completes'] != NOTHING) & (vertex >= 0), each['job'] * n
        for place, other in enumerate(self._before[vertex].T):
            taken = done & (other >= 0) & ((leg < 0) | (leg == place))
            yield where(taken, fixed(_FLOW_ENDS, (base + other) * n + vertex + 1))
        for other in self._after[vertex].T:
            sent = done & (other >= 0) & (each['completes'] == VERTEX)
            yield where(sent, fixed(_FLOW, (base + vertex) * n + other + 1))

    def _verdicts(self) -> None:
        """Write jobs on the tracks of their sinks, and missed deadlines on their track."""
        verdicts = self._replay.judged.verdicts
        verdicts = verdicts[sort_by(verdicts['release'], verdicts['sink'])]
        sink, release, completed = (verdicts[key] for key in ('sink', 'release', 'completed'))
        done = completed >= release

        def of_sink(row: int) -> tuple[str, int, int]:
            return self._names[sink[done][row]], _JOBS, int(sink[done][row])

        tracks = np.zeros(len(sink), dtype=np.int64)
        tracks[done] = self._tracks(sink[done], release[done], completed[done], of_sink)
        for each in _batches({
                **{key: verdicts[key] for key in (
                    'kind', 'dag', 'sink', 'job', 'release', 'deadline', 'completed')},
                'done': done, 'track': tracks}):
            deadline, completed = each['deadline'], each['completed']
            note = self._note('deadline_ns', deadline)
            self._write(
                where(each['done'], self._event(
                    each['release'], _BEGIN, each['track'],
                    self._job_name(each['job'], each['kind']), note,
                    self._note('slack_ns', deadline - completed)),
                    self._event(completed, _END, each['track'])),
                where(each['kind'] != SINK_IN_TIME, self._event(
                    deadline, _INSTANT, _MISSED,
                    number(_NAME_IID, each['sink'] + len(self._names) + 1),
                    *self._of_job(each), self._word('verdict', _KINDS, each['kind']))))

    # --- tracks ----------------------------------------------------------------------------------

    def _group(self, dag: int) -> int:
        if dag not in self._groups:
            name = 'undeclared'
            if dag >= 0:
                one = self._task_set.dags[dag]
                name = f'{one.name}, every {format_ns(one.period_ns)}'
            self._groups[dag] = self._track(name, _CALLBACKS, dag + 1)
        return self._groups[dag]

    def _tracks(
        self, keys: Ints, start: Ints, end: Ints, of: Callable[[int], tuple[str, int, int]]
    ) -> Ints:
        """
        Return the track of each slice; slices that overlap get different ones of the same name.

        :param keys: which slices belong together.
        :param of: returns name, parent and rank of the track of a row.
        """
        key = np.unique(keys, return_inverse=True)[1]
        lanes = _lanes(key, start, end)
        _, first, place = np.unique(
            key * (lanes.max(initial=0) + 1) + lanes, return_index=True, return_inverse=True)
        tracks = np.array([self._track(*of(row)) for row in first.tolist()], dtype=np.int64)
        return tracks[place]

    def _track(self, name: str, parent: int, rank: int) -> int:
        """Describe a new track; without a parent it is at the top."""
        self._uuid += 1
        above = [number(5, parent)] if parent else []
        self._put(self._head[0], message(
            _TRACK, number(1, self._uuid), texts(2, [printable(name)]), *above,
            number(11, _EXPLICIT), number(12, rank)))
        return self._uuid

    # --- events ----------------------------------------------------------------------------------

    def _job_name(self, job: Ints, kind: Any = SINK_IN_TIME) -> Bytes:
        """Return the names of slices: the jobs, and how they ended if not in time."""
        different, which = np.unique(job * len(_KINDS) + kind, return_inverse=True)
        names = [f'job {each // len(_KINDS)} ({_KINDS[each % len(_KINDS)]})'.removesuffix(
            f' ({_KINDS[SINK_IN_TIME]})') for each in different.tolist()]
        return texts(_NAME, names, which)

    def _note(self, key: str, values: Any) -> Bytes:
        return message(_NOTE, number(1, _NOTES.index(key) + 1), number(4, values))

    def _word(self, key: str, words: Sequence[str], which: Ints) -> Bytes:
        return message(_NOTE, number(1, _NOTES.index(key) + 1),
                       texts(6, words, which))

    def _event(self, time: Ints, kind: int, track: Any, *parts: Bytes) -> Bytes:
        return message(
            _PACKET, number(_TIMESTAMP, np.maximum(0, time)), *self._head,
            message(_TRACK_EVENT, number(_TYPE, kind), number(_UUID, track), *parts))

    def _put(self, *parts: Bytes) -> None:
        self._write(message(_PACKET, *parts))

    def _write(self, *packets: Bytes) -> None:
        self._file.write(joined(packets).packed())
