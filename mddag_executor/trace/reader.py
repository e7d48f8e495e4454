# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Reads traces as a stream of events.

The orders of reading and the handling of damage are in `reading`.
"""

from __future__ import annotations

from array import array
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
import os
import stat
import struct
from typing import Any, BinaryIO
import warnings
import weakref

from mddag_executor.text import counted
from mddag_executor.trace.blocks import open_data, read_summary, Summary
from mddag_executor.trace.channels import Channels, Topic
from mddag_executor.trace.errors import TraceError, TraceWarning, unreadable
from mddag_executor.trace.events import Batch, Event
from mddag_executor.trace.reading import Messages, Reading
from mddag_executor.trace.records import LIBRARY
from mddag_executor.trace.schema import HOST, PROCESS


def _opened(path: str) -> BinaryIO:
    if '\0' in path:
        raise TraceError(path, 'is not a file name', 'give the .mcap file')
    try:
        mode = os.stat(path).st_mode
        if stat.S_ISDIR(mode):
            raise no_trace(path)
        if not stat.S_ISREG(mode):      # opening a pipe would wait for its writer
            raise TraceError(path, 'is not a file', 'give the .mcap file itself')
        return open(path, 'rb')
    except OSError as error:
        raise unreadable(path, error) from None


def no_trace(folder: str) -> TraceError:
    """
    Return the error for a folder that was given instead of a trace.

    :raises OSError: if the folder cannot be read
    """
    if any('metadata' in files for _, _, files in os.walk(folder)):
        return TraceError(folder, 'is a folder that LTTng recorded to',
                          "make a trace of it with 'mddag import ctf'")
    traces = sorted(name for name in os.listdir(folder) if name.endswith('.mcap'))
    if not traces:
        return TraceError(folder, 'is a folder without a trace', 'give a trace, an .mcap file')
    return TraceError(folder, 'is a folder', f'give the trace {os.path.join(folder, traces[0])}'
                      + ' or another one in it' * (len(traces) > 1))


class TraceReader:
    """
    Reads a trace file, which is opened once; every call of `events` reads it again.

    `warnings` has missing data and undecodable messages, one line each, after the reading has
    ended. `fields` has the names of the fields of the events read so far, `topics` all channels,
    and `times` the log times of all messages, after `messages` was read.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = os.fspath(path)
        self.warnings: list[str] = []
        self.fields: dict[str, tuple[str, ...]] = {}
        self.topics: dict[int, Topic] = {}
        self.times = array('Q')
        stream = self._stream = _opened(self.path)
        weakref.finalize(self, stream.close)
        try:
            size = self._size = os.fstat(stream.fileno()).st_size
            self._start, library = open_data(stream, self.path, size)
            #: Whether this program wrote the file.
            self.written_here = library == LIBRARY
            #: Whether the summary at the end is there and sound; or a finished file has none.
            self._finished = True
            self._summary: Summary | None = None
            try:
                self._summary = read_summary(stream, size)
            except (ValueError, struct.error):
                self._finished = False
        except OSError as error:
            raise unreadable(self.path, error) from None

    @property
    def message_count(self) -> int | None:
        """Return the number of messages; None without a valid summary."""
        return self._summary.messages if self._summary else None

    def may_have(self, name: str) -> bool:
        """Return whether the file may have an event of that full name; True if it does not say."""
        topic = '/trace/' + name.replace(':', '/')
        topics = self._stated_topics
        return topics is None or topic in topics

    def has_events(self) -> bool:
        """Return whether there are channels of events, not only of other messages."""
        topics = self._stated_topics
        if topics is not None:
            return any(topic.startswith('/trace/') for topic in topics)
        return next(self.events(), None) is not None

    @property
    def _stated_topics(self) -> frozenset[str] | None:
        """Return all topics of the file, if its summary has them."""
        return None if self._summary is None else self._summary.topics

    def events(self, names: Iterable[str] | None = None, *,
               sorted: bool = False) -> Iterator[Event]:      # noqa: A002
        """
        Yield events as tuples: full name, timestamp (ns), process id, thread id, then the fields.

        Fields are in the order of the table (`schema.EVENTS`), None if the file lacks one; events
        that are not in the table have the order of the file (`fields`).

        :param names: full names (`ros2:callback_start`) of the wanted events, None for all
        :param sorted: whether to yield in the order of time instead of that of the file
        :raises TraceError: if the file can no longer be read
        """
        return self._events(names, True, sorted)

    def layout_events(self, names: Iterable[str] | None) -> Iterator[Event]:
        """
        Yield events in the order of time, with a `Layout` instead of the name.

        They have the fields of the file, not those of the table.
        """
        return self._events(names, False, True)

    def _events(
        self, names: Iterable[str] | None, as_table: bool, in_order: bool
    ) -> Iterator[Event]:
        with self._reading(Channels(None if names is None else set(names), as_table)) as reading:
            if in_order:
                yield from reading.by_time()
            else:
                for batch in reading.by_file():
                    yield from batch.tuples()

    def batches(self, names: Iterable[str], as_table: bool = True) -> Iterator[Batch]:
        """
        Yield the named events in the order of the file, in batches.

        :param as_table: whether they have the fields of the table, not those of the file.
        """
        with self._reading(Channels(set(names), as_table)) as reading:
            yield from reading.by_file()

    def messages(self, topics: Collection[str]) -> Iterator[list[Messages]]:
        """
        Yield the undecoded messages of some topics, some at a time, by channel.

        Those of a channel are in the order of the file.
        """
        with self._reading(Channels(set(), True)) as reading:
            yield from reading.messages_of(topics, self.times, self._summary)

    @contextmanager
    def _reading(self, channels: Channels) -> Iterator[Reading]:
        self.fields, self.topics = channels.fields, channels.topics
        try:
            reading = Reading(self.path, channels, self._stream, self._start, self._size)
            yield reading
        except OSError as error:
            raise unreadable(self.path, error) from None
        for text in (self._missing(reading), reading.undecoded(), reading.impossible_times()):
            if text and text not in self.warnings:
                self.warnings.append(text)

    def _missing(self, reading: Reading) -> str | None:
        """Return the warning about missing data, None if nothing is missing."""
        damage, summary = reading.damage, self._summary
        found = _contents(reading.chunks, reading.messages)
        stated = (f'the file says that it holds {_contents(summary.chunks, summary.messages)}'
                  if summary else 'the file has no index, so the loss is unknown')
        if damage:
            lost = self._size - damage.offset
            more = f', ignored the last {lost} bytes' if lost else ''
            return (f'{self.path}: {damage.what} (at byte {damage.offset}): read {found} before '
                    f'it{more}; {stated}')
        if not self._finished:
            return (f'{self.path}: the summary at the end is damaged or missing: read all of the '
                    f'data, {found}')
        if summary and (summary.chunks, summary.messages) != (reading.chunks, reading.messages):
            return f'{self.path}: events are missing or doubled: read {found}; {stated}'
        return None


