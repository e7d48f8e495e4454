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

"""Real-time setting of worker threads: scheduling policy, priority, CPU set."""

from __future__ import annotations

from collections.abc import Callable
import os

from mddag_executor.errors import UsageError

POLICIES = ('SCHED_OTHER', 'SCHED_FIFO', 'SCHED_RR')


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
