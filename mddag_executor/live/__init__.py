# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The live executor: rclpy nodes under the scheduler core."""

from __future__ import annotations

import sys
from typing import Any, NamedTuple

__all__ = ['DeadlineMiss', 'Job', 'MultiDeadlineExecutor', 'current_job']


class Job(NamedTuple):
    """
    The job that a running callback belongs to.

    :ivar dag: name of its DAG.
    :ivar job: its index, from 0.
    :ivar release_ns: when its source became due, ns since the epoch.
    """

    dag: str
    job: int
    release_ns: int


def current_job() -> Job | None:
    """
    Return the job whose callback runs in the calling thread.

    None outside of callbacks of this executor, and in callbacks that no DAG declares.
    """
    hooks = sys.modules.get('mddag_executor.live.hooks')  # not imported: there is no executor
    running: Any = hooks.current.running if hooks is not None else None
    if running is None or running.work.origin is None:
        return None
    origin = running.work.origin
    return Job(
        running.pool.dispatcher.dag_names[origin.dag], origin.job,
        running.pool.dispatcher.release_of(running.work))


def __getattr__(name: str) -> Any:
    """Import the executor on first use: it loads rclpy."""
    if name == 'MultiDeadlineExecutor':
        from mddag_executor.live.executor import MultiDeadlineExecutor
        return MultiDeadlineExecutor
    if name == 'DeadlineMiss':
        from mddag_executor.live.verdicts import DeadlineMiss
        return DeadlineMiss
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
