# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Where the threads of a run are that does not end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import faulthandler
from functools import partial

STUCK_S = 30.0
"""Well above the duration of an end with slow callbacks, middleware and disk."""
_STDERR = 2


@contextmanager
def dump_when_stuck(seconds: float = STUCK_S) -> Iterator[Callable[[], None]]:
    """
    Give a function to call when the end begins.

    When this context is not left within a time from then, ``Timeout`` and the stack of each thread
    are written to standard error, once, and the process goes on.  A native thread does that, which
    needs no interpreter lock: it also works if the thread that holds the lock is stuck.
    """
    try:
        yield partial(faulthandler.dump_traceback_later, seconds, file=_STDERR)
    finally:
        faulthandler.cancel_dump_traceback_later()
