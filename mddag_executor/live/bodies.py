# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What the callbacks of synthetic nodes do: execute, pass the release on, join, keep the books.

``synthetic`` says how nodes are made of these.
"""

from __future__ import annotations

from collections import deque, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
import threading
import time
from typing import Any

from mddag_executor.live.execution import Emulate
from mddag_executor.live.measure import Ledger
from msg_graph import Vertex
from rclpy.publisher import Publisher
from rclpy.timer import Timer
from std_msgs.msg import Header

JOIN_LIMIT = 64
"""Incomplete joins that a sync vertex keeps; the oldest is dropped and counted."""

SENSOR = '#sensor '
"""What the ``frame_id`` of a stand-in sensor's message starts with; its topic follows."""

CurrentJob = Callable[[], Any]
"""Returns None, or what has the ``release_ns`` of the job that the calling thread runs."""


def no_job() -> None:
    """Stand for ``current_job`` under executors that know no jobs."""


def stamped(release: int, sender: str = '') -> Header:
    """Make a message that carries a release (ns since the epoch)."""
    message = Header(frame_id=sender)
    message.stamp.sec, message.stamp.nanosec = divmod(release, 1_000_000_000)
    return message


def release_of(message: Header) -> int:
    """Return the release that a message carries, ns since the epoch."""
    stamp = message.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


@dataclass
class Role:
    """
    A callback as one vertex: what it does for a message of that DAG.

    :ivar senders: the ``frame_id`` of the messages that it waits for.
    :ivar sender: the ``frame_id`` of the messages that it publishes.
    :ivar completions: where a sink notes (release, completion); None for other vertices.
    """

    vertex: Vertex
    senders: list[str]
    sender: str
    execution_ns: int
    publishers: list[Publisher]
    emulate: Emulate
    durations: deque[int]
    completions: deque[tuple[int, int]] | None
    clock_offset_ns: int

    def execute(self, message: Header, release: int) -> None:
        """Execute the body, publish, and note the completion of a sink."""
        monotonic_ns = time.monotonic_ns
        start = monotonic_ns()
        self.emulate(self.execution_ns)
        self.durations.append(monotonic_ns() - start)
        message.frame_id = self.sender
        for publisher in self.publishers:
            publisher.publish(message)
        if self.completions is not None:
            self.completions.append((release, monotonic_ns() + self.clock_offset_ns))


class Grid:
    """
    Nominal due times of a started timer, ns since the epoch.

    ``release`` is to be called once in each call of the timer.
    """

    def __init__(self, timer: Timer, clock_offset_ns: int) -> None:
        self._timer = timer
        self._offset = clock_offset_ns
        self._period = timer.timer_period_ns
        self._lock = threading.Lock()
        # Of several readings the one with the least time between the clocks is the best.
        readings = []
        for _ in range(3):
            before = time.monotonic_ns()
            left = timer.time_until_next_call()
            after = time.monotonic_ns()
            readings.append((after - before, (before + after) // 2 + left))
        self._first = self._next = min(readings)[1]

    @property
    def first_release(self) -> int:
        """Return the first due time."""
        return int(self._first + self._offset)

    def release(self) -> int:
        """Return the due time that this call of the timer stands for."""
        with self._lock:
            release = self._next
            left = self._timer.time_until_next_call()
            if left is not None:  # else it was cancelled meanwhile
                periods = round((time.monotonic_ns() + left - self._first) / self._period)
                self._next = self._first + periods * self._period
        return int(release + self._offset)


@dataclass
class Join:
    """The incomplete joins of one sync vertex: which messages have come, by release."""

    role: Role
    waiting: OrderedDict[int, set[str]] = field(default_factory=OrderedDict)
    evicted: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)

    def completes(self, release: int, sender: str) -> bool:
        """Note a message; return whether it was the last one of its job."""
        with self.lock:
            seen = self.waiting.setdefault(release, set())
            seen.add(sender)
            if len(seen) == len(self.role.senders):
                del self.waiting[release]
                return True
            if len(self.waiting) > JOIN_LIMIT:
                self.waiting.popitem(last=False)
                self.evicted += 1
            return False


def plain_callback(
    roles: list[Role], ledger: Ledger, current_job: CurrentJob
) -> Callable[[Header], None]:
    """Make the callback of a subscription: the sender of a message says which vertex runs."""
    by_sender = {sender: role for role in roles for sender in role.senders}

    def on_message(message: Header) -> None:
        role = by_sender.get(message.frame_id)
        if role is None:
            return  # published by somebody outside of the declaration
        release = release_of(message)
        if current_job is not no_job:
            release = attributed(role, release, ledger, current_job)
            if not role.vertex.predecessors:
                message = stamped(release)
        role.execute(message, release)

    return on_message


def sync_callback(
    joins: list[Join], ledger: Ledger, current_job: CurrentJob
) -> Callable[[Header], None]:
    """Make the callback of all legs of a sync: the last leg of a job executes the body."""
    by_sender = {sender: join for join in joins for sender in join.role.senders}

    def on_message(message: Header) -> None:
        join = by_sender.get(message.frame_id)
        if join is None:
            return
        release = release_of(message)
        if join.completes(release, message.frame_id):
            if current_job is not no_job:
                attributed(join.role, release, ledger, current_job)
            join.role.execute(message, release)

    return on_message


def attributed(role: Role, release: int, ledger: Ledger, current_job: CurrentJob) -> int:
    """
    Compare the release that a message carries with the job that the executor runs it as.

    :return: of a source the release that the executor says, otherwise the message's.
    """
    job = current_job()
    if job is None:
        ledger.unattributed.append(role.vertex.name)
    elif not role.vertex.predecessors:
        return int(job.release_ns)
    elif abs(job.release_ns - release) > ledger.tolerance_ns:
        ledger.misattributed.append((role.vertex.name, release, job.release_ns))
    return release
