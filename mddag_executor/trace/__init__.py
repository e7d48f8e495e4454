# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Traces: recorded by a live run, written by importers and simulations, read by the replayer.

A trace is one MCAP file with a channel for each kind of event, as CARET and ros2_tracing name
them, in CDR; every MCAP and rosbag2 tool reads it. `TraceWriter` records from many threads,
`TraceFile` writes event by event, `TraceReader` and `read_events` read, `import_ctf` brings CARET
and ros2_tracing recordings in. The names are looked up on first use: a robot that does not record
loads no compression and no importer.
"""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from mddag_executor.trace.ctf import import_ctf, Imported
    from mddag_executor.trace.errors import TraceError, TraceWarning
    from mddag_executor.trace.messages import MessageReader
    from mddag_executor.trace.reader import read_events, TraceReader
    from mddag_executor.trace.schema import EVENTS, EventType
    from mddag_executor.trace.trace_file import TraceFile
    from mddag_executor.trace.writer import TraceWriter

__all__ = [
    'EVENTS', 'EventType', 'Imported', 'MessageReader', 'TraceError', 'TraceFile', 'TraceReader',
    'TraceWarning', 'TraceWriter', 'import_ctf', 'read_events',
]

_LAZY = {
    'EVENTS': 'schema',
    'EventType': 'schema',
    'Imported': 'ctf',
    'MessageReader': 'messages',
    'TraceError': 'errors',
    'TraceFile': 'trace_file',
    'TraceReader': 'reader',
    'TraceWarning': 'errors',
    'TraceWriter': 'writer',
    'import_ctf': 'ctf',
    'read_events': 'reader',
}


def __getattr__(name: str) -> Any:
    """Import a public name on first use (PEP 562)."""
    if name not in _LAZY:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    from importlib import import_module
    value = getattr(import_module(f'{__name__}.{_LAZY[name]}'), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})
