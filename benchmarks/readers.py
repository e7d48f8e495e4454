# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Measures the speed and memory of readers of a trace.

The trace is a simulated run of a declaration.  Each reader is measured in a separate process,
including the processes that it starts: duration, CPU time, and maximum memory.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
import math
import os
from pathlib import Path
import resource
import time
from typing import Any

from mddag_executor.child import run_child
from mddag_executor.simulate import (
    draw_execution_times,
    periodic_workload,
    scale_execution_times,
    Settings,
    simulate,
)
from mddag_executor.trace import TraceReader
from mddag_executor.whatif.run_writer import write_trace
from msg_graph import TaskSet

LIMIT_S = 3600.0


def peak_memory_mb() -> float:
    """
    Return the most memory that this process has had in RAM so far, MB.

    From the kernel's ``VmHWM`` where there is one: what ``getrusage`` returns includes what the
    process that started this one had by then.
    """
    try:
        status = Path('/proc/self/status').read_text(encoding='ascii')
        return int(status.split('VmHWM:')[1].split()[0]) / 1024
    except (OSError, IndexError, ValueError):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def write_long_trace(path: str, task_set: TaskSet, events: int) -> None:
    """Write the trace of a run of at least this many events: one a release, four an execution."""
    settings = Settings(duration_ns=math.ceil(events / sum(
        (1 + 4 * len(dag.vertices)) / dag.period_ns for dag in task_set.dags)),
        judge='completions')
    times = scale_execution_times(
        task_set, draw_execution_times(task_set, 0), settings.workers, 0.6)
    load = periodic_workload(task_set, times, settings.duration_ns)
    write_trace(path, task_set, load, simulate(task_set, load, settings, log=True))


def _read(path: str, limit: int) -> int:
    return sum(1 for _ in TraceReader(path).events())


def _read_sorted(path: str, limit: int) -> int:
    return sum(1 for _ in TraceReader(path).events(sorted=True))


def _link(path: str, limit: int) -> int:
    from mddag_executor.sources.open import open_recording
    open_recording(path)
    return TraceReader(path).message_count or 0


def _replay(path: str, limit: int) -> int:
    from mddag_executor import replay
    outcome = replay(path)
    assert outcome.result()['dags']
    return TraceReader(path).message_count or 0


def _reschedule(path: str, limit: int) -> int:
    from mddag_executor import reschedule
    assert reschedule(path).result()['dags']
    return TraceReader(path).message_count or 0


def _exported(form: str, path: str, limit: int) -> int:
    from mddag_executor import replay
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


def measure(name: str, path: str, limit: int) -> dict[str, Any]:
    """
    Run one of ``READERS`` over a file in a separate process.

    :param limit: number of events after which a reader of ``OTHERS`` stops.
    :return: the cost of reading: events (as far as read), seconds, memory.
    """
    cost: dict[str, Any] = run_child(f'{__name__}:_measure', (name, path, limit), name, LIMIT_S)
    return cost


def _measure(name: str, path: str, limit: int) -> dict[str, Any]:
    begin, cpu = time.monotonic(), time.process_time()
    count = READERS[name](path, limit)
    took, cpu = time.monotonic() - begin, time.process_time() - cpu
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        'events': count, 'elapsed_s': took,
        'cpu_s': cpu + children.ru_utime + children.ru_stime, 'events_per_s': count / took,
        'peak_mb': peak_memory_mb() + children.ru_maxrss / 1024,
        'partial': name in OTHERS and count == limit}
