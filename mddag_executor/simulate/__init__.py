# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Simulation in virtual time: the core with given releases and execution times."""

from mddag_executor.simulate.execution_times import (
    draw_execution_times,
    read_execution_times,
    scale_execution_times,
    utilisation,
)
from mddag_executor.simulate.policies import ALL_POLICIES, policy
from mddag_executor.simulate.pool import END, JOB_ENDED, LogEntry, PREEMPT, RELEASE, START
from mddag_executor.simulate.run import JUDGES, simulate, SimulatedRun
from mddag_executor.simulate.schedule import schedule, Scheduled, Settings
from mddag_executor.simulate.workload import periodic_workload, Workload

__all__ = [
    'ALL_POLICIES', 'END', 'JOB_ENDED', 'JUDGES', 'LogEntry', 'PREEMPT', 'RELEASE', 'START',
    'Scheduled', 'Settings', 'SimulatedRun', 'Workload', 'draw_execution_times',
    'periodic_workload', 'policy', 'read_execution_times', 'scale_execution_times', 'schedule',
    'simulate', 'utilisation',
]
