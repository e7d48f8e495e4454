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

"""What an executor is told when it is made: checked, and brought into one form."""

from __future__ import annotations

from collections.abc import Callable
import os

from mddag_executor.errors import UsageError
from msg_graph import load, parse_duration, TaskSet

INTAKES = ('auto', 'events', 'waitset')
DEFAULT_WORKERS = 7
POLICIES = ('SCHED_OTHER', 'SCHED_BATCH', 'SCHED_FIFO', 'SCHED_RR')


def resolve(
    graph: str | os.PathLike[str] | TaskSet | None, num_workers: int | None,
    default_deadline: int | str, intake: str,
) -> tuple[TaskSet | None, int, int]:
    """
    Return the task set, the number of workers and the default deadline (ns) of an executor.

    :raises msg_graph.GraphError: when the declaration is not right.
    :raises UsageError: on a value that makes no sense.
    """
    task_set = load(graph) if isinstance(graph, (str, os.PathLike)) else graph
    if num_workers is None:
        num_workers = (task_set.workers if task_set is not None else None) or DEFAULT_WORKERS
    if num_workers < 1:
        raise UsageError(f'num_workers: {num_workers} is too few: give at least 1')
    if isinstance(default_deadline, str):
        default_deadline = parse_duration(default_deadline)
    if default_deadline < 1:
        raise UsageError(f'default_deadline: {default_deadline} ns is too short: give at least 1')
    if intake not in INTAKES:
        raise UsageError(f"intake: '{intake}' is unknown: give {', '.join(INTAKES[:-1])} or "
                         f'{INTAKES[-1]}')
    return task_set, num_workers, default_deadline


def thread_setting(
    policy: str | None, priority: int | None, cpus: set[int] | None
) -> Callable[[], None] | None:
    """
    Return what each worker thread calls first, None where nothing is to be set.

    :raises UsageError: on a setting that this machine or process can not have.
    """
    if policy is None and cpus is None:
        if priority is not None:
            raise UsageError(
                'worker_priority: there is no policy for it: give worker_policy too')
        return None
    if policy is not None and policy not in POLICIES:
        raise UsageError(
            f"worker_policy: '{policy}' is unknown: give one of {', '.join(POLICIES)}")
    if not hasattr(os, 'sched_setscheduler'):
        raise UsageError('worker_policy: this system has none: leave it out')
    if cpus is not None and not cpus <= os.sched_getaffinity(0):
        raise UsageError(
            f'worker_cpus: {sorted(cpus)} has CPUs that this process may not use: '
            f'choose from {sorted(os.sched_getaffinity(0))}')

    def prepare() -> None:
        if cpus is not None:
            os.sched_setaffinity(0, cpus)
        if policy is None:
            return
        try:
            os.sched_setscheduler(0, getattr(os, policy), os.sched_param(priority or 0))
        except (PermissionError, OSError) as error:
            raise UsageError(
                f'worker_policy: this process may not use {policy} {priority or 0} ({error}): '
                'raise its rtprio limit (ulimit -r) or run it with CAP_SYS_NICE') from None

    return prepare
