# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Short ways to drive the scheduler as the live executor does."""

from __future__ import annotations

from typing import Any

from mddag_executor.core import Scheduler, Tables
from msg_graph import TaskSet

from .task_sets import declaration

US = 1_000

JOIN = declaration([
    {'node': '/n', 'name': 's', 'timer': '100us', 'publishes': ['/s'], 'dag': 'd'},
    {'node': '/n', 'name': 'x', 'subscription': '/s', 'publishes': ['/x']},
    {'node': '/n', 'name': 'y', 'subscription': '/s', 'publishes': ['/y']},
    {'node': '/n', 'name': 'join', 'sync': ['/x', '/y'], 'deadline': '50us'},
])
S, X, Y, J = range(4)


def live(task_set: TaskSet | None = JOIN, workers: int = 2, **more: Any) -> Scheduler:
    options = {name: more.pop(name) for name in ('max_active_jobs', 'expire_after', 'on_late')
               if name in more}
    tables = Tables.build(task_set, legs=True, groups=False, **options)
    return Scheduler(tables, workers, **more)


def run_one(scheduler: Scheduler, x: int, now: int) -> bool:
    """Make an execution ready and run it at once."""
    scheduler.ready(x, now)
    assert scheduler.take(scheduler.state.worker_x.index(-1), now) == x
    return scheduler.complete(x, now)


def start_job(scheduler: Scheduler, job: int = 0, now: int = 0, dag: int = 0) -> int:
    """Release a job and run its source."""
    slot = scheduler.release(dag, job, now, now)
    assert run_one(scheduler, scheduler.source(slot), now)
    return slot


def undeclared(scheduler: Scheduler, job: int, group: int, now: int, holds: int = 0) -> int:
    """Make a callback that no DAG declares ready; return its execution."""
    return scheduler.ready_undeclared(job, group, holds, now)
