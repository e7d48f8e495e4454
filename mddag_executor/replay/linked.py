# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the linker finds in a recording: executions, publications, and what was lost."""

from __future__ import annotations

from collections import Counter
from typing import Protocol

from mddag_executor.replay.entities import Callback, Publisher
from mddag_executor.replay.paths import Places
from mddag_executor.text import counted

Thread = tuple[int, int]        # process and thread


class Run:
    """
    An execution of a callback.

    :ivar thread: process and thread.
    :ivar end: -1 while it runs, or where its end was lost.
    :ivar stamp: source timestamp of the message that it runs for; 0: none is known.
    :ivar stated: the message's header stamp, where the recording has it; else 0.
    :ivar taken: when the message was taken, ns; 0: that is not recorded.
    :ivar inner: when another one last began in its thread while it ran, ns; 0: none did.
    :ivar ready: for those who use it: when it became ready, ns.
    :ivar of: for those who use it: DAG, vertex and job that it belongs to.
    :ivar leg: for those who use it: which leg of the vertex it is.
    :ivar places: for those who use it: its places in paths.
    """

    __slots__ = ('callback', 'thread', 'start', 'end', 'stamp', 'stated', 'taken', 'message',
                 'inner', 'ready', 'of', 'leg', 'places')

    def __init__(self, callback: Callback, thread: Thread, start: int) -> None:
        self.callback = callback
        self.thread = thread
        self.start = start
        self.end = -1
        self.stamp = 0
        self.stated = 0
        self.taken = 0
        self.message: Publication | None = None
        self.inner = 0
        self.ready = start
        self.of: tuple[int, int, int] | None = None
        self.leg = 0
        self.places = Places()


class Publication:
    """
    A message that was published; times in ns, 0 where they are not recorded.

    :ivar run: the execution that published it, None: none did.
    :ivar message: its address, and `written` that of what the middleware made of it.
    :ivar places: for those who use it: its places in paths.
    """

    __slots__ = ('publisher', 'run', 'rclcpp', 'rcl', 'dds', 'stamp', 'message', 'written',
                 'within', 'places')

    def __init__(self, publisher: Publisher | None, run: Run | None, message: int) -> None:
        self.publisher = publisher
        self.run = run
        self.rclcpp = 0
        self.rcl = 0
        self.dds = 0
        self.stamp = 0
        self.message = message
        self.written = 0
        self.within = False     # so far only within the process
        self.places = Places()

    @property
    def time(self) -> int:
        """Return when it was published."""
        return self.rclcpp or self.rcl

    @property
    def topic(self) -> str:
        """Return its topic, empty where that is not known."""
        return self.publisher.topic if self.publisher is not None else ''


class Sink(Protocol):
    """Is told what happened, in the order of time."""

    def started(self, run: Run, message: Publication | None) -> None:
        """Take in that an execution has begun, with the message that it runs for."""

    def published(self, message: Publication) -> None:
        """Take in that a message was published."""

    def took(self, run: Run, message: Publication) -> None:
        """Take in that a running callback took a message itself."""

    def ended(self, run: Run) -> None:
        """Take in that an execution has ended."""

    def missing(self, callback: Callback | None, run: Run | None, time: int) -> None:
        """
        Take in that something is not recorded.

        :param callback: it ran, nobody can tell for what; None: events were discarded.
        :param run: its execution, where only the end is not recorded.
        """


class Losses:
    """What was lost in a recording, by what it affects."""

    def __init__(self) -> None:
        self.ends: Counter[str] = Counter()
        self.starts: Counter[str] = Counter()
        self.messages: Counter[str] = Counter()
        self.unlinked: Counter[str] = Counter()
        self.untold: Counter[str] = Counter()
        self.partial: Counter[str] = Counter()
        self.ambiguous: Counter[str] = Counter()
        self.overwritten: Counter[str] = Counter()
        self.unknown: Counter[str] = Counter()
        #: What the tracer itself says that it discarded.
        self.discarded = 0

    def lines(self) -> list[str]:
        """Return what to say about it."""
        said = (
            (self.ends, 'execution', 'without an end in it (the event was lost)'),
            (self.starts, 'execution', 'without a start in it (the event was lost): left out'),
            (self.messages, 'execution', 'for a message whose publication is not in it: of no job '
             'and no path'),
            (self.unlinked, 'execution', 'for a message whose publication cannot be told (not all '
             'of its topic have a source timestamp in it): of no job and no path'),
            (self.untold, 'execution', 'of a subscription without a message in it (its taking is '
             'not recorded): of no job and no path'),
            (self.partial, 'publication', 'without the tracepoint rclcpp_publish that others of '
             'the publisher have: counted from rcl_publish on'),
            (self.ambiguous, 'execution', 'for a message with the topic and source timestamp of '
             'another one: of no job and no path'),
            (self.overwritten, 'message', 'overwritten in a ring buffer, never taken'),
            (self.unknown, 'execution', 'of a callback whose initialisation is not in it'))
        lines = [f'{counted(sum(counts.values()), noun)} {text}: {_most(counts)}'
                 for counts, noun, text in said if counts]
        if self.discarded:
            lines.insert(0, f'the tracer discarded {counted(self.discarded, "event")} or more: '
                         'executions and messages may be missing')
        return lines


def _most(counts: Counter[str]) -> str:
    named = ', '.join(f'{name} ({n})' for name, n in counts.most_common(3))
    return named + (f', … ({len(counts) - 3} more)' if len(counts) > 3 else '')
