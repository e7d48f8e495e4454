# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A trace of this executor: what its head says, and its events in the order of time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
import os
from typing import Any, NamedTuple, TYPE_CHECKING

from mddag_executor.errors import InputError
from mddag_executor.trace import TraceError, TraceReader
from msg_graph import GraphError, loads, TaskSet

if TYPE_CHECKING:
    from mddag_executor.trace.columns import Columns

TASK_SET = 'mddag:task_set'
_RECORD = 'record a run with mddag run GRAPH … --trace'


class ReplayError(InputError):
    """A trace that holds nothing to replay; its text is `FILE: what is wrong: what to do`."""


class Head(NamedTuple):
    """What the executor wrote when it began to record: its declaration and its settings."""

    time: int
    yaml: str
    file: str
    policy: str
    workers: int
    default_deadline: int
    max_active_jobs: int
    preemptive: bool


class Recording:
    """
    A recorded run.

    :param path: the trace.
    :param name: what messages call it, where that is not its path (standard input).
    :raises mddag_executor.trace.TraceError: when it is no trace.
    :raises ReplayError: when no run of this executor is recorded in it.
    :raises msg_graph.GraphError: when the recorded declaration is wrong.
    """

    def __init__(self, path: str | os.PathLike[str], name: str | None = None) -> None:
        self.path = os.fspath(path)
        self.name = name or self.path
        with self._named():
            self._reader = TraceReader(self.path)
            self.head = self._read_head()
        #: The DAG tasks that the trace was recorded with; its events refer to them by index.
        self.task_set = self._declared()

    def _read_head(self) -> Head:
        for event in self._reader.events({TASK_SET}):
            if None in event:
                continue  # written by something else: fields are missing
            return Head(event[1], *event[4:])
        raise no_run(self._reader)

    def _declared(self) -> TaskSet:
        if not self.head.yaml.strip():
            raise ReplayError(
                self.name, 'it was recorded without a declaration, so there are no jobs', _RECORD)
        try:
            return loads(self.head.yaml, self.head.file or self.name)
        except GraphError as error:
            raise ReplayError(
                self.name, f'the declaration that it was recorded with is wrong ({error})',
                'record the run anew') from None

    @property
    def message_count(self) -> int | None:
        """Return how many messages the trace is said to hold, None where that is not known."""
        return self._reader.message_count

    @property
    def warnings(self) -> list[str]:
        """Return what is missing of the trace, once ``events`` has come to its end."""
        return [self._rename(text) for text in self._reader.warnings]

    def events(self, names: Iterable[str]) -> Iterator[tuple[Any, ...]]:
        """
        Yield the named events in the order of time; see ``TraceReader.events``.

        :raises mddag_executor.trace.TraceError: when the file can no longer be read.
        """
        with self._named():
            yield from self._reader.events(names, sorted=True)

    def columns(
        self, names: Iterable[str], kinds: Mapping[str, int], scan: Any
    ) -> Iterator[Columns]:
        """Yield the named events in the order of time as rows; see ``TraceReader.columns``."""
        with self._named():
            yield from self._reader.columns(names, kinds, scan)

    def _named(self) -> AbstractContextManager[None]:
        return named_errors(self.path, self.name)

    def _rename(self, text: str) -> str:
        return self.name + text[len(self.path):] if text.startswith(self.path) else text


def no_run(reader: TraceReader) -> ReplayError:
    """Return the error for a trace, read to its end, without a run of this executor."""
    what = f'no run of this executor is recorded in it (it has no event {TASK_SET})'
    if reader.warnings:
        damage = reader.warnings[0].removeprefix(f'{reader.path}: ').partition(': ')[0]
        what = f'it is damaged ({damage}), and the declaration of its run is lost'
    return ReplayError(reader.path, what, _RECORD)


@contextmanager
def named_errors(path: str, name: str) -> Iterator[None]:
    """Let errors about a file call it by its name."""
    def rename(text: str) -> str:
        return name + text[len(path):] if text.startswith(path) else text

    try:
        yield
    except TraceError as error:
        raise TraceError(rename(error.file), error.problem, error.remedy) from None
    except ReplayError as error:
        raise ReplayError(rename(error.file), error.problem, error.remedy) from None
