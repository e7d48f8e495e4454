# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What tests of hosting share, some of it with those of the executor."""

from pathlib import Path

from ..executor.conftest import make_node, wait_for

__all__ = ['GUESTS', 'is_gone', 'make_node', 'TWO_PROCESSES', 'wait_for']

GUESTS = Path(__file__).resolve().parent / 'guests'
TWO_PROCESSES = """\
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: t, timer: 9ms, deadline: 9ms, execution_time: 1ms}]}
  - {node: /b, callbacks: [{name: t, timer: 9ms, deadline: 9ms, execution_time: 1ms}]}
processes: {one: [/a], two: [/b]}
"""


def is_gone(pid):
    """Tell whether a process is gone; no process may be there to take note of its end."""
    try:
        return ') Z ' in Path(f'/proc/{pid}/stat').read_text()
    except (ProcessLookupError, FileNotFoundError):
        return True
