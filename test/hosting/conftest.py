# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the tests of the executor have, too."""

from pathlib import Path

from ..executor.conftest import make_node, wait_for

__all__ = ['has_ended', 'make_node', 'wait_for']


def has_ended(pid):
    """Tell whether a process is gone; no process may be there to take note of its end."""
    try:
        return ') Z ' in Path(f'/proc/{pid}/stat').read_text()
    except (ProcessLookupError, FileNotFoundError):
        return True
