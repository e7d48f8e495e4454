# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Traces: recorded by a live run, written by importers and simulations, read by the replayer.

A trace is one MCAP file with a channel for each kind of event, as CARET and ros2_tracing name
them, in CDR; every MCAP and rosbag2 tool reads it. `TraceWriter` records from many threads,
`TraceFile` writes event by event, `TraceReader` and `read_events` read, `import_ctf` brings CARET
and ros2_tracing recordings in.
"""

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
