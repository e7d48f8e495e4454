# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Opens recordings of every kind; the only place that distinguishes the kinds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
import os

from mddag_executor.errors import UsageError
from mddag_executor.recording.head import is_declared, ReplayError
from mddag_executor.recording.mapping import judged_by
from mddag_executor.recording.recording import Recording
from mddag_executor.sources.head import named_errors, read_head, without_declaration
from mddag_executor.sources.own import read_own
from mddag_executor.sources.progress import Progress
from mddag_executor.trace import TraceReader
from msg_graph import EMPTY_TASK_SET, load, TaskSet
from msg_graph.derive import gc_paused


@dataclass(frozen=True)
class Traces:
    """
    The traces of the processes of one run, with or without a declaration.

    One of them may be an imported recording, of the processes that other executors ran.

    :ivar paths: paths of the traces, at least one.
    :ivar offsets: how far the clocks of other machines are ahead of the first trace's clock, ns,
        by the last word of the trace's name (``control`` of ``run.control.mcap``).  Missing
        offsets are estimated from messages.
    :raises mddag_executor.errors.UsageError: if there is no path.
    """

    paths: Sequence[str | os.PathLike[str]]
    offsets: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.paths:
            raise UsageError('traces: there is no path: give those of all processes of a run')

    def __str__(self) -> str:
        return ', '.join(os.fspath(path) for path in self.paths)


Given = str | os.PathLike[str] | Sequence[str | os.PathLike[str]] | Traces | TraceReader
"""A trace or its path, or the paths of the traces of all processes of one run."""


@gc_paused()
def open_recording(
    path: Given, task_set: TaskSet | str | os.PathLike[str] | None = None,
    name: str | None = None, progress: Progress | None = None,
) -> Recording:
    """
    Read a trace of this executor, an imported trace, the traces of one run, or an ordinary bag.

    A bag only has releases: the messages that start the declared DAGs.

    :param task_set: the declaration to judge by, or its path; None: the one in the trace, if any.
    :param name: the recording's name in messages, if not its path.
    :param progress: called regularly with the number of events read.
    :raises mddag_executor.trace.TraceError: if a file is not a trace.
    :raises mddag_executor.ReplayError: if the recording has nothing to replay or none of
        the declaration's callbacks, or if it is a bag, and there is no declaration.
    """
    if isinstance(task_set, (str, os.PathLike)):
        task_set = load(task_set)
    if not isinstance(path, (str, os.PathLike, TraceReader)):
        return _of_several(path if isinstance(path, Traces) else Traces(path), task_set, progress)
    path, reader = _opened(path)
    name = name or path
    if reader is None:
        from mddag_executor.sources.kinds import is_ordinary
        if is_ordinary(path):
            return _bag(path, task_set, name)
    with named_errors(path, name):
        reader = reader or TraceReader(path)
        head = read_head(reader)
        if head is None:
            from mddag_executor.sources.imported_run import ImportedRun
            return ImportedRun(reader, name, task_set, progress=progress).read()
        if is_declared(head):
            return judged_by(read_own(reader, name, head, progress), task_set)
        from mddag_executor.sources.undeclared_run import UndeclaredRun
        return UndeclaredRun(reader, name, task_set or EMPTY_TASK_SET, head, progress).read()


def _of_several(
    traces: Traces, task_set: TaskSet | None, progress: Progress | None
) -> Recording:
    """Return the recording of a run that has several; one may be imported."""
    paths = [os.fspath(each) for each in traces.paths]
    if len(paths) == 1 and not traces.offsets:
        return open_recording(paths[0], task_set, progress=progress)
    from mddag_executor.sources.kinds import is_ordinary
    for path in paths:
        if is_ordinary(path):
            raise ReplayError(
                path, 'it is an ordinary bag, which has no executions to join with those of '
                'traces', 'give the traces of the processes of one run')
    heads = [read_head(TraceReader(path)) for path in paths]
    if all(head is not None and is_declared(head) for head in heads):
        from mddag_executor.sources.joining import Joined
        return judged_by(Joined(paths, traces.offsets).recording(progress), task_set)
    if traces.offsets:
        raise UsageError('--offset: unless each trace is of a declared run, clocks of computers '
                         'are compared by messages: leave the option out')
    from mddag_executor.sources.mixed_run import MixedRun
    return MixedRun(paths, task_set, progress).read()


def open_to_draft(
    path: str | os.PathLike[str] | Traces, name: str, progress: Progress | None = None
) -> Recording:
    """
    Read a trace to draft a declaration, by the recorded one, if any; see ``open_recording``.

    :raises mddag_executor.ReplayError: as ``open_recording`` does, and for a bag, which has
        nothing to draft from.
    """
    if isinstance(path, Traces):    # of a declared run
        return open_recording(path, None, name, progress)
    from mddag_executor.sources.kinds import is_ordinary
    if is_ordinary(os.fspath(path)):
        raise ReplayError(
            name, 'it is an ordinary bag: it has messages, but nothing in it says which callbacks '
            'received them', 'record the nodes with mddag run … --trace FILE, CARET or '
            'ros2_tracing')
    with named_errors(os.fspath(path), name):
        reader = TraceReader(path)
        head = read_head(reader)
        return open_recording(
            reader, None if head is None or is_declared(head) else EMPTY_TASK_SET, name, progress)


def _opened(path: str | os.PathLike[str] | TraceReader) -> tuple[str, TraceReader | None]:
    """Return the path of a trace, and the trace if it is open."""
    return (path.path, path) if isinstance(path, TraceReader) else (os.fspath(path), None)


def _bag(path: str, task_set: TaskSet | None, name: str) -> Recording:
    """Return the recording of an ordinary bag."""
    if task_set is None:
        raise ReplayError(
            name, 'it is an ordinary bag: nothing in it says which callbacks its messages start',
            'give the GRAPH')
    from mddag_executor.sources.bag_run import read_bag
    return read_bag(path, task_set, name)


def check_declared(path: Given, name: str) -> None:
    """Check that a recording declares deadlines, or raise ReplayError."""
    if isinstance(path, (str, os.PathLike, TraceReader)):
        path, reader = _opened(path)
        with named_errors(path, name):
            reader = reader or TraceReader(path)
            head = read_head(reader)
            if head is not None and not is_declared(head):
                raise without_declaration(name)
            if head is None:
                from mddag_executor.sources.imported_run import ImportedRun
                ImportedRun(reader, name, None)     # None: the trace is an imported one
                raise undeclared(name)
        return
    traces = path if isinstance(path, Traces) else Traces(path)
    heads = [read_head(TraceReader(each)) for each in traces.paths]
    if not any(head is not None and is_declared(head) for head in heads):
        raise without_declaration(name)


def undeclared(name: str, imported: bool = True) -> ReplayError:
    """Return the error for a recording without declared deadlines."""
    return without_declaration(name) if not imported else ReplayError(
        name, 'it was imported, so nothing in it says which callbacks have which deadlines',
        'give the GRAPH')


def has_declaration(path: str | os.PathLike[str], name: str | None = None) -> bool:
    """Return whether a trace declares deadlines."""
    with named_errors(os.fspath(path), name or os.fspath(path)):
        head = read_head(TraceReader(path))
        return head is not None and is_declared(head)
