# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Short ways to drive the scheduler as the live executor does."""

from mddag_executor.core import Scheduler, Tables

from .task_sets import declaration

US = 1_000

JOIN = declaration([
    {'node': '/n', 'name': 's', 'timer': '100us', 'publishes': ['/s'], 'dag': 'd'},
    {'node': '/n', 'name': 'x', 'subscription': '/s', 'publishes': ['/x']},
    {'node': '/n', 'name': 'y', 'subscription': '/s', 'publishes': ['/y']},
    {'node': '/n', 'name': 'join', 'sync': ['/x', '/y'], 'deadline': '50us'},
])
S, X, Y, J = range(4)


def live(task_set=JOIN, workers=2, **more):
    options = {name: more.pop(name) for name in ('max_active_jobs', 'expire_after', 'on_late')
               if name in more}
    tables = Tables.build(task_set, legs=True, groups=False, **options)
    return Scheduler(tables, workers, **more)


def run_one(scheduler, x, now):
    """Make an execution ready and run it at once."""
    scheduler.ready(x, now)
    assert scheduler.take(scheduler.state.worker_x.index(-1), now) == x
    return scheduler.complete(x, now)


def start_job(scheduler, job=0, now=0, dag=0):
    """Release a job and run its source."""
    slot = scheduler.release(dag, job, now, now)
    assert run_one(scheduler, scheduler.source(slot), now)
    return slot


def undeclared(scheduler, job, group, now, holds=0):
    """Make a callback that no DAG declares ready; return its execution."""
    return scheduler.ready_undeclared(job, group, holds, now)
