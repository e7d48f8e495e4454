# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
One callback at a time: ``spin_once``.

It uses no thread at all: one wait set over everything hands over what is ready, and the calling
thread runs the one callback that the core puts first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
import time

from mddag_executor.live.intake.waitset import ALL_KINDS, WaitSetIntake
from mddag_executor.live.pool import Pool
from mddag_executor.live.receiver import Receiver
from mddag_executor.live.upkeep import Upkeep
from rclpy.context import Context
from rclpy.guard_condition import GuardCondition


class Stepper:
    """
    Runs single callbacks in the calling thread.

    :param guards: what ends its wait.
    :param submit_tasks: has the tasks run that have been created.
    """

    def __init__(
        self, context: Context, receiver: Receiver, guards: Iterable[GuardCondition],
        upkeep: Upkeep, pool: Pool, submit_tasks: Callable[[], None],
    ) -> None:
        self._upkeep = upkeep
        self._pool = pool
        self._submit_tasks = submit_tasks
        self._intake = WaitSetIntake(context, receiver, guards, ALL_KINDS)
        upkeep.add_intake(self._intake)

    def step(self, deadline: float | None, done: Callable[[], bool]) -> bool:
        """
        Handle what is ready, waiting where nothing is; run one callback if there is one.

        :param deadline: when to wait no longer (monotonic, s); None: never.
        :param done: whether there is nothing to wait for any more.
        :return: whether one ran.
        """
        self._upkeep.refresh()
        self._pool.look_around()
        self._intake.poll(0.0)
        self._submit_tasks()
        if self._pool.run_one():
            return True
        if done():  # what it woke up for has just been polled away
            return False
        self._intake.poll(None if deadline is None else max(0.0, deadline - time.monotonic()))
        self._upkeep.refresh()
        self._submit_tasks()
        return self._pool.run_one()

    def stop(self) -> None:
        """Let go of all entities."""
        self._intake.stop()
        self._upkeep.remove_intake(self._intake)
