# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Make and spin the executors that are compared."""

from __future__ import annotations

import time

from mddag_executor.live.bench.spec import NONE, OURS, Spec
from mddag_executor.live.bench.unmanaged import NoExecutor
from mddag_executor.live.session import Session
from msg_graph import TaskSet
from rclpy.executors import Executor, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.task import Future
from rclpy.utilities import ok as context_ok


def spin_events_executor(executor: Executor) -> None:
    """Spin rclpy's events executor, whose spin() without a timeout never dispatches (7.1.5)."""
    while context_ok():
        executor.spin_until_future_complete(Future(), 1000.0)


def make_executor(spec: Spec, task_set: TaskSet | None) -> Executor:
    """
    Make an executor.

    :param task_set: the declared tasks, which only this executor makes use of.
    """
    if spec.executor in OURS:
        # Here: the others are measured without a trace of this executor in the process.
        from mddag_executor.live.executor import MultiDeadlineExecutor
        return MultiDeadlineExecutor(
            task_set, num_workers=spec.workers, policy=spec.policy, intake=OURS[spec.executor],
            process=spec.process)
    if spec.executor == NONE:
        return NoExecutor()
    if spec.executor == 'multi':
        return MultiThreadedExecutor(spec.workers)
    return SingleThreadedExecutor() if spec.executor == 'single' else EventsExecutor()


class UnfinishedSession(Session):
    """
    A session whose executor is not shut down: the process ends instead.

    rclpy's executors cannot be stopped in an orderly way while callbacks wait for their pool.
    """

    def __init__(self, executor: Executor, spec: Spec) -> None:
        """Make a session that knows how to spin each of the compared executors."""
        events = spec.executor == 'events'
        super().__init__(executor, (lambda: spin_events_executor(executor)) if events else None)

    def end(self) -> None:
        """Let a moment pass for what just completes."""
        if not self.stopped:
            self.stop()
            time.sleep(0.05)
