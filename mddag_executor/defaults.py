# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Constants that several parts share; most are defaults of the paper's experiment."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from msg_graph import TaskSet

WORKERS = 7
POLICIES = ('rad', 'rm', 'wc', 'fifo')
"""Those that an evaluation compares."""
DURATION_NS = 3_000_000_000
"""Virtual time of a simulated run."""
BUDGETS = ('max', 'p99', 'mean')
"""Which value of a declared execution time an analysis may count."""
SAME_SIGNAL_S = 1.0
"""Signals within this time are one: `timeout` sends one to the process, and one to its group."""


def workers(asked: int | None, task_set: TaskSet | None) -> int:
    """Return the given number of workers, else the declared one, else seven."""
    declared = None if task_set is None else task_set.workers
    return asked or declared or WORKERS


def processors() -> int:
    """Count the processors that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not every system has it
        return os.cpu_count() or 1
