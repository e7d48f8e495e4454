# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The compiled replay's entry points.

What numba makes of them is kept on disk (see ``simulate.compiled``); where that has not been done
before, it takes half a minute, so that only long traces are worth it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from mddag_executor.simulate.compiled import (
    available,
    cached_entries,
    compile_elsewhere,
    entries_of,
    keeps_entries,
)

_KERNELS = tuple(f'mddag_executor.{name}' for name in (
    'simulate.kernel', 'trace.columns_kernel', 'replay.fast_tables', 'replay.fast_paths',
    'replay.fast_threads', 'replay.fast_core', 'replay.fast_kernel'))
_SOURCES = (*_KERNELS, 'mddag_executor.trace.column_layout', 'mddag_executor.replay.fast_work',
            'mddag_executor.replay.fast_types')
_ENTRIES = ('advance', 'begin_run', 'finish_run', 'copy_table', 'set_callback', 'set_publisher',
            'scan', 'free_core')
_NOTHING = """\
mddag: 1
nodes:
  - node: /a
    callbacks:
      - {name: a, timer: 1s, publishes: [/a], execution_time: 1ms}
      - {name: b, subscription: /a, deadline: 1s, execution_time: 1ms}
paths:
  - {name: a, callbacks: ['/a:a', '/a:b']}
"""
WORTH_COMPILING = 4_000_000
"""Events from which on compiling, which is done once, is worth its time."""
WORTH_LOADING = 300_000
"""Events from which on it is worth to load what was compiled."""


def worth_it(messages: int | None) -> bool:
    """Tell whether to replay a trace of so many messages with compiled code."""
    if messages is None or messages < WORTH_LOADING or not available():
        return False
    if messages >= WORTH_COMPILING:
        prepare()
    return cached_entries(_SOURCES, 'advance')


def prepare() -> None:
    """Compile, if that has not been done and what is compiled can be kept."""
    if (available() and not cached_entries(_SOURCES, 'advance')
            and keeps_entries(_SOURCES)):
        compile_elsewhere(__name__)


@cache
def entries() -> dict[str, Callable[..., Any]]:
    """Return the compiled entry points."""
    from importlib import import_module
    return entries_of(tuple(import_module(name) for name in _KERNELS), _ENTRIES, _SOURCES)


def compile_here() -> None:
    """Compile everything, by replaying nothing."""
    import tempfile

    from mddag_executor.replay.as_recorded import replay_compiled
    from mddag_executor.replay.mapping import Mapping
    from mddag_executor.replay.recording import Recording
    from mddag_executor.trace import TraceFile
    with tempfile.NamedTemporaryFile(suffix='.mcap') as file:
        with TraceFile(file.name) as trace:
            trace.add('task_set', 0, 1, 1, _NOTHING, 'nothing.yaml', 'rad', 1, 1, 1, False)
            trace.add('dispatch', 1, 1, 1, 1, 0, 0, 0, 0, 1, 1)
            trace.add('shutdown', 2, 1, 1, 2)
        recording = Recording(file.name)
        replay_compiled(recording, Mapping(recording, None))
