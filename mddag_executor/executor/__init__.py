# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The live executor: rclpy nodes under the scheduler core."""

from __future__ import annotations

import sys
from typing import Any, NamedTuple, TYPE_CHECKING

from mddag_executor.lazy import on_first_use

if TYPE_CHECKING:
    from mddag_executor.executor.executor import MultiDeadlineExecutor
    from mddag_executor.executor.verdicts import DeadlineMiss

__all__ = ['DeadlineMiss', 'Job', 'MultiDeadlineExecutor', 'current_job']


class Job(NamedTuple):
    """
    The job that a running callback belongs to.

    :ivar dag: name of its DAG.
    :ivar job: its index, from 0.
    :ivar release_ns: its release, ns since the epoch.
    """

    dag: str
    job: int
    release_ns: int


def current_job() -> Job | None:
    """
    Return the job whose callback runs in the calling thread.

    None outside of callbacks of this executor, and in undeclared callbacks.
    """
    work = sys.modules.get('mddag_executor.executor.work')  # not imported: no executor
    running: Any = work.current.running if work is not None else None
    job = running.job if running is not None else None
    return None if job is None else Job(*job)


__getattr__, __dir__ = on_first_use(__name__, {
    'DeadlineMiss': 'mddag_executor.executor.verdicts',
    'MultiDeadlineExecutor': 'mddag_executor.executor.executor',
})
