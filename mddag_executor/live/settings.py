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
from dataclasses import dataclass
import os

from mddag_executor.errors import UsageError
from msg_graph import load, parse_duration, TaskSet

INTAKES = ('auto', 'events', 'waitset')
DEFAULT_WORKERS = 7
POLICIES = ('SCHED_OTHER', 'SCHED_BATCH', 'SCHED_FIFO', 'SCHED_RR')
SHORTEST_DIAGNOSTICS_NS = 10_000_000


@dataclass(frozen=True)
class Thresholds:
    """
    What makes a status of ``/diagnostics`` worse than OK.

    :ivar warn_ratio: WARN when this share of the window's results missed their deadlines.
    :ivar warn_burst: WARN when so many misses came in one period of the diagnostics.
    :ivar error_ratio: ERROR when this share of the window's results missed them, and they are
        ``warn_burst`` or more (two results of which one is late are no proof).
    :ivar window: how many periods of the diagnostics the window has.
    :ivar stale_periods: STALE when a source has released nothing for so many of its periods, and
        for a period of the diagnostics.
    :ivar name: what stands before the names of the statuses, for robots with several processes.
    """

    warn_ratio: float = 0.01
    warn_burst: int = 3
    error_ratio: float = 0.1
    window: int = 10
    stale_periods: int = 3
    name: str = 'mddag'

    def __post_init__(self) -> None:
        """Check the values."""
        for field in ('warn_ratio', 'error_ratio'):
            value = getattr(self, field)
            if not 0.0 < value <= 1.0:
                raise UsageError(f'{field}: {value} is no share: give more than 0, at most 1')
        for field in ('warn_burst', 'window', 'stale_periods'):
            value = getattr(self, field)
            if value < 1:
                raise UsageError(f'{field}: {value} is too few: give at least 1')


def diagnostics_period_ns(period: int | str | None) -> int | None:
    """
    Return the period of the diagnostics in ns, None for none.

    :param period: ns, or text as ``1s``; None or 0: no diagnostics.
    :raises UsageError: when it is too short.
    """
    if isinstance(period, str):
        period = parse_duration(period)
    if not period:
        return None
    if period < SHORTEST_DIAGNOSTICS_NS:
        raise UsageError(
            f'diagnostics_period: {period} ns is too short: give at least '
            f'{SHORTEST_DIAGNOSTICS_NS // 1_000_000}ms, or 0 for none')
    return period


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
