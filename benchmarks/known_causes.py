# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Live runs in which deadlines are missed for one known reason, and what `mddag explain` says.

    python benchmarks/known_causes.py --misses 100

Theory of operation
-------------------
In each run a timer every 40 ms publishes a message, whose subscription has a deadline of 20 ms.
Now and then something makes it late:

* *ran long*: every third time the subscription's callback takes ten times as long;
* *waited*: a burst of ten messages for another callback, before it in the queue of one worker;
* *group*: another callback of its mutually exclusive group runs for 30 ms;
* *interpreter*: another callback keeps the interpreter's lock for 30 ms, with workers free;
* *released late*: every third release is noticed 30 ms late;
* *machine*: the process is stopped for 300 ms (SIGSTOP);
* *not published*: every third message is not published.

Each run is a process of its own.  ``--scale`` makes all times longer, for busy machines.
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import threading
import time

from mddag_executor import MultiDeadlineExecutor, replay
from mddag_executor.executor.timers import TimerEntity, TimerQueue
from msg_graph import loads
import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.node import Node
from std_msgs.msg import Empty

PERIOD_MS, DEADLINE_MS, LONG_S, STOP_S = 40, 20, 0.03, 0.3
GRAPH = """\
mddag: 1
nodes:
  - node: /sensor
    callbacks: [{{name: tick, timer: {period}ms, publishes: [/data]}}]
  - node: /victim
    callbacks:
      - {{name: use, subscription: /data, deadline: {deadline}ms}}
      - {{name: other, dag: other, timer: {other}ms, deadline: {other}ms}}
"""
#: By cause: about how often a deadline is missed, in periods.
PERIODS = {'ran long': 3, 'waited': 3, 'group': 2, 'interpreter': 2, 'released late': 3,
           'machine': 3, 'not published': 3}


class Run:
    """
    The nodes of a run, with what makes its jobs late.

    :param scale: of all times.
    """

    def __init__(self, cause: str, trace: str, scale: float) -> None:
        self._cause, self._long = cause, LONG_S * scale
        self._period = PERIOD_MS / 1e3 * scale
        self.executor = MultiDeadlineExecutor(
            loads(GRAPH.format(period=round(PERIOD_MS * scale), other=round(2 * PERIOD_MS * scale),
                               deadline=round(DEADLINE_MS * scale)), 'known_causes.yaml'),
            1 if cause == 'waited' else 4, policy='fifo', trace=trace)
        self._ticks, self._uses = itertools.count(1), itertools.count(1)
        group = MutuallyExclusiveCallbackGroup()
        sensor, victim = (Node(name, start_parameter_services=False, enable_rosout=False)
                          for name in ('sensor', 'victim'))
        self._data = sensor.create_publisher(Empty, '/data', 10)
        self._many = sensor.create_publisher(Empty, '/many', 20)
        # first the blocking callback: its timer is due first
        victim.create_timer(2 * self._period, self._other, callback_group=(
            group if cause == 'group' else ReentrantCallbackGroup()))
        sensor.create_timer(self._period, self._tick)
        victim.create_subscription(Empty, '/data', self._use, 10, callback_group=group)
        victim.create_subscription(
            Empty, '/many', lambda _: time.sleep(self._long / 6), 20,
            callback_group=ReentrantCallbackGroup())
        self._count = _count_for(self._long) if cause == 'interpreter' else 0
        for node in (sensor, victim):
            self.executor.add_node(node)

    def _tick(self) -> None:
        third = next(self._ticks) % 3 == 0
        if self._cause == 'waited' and third:
            for _ in range(10):
                self._many.publish(Empty())
        if self._cause != 'not published' or not third:
            self._data.publish(Empty())

    def _use(self, _: Empty) -> None:
        long = self._cause == 'ran long' and next(self._uses) % 3 == 0
        time.sleep(self._long if long else self._long / 10)

    def _other(self) -> None:
        if self._cause == 'group':
            time.sleep(self._long)
        elif self._cause == 'interpreter':
            sum(range(self._count))

    def notice_late(self) -> None:
        """Notice every third release of the sensor late."""
        push, calls = TimerQueue._push, itertools.count(1)

        def late(queue: TimerQueue, source: TimerEntity, due: int) -> None:
            if source.period() == round(self._period * 1e9) and next(calls) % 3 == 0:
                due += round(self._long * 1e9)
            push(queue, source, due)

        TimerQueue._push = late     # type: ignore[method-assign, assignment]

    def spin(self, seconds: float) -> None:
        """Run for a time."""
        thread = threading.Thread(target=self.executor.spin)
        thread.start()
        time.sleep(seconds)
        self.executor.shutdown(5.0)
        thread.join()


def _count_for(seconds: float) -> int:
    """Return up to what to count in one call, which keeps the interpreter's lock for a time."""
    def took(count: int) -> float:
        begin = time.thread_time()
        sum(range(count))
        return time.thread_time() - begin

    return round(10 ** 6 * seconds / min(took(10 ** 6) for _ in range(5)))


def record(
    cause: str, trace: Path, misses: int, scale: float = 1.0
) -> list[tuple[int, int]]:
    """Record a run with about this many misses; return begin and end of each stop, epoch ns."""
    stops = []
    seconds = misses * PERIODS[cause] * PERIOD_MS / 1e3 * scale + 1
    process = subprocess.Popen(
        [sys.executable, __file__, '--record', cause, str(trace), str(seconds),
         '--scale', str(scale)], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == 'ready\n'
        end = time.monotonic() + seconds
        while cause == 'machine' and time.monotonic() < end - 3 * STOP_S * scale:
            time.sleep(2 * STOP_S * scale)
            process.send_signal(signal.SIGSTOP)
            begin = time.time_ns()
            time.sleep(STOP_S * scale)
            stops.append((begin, time.time_ns()))
            process.send_signal(signal.SIGCONT)
        assert process.wait(seconds + 60) == 0
    finally:
        process.kill()
        process.wait()
    return stops


def causes(trace: Path) -> dict[str, int]:
    """Return how many misses of each cause are named."""
    found = replay(trace).explanation.summary()['causes']
    return {cause: n for cause, n in found.items() if n}


def measure(misses: int, scale: float, wanted: list[str]) -> None:
    """Record a run for each cause, and print what explain names."""
    print(f'{"made for":<15}{"misses":>8}{"named so":>12}  other causes named')
    for cause in wanted or list(PERIODS):
        with tempfile.TemporaryDirectory() as folder:
            trace = Path(folder) / 'run.mcap'
            record(cause, trace, misses, scale)
            reported = causes(trace)
        total, right = sum(reported.values()), reported.pop(cause, 0)
        instead = ', '.join(f'{n} {other}' for other, n in reported.items()) or '-'
        print(f'{cause:<15}{total:>8}{right / max(1, total):>11.1%}   {instead}', flush=True)


def main() -> None:
    """Measure, or record one run."""
    parser = argparse.ArgumentParser(description='What explain reports of live runs.')
    parser.add_argument('cause', nargs='*', choices=[*PERIODS, []], help='default: all of them')
    parser.add_argument('--misses', type=int, default=100, help='about this many of each cause')
    parser.add_argument('--scale', type=float, default=1.0, help='of all times')
    parser.add_argument('--record', nargs=3, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.record is None:
        measure(args.misses, args.scale, args.cause)
        return
    cause, trace, seconds = args.record
    rclpy.init()
    run = Run(cause, trace, args.scale)
    if cause == 'released late':
        run.notice_late()
    print('ready', flush=True)
    run.spin(float(seconds))
    rclpy.shutdown()


if __name__ == '__main__':
    main()
