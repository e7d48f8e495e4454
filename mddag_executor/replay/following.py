# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Recordings of every kind, their mappings and followers: one place to tell them apart."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import os
from typing import Any

from mddag_executor.replay.follower import Follower, Observer
from mddag_executor.replay.imported import (
    ImportedMapping,
    ImportedRecording,
    is_own,
    open_recording,
)
from mddag_executor.replay.imported_jobs import ImportedFollower
from mddag_executor.replay.mapping import Mapping
from mddag_executor.replay.recording import Recording, ReplayError
from msg_graph import TaskSet

AnyRecording = Recording | ImportedRecording
AnyMapping = Mapping | ImportedMapping
AnyFollower = Follower | ImportedFollower
Handlers = dict[str, Callable[[tuple[Any, ...]], None]]

__all__ = [
    'AnyFollower', 'AnyMapping', 'AnyRecording', 'Handlers', 'check_declared', 'is_own',
    'make_follower', 'map_recording', 'merged', 'open_declared', 'open_recording']


def open_declared(
    path: str | os.PathLike[str], name: str | None, task_set: TaskSet | None
) -> AnyRecording:
    """
    Open a recorded run for which there is a declaration; see ``open_recording``.

    :raises ReplayError: when it is imported, and none is given.
    """
    if task_set is None:
        check_declared(path, name)
    return open_recording(path, name)


def check_declared(path: str | os.PathLike[str], name: str | None) -> None:
    """
    Find out whether a recorded run is of this executor, so that it has a declaration.

    :raises ReplayError: when it is imported.
    :raises mddag_executor.trace.TraceError: when it is no trace.
    """
    if not is_own(path, name) and isinstance(open_recording(path, name), ImportedRecording):
        raise ReplayError(
            name or os.fspath(path), 'it was imported, so nothing in it says which callbacks have '
            'which deadlines', 'give the GRAPH')


def map_recording(recording: AnyRecording, task_set: TaskSet | None) -> AnyMapping:
    """
    Return where a recording's callbacks are in the declaration that judges.

    :raises mddag_executor.replay.ReplayError: when none of its callbacks is in the recording.
    """
    if isinstance(recording, ImportedRecording):
        return ImportedMapping(recording, task_set)
    return Mapping(recording, task_set)


def make_follower(
    recording: AnyRecording, mapping: AnyMapping, observers: Sequence[Observer],
    more: Handlers | None = None, sinks: Sequence[Any] = (),
) -> AnyFollower:
    """
    Return what goes through a recording's events.

    :param more: handlers of further events, by full name; of an imported recording they are told
        of the callback groups only.
    :param sinks: who is told what an imported recording's linker says.
    """
    if isinstance(recording, ImportedRecording):
        assert isinstance(mapping, ImportedMapping)
        return ImportedFollower(recording, mapping, observers, more, sinks)
    assert isinstance(mapping, Mapping)
    return Follower(recording, mapping, observers, more)


def merged(*several: Handlers) -> Handlers:
    """Return handlers that tell all who want to know of an event, in order."""
    every: dict[str, list[Callable[[tuple[Any, ...]], None]]] = {}
    for handlers in several:
        for name, handler in handlers.items():
            every.setdefault(name, []).append(handler)
    return {name: told[0] if len(told) == 1 else _teller(told) for name, told in every.items()}


def _teller(
    told: list[Callable[[tuple[Any, ...]], None]]
) -> Callable[[tuple[Any, ...]], None]:
    def tell(event: tuple[Any, ...]) -> None:
        for handler in told:
            handler(event)

    return tell
