# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Measures the replayer: speed of reading and linking, and accuracy of predictions.

Theory of operation
-------------------
The trace is a simulated run of a declaration, repeated with a pause between, each time later and
with the next jobs' numbers; messages are recorded as the executor records them.  So it has the
mixture of events of a live run, of any length.

Each reader is measured in a separate process, including the processes that it starts: duration,
CPU time, and maximum memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
import multiprocessing
import os
import resource
import time
from typing import Any, NamedTuple

from mddag_executor.errors import MddagError
from mddag_executor.memory import peak_memory_mb
from mddag_executor.replay.run_writer import write_events
from mddag_executor.simulate import (
    draw_execution_times,
    Load,
    periodic_load,
    scale_execution_times,
    Settings,
    simulate,
)
from mddag_executor.trace import TraceFile, TraceReader
from msg_graph import TaskSet

_TILE = 10_000_000_000      # ns simulated
_PAUSE = 1_000_000_000      # ns after it, in which all jobs complete
_BEGIN = 1_732_166_766_000_000_000
_PROCESS = 1
_ADDRESS = 1024     # times the index of a callback, so that handles differ
_KINDS = ('job_release', 'dispatch', 'callback_start', 'callback_end', 'complete')
Event = tuple[Any, ...]


class Speed(NamedTuple):
    """The cost of reading: events in the file (as far as read), seconds, maximum memory."""

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
    """Write a trace of at least ``events`` events and return their number."""
    times = scale_execution_times(
        task_set, draw_execution_times(task_set, 0), workers, utilisation)
    load = periodic_load(task_set, times, _TILE)
    tile = _tile(task_set, load, workers)
    jobs = [0] * len(task_set.dags)
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


def _tile(task_set: TaskSet, load: Load, workers: int) -> list[Event]:
    """
    Return the events of a simulated run, with its messages, in the order of a live recording.

    The events of an execution are recorded when it ends, one after the other.
    """
    run = simulate(task_set, load, Settings(
        workers=workers, duration_ns=_TILE + _PAUSE, judge='completions'), log=True)
    found: list[Event] = []     # messages
    recorded: list[tuple[int, Event]] = []
    publishes: dict[int, bool] = {}     # by thread
    begun: dict[int, list[Event]] = {}

    def add(name: str, when: int, thread: int, *fields: Any) -> None:
        if name not in _KINDS:
            return
        address = _ADDRESS * fields[0]
        if name == 'dispatch':
            vertex = task_set.dags[fields[1]].vertices[fields[2]]
            publishes[thread] = bool(vertex.successors)
            if vertex.predecessors:
                ready = fields[5]
                found.append(('rmw_take', ready, 0, address + 1, address + 2, ready, True))
        elif name == 'callback_end' and publishes[thread]:
            found.append(('rclcpp_publish', when, thread, address + 3, address + 4, when))
            found.append(('rcl_publish', when, thread, address + 3, address + 4))
        event = name, when, thread, *fields
        if name in ('dispatch', 'callback_start'):
            begun.setdefault(thread, []).append(event)
        else:
            if name == 'callback_end':
                recorded.extend((when, each) for each in begun.pop(thread))
            recorded.append((when, event))

    write_events(task_set, load, run, add)
    recorded.extend((event[1], event) for event in found)
    return [event for _, event in sorted(recorded, key=lambda entry: entry[0])]


# --- readers -------------------------------------------------------------------------------------

def _read(path: str, limit: int) -> int:
    return sum(1 for _ in TraceReader(path).events())


def _read_sorted(path: str, limit: int) -> int:
    return sum(1 for _ in TraceReader(path).events(sorted=True))


def _link(path: str, limit: int) -> int:
    from mddag_executor.replay.run import open_recording
    open_recording(path)
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


def _exported(form: str, path: str, limit: int) -> int:
    from mddag_executor.replay import replay
    from mddag_executor.report.export import write
    with open(os.devnull, 'wb') as file:
        write(form, file, replay(path), 'executions')
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
    'exported to Parquet': partial(_exported, 'parquet'),
    'exported to Perfetto': partial(_exported, 'pftrace'),
    'mcap, undecoded': _mcap,
    'rosbags, undecoded': _rosbags,
}
OTHERS = ('mcap, undecoded', 'rosbags, undecoded')
"""Readers that stop after a number of events: they are slow, and only their rate is reported."""


def _in_child(name: str, path: str, limit: int, pipe: Any) -> None:
    begin, cpu = time.monotonic(), time.process_time()
    try:
        count = READERS[name](path, limit)
    except MddagError as error:
        pipe.send(str(error))
        return
    took, cpu = time.monotonic() - begin, time.process_time() - cpu
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    pipe.send(Speed(count, took, cpu + children.ru_utime + children.ru_stime,
                    peak_memory_mb() + children.ru_maxrss / 1024))


def measure(name: str, path: str, limit: int) -> Speed:
    """
    Run one of ``READERS`` over a file in a separate process.

    :param limit: number of events after which a reader of ``OTHERS`` stops.
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
    jobs: float
    recorded_median: float
    predicted_median: float
    ideal_median: float
    recorded_p99: float
    predicted_p99: float

    @property
    def median_error(self) -> float:
        """Return predicted over recorded median, minus one."""
        return self.predicted_median / self.recorded_median - 1

    @property
    def p99_error(self) -> float:
        """Return predicted over recorded 99 % quantile, minus one."""
        return self.predicted_p99 / self.recorded_p99 - 1


def agreements(
    recorded: Mapping[str, Any], predicted: Mapping[str, Any], ideal: Mapping[str, Any]
) -> list[Agreement]:
    """
    Compare results, sink by sink; without sinks that lack completed jobs on a side.

    :param recorded: `dags` of a result of ``replay``; the others: of rescheduled ones.
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
