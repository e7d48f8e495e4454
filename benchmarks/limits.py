# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Limits that the garbage collector and the system's scheduler set to an executor.

python benchmarks/limits.py gc|policy [--seconds 2] [--workers 7]

* ``gc``: the longest collection and the timer's lateness in a program with a million objects, with
  and without ``freeze_gc``.
* ``policy``: the timer's lateness while other processes use every CPU, with the workers and with
  the whole process under the normal and a real-time policy.

``docs/machine.md`` names it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
import gc
import json
import os
import subprocess
import sys
import threading
import time
from typing import Any

from mddag_executor.clocks import epoch_offset_ns
from mddag_executor.core import quantile
from mddag_executor.errors import MddagError, UsageError
from mddag_executor.executor import current_job
from mddag_executor.executor.executor import MultiDeadlineExecutor
from mddag_executor.hosting.session import Session
from msg_graph import loads
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.utilities import try_shutdown

BODY_S = 0.005
PERIOD_S = 0.01
OBJECTS = 1_000_000
PRIORITY = 40
GRAPH = """
mddag: 1
nodes:
  - node: /limits
    callbacks: [{name: tick, timer: 10ms, deadline: 10ms}]
"""


class Lateness:
    """A node with an empty timer that notes how late it runs, ns."""

    def __init__(self) -> None:
        self.late: list[int] = []
        self._offset_ns = epoch_offset_ns()
        self.node = Node('limits', enable_rosout=False, start_parameter_services=False)
        self.node.create_timer(PERIOD_S, self._tick, ReentrantCallbackGroup())

    def _tick(self) -> None:
        job = current_job()
        if job is not None:
            self.late.append(time.monotonic_ns() + self._offset_ns - job.release_ns)

    def result(self) -> dict[str, float]:
        """Return quantiles in us."""
        ordered = sorted(self.late) or [0]
        return {'p50': quantile(ordered, 0.5) / 1e3, 'p99': quantile(ordered, 0.99) / 1e3,
                'max': ordered[-1] / 1e3}


def lateness(
    seconds: float, workers: int, body: Callable[[], None] | None = None, **arguments: Any
) -> dict[str, float]:
    """Return the lateness of an empty timer (us) while all workers but one run bodies."""
    ending = threading.Event()
    watched = Lateness()
    executor = MultiDeadlineExecutor(loads(GRAPH), num_workers=workers, **arguments)

    def run() -> None:
        assert body is not None
        body()
        if not ending.is_set():
            executor.create_task(run)

    executor.add_node(watched.node)
    for _ in range(workers - 1 if body is not None else 0):
        executor.create_task(run)
    with Session(executor) as session:
        time.sleep(0.3)
        watched.late.clear()
        time.sleep(seconds)
        ending.set()
        result = watched.result()
    watched.node.destroy_node()
    if session.error is not None:
        raise session.error
    return result


class GcWatch:
    """Notes the time of each garbage collection, ns, while it is entered."""

    def __init__(self) -> None:
        self.pauses: list[int] = []
        self._begun = 0

    def __call__(self, phase: str, info: dict[str, int]) -> None:
        """Note what the collector reports."""
        if phase == 'start':
            self._begun = time.monotonic_ns()
        else:
            self.pauses.append(time.monotonic_ns() - self._begun)

    def __enter__(self) -> GcWatch:
        gc.callbacks.append(self)
        return self

    def __exit__(self, *args: object) -> None:
        gc.callbacks.remove(self)


def measure_gc(seconds: float, workers: int) -> list[dict[str, Any]]:
    """Measure the pauses of a program with many objects that allocates continuously."""
    kept = [(str(i), [i]) for i in range(OBJECTS // 2)]
    garbage: list[list[Any]] = []

    def body() -> None:
        time.sleep(BODY_S / 5)
        garbage.extend([] for _ in range(500))
        if len(garbage) > 100_000:
            garbage.clear()

    rows = []
    for freeze in (False, True):
        with GcWatch() as watch:
            late = lateness(seconds, workers, body, freeze_gc=freeze)
            if freeze:
                del watch.pauses[0]  # the collection of freeze_gc itself, before anything runs
            longest = max(watch.pauses, default=0)
            gc.collect()
        rows.append({
            'freeze_gc': str(freeze), 'full collection ms': round(watch.pauses[-1] / 1e6, 1),
            'longest ms': round(longest / 1e6, 1),
            **{f'timer late {k} us': round(v) for k, v in late.items()}})
    gc.unfreeze()
    del kept
    return rows


def measure_policy(seconds: float, workers: int) -> list[dict[str, Any]]:
    """Measure lateness while processes compute, under each policy that this process may use."""
    busy = [subprocess.Popen([sys.executable, '-c', 'while True: pass'])
            for _ in range(os.cpu_count() or 1)]
    rows = []
    try:
        for name, threads, process in (
            ('all SCHED_OTHER', None, None), ('workers SCHED_FIFO', 'SCHED_FIFO', None),
            ('whole process SCHED_FIFO', None, os.SCHED_FIFO),
        ):
            arguments: dict[str, Any] = {}
            if threads is not None:
                arguments = {'worker_policy': threads, 'worker_priority': PRIORITY}
            if process is not None:  # threads started from here on inherit it
                _set_policy(process, PRIORITY)
            try:
                late = lateness(seconds, workers, **arguments)
            finally:
                if process is not None:
                    _set_policy(os.SCHED_OTHER, 0)
            rows.append({'setting': name, **{f'timer late {k} us': round(v)
                                             for k, v in late.items()}})
    finally:
        for each in busy:
            each.kill()
            each.wait()
    return rows


def _set_policy(policy: int, priority: int) -> None:
    try:
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    except OSError as error:
        raise UsageError(
            f'policy: this process may not use SCHED_FIFO {PRIORITY} ({error}): raise its rtprio '
            'limit (ulimit -r) or run it with CAP_SYS_NICE') from None


MEASUREMENTS = {'gc': measure_gc, 'policy': measure_policy}


def main(arguments: list[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description='Measure what Python and the system allow.')
    parser.add_argument('what', choices=MEASUREMENTS)
    parser.add_argument('--seconds', type=float, default=2.0)
    parser.add_argument('--workers', type=int, default=7)
    parser.add_argument('--json', action='store_true', help='print JSON')
    args = parser.parse_args(arguments)
    rclpy.init(args=[])
    try:
        rows = MEASUREMENTS[args.what](args.seconds, args.workers)
    except MddagError as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    finally:
        try_shutdown()
    if args.json:
        print(json.dumps(rows, indent=1))
    else:
        for row in rows:
            print(', '.join(f'{key}: {value}' for key, value in row.items()))
    return 0


if __name__ == '__main__':
    sys.exit(main())
