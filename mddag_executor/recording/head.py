# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The head of a recording: the declaration and settings that it was recorded with."""

from __future__ import annotations

from typing import NamedTuple

from mddag_executor.errors import InputError


class ReplayError(InputError):
    """A trace without anything to replay; its text is `FILE: what is wrong: what to do`."""


class Head(NamedTuple):
    """
    The declaration and settings that the executor wrote at the beginning of the recording.

    :ivar cpus: number of CPUs that the process could use; 0: unknown.
    :ivar on_late: treatment of late jobs, a value of ``core.tables.ON_LATE``.
    """

    time: int
    yaml: str
    file: str
    policy: str
    workers: int
    default_deadline: int
    max_active_jobs: int
    preemptive: bool
    cpus: int = 0
    on_late: int = 0


def is_declared(head: Head) -> bool:
    """Return whether a run was recorded with a declaration."""
    return bool(head.yaml.strip())
