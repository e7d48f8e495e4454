# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Run nodes under the executor: the Python API of `mddag run`."""

from __future__ import annotations

import warnings

from mddag_executor.errors import UserCodeError
from mddag_executor.hosting.run_here import Display, run_here
from mddag_executor.hosting.run_options import RunOptions
from mddag_executor.hosting.run_processes import run_processes
from mddag_executor.hosting.run_result import RunResult


class RunWarning(UserWarning):
    """Something about a run that its user should know."""


def run(options: RunOptions) -> RunResult:
    """
    Run nodes as `mddag run` does, until the run ends; return its result.

    It may be called again and again in one process, while rclpy is not initialised.  From the main
    thread, Ctrl-C ends the run.  Warnings are issued as ``RunWarning``.

    :raises MddagError: when the run cannot begin, with the place, what is wrong and what to do.
    :raises msg_graph.GraphError: when the declaration is invalid.
    :raises UserCodeError: when a node raised; its cause is the exception, its ``result`` the
        result.
    :raises KeyboardInterrupt: when a program did not catch it.
    """
    result = run_with(options, Display(
        lambda line: warnings.warn(line, RunWarning, stacklevel=2)))
    error = result.error
    if isinstance(error, UserCodeError):
        error.result = result
    if error is not None and not isinstance(error, SystemExit):
        raise error
    return result


def run_with(options: RunOptions, display: Display) -> RunResult:
    """Do the same with a display; what a node raised is in the result."""
    task_set = options.task_set()
    if options.process is None and (task_set.processes or (options.n_processes or 1) > 1):
        return run_processes(options, task_set, display)
    return run_here(options, task_set, display)
