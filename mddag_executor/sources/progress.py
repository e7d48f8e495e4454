# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What is called while recordings are read."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int], None]
"""It is called regularly with the number of events read."""


def progress_from(progress: Progress | None, before: int) -> Progress | None:
    """Return what is called with the number of events read of one recording of several."""
    return None if progress is None else lambda more: progress(before + more)
