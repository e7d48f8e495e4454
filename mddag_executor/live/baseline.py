# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Run the synthetic nodes of a declaration on any executor and print what was measured, as JSON.

    python -m mddag_executor.live.baseline config/autoware.yaml --executor multi --seconds 10

One process for one executor, so that none inherits another's threads or caches.  The yardstick is
the same for all: the nodes, the seed, the warm-up and the books that the nodes keep themselves.
The process ends without destroying anything: rclpy's executors can't be stopped in an orderly way
while callbacks wait for their pool.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
import json
import os
import sys
import time
from typing import Any

from mddag_executor.errors import MddagError
from mddag_executor.live import current_job
from mddag_executor.live.bodies import no_job
from mddag_executor.live.execution import ExecutionPlan, MODES
from mddag_executor.live.session import run_synthetic, Session
from mddag_executor.live.synthetic import build_nodes
from msg_graph import GraphError, load, TaskSet
import rclpy
from rclpy.executors import Executor, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import ok as context_ok


def spin_events_executor(executor: Executor) -> None:
    """Spin rclpy's events executor, whose spin() without a timeout never dispatches (7.1.5)."""
    while context_ok():
        executor.spin_until_future_complete(Future(), 1000.0)


def _ours(intake: str) -> Callable[[TaskSet, int], Executor]:
    def make(task_set: TaskSet, workers: int) -> Executor:
        # Here: the others are measured without a trace of this executor in the process.
        from mddag_executor.live.executor import MultiDeadlineExecutor
        return MultiDeadlineExecutor(task_set, num_workers=workers, intake=intake)

    return make


EXECUTORS: dict[str, Callable[[TaskSet, int], Executor]] = {
    'multi': lambda task_set, workers: MultiThreadedExecutor(workers),
    'single': lambda task_set, workers: SingleThreadedExecutor(),
    'events': lambda task_set, workers: EventsExecutor(),
    'rad-events': _ours('events'),
    'rad-waitset': _ours('waitset'),
}


def run(
    task_set: TaskSet, kind: str, plan: ExecutionPlan, seconds: float
) -> dict[str, Any] | None:
    """Run a workload on a new executor of a kind; return what was measured."""
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    executor = EXECUTORS[kind](task_set, plan.workers)
    ours = kind.startswith('rad-')
    workload = build_nodes(task_set, plan, current_job=current_job if ours else no_job)
    for node in workload.nodes:
        executor.add_node(node)
    spin = (lambda: spin_events_executor(executor)) if kind == 'events' else None
    session = _Unfinished(executor, spin)
    with session:
        result = run_synthetic(session, workload, seconds)
    if session.error is not None:
        raise session.error
    if result is not None:
        result = {'executor': kind, **result}
    return result


class _Unfinished(Session):
    """A session whose executor is not shut down: the process ends instead."""

    def end(self) -> None:
        """Let a moment pass for what just completes."""
        if not self.stopped:
            self.stop()
            time.sleep(0.05)


def main() -> int:
    """Run the program; return its exit status."""
    parser = argparse.ArgumentParser(
        prog='python -m mddag_executor.live.baseline', description=(__doc__ or '').split('\n')[1])
    parser.add_argument('graph')
    parser.add_argument('--executor', choices=sorted(EXECUTORS), default='multi')
    parser.add_argument('--synthetic', choices=MODES, default='sleep')
    parser.add_argument('--utilisation', type=float)
    parser.add_argument('--workers', type=int, default=7)
    parser.add_argument('--seconds', type=float, default=10.0)
    parser.add_argument('--seed', type=int, default=0)
    args = parser.parse_args()
    try:
        task_set = load(args.graph)
        plan = ExecutionPlan(
            task_set, args.seed, args.utilisation, args.workers, args.synthetic)
        result = run(task_set, args.executor, plan, args.seconds)
    except (MddagError, GraphError) as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    json.dump(result, sys.stdout, indent=2)
    print(flush=True)
    return 0


if __name__ == '__main__':
    status = main()
    sys.stderr.flush()
    os._exit(status)
