# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0


"""
What tracing costs, by hand: `python test/trace/measure.py [FILE]`.

Prints the time of `record()`, the writer thread's CPU at 10,000 events/s and at full speed, the
size on disk, and how fast a trace is read. The events are a mixture as the executor records it.
"""

from __future__ import annotations

import os
import statistics
import sys
import tempfile
import time
from typing import Any

from mddag_executor.trace import read_events, TraceFile, TraceReader, TraceWriter

COUNT = 400_000
START = 1_732_166_766_000_000_000
ADDRESS = 94_039_090_000_000


def workload(count: int) -> list[tuple[Any, ...]]:
    """Return what about `count` / 8 callbacks record, on 7 workers and 86 vertices."""
    events: list[tuple[Any, ...]] = []
    for run in range(count // 8):
        callback, dag, job = ADDRESS + run % 86 * 256, run % 11, run // 86
        time_, thread = START + run * 780_000, 1000 + run % 7
        events += [
            ('rmw_take', time_, thread, callback + 1, callback + 2, time_ - 50_000, True),
            ('dispatch', time_ + 10_000, thread, callback, dag, run % 9, job, run % 7, time_,
             time_ + 100_000_000),
            ('callback_start', time_ + 20_123, thread, callback, False),
            ('rclcpp_publish', time_ + 300_456, thread, callback + 8, callback + 16, time_),
            ('rcl_publish', time_ + 301_456, thread, callback + 8, callback + 16),
            ('dds_write', time_ + 302_456, thread, callback + 16),
            ('callback_end', time_ + 400_789, thread, callback),
            ('deadline', time_ + 410_123, thread, dag, run % 9, job, time_, time_ + 400_789)]
    return events


def measure_record(path: str) -> None:
    """Print the time of one record() call."""
    writer = TraceWriter(path, capacity=1 << 30, flush_interval_s=3600)
    record = writer.record
    times = []
    for _ in range(50):
        begin = time.perf_counter()
        for number in range(START, START + 2000):
            record('callback_start', number, 1234, ADDRESS, False)
        times.append((time.perf_counter() - begin) / 2000)
        writer._pending.clear()
    print(f'record(), with its loop: {statistics.median(times) * 1e9:.0f} ns')
    writer.close()


def measure_writer(path: str, events: list[tuple[Any, ...]]) -> None:
    """Print what encoding, compressing and writing cost."""
    begin = time.thread_time()
    with TraceFile(path) as file:
        file.extend(events, 1)
    cpu = time.thread_time() - begin
    print(f'full speed: {cpu * 1e6 / len(events):.2f} us and '
          f'{os.path.getsize(path) / len(events):.1f} bytes an event')

    writer = TraceWriter(path)
    clock = time.pthread_getcpuclockid(writer._thread.ident or 0)
    begin, cpu = time.perf_counter(), time.clock_gettime(clock)
    for first in range(0, 50_000, 100):
        for event in events[first:first + 100]:
            writer.record(*event)
        time.sleep(max(0, begin + (first + 100) / 10_000 - time.perf_counter()))
    elapsed, cpu = time.perf_counter() - begin, time.clock_gettime(clock) - cpu
    writer.close()
    print(f'writer thread at 10,000 events/s: {100 * cpu / elapsed:.2f} % of a core, '
          f'{cpu * 1e6 / 50_000:.2f} us an event, {writer.dropped} dropped')


def measure_reader(path: str, events: list[tuple[Any, ...]]) -> None:
    """Print how many events a second come out."""
    with TraceFile(path) as file:
        file.extend(events, 1)
    reader = TraceReader(path)
    for name, found in (
            ('in file order', reader.events()), ('in time order', reader.events(sorted=True)),
            ('one kind of 8', reader.events({'ros2:callback_start'})),
            ('as dicts', read_events(path))):
        begin = time.perf_counter()
        count = sum(1 for _ in found)
        rate = len(events) / (time.perf_counter() - begin)
        print(f'reading {name}: {count} events, {rate / 1e6:.2f} million of the file a second')


if __name__ == '__main__':
    with tempfile.TemporaryDirectory() as folder:
        target = sys.argv[1] if len(sys.argv) > 1 else os.path.join(folder, 'trace.mcap')
        mixture = workload(COUNT)
        measure_record(target)
        measure_writer(target, mixture)
        measure_reader(target, mixture)
