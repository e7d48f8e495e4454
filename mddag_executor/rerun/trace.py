# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The trace of a rerun: written at once, as nobody waits for it, and nothing is lost."""

from __future__ import annotations

import os
from typing import Any

from mddag_executor.trace.errors import TraceError
from mddag_executor.trace.trace_file import TraceFile

_MANY = 4096


class VirtualTraceWriter:
    """Records events as ``TraceWriter`` does."""

    dropped = 0
    error: TraceError | None = None

    def __init__(self, path: str) -> None:
        self.path = path
        self._file = TraceFile(path)
        self._events: list[tuple[Any, ...]] = []

    def record(self, *event: Any) -> None:
        """Record one event, or several at once as an entry of ``groups``."""
        self._events.append(event)
        if len(self._events) >= _MANY:
            self._write()

    def _write(self) -> None:
        self._file.extend(self._events, os.getpid())
        self._events = []

    def close(self) -> None:
        """Write the rest, and complete the file."""
        self._write()
        self._file.finish()
