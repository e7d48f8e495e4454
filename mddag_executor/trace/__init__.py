# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Traces: recorded by live runs, written by importers and simulations, read by replay.

A trace is one MCAP file with a CDR channel for each kind of event, named as in CARET and
ros2_tracing; every MCAP and rosbag2 tool reads it. `TraceWriter` records from many threads,
`TraceFile` writes event by event, `TraceReader` and `read_events` read, `import_ctf` imports CARET
and ros2_tracing recordings. Names are imported on first use: a robot that does not record loads no
compression and no importer.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mddag_executor.lazy import on_first_use

if TYPE_CHECKING:
    from mddag_executor.trace.ctf import import_ctf, Imported
    from mddag_executor.trace.errors import TraceError, TraceWarning
    from mddag_executor.trace.reader import read_events, TraceReader
    from mddag_executor.trace.schema import EVENTS, EventType
    from mddag_executor.trace.trace_file import TraceFile
    from mddag_executor.trace.writer import TraceWriter

__all__ = [
    'EVENTS', 'EventType', 'Imported', 'TraceError', 'TraceFile', 'TraceReader',
    'TraceWarning', 'TraceWriter', 'import_ctf', 'read_events',
]

__getattr__, __dir__ = on_first_use(__name__, {
    name: f'{__name__}.{module}' for module, names in {
        'ctf': ('Imported', 'import_ctf'),
        'errors': ('TraceError', 'TraceWarning'),
        'reader': ('TraceReader', 'read_events'),
        'schema': ('EVENTS', 'EventType'),
        'trace_file': ('TraceFile',),
        'writer': ('TraceWriter',),
    }.items() for name in names})
