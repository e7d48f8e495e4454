# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Declared message graphs to DAG tasks.

``load`` reads a declaration and derives its DAG tasks. The result, an immutable ``TaskSet``, is
all that the rest of a program needs to know about the graph. The rules are in ``derive``.
"""

from __future__ import annotations

from msg_graph.derive import load, loads
from msg_graph.duration import DurationError, format_duration, parse_duration
from msg_graph.errors import GraphError
from msg_graph.model import (
    Callback,
    Dag,
    EMPTY_TASK_SET,
    ExecutionTime,
    Path,
    Process,
    QueueEdge,
    TaskSet,
    Vertex,
    WeaklyHard,
)

__all__ = [
    'Callback', 'Dag', 'DurationError', 'ExecutionTime', 'GraphError', 'EMPTY_TASK_SET',
    'Path', 'Process', 'QueueEdge', 'TaskSet', 'Vertex', 'WeaklyHard', 'format_duration', 'load',
    'loads', 'parse_duration',
]