def read_events(path: str | os.PathLike[str],
                names: Iterable[str] | None = None) -> Iterator[dict[str, Any]]:
    """
    Yield the events of a trace in the order of time, in the form that CARET's analysis reads.

    CARET's analysis fails on unknown events; ``names`` selects the wanted ones.

    Each event is a dict of `_name` (as in `ros2:callback_start`), `_timestamp` (ns), `_vpid`,
    `_vtid` and the event's fields in the file. In an imported recording it also has `_procname`:
    the events `mddag:process` that hold it, and `mddag:host`, are only yielded if they are named.
    A `TraceWarning` at the end reports missing data.

    :param names: full names of the wanted events, None for all
    :raises TraceError: if the file cannot be read
    """
    reader = TraceReader(path)
    wanted = None if names is None else set(names)
    named: dict[tuple[int, int], dict[str, Any]] = {}       # by process and thread
    for layout, timestamp, vpid, vtid, *fields in reader.layout_events(
            None if wanted is None else wanted | {PROCESS}):
        values = dict(zip(layout.fields, fields))
        if layout.name == PROCESS:
            named[vpid, vtid] = {'_procname': values.get('procname', '')}
        if layout.name in (PROCESS, HOST) and (wanted is None or layout.name not in wanted):
            continue
        yield {'_name': layout.name, '_timestamp': timestamp, '_vpid': vpid, '_vtid': vtid,
               **named.get((vpid, vtid), {}), **values}
    for text in reader.warnings:
        warnings.warn(text, TraceWarning, stacklevel=2)


def _contents(chunks: int, messages: int) -> str:
    return f'{counted(chunks, "chunk")} with {counted(messages, "message")}'
