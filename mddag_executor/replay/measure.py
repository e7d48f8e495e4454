# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Measurements of the replayer: how fast it reads and links, and how well it predicts.

Theory of operation
-------------------
The file to read is a simulated run of a declaration, written over and over with a pause between,
each time later and with the next jobs' numbers; messages are recorded as the executor records
them.  So it has the mixture of events of a live run, as long as is wanted.

Each reader is measured in a process of its own, with those that it starts itself: how long it
takes, its CPU time, and its greatest memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
import multiprocessing
import os
import resource
import time
from typing import Any, NamedTuple

from mddag_executor.core import legs_of, Tables
from mddag_executor.core import policy as find_policy
from mddag_executor.core.state import new_state
from mddag_executor.errors import MddagError
from mddag_executor.memory import peak_memory_mb
from mddag_executor.simulate import (
    draw_execution_times,
    END,
    Load,
    LogEntry,
    periodic_load,
    scale_execution_times,
    START,
)
from mddag_executor.simulate.engine import run
from mddag_executor.trace import TraceFile, TraceReader
from msg_graph import Dag, TaskSet

_TILE = 10_000_000_000      # ns simulated
_PAUSE = 1_000_000_000      # ns after it, in which everything completes
_BEGIN = 1_732_166_766_000_000_000
_PROCESS = 1
_BATCH = 8192
Event = tuple[Any, ...]


class Speed(NamedTuple):
    """What reading took: events in the file (as far as read), seconds, greatest memory."""

    events: int
    elapsed_s: float
    cpu_s: float
    peak_mb: float

    @property
    def per_s(self) -> float:
        """Return events a second."""
        return self.events / self.elapsed_s if self.elapsed_s else 0.0


def write_long_trace(
    path: str, task_set: TaskSet, events: int, workers: int = 7, utilisation: float = 0.6,
    progress: Callable[[int], None] | None = None,
) -> int:
    """
    Write a trace of at least so many events and return how many it has.

    :raises mddag_executor.errors.MddagError: when the declaration has no execution times
    """
    times = scale_execution_times(
        task_set, draw_execution_times(task_set, 0), workers, utilisation)
    load = periodic_load(task_set, times, _TILE)
    tables = Tables.build(task_set)
    state = new_state(tables, workers)
    log: list[LogEntry] = []
    run(tables, state, find_policy('rad').key, load, _TILE + _PAUSE, False, log)
    tile = list(_Tile(task_set, tables, load, log).events())
    jobs = [0] * tables.n_dags
    for dag in load.dags:
        jobs[dag] += 1
    written = 0
    with TraceFile(path) as file:
        file.add('task_set', _BEGIN, _PROCESS, 1, task_set.text, task_set.file, 'rad', workers,
                 100_000_000, 2**31 - 1, False)
        number = 0
        while written < events:
            shifted = _shifted(tile, number, jobs)
            file.extend(shifted, _PROCESS)
            written += len(tile)
            number += 1
            if progress is not None:
                progress(written)
        end = _BEGIN + number * (_TILE + _PAUSE)
        file.add('shutdown', end, _PROCESS, 1, end)
    return written + 2


def _shifted(tile: list[Event], number: int, jobs: list[int]) -> Iterator[Event]:
    """Yield the events of a tile, later and with other jobs' numbers."""
    later = _BEGIN + number * (_TILE + _PAUSE)
    for name, when, thread, *fields in tile:
        if name == 'job_release':
            dag, job, release = fields
            fields = [dag, job + number * jobs[dag], release + later]
        elif name == 'dispatch':
            fields[3] += number * jobs[fields[1]]
            fields[5] += later
            fields[6] += later
        elif name == 'complete':
            fields[3] += number * jobs[fields[1]]
            fields[5] += later
        elif name == 'rmw_take':
            fields[2] += later
        elif name == 'rclcpp_publish':
            fields[2] += later
        yield (name, when + later, thread, *fields)


class _Tile:
    """The events of a simulated run, in the order in which an executor records them."""

    def __init__(
        self, task_set: TaskSet, tables: Tables, load: Load, log: list[LogEntry]
    ) -> None:
        self._dags = task_set.dags
        self._tables = tables
        self._load = load
        self._log = log
        self._ready: dict[tuple[int, int], int] = {}

    def events(self) -> Iterator[Event]:
        """Yield them in order of time."""
        events: list[Event] = []
        for when, dag, job in zip(self._load.times, self._load.dags, self._load.jobs):
            events.append(('job_release', when, 99, dag, job, when))
            self._ready[self._tables.source[dag], job] = when
        started: dict[int, int] = {}
        for when, kind, worker, dag, vertex, job in self._log:
            if kind == START:
                started[worker] = when
            elif kind == END:
                events.extend(self._execution(
                    self._dags[dag], vertex, job, worker, started[worker], when))
        return iter(sorted(events, key=lambda event: event[1]))

    def _execution(
        self, dag: Dag, vertex: int, job: int, worker: int, start: int, end: int
    ) -> Iterator[Event]:
        t = self._tables
        thread, address = 100 + worker, 1000 + 16 * vertex
        local = t.index_in_dag[vertex]
        ready = self._ready.pop((vertex, job))
        if dag.vertices[local].predecessors:
            yield ('rmw_take', ready, 99, address + 1, address + 2, ready, True)
        yield ('dispatch', start, thread, address, dag.index, local, job, worker, ready, end)
        yield ('callback_start', start, thread, address, False)
        if dag.vertices[local].successors:
            yield ('rclcpp_publish', end, thread, address + 3, address + 4, end)
            yield ('rcl_publish', end, thread, address + 3, address + 4)
        yield ('callback_end', end, thread, address)
        here = dag.vertices[local]
        last = max(1, len(legs_of(here, dag.vertices))) - 1
        for leg in range(last + 1):
            yield ('complete', end, thread, address, dag.index, local, job, leg == last, end, leg)
        for after in dag.vertices[local].successors:
            self._ready[t.first_vertex[dag.index] + after, job] = end


