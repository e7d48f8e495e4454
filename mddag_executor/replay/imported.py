# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Recordings of other executors: CARET and ros2_tracing sessions that were imported.

Theory of operation
-------------------
Nothing in such a recording says which callback is which of a graph.  A callback of the graph is
found by its node's name and by what starts it:

* a timer by its period (``binding.is_period``); where a node's periods differ from the declared
  ones, but there are as many timers, by order, and that is said,
* a subscription, and each leg of a sync callback, by its topic,
* a service by its name.

Several that look the same are told apart by order: in the file, and in which they were made.  A
node that was started more than once, or in several processes, is matched each time.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
import os
from typing import Any, NamedTuple

from mddag_executor.replay.entities import Callback, Entities, fields_of, INIT_EVENTS, Node
from mddag_executor.replay.mapping import asked, first_meant
from mddag_executor.replay.recording import (
    Head,
    named_errors,
    no_run,
    Recording,
    ReplayError,
)
from mddag_executor.text import counted, listed
from mddag_executor.trace import TraceReader
from msg_graph import Callback as Declared
from msg_graph import format_duration, TaskSet
from msg_graph.binding import Entity, is_period

_START = 'ros2:callback_start'
_OWN = ('mddag:job_release', 'mddag:dispatch')
_DEFAULT_DEADLINE = 100_000_000
NO_TASK_SET = TaskSet((), (), (), (), None, '', '')
"""The declaration of those who gave none."""


class ImportedRecording:
    """
    A recording of another executor.

    :param path: the trace.
    :param name: what messages call it, where that is not its path.
    :raises mddag_executor.trace.TraceError: when it is no trace.
    :raises ReplayError: when no callback runs in it.
    """

    def __init__(self, path: str | os.PathLike[str], name: str | None = None) -> None:
        self.path = os.fspath(path)
        self.name = name or self.path
        with named_errors(self.path, self.name):
            self._reader = TraceReader(self.path)
            first: int | None = None
            threads: set[tuple[int, int]] = set()
            own = False
            init: list[tuple[str, dict[str, Any]]] = []
            for event in self._reader.layout_events(INIT_EVENTS | {_START, *_OWN}):
                name_of_event = event[0].name
                if name_of_event == _START:
                    threads.add(event[2:4])
                    first = event[1] if first is None else first
                elif name_of_event in _OWN:
                    own = True      # of this executor, but what it ran is lost
                else:
                    init.append((name_of_event, fields_of(event)))
            if first is None or own:
                raise no_run(self._reader)
        #: Who is who in it.
        self.entities = Entities(init)
        #: Processes and threads that ran callbacks.
        self.threads = threads
        # What another executor goes by is not recorded; it takes the place of the pool.
        self.head = Head(first, '', '', 'ros2', len(threads), _DEFAULT_DEADLINE, 0, False)

    @property
    def processes(self) -> int:
        """Count the processes that ran callbacks."""
        return len({pid for pid, _ in self.threads})

    @property
    def message_count(self) -> int | None:
        """Return how many messages the trace is said to hold, None where that is not known."""
        return self._reader.message_count

    @property
    def warnings(self) -> list[str]:
        """Return what is missing of the trace, once ``events`` has come to its end."""
        lines = [self.name + text[len(self.path):] if text.startswith(self.path) else text
                 for text in self._reader.warnings]
        if self.entities.incomplete:
            lines.append(f'{self.name}: left out: '
                         f'{counted(self.entities.incomplete, "event")} of the initialisation '
                         'without some of the fields')
        return lines

    def events(self, names: Iterable[str]) -> Iterator[tuple[Any, ...]]:
        """
        Yield the named events in the order of time; see ``TraceReader.layout_events``.

        :raises mddag_executor.trace.TraceError: when the file can no longer be read.
        """
        with named_errors(self.path, self.name):
            yield from self._reader.layout_events(names)


def open_recording(
    path: str | os.PathLike[str], name: str | None = None, own: type[Recording] = Recording
) -> Recording | ImportedRecording:
    """
    Open a recorded run, of this executor or of another one.

    :param name: what messages call the trace, where that is not its path.
    :param own: what to make of a recording of this executor.
    :raises mddag_executor.trace.TraceError: when it is no trace.
    :raises ReplayError: when no run is recorded in it.
    :raises msg_graph.GraphError: when the recorded declaration is wrong.
    """
    return own(path, name) if is_own(path, name) else ImportedRecording(path, name)


