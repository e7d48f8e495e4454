# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Around the executor: programs, several processes.

``run`` is the Python API of `mddag run`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mddag_executor.lazy import on_first_use

if TYPE_CHECKING:
    from mddag_executor.hosting.run_nodes import run, RunWarning
    from mddag_executor.hosting.run_options import RunOptions
    from mddag_executor.hosting.run_result import ProgramEnd, RunResult

__all__ = ['ProgramEnd', 'RunOptions', 'RunResult', 'RunWarning', 'run']

__getattr__, __dir__ = on_first_use(__name__, {
    'ProgramEnd': 'mddag_executor.hosting.run_result',
    'RunOptions': 'mddag_executor.hosting.run_options',
    'RunResult': 'mddag_executor.hosting.run_result',
    'RunWarning': 'mddag_executor.hosting.run_nodes',
    'run': 'mddag_executor.hosting.run_nodes',
})
