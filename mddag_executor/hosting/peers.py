# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The synthetic nodes of a declaration under one of rclpy's executors, for comparison.

``measure_peer`` runs them in a separate process, or in one process for each of ``processes:``, all
at the same time.  The nodes measure themselves (``measure``), as under this program's executor.
"""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
import gc
import time
from typing import Any

from mddag_executor.hosting.child import ChildError, run_child, Tick
from mddag_executor.hosting.measure import ExecutionPlan, Ledger, measure, Mode
from mddag_executor.hosting.session import Session
from mddag_executor.hosting.synthetic import no_job, SyntheticWorkload, WARM_UP_S
from msg_graph import load
import rclpy
from rclpy.executors import Executor, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import ok as context_ok

PATIENCE_S = 90.0
"""The time of a process in addition to its window and warm-up: discovery and the end."""


def make_peer(name: str, workers: int) -> Executor:
    """Return an executor of rclpy: ``single``, ``multi`` or ``events``."""
    if name == 'multi':
        return MultiThreadedExecutor(workers)
    return SingleThreadedExecutor() if name == 'single' else EventsExecutor()


def spin_events_executor(executor: Executor) -> None:
    """Spin rclpy's EventsExecutor, whose ``spin`` does not dispatch without a timeout (7.1.5)."""
    while context_ok():
        executor.spin_until_future_complete(Future(), 1000.0)


class UnfinishedSession(Session):
    """
    A session whose executor is not shut down: the process ends instead.

    rclpy's executors cannot be stopped in order while callbacks wait for their pool.
    """

    def __init__(self, executor: Executor) -> None:
        """Make a session that can spin any executor."""
        is_native = not isinstance(executor, Executor)  # only EventsExecutor is
        super().__init__(
            executor, partial(spin_events_executor, executor) if is_native else None)

    def end(self) -> None:
        """Wait briefly for callbacks that are just completing."""
        if not self.stopped:
            self.stop()
            time.sleep(0.05)

    def check(self, measured: bool) -> None:
        """
        Check that a run was measured to its end.

        :raises BaseException: the exception that has ended it.
        """
        if self.error is not None:
            raise self.error
        if not measured:
            raise ChildError('the run was ended before anything was measured: run it again')


def run_nodes(
    executor: Executor, workload: SyntheticWorkload, seconds: float, warm_up_s: float = WARM_UP_S
) -> None:
    """Run synthetic nodes under any executor; their measurements are in their ledger."""
    for node in workload.nodes:
        executor.add_node(node)
    session = UnfinishedSession(executor)
    # for all executors alike: a full collection would stop every thread for 25 ms
    gc.collect()
    gc.freeze()
    with session:
        measured = workload.run(session, seconds, warm_up_s=warm_up_s)
    session.check(measured)


def measure_peer(
    executor: str, graph: str, workers: int, *, seconds: float, seed: int, utilisation: float,
    mode: Mode, tick: Tick | None = None,
) -> dict[str, Any]:
    """
    Run the nodes of a declaration under an executor of rclpy; return the result of ``measure``.

    :param executor: ``single``, ``multi`` or ``events``.
    :param seconds: duration of the measurement, after ``WARM_UP_S``.
    :raises ChildError: when the run cannot be made.
    :raises mddag_executor.errors.UsageError: when no execution time is declared.
    """
    task_set = load(graph)
    plan = ExecutionPlan(task_set, seed, utilisation, workers, mode)
    names: Iterable[str | None] = [p.name for p in task_set.processes] or [None]

    def part(name: str | None) -> dict[str, Any]:
        ledger: dict[str, Any] = run_child(
            f'{__name__}:run', (executor, plan, seconds, name), executor,
            seconds + WARM_UP_S + PATIENCE_S, tick if len(task_set.processes) < 2 else None)
        return ledger

    with ThreadPoolExecutor(max(1, len(task_set.processes))) as threads:
        ledgers = list(threads.map(part, names))
    return measure(Ledger.of_processes(task_set, ledgers), plan)


def run(executor: str, plan: ExecutionPlan, seconds: float, process: str | None) -> dict[str, Any]:
    """Run the nodes of a plan, or of one of its processes, here; return their ledger."""
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    workload = SyntheticWorkload(plan.task_set, plan, current_job=no_job, process=process)
    run_nodes(make_peer(executor, plan.workers), workload, seconds)
    return vars(workload.ledger)
