# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Publish topics at fixed rates from a process of its own, and count.

    python -m mddag_executor.live.bench.publisher '{"topics": ["/a"], "rate_hz": 50, "seed": 0}'

Theory of operation: the process says ``ready`` when each of its topics has a subscription, begins
to publish on the line ``go``, and stops on the line ``stop``.  Its last line is the number of
messages that it published on each topic.  It ends when its standard input does: so it cannot
outlive the process that reads from it.

All topics have the same period.  With a seed their phases are drawn, so that messages come neither
all at once nor evenly spaced; without one all are published in a row, each period.  What falls
behind by more than a period leaves releases out: messages in a burst would be lost for want of
queue depth, which is no fault of the executor that is measured.
"""

from __future__ import annotations

from collections.abc import Sequence
import heapq
import json
import os
import random
import subprocess
import sys
import threading
import time

from mddag_executor.live.bench.spec import BenchError
from mddag_executor.live.session import MATCH_TIMEOUT_S
from mddag_executor.live.synthetic import QOS, quiet_node
import rclpy
from rclpy.publisher import Publisher
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Header

END_TIMEOUT_S = 10.0


class PublisherProcess:
    """
    The process that publishes, seen from the one that measures; a context manager.

    :param topics: what it publishes.
    """

    def __init__(self, topics: Sequence[str], rate_hz: float, seed: int | None) -> None:
        what = json.dumps({'topics': list(topics), 'rate_hz': rate_hz, 'seed': seed})
        self._process = subprocess.Popen(
            [sys.executable, '-m', 'mddag_executor.live.bench.publisher', what],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def __enter__(self) -> PublisherProcess:
        """Return itself."""
        return self

    def __exit__(self, *args: object) -> None:
        """End the process, whatever it does."""
        self._process.kill()
        self._process.communicate()

    def wait_until_ready(self) -> None:
        """
        Wait until all its topics have a subscription.

        :raises BenchError: when the process ended instead.
        """
        self._answer('ready')

    def begin(self) -> None:
        """Let it publish."""
        self._say('go')

    def finish(self) -> list[int]:
        """
        Stop it and return how many messages it published on each topic.

        :raises BenchError: when the process ended before.
        """
        self._say('stop')
        counts: list[int] = json.loads(self._answer('['))
        return counts

    def _say(self, line: str) -> None:
        if self._process.stdin is not None:
            try:
                self._process.stdin.write(line + '\n')
                self._process.stdin.flush()
            except BrokenPipeError:
                pass  # the missing answer shows it

    def _answer(self, begin: str) -> str:
        line = '' if self._process.stdout is None else self._process.stdout.readline()
        if not line.startswith(begin):
            raise BenchError(
                'the publishing process ended early: check ROS_DOMAIN_ID and the network')
        return line


class _Orders:
    """What the other process says on standard input."""

    def __init__(self) -> None:
        self.go = threading.Event()
        self.stop = threading.Event()
        self.ended = threading.Event()
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        for line in sys.stdin:
            (self.go if line.strip() == 'go' else self.stop).set()
        self.ended.set()
        self.stop.set()
        self.go.set()


def publish(
    publishers: Sequence[Publisher], rate_hz: float, seed: int | None, stop: threading.Event
) -> list[int]:
    """Publish on all topics until asked to stop; return how often on each."""
    period = round(1e9 / rate_hz)
    generator = random.Random(seed)
    begin = time.monotonic_ns() + 1_000_000
    due = [(begin + (0 if seed is None else generator.randrange(period)), index)
           for index in range(len(publishers))]
    heapq.heapify(due)
    counts = [0] * len(publishers)
    message = Header()
    while not stop.is_set():
        at, index = due[0]
        left = at - time.monotonic_ns()
        if left > 0 and stop.wait(left / 1e9):
            break
        publishers[index].publish(message)
        counts[index] += 1
        missed = max(0, time.monotonic_ns() - at) // period
        heapq.heapreplace(due, (at + (1 + missed) * period, index))
    return counts


def main(text: str) -> int:
    """Publish as asked; return the exit status."""
    what = json.loads(text)
    orders = _Orders()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = quiet_node('/mddag_bench_publisher')
    publishers = [node.create_publisher(Header, topic, QOS) for topic in what['topics']]
    end = time.monotonic() + MATCH_TIMEOUT_S
    while not all(publisher.get_subscription_count() for publisher in publishers):
        if orders.stop.wait(0.01) or time.monotonic() > end:
            return 1
    print('ready', flush=True)
    orders.go.wait()
    counts = publish(publishers, what['rate_hz'], what['seed'], orders.stop)
    print(json.dumps(counts), flush=True)
    # What was published last may have to be sent again.
    orders.ended.wait()
    return 0


if __name__ == '__main__':
    status = main(sys.argv[1])
    sys.stdout.flush()
    os._exit(status)
