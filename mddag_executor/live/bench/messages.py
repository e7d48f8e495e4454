# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Measure an executor with subscriptions whose callbacks are empty.

Every message is counted: what was published and has not been run when nothing comes any more is
lost.  The publishers are in another process, so the CPU time is that of receiving only: executor,
middleware, interpreter, and reading the clock.
"""

from __future__ import annotations

import os
from pathlib import Path
import time
from typing import Any

from mddag_executor.core.tally import quantiles_us
from mddag_executor.live.bench.executors import make_executor, UnfinishedSession
from mddag_executor.live.bench.latency import Starts
from mddag_executor.live.bench.publisher import PublisherProcess
from mddag_executor.live.bench.spec import Spec
from mddag_executor.live.synthetic import QOS, quiet_node
from rclpy.node import Node
from rclpy.subscription import Subscription
from std_msgs.msg import Header

QUIET_S = 0.5
"""When no callback has run for so long after the last publication, nothing comes any more."""
DRAIN_S = 10.0
MIDDLEWARE = 'dds.'
"""What the names of Fast DDS's threads begin with."""


def run_messages(spec: Spec) -> dict[str, Any]:
    """
    Run subscriptions under an executor while another process publishes.

    :return: callbacks, CPU time and dispatch latency within the window; ``published``,
        ``received`` and ``lost`` of the whole run.
    :raises mddag_executor.errors.MddagError: when publishers and subscriptions do not find each
        other.
    """
    executor = make_executor(spec, None)
    # Topics of this process only, whoever else is in this domain.
    prefix = f'/mddag_bench_{os.getpid()}'
    topics = [f'{prefix}/topic_{i}' for i in range(spec.topics)]
    node = quiet_node('/mddag_bench')
    starts = Starts()
    active = [_subscribe(node, topic, starts) for topic in topics]
    for i in range(spec.idle):
        _subscribe(node, f'{prefix}/idle_{i}', starts)
    executor.add_node(node)
    session = UnfinishedSession(executor, spec)
    seed = None if spec.phases == 'together' else spec.seed
    with session, PublisherProcess(topics, spec.rate_hz, seed) as publisher:
        publisher.wait_until_ready()
        session.wait_until_matched(lambda: [
            each.topic_name for each in active if not each.get_publisher_count()])
        publisher.begin()
        session.wait(spec.warm_up_s)
        begin, cpu_begin, dds_begin = _clocks()
        session.wait(spec.seconds)
        end, cpu_end, dds_end = _clocks()
        published = sum(publisher.finish())
        _drain(session, starts, published)
        received = len(starts.messages)
    if session.error is not None:
        raise session.error
    latencies = starts.within(begin, end)
    callbacks = len(latencies)
    return {
        'window_ns': end - begin, 'callbacks': callbacks,
        'callbacks_per_s': callbacks / ((end - begin) / 1e9),
        'cpu_us_per_callback': (cpu_end - cpu_begin) / 1000 / callbacks if callbacks else None,
        'middleware_cpu_us_per_callback':
            None if dds_begin is None or dds_end is None or not callbacks
            else (dds_end - dds_begin) / 1000 / callbacks,
        'dispatch_latency_us': quantiles_us(latencies), 'published': published,
        'received': received, 'lost': published - received}


def _clocks() -> tuple[int, int, int | None]:
    """Return the time, the CPU time of the process and that of its middleware's threads, ns."""
    return time.time_ns(), time.process_time_ns(), _middleware_cpu_ns()


def _middleware_cpu_ns() -> int | None:
    """
    Return the CPU time that the middleware's own threads have taken, ns.

    They receive and store messages, whatever the executor does.  None where the kernel does not
    tell (no Linux), or where no thread has such a name (another middleware).
    """
    times = []
    for task in Path('/proc/self/task').glob('*'):
        try:
            if (task / 'comm').read_text().startswith(MIDDLEWARE):
                times.append(int((task / 'schedstat').read_text().split()[0]))
        except (OSError, ValueError, IndexError):
            continue  # it has ended, or is not known
    return sum(times) if times else None


def _subscribe(node: Node, topic: str, starts: Starts) -> Subscription:
    return node.create_subscription(Header, topic, starts.noting(), QOS)


def _drain(session: UnfinishedSession, starts: Starts, published: int) -> None:
    """Wait until all messages were received, or none has come for a while."""
    last, quiet_since = -1, time.monotonic()
    end = time.monotonic() + DRAIN_S
    while len(starts.messages) < published and time.monotonic() < end:
        count = len(starts.messages)
        if count != last:
            last, quiet_since = count, time.monotonic()
        elif time.monotonic() - quiet_since > QUIET_S:
            return
        if session.wait(0.02):
            return
