# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The synthetic nodes of a declaration under rclpy's MultiThreadedExecutor, for comparison.

``measure_peer`` runs them in a separate process.  The nodes measure themselves (``measure``), as
under this program's executor.
"""

from __future__ import annotations

from collections.abc import Callable
import gc
import time
from typing import Any, cast

from mddag_executor.child import ChildError, run_child, Tick
from mddag_executor.executor.session import Session
from mddag_executor.synthetic.measure import ExecutionPlan, measure
from mddag_executor.synthetic.workload import SyntheticWorkload
from msg_graph import load
import rclpy
from rclpy.executors import Executor, MultiThreadedExecutor
from rclpy.signals import SignalHandlerOptions

PATIENCE_S = 90.0
"""The time of a process in addition to its window: discovery, warm-up and the end."""


class UnfinishedSession(Session):
    """
    A session whose executor is not shut down: the process ends instead.

    rclpy's executors cannot be stopped in order while callbacks wait for their pool.
    """

    def end(self) -> None:
        """Wait briefly for callbacks that are just completing."""
        if not self.stopped:
            self.stop()
            time.sleep(0.05)

    def check(self, measured: bool) -> None:
        """Raise the exception that has ended a run, or an error if it was not measured."""
        if self.error is not None or not measured:
            raise self.error or ChildError(
                'the run was ended before anything was measured: run it again')


def run_nodes(
    executor: Executor, workload: SyntheticWorkload, seconds: float,
    spin: Callable[[], None] | None = None,
) -> None:
    """Run synthetic nodes under any executor; their measurements are in their ledger."""
    for node in workload.nodes:
        executor.add_node(node)
    session = UnfinishedSession(executor, spin)
    # for all executors alike: a full collection would stop every thread for 25 ms
    gc.collect()
    gc.freeze()
    with session:
        measured = workload.run(session, seconds)
    session.check(measured)


def measure_peer(
    graph: str, workers: int, *, seconds: float, seed: int, utilisation: float,
    tick: Tick | None = None,
) -> dict[str, Any]:
    """
    Run the nodes of a declaration under rclpy's executor; return the result of ``measure``.

    :param seconds: duration of the measurement, after ``WARM_UP_S``.
    :raises ChildError: when the run cannot be made.
    :raises mddag_executor.errors.UsageError: when no execution time is declared.
    """
    plan = ExecutionPlan(load(graph), seed, utilisation, workers)
    return cast('dict[str, Any]', run_child(
        f'{__name__}:run', (plan, seconds), 'MultiThreadedExecutor', seconds + PATIENCE_S, tick))


def run(plan: ExecutionPlan, seconds: float) -> dict[str, Any]:
    """Run the nodes of a plan here; return the result of ``measure``."""
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    workload = SyntheticWorkload(plan.task_set, plan)
    run_nodes(MultiThreadedExecutor(plan.workers), workload, seconds)
    return measure(workload.ledger, plan)
