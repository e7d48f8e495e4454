# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The messages of any MCAP recording, of the topics that are asked for.

Theory of operation: as in `reading`, in the order of the file: block by block, and nothing after
damage. Messages are not decoded; whoever wants a part of one gets its bytes.
"""

from __future__ import annotations

from array import array
from collections.abc import Collection, Iterator
import os
from typing import NamedTuple

from mcap.opcode import Opcode
from mddag_executor.text import counted
from mddag_executor.trace import records
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
from mddag_executor.trace.channels import DEFINITIONS_LIMIT
from mddag_executor.trace.reader import open_trace


class Topic(NamedTuple):
    """A channel: its topic, how its messages are encoded, and their type with its definition."""

    name: str
    encoding: str
    message_type: str
    definition_encoding: str
    definition: str


class Message(NamedTuple):
    """A message: its channel, its times (ns) and its bytes."""

    topic: Topic
    log_time: int
    publish_time: int
    data: memoryview


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
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self._channels: dict[int, Topic] = {}
        self._wanted: dict[int, Topic] = {}
        self._size = 0

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Yield the messages of some topics, in the order of the file."""
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
    ) -> Iterator[Message]:
        view = memoryview(data)
        position, end = 0, len(data)
        wanted = self._wanted
        head_size = records.RECORD.size + records.MESSAGE_HEAD.size
        while position < end:
            if position + records.RECORD.size > end:
                raise Damage('the records of a chunk do not fit into it', block.offset)
            opcode, length = records.RECORD.unpack_from(data, position)
            content = position + records.RECORD.size
            after = content + length
            if after > end:
                raise Damage('the records of a chunk do not fit into it', block.offset)
            if opcode == Opcode.MESSAGE:
                if position + head_size > after:
                    raise Damage('a message is shorter than its head', block.offset)
                channel, _, log_time, publish_time = records.MESSAGE_HEAD.unpack_from(
                    data, content)
                self._note(channel, log_time, block)
                topic = wanted.get(channel)
                if topic is not None:
                    yield Message(topic, log_time, publish_time, view[position + head_size:after])
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                try:
                    self._define(opcode, data[content:after], topics)
                except ValueError as error:
                    raise Damage(str(error), block.offset) from None
            position = after

    def _note(self, channel: int, log_time: int, block: Block) -> None:
        if channel not in self._channels:
            raise Damage('a message is of no channel', block.offset)
        self.count += 1
        self.times.append(log_time)

    def _define(self, opcode: int, content: bytes, topics: Collection[str]) -> None:
        self._size += len(content)
        if self._size > DEFINITIONS_LIMIT:
            raise ValueError('the schemas are too large')
        cursor = records.Cursor(content)
        number = cursor.uint16()
        if opcode == Opcode.SCHEMA:
            name, encoding = cursor.string(), cursor.string()
            schema = (name, encoding, cursor.block().decode(errors='replace'))
            if self._schemas.setdefault(number, schema) != schema:
                raise ValueError('a schema or channel changes its meaning')
            return
        schema = self._schemas.get(cursor.uint16(), ('', '', ''))
        name = cursor.string()
        topic = Topic(name, cursor.string(), *schema)
        if self._channels.setdefault(number, topic) != topic:
            raise ValueError('a schema or channel changes its meaning')
        self.topics.add(name)
        if name in topics:
            self._wanted[number] = topic