def is_own(path: str | os.PathLike[str], name: str | None = None) -> bool:
    """
    Tell whether a trace was recorded by this executor.

    :raises mddag_executor.trace.TraceError: when it is no trace.
    """
    with named_errors(os.fspath(path), name or os.fspath(path)):
        return TraceReader(path).task_set_text is not None


class Target(NamedTuple):
    """A declared callback that a recorded one stands for, and the leg of it that it is."""

    callback: Declared
    leg: int
    topic: str


class ImportedMapping:
    """
    Which declared callbacks those of a recording are.

    :param judge: the declaration that judges; None: there is none.
    :raises ReplayError: when none of its callbacks is in the recording.
    """

    same = False

    def __init__(self, recording: ImportedRecording, judge: TaskSet | None) -> None:
        self.task_set = NO_TASK_SET if judge is None else judge
        self.warnings: list[str] = []
        #: By number of a recorded callback.
        self.target: dict[int, Target] = {}
        self._name = recording.name
        self._other_periods: list[str] = []
        if judge is None:
            return
        instances: dict[str, dict[Node, list[Callback]]] = {}
        for callback in recording.entities.every:
            if callback.node is not None:
                nodes = instances.setdefault(callback.node.name, {})
                nodes.setdefault(callback.node, []).append(callback)
        found: set[str] = set()
        for node in dict.fromkeys(c.node for c in judge.callbacks):
            declared = [c for c in judge.callbacks if c.node == node]
            for callbacks in instances.get(node, {}).values():
                found |= self._match(declared, sorted(callbacks, key=lambda c: (c.made, c.number)))
        self._report(recording, judge, found)

    def _match(self, declared: list[Declared], recorded: list[Callback]) -> set[str]:
        """Match a node's callbacks; return the keys of those found."""
        free: dict[tuple[str, str], list[Callback]] = {}
        for callback in recorded:
            what = str(callback.period) if callback.kind == 'timer' else callback.start
            free.setdefault((callback.kind, what), []).append(callback)
        found: set[str] = set()
        timers: list[Declared] = []
        for one in declared:
            if one.kind == 'timer':
                period = one.timer_period_ns or 0
                near = [int(what) for (kind, what), some in free.items()
                        if kind == 'timer' and some and is_period(int(what), period)]
                wanted = [('timer', str(min(near, key=lambda p: abs(p - period), default='')))]
            elif one.kind == 'service':
                wanted = [('service', one.service or '')]
            else:
                wanted = [('subscription', topic) for topic in one.topics]
            for leg, key in enumerate(wanted):
                if free.get(key):
                    self.target[free[key].pop(0).number] = Target(
                        one, leg, key[1] if key[0] == 'subscription' else '')
                    found.add(one.key)
                elif one.kind == 'timer':
                    timers.append(one)
        left = [c for c in recorded if c.kind == 'timer' and c.number not in self.target]
        if timers and len(timers) == len(left):
            for one, callback in zip(timers, left):
                self.target[callback.number] = Target(one, 0, '')
                found.add(one.key)
                self._other_periods.append(
                    f'{one.key} ({format_duration(callback.period)} instead of '
                    f'{format_duration(one.timer_period_ns or 0)})')
        return found

    def _report(self, recording: ImportedRecording, judge: TaskSet, found: set[str]) -> None:
        absent = [c for c in judge.callbacks if c.key not in found]
        missing = [c.key for c in absent]
        others = [Entity(c.node.name, c.kind, c.start, c.period)
                  for c in recording.entities.every
                  if c.node is not None and c.number not in self.target]
        if len(missing) == len(judge.callbacks):
            known = [c.label for c in recording.entities.every if c.kind != 'service']
            has = f'it has {listed(known)}' if known else 'it does not say what its callbacks are'
            raise ReplayError(
                recording.name, f'none of the callbacks of {judge.file} is in it: {has}',
                first_meant(absent, others) or
                'give the graph of the nodes that were recorded, or none')
        if missing:
            self.warnings.append(
                f'{recording.name}: not in it: {len(missing)} of the {len(judge.callbacks)} '
                f'callbacks of {judge.file}, which count as never completed: {listed(missing)}'
                + asked(absent, others))
        if self._other_periods:
            self.warnings.append(
                f'{recording.name}: {counted(len(self._other_periods), "timer")} with another '
                f'period than declared: {listed(self._other_periods)}')
        if recording.processes > 1:
            self.warnings.append(
                f'{recording.name}: {recording.processes} processes ran callbacks, each with '
                f'workers of its own: '
                f'{counted(recording.head.workers, "thread")} are taken together')
