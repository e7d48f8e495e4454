# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Recorded runs of every kind: one place that distinguishes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
import os
import shutil
import tempfile
from typing import TYPE_CHECKING, Union
import weakref

from mddag_executor.replay.own import OwnRun
from mddag_executor.replay.recording import is_declared, named_errors, read_head, ReplayError
from mddag_executor.trace import TraceReader
from msg_graph import TaskSet

if TYPE_CHECKING:
    from mddag_executor.replay.imported_run import ImportedRun

Run = Union[OwnRun, 'ImportedRun']
"""
What all have: ``play``, and

* ``name`` of the recording, its ``head`` (policy, workers, …), the ``task_set`` that judges,
  ``declared``: whether the recording itself says which deadlines there are, ``same``: whether
  these judge, and ``imported``: whether another executor ran it;
* once it has been played: ``start`` and ``end`` (ns), ``shut_down``: whether the end is recorded,
  ``lost`` events, ``dropped`` messages by reason, and ``warnings``.
"""


@dataclass(frozen=True)
class Traces:
    """
    The traces of the processes of one run.

    :ivar paths: of the traces.
    :ivar offsets: how far clocks of other machines are ahead of the first trace's, ns, by the
        last word of a trace's name, as ``control`` of ``run.control.mcap``.  Else they are
        estimated from messages.
    """

    paths: Sequence[str]
    offsets: Mapping[str, int] = field(default_factory=dict)

    def __str__(self) -> str:
        """Return what messages call them."""
        return ', '.join(self.paths)


Recording = str | os.PathLike[str] | Sequence[str] | Traces | TraceReader
"""A trace or its path, or the paths of the traces of all processes of one run."""


def open_run(
    path: Recording, task_set: TaskSet | None = None, name: str | None = None,
    needs_declaration: bool = False,
) -> Run:
    """
    Open a recorded run, of this executor or of another one.

    :param task_set: the declaration that judges; None: the one in the trace, if it has one.
    :param needs_declaration: whether there must be one.
    """
    if not isinstance(path, (str, os.PathLike, TraceReader)):
        return _joined(path if isinstance(path, Traces) else Traces(path), task_set)
    reader = path if isinstance(path, TraceReader) else None
    path = os.fspath(path) if not isinstance(path, TraceReader) else path.path
    with named_errors(path, name or path):
        reader = reader or TraceReader(path)
        head = read_head(reader)
        if head is not None and (task_set is None or is_declared(head)):
            return OwnRun(reader, name or path, head, task_set)
        if head is not None and task_set is not None:
            from mddag_executor.replay.undeclared_run import UndeclaredRun
            return UndeclaredRun(reader, name or path, head, task_set)
        from mddag_executor.replay.imported_run import ImportedRun
        run = ImportedRun(reader, name or path, task_set)
    if needs_declaration and task_set is None:
        raise ReplayError(
            run.name, 'it was imported, so nothing in it says which callbacks have which '
            'deadlines', 'give the GRAPH')
    return run


def _joined(traces: Traces, task_set: TaskSet | None) -> OwnRun:
    """Return the run of several traces; it can be played once."""
    from mddag_executor.replay.joining import Joined
    joined = Joined([(path, path) for path in traces.paths], traces.offsets)
    folder = tempfile.mkdtemp(prefix='mddag-')
    path = os.path.join(folder, 'joined.mcap')
    try:
        joined.write(path)
        with named_errors(path, joined.name):
            reader = TraceReader(path)
            head = read_head(reader)
            assert head is not None
            run = OwnRun(reader, joined.name, head, task_set)
            run.processes, run.placed = len(traces.paths), joined.placed()
            run.workers_each = joined.workers_each
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    run.when_played = weakref.finalize(run, shutil.rmtree, folder, ignore_errors=True)
    run.same = False  # each process judged its own part of the jobs
    run.notes, run.worker_names = joined.warnings, joined.worker_names
    return run


def has_declaration(path: str | os.PathLike[str], name: str | None = None) -> bool:
    """Return whether a trace says which deadlines there are."""
    with named_errors(os.fspath(path), name or os.fspath(path)):
        head = read_head(TraceReader(path))
        return head is not None and is_declared(head)
