# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How much memory this process has used, and how it gives back what is free."""

from __future__ import annotations

import ctypes
from pathlib import Path
import resource


def peak_memory_mb() -> float:
    """
    Return the most memory that this process has had in RAM so far, MB.

    From the kernel's ``VmHWM`` where there is one: what ``getrusage`` returns includes what the
    process that started this one had by then.
    """
    try:
        status = Path('/proc/self/status').read_text(encoding='ascii')
        return int(status.split('VmHWM:')[1].split()[0]) / 1024
    except (OSError, IndexError, ValueError):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def give_back() -> None:
    """Give the system the memory that is free: the C library keeps it where it can."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (AttributeError, OSError):
        pass    # not glibc
