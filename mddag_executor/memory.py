# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How this process gives back memory that is free."""

from __future__ import annotations

import ctypes


def give_back() -> None:
    """Give the system the memory that is free: the C library keeps it where it can."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (AttributeError, OSError):
        pass    # not glibc
