# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How this process gives back memory that is free."""

from __future__ import annotations

from resource import getrusage, RUSAGE_SELF

_LITTLE_KB = 100_000


def give_back() -> None:
    """Give the system the memory that is free, if it is much: the C library keeps it."""
    if getrusage(RUSAGE_SELF).ru_maxrss < _LITTLE_KB:
        return
    import ctypes
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (AttributeError, OSError):
        pass    # not glibc
