# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The messages of any MCAP recording, of the topics that are asked for.

Theory of operation: as in `reading`, in the order of the file: block by block, and nothing after
damage. mcap takes the blocks apart. Messages are not decoded; whoever wants a part of one gets its
bytes.
"""

from __future__ import annotations

from array import array
from collections.abc import Collection, Iterator
import os
from typing import NamedTuple

from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import breakup_chunk
from mddag_executor.text import counted
from mddag_executor.trace.blocks import (
    Block,
    Damage,
    load,
    open_data,
    read_summary,
    usable,
    used_once,
    what_was_used,
)
from mddag_executor.trace.reader import open_trace


class Topic(NamedTuple):
    """A channel: its topic, how its messages are encoded, and their type with its definition."""

    name: str
    encoding: str
    message_type: str
    definition_encoding: str
    definition: str


class MessageReader:
    """
    Reads messages of an MCAP file, once.

    :ivar warnings: what was found to be missing, one line, once the reading has come to its end.
    :ivar count: messages so far, of all topics.
    :ivar topics: the topics met so far, also those not asked for.
    :ivar times: the log times of all messages, of any topic, in the order of the file.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = os.fspath(path)
        self.warnings: list[str] = []
        self.count = 0
        self.topics: set[str] = set()
        self.times = array('Q')
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._topics: dict[int, Topic] = {}

    def messages(self, topics: Collection[str]) -> Iterator[tuple[Topic, int, int, bytes]]:
        """
        Yield the messages of some topics: topic, log time, publish time (ns), bytes.

        They come in the order of the file.

        :raises TraceError: where the file cannot be read or is no MCAP file
        """
        twice: list[int] = []
        with open_trace(self.path) as (stream, size):
            start, _ = open_data(stream, self.path)
            _, summary = read_summary(stream, size, start)
            try:
                for block in usable(stream, start, size, summary, twice):
                    yield from self._messages(load(stream, block), block, topics)
            except Damage as damage:
                self.warnings.append(what_was_used(
                    self.path, damage, counted(self.count, 'message'), size))
                return
        if twice:
            self.warnings.append(used_once(self.path, twice))
        if summary is not None and summary.messages != self.count:
            self.warnings.append(
                f'{self.path}: its summary counts {summary.messages} messages, but there are '
                f'{self.count}')

    def _messages(
        self, data: bytes, block: Block, topics: Collection[str]
    ) -> Iterator[tuple[Topic, int, int, bytes]]:
        try:
            records = breakup_chunk(Chunk('', data, 0, 0, 0, len(data)))
        except Exception:   # whatever mcap's readers raise on damage
            raise Damage('the records of a chunk do not fit into it', block.offset) from None
        for record in records:
            if isinstance(record, Message):
                topic = self._topics.get(record.channel_id)
                if topic is None:
                    raise Damage('a message is of no channel', block.offset)
                self.count += 1
                self.times.append(record.log_time)
                if topic.name in topics:
                    yield topic, record.log_time, record.publish_time, record.data
            elif isinstance(record, (Schema, Channel)):
                self._define(record, block)

    def _define(self, record: Schema | Channel, block: Block) -> None:
        if isinstance(record, Schema):
            same = self._schemas.setdefault(record.id, record) == record
        else:
            same = self._channels.setdefault(record.id, record) == record
            schema = self._schemas.get(record.schema_id, Schema(0, b'', '', ''))
            self._topics[record.id] = Topic(
                record.topic, record.message_encoding, schema.name, schema.encoding,
                schema.data.decode(errors='replace'))
            self.topics.add(record.topic)
        if not same:
            raise Damage('a schema or channel changes its meaning', block.offset)