# --- readers -------------------------------------------------------------------------------------

def _read(path: str, limit: int) -> int:
    return sum(1 for _ in TraceReader(path).events())


def _read_sorted(path: str, limit: int) -> int:
    return sum(1 for _ in TraceReader(path).events(sorted=True))


def _link(path: str, limit: int) -> int:
    from mddag_executor.replay.run import open_run
    open_run(path).play([])
    return TraceReader(path).message_count or 0


def _replay(path: str, limit: int) -> int:
    from mddag_executor.replay import replay
    outcome = replay(path)
    assert outcome.result()['dags']
    return TraceReader(path).message_count or 0


def _reschedule(path: str, limit: int) -> int:
    from mddag_executor.replay import reschedule
    assert reschedule(path).result()['dags']
    return TraceReader(path).message_count or 0


def _mcap(path: str, limit: int) -> int:
    from mcap.reader import make_reader
    count = 0
    with open(path, 'rb') as stream:
        for _ in make_reader(stream).iter_messages():
            count += 1
            if count == limit:
                break
    return count


def _rosbags(path: str, limit: int) -> int:
    from pathlib import Path

    from rosbags.rosbag2.storage_mcap import McapReader
    reader = McapReader(Path(path))
    reader.open()
    count = 0
    for _ in reader.messages(reader.connections):
        count += 1
        if count == limit:
            break
    reader.close()
    return count


READERS: dict[str, Callable[[str, int], int]] = {
    'events in the order of the file': _read,
    'events in the order of time': _read_sorted,
    'read and linked': _link,
    'replayed as recorded': _replay,
    'rescheduled': _reschedule,
    'mcap, undecoded': _mcap,
    'rosbags, undecoded': _rosbags,
}
OTHERS = ('mcap, undecoded', 'rosbags, undecoded')
"""Those that stop after so many events: they are slow, and only their rate is of interest."""


def _in_child(name: str, path: str, limit: int, pipe: Any) -> None:
    begin, cpu = time.monotonic(), time.process_time()
    try:
        count = READERS[name](path, limit)
    except MddagError as error:
        pipe.send(str(error))
        return
    took, cpu = time.monotonic() - begin, time.process_time() - cpu
    beside = resource.getrusage(resource.RUSAGE_CHILDREN)
    pipe.send(Speed(count, took, cpu + beside.ru_utime + beside.ru_stime,
                    peak_memory_mb() + beside.ru_maxrss / 1024))


def measure(name: str, path: str, limit: int) -> Speed:
    """
    Run one of ``READERS`` over a file in a process of its own.

    :param limit: events after which another's reader stops.
    :raises mddag_executor.errors.MddagError: when it cannot
    """
    context = multiprocessing.get_context('spawn')
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_in_child, args=(name, os.fspath(path), limit, theirs))
    process.start()
    theirs.close()
    try:
        found = ours.recv()
    except EOFError:
        found = f'{name}: the measurement ended early: see above'
    process.join()
    if isinstance(found, str):
        raise MddagError(found)
    return Speed(*found)


# --- accuracy ------------------------------------------------------------------------------------

class Agreement(NamedTuple):
    """A sink's response times, recorded and predicted, ns; without overheads as ``ideal``."""

    dag: str
    sink: str
    jobs: int
    recorded_median: int
    predicted_median: int
    ideal_median: int
    recorded_p99: int
    predicted_p99: int

    @property
    def median_error(self) -> float:
        """Return predicted over recorded median, less one."""
        return self.predicted_median / self.recorded_median - 1

    @property
    def p99_error(self) -> float:
        """Return predicted over recorded 99 % quantile, less one."""
        return self.predicted_p99 / self.recorded_p99 - 1


def agreements(
    recorded: Mapping[str, Any], predicted: Mapping[str, Any], ideal: Mapping[str, Any]
) -> list[Agreement]:
    """
    Compare results, sink by sink; sinks without a completed job on a side are left out.

    :param recorded: `dags` of a result of ``replay``, as the others of rescheduled ones.
    """
    rows = []
    for dag_name, dag in recorded.items():
        for name, sink in dag['sinks'].items():
            times = [side[dag_name]['sinks'][name]['response_ns'] for side in (predicted, ideal)]
            response = sink['response_ns']
            if response is None or None in times:
                continue
            rows.append(Agreement(
                dag_name, name, sink['completed'], response['median'], times[0]['median'],
                times[1]['median'], response['p99'], times[0]['p99']))
    return rows
