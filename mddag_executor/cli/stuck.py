# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Where a run stands that does not come to its end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import faulthandler
from functools import partial

STUCK_S = 30.0
"""Well above what the end takes where callbacks, the middleware and the disk are slow."""
_STDERR = 2


@contextmanager
def dump_when_stuck(seconds: float = STUCK_S) -> Iterator[Callable[[], None]]:
    """
    Give a function to call when the end begins.

    When this context is not left within a time from then, ``Timeout`` and the place where each
    thread stands are written to standard error, once, and the process goes on.  That is done by a
    native thread, which needs no interpreter lock: it also works where who holds that is stuck.
    """
    try:
        yield partial(faulthandler.dump_traceback_later, seconds, file=_STDERR)
    finally:
        faulthandler.cancel_dump_traceback_later()
