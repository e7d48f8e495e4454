# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Reads the head of a trace: whether this executor wrote it, its declaration and settings."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
import re

from mddag_executor.core.tables import DEMOTE
from mddag_executor.recording.head import Head, is_declared, ReplayError
from mddag_executor.recording.losses import Loss
from mddag_executor.text import step_text
from mddag_executor.trace import TraceError, TraceReader
from mddag_executor.trace.errors import renamed
from msg_graph import GraphError, loads, TaskSet

TASK_SET = 'mddag:task_set'
_RENAMED = re.compile(r'on_miss(?<!\won_miss)(?=[\'"]?\s*:)')
"""Older name of ``on_late``, written before version 2.0."""
_GONE = re.compile(r"(on_late(?<!\won_late)['\"]?\s*:\s*['\"]?)abort\b")
"""A treatment of late jobs that version 2.0 had; rescheduled, such jobs are demoted."""
_ABORT = 2
"""Its number in the head."""


def read_head(reader: TraceReader) -> Head | None:
    """Return the head of a trace; None if this executor did not write it."""
    if not reader.may_have(TASK_SET):
        return None
    of_this = False
    for event in reader.events({TASK_SET}):
        if event[4] is None and not of_this:
            return None
        of_this = True
        if None not in event:       # None: another program wrote it, fields are missing
            head = Head(event[1], *event[4:])
            return head._replace(on_late=DEMOTE) if head.on_late == _ABORT else head
    if of_this:
        raise no_run(reader)
    return None


def declared(head: Head, name: str) -> TaskSet:
    """Return the declaration of a recorded run."""
    if not is_declared(head):
        raise without_declaration(name)
    try:
        return loads(
            _GONE.sub(r'\1demote', _RENAMED.sub('on_late', head.yaml)), head.file or name)
    except GraphError as error:
        raise ReplayError(
            name, f'the declaration that it was recorded with is wrong ({error})',
            'record the run again') from None


def without_declaration(name: str) -> ReplayError:
    """Return the error for a run of this executor without a declaration."""
    return ReplayError(
        name, 'it was recorded without a declaration, so there are no jobs',
        'give the GRAPH that judges it (mddag graph from-trace drafts one)')


def damage(warnings: Iterable[str], path: str, name: str) -> list[Loss]:
    """Return the warnings of a reader about damage of a file, with the given name."""
    return [Loss('damage', 1, renamed(text, path, name)) for text in warnings]


def steps(name: str, several: Sequence[int]) -> list[Loss]:
    """Return what a run lacks if the system clock was set, by steps in ns (forward)."""
    text = step_text(max(several, key=abs, default=0))
    if len(several) > 1:
        text = f'{text} (and {len(several) - 1} more)'
    return [Loss('clock', len(several), f'{name}: {text}')] if several else []


def no_end(name: str) -> Loss:
    """Return what a run without recorded end lacks."""
    return Loss('end', 1, (
        f'{name}: the end of the run is not recorded (the process was killed, or the trace is '
        'cut): open jobs are judged at the last recorded instant'))


def no_jobs(name: str) -> Loss:
    """Return what a run without jobs lacks."""
    return Loss('empty', 1, f'{name}: no job was released in it')


def no_run(reader: TraceReader) -> ReplayError:
    """Return the error for a completely read trace without a run of this executor."""
    if reader.warnings:
        damage = reader.warnings[0].removeprefix(f'{reader.path}: ').partition(': ')[0]
        return ReplayError(
            reader.path, f'it is damaged ({damage}), and nothing of a run is left in it',
            'take another copy of the file, or record the run again')
    return ReplayError(
        reader.path, f'no run of this executor is recorded in it (it has no event {TASK_SET})',
        'record a run with mddag run GRAPH … --trace')


@contextmanager
def named_errors(path: str, name: str) -> Iterator[None]:
    """Use the given name in errors about a file."""
    try:
        yield
    except TraceError as error:
        raise TraceError(renamed(error.file, path, name), error.problem, error.remedy) from None
    except ReplayError as error:
        raise ReplayError(renamed(error.file, path, name), error.problem, error.remedy) from None
