# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Schedulability analysis: what can be said of a declaration's deadlines before the first run."""

from mddag_executor.analysis.model import AnalysisError, Task, tasks_of
from mddag_executor.analysis.verdicts import analyse, Analysis, FAILS, HOLDS, NOTHING, Verdict

__all__ = [
    'Analysis', 'AnalysisError', 'FAILS', 'HOLDS', 'NOTHING', 'Task', 'Verdict',
    'analyse', 'tasks_of',
]
