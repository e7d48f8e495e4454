# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The channels of a trace, and decoders made from the schemas in the file.

Theory of operation:

1. A channel with topic `/trace/<provider>/<event>` holds events. Other channels (common in
   ordinary recordings) are skipped.
2. Messages are decoded by the schema in the file, not by this program's table, because other
   versions, writers and importers may have other fields. If a schema is not a flat CDR message
   with the preamble, the messages of its channel are skipped and counted.
3. An event of the table is returned with the table's fields in the table's order. Fields missing
   in the file are None, or the table's default of optional ones; other fields are dropped. A
   channel with a field of another kind than the table's (text instead of a number) cannot be
   decoded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import re
import struct
from typing import NamedTuple, TypeVar

from mddag_executor.trace import cdr
from mddag_executor.trace.cdr import FieldType
from mddag_executor.trace.events import Event, Fixed
from mddag_executor.trace.records import Channel, Content, Schema
from mddag_executor.trace.schema import EVENTS, PREAMBLE
import numpy as np

Decoder = tuple[Event, Callable[[bytes], Event]]

UNDEFINED = 'the channel is not defined'
_TOPIC = re.compile(r'/trace/([A-Za-z][A-Za-z0-9_]*)/([A-Za-z][A-Za-z0-9_]*)')
_NO_SCHEMA = Schema('', '', b'')
_T = TypeVar('_T', Channel, Schema)
DEFINITIONS_LIMIT = 64 * 1024 * 1024        # bytes of all schemas and channels
DEFINITIONS_PARSED = 8 * 1024 * 1024        # of those of events that are read
_DECODER = 800      # bytes that a decoder counts for in addition


class Topic(NamedTuple):
    """A channel: topic, message encoding, message type and its definition."""

    name: str
    encoding: str
    message_type: str
    definition_encoding: str
    definition: str


@dataclass(frozen=True)
class Layout:
    """An event's full name, and the names of its fields without the preamble."""

    name: str
    fields: tuple[str, ...]


class Channels:
    """
    The schemas and channels of a file, added as they are read.

    With `as_table` events of the table have the table's fields, and an event starts with its full
    name. Without it events have the fields of the file, and an event starts with its `Layout`.
    """

    def __init__(self, names: set[str] | None, as_table: bool) -> None:
        """Choose the events to decode: the named ones, or all."""
        self._names = names
        self._as_table = as_table
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._size = 0
        self._parsed = 0        # bytes of the definitions from which decoders were made
        self._texts: dict[int, str] = {}        # definitions, by schema
        self._known_schemas: set[bytes] = set()         # contents of their records
        self._known_channels: set[bytes] = set()
        #: The topics of the channels.
        self.topics: dict[int, Topic] = {}
        #: Channels whose messages are skipped.
        self.passed_over: set[int] = set()
        #: Channels whose messages have a fixed layout: begin of their events, structure of the
        #: rest, and values of missing fields.
        self.fixed: dict[int, Fixed] = {}
        #: The fields of the events read so far, by full name.
        self.fields: dict[str, tuple[str, ...]] = {}
        self._decoders: dict[int, Decoder | str] = {}       # or the reason why there is none

    def add_schema(self, content: bytes) -> None:
        """Add the content of a schema record; ValueError: malformed, or redefines a known one."""
        if content in self._known_schemas:      # most files repeat them in each chunk
            return
        body = Content(content)
        self._keep(self._schemas, body.number(2), Schema.read(body), content)
        self._known_schemas.add(content)

    def add_channel(self, content: bytes) -> None:
        """Add the content of a channel record; ValueError: malformed, or redefines a known one."""
        if content in self._known_channels:
            return
        body = Content(content)
        number, channel = body.number(2), Channel.read(body)
        self._keep(self._channels, number, channel, content)
        self._known_channels.add(content)
        if number in self.topics:
            return
        schema = self._schemas.get(channel.schema, _NO_SCHEMA)
        if channel.schema not in self._texts and schema is not _NO_SCHEMA:
            self._texts[channel.schema] = schema.data.decode(errors='replace')
        topic = self.topics[number] = Topic(
            channel.topic, channel.encoding, schema.name, schema.encoding,
            self._texts.get(channel.schema, ''))
        match = _TOPIC.fullmatch(topic.name)
        name = f'{match[1]}:{match[2]}' if match else ''
        if match is None or (self._names is not None and name not in self._names):
            self.passed_over.add(number)
            return
        self._parsed += len(topic.definition) + _DECODER
        if self._parsed > DEFINITIONS_PARSED:
            raise ValueError('the definitions of events are too large, or too many')
        try:
            self._decode(number, name, _fields_of(topic))
        except ValueError as error:
            self._decoders[number] = str(error)

    def undecodable(self, number: int) -> str | None:
        """Return why no message of a channel can be decoded; None: it can."""
        decoder = self._decoders.get(number, UNDEFINED)
        return decoder if isinstance(decoder, str) else None

    def decoder(self, number: int) -> Decoder:
        """
        Return the begin of a channel's events, and the function that decodes the rest.

        :raises ValueError: if the channel cannot be decoded
        """
        decoder = self._decoders.get(number, UNDEFINED)
        if isinstance(decoder, str):
            raise ValueError(decoder)
        return decoder

    def _keep(self, kept: dict[int, _T], number: int, record: _T, content: bytes) -> None:
        if kept.setdefault(number, record) != record:
            raise ValueError('a schema or channel changes its meaning')
        self._size += len(content)
        if self._size > DEFINITIONS_LIMIT:
            raise ValueError('the schemas are too large')

    def _decode(self, number: int, name: str, fields: dict[str, FieldType]) -> None:
        """Make the decoder of a channel of events; raise ValueError if impossible."""
        table = dict(EVENTS[name].fields) if name in EVENTS else {}
        _check(fields, table)
        preamble = [field for field, _ in PREAMBLE]
        wanted = table if self._as_table and table else fields
        layout = Layout(name, tuple(field for field in wanted if field not in preamble))
        self.fields.setdefault(name, layout.fields)

        head = (name if self._as_table else layout,)
        names, types = list(fields), list(fields.values())
        defaults = EVENTS[name].defaults if table else {}
        missing = [field for field in layout.fields if field not in fields]
        others = [*names, *missing]
        place_of = {field: place for place, field in enumerate(others)}
        places = [place_of[field] for field in (*preamble, *layout.fields)]
        rest = tuple(defaults.get(field) for field in missing)

        def decode(data: bytes) -> Event:
            values = (*cdr.decode(types, data), *rest)
            return tuple(values[place] for place in places)

        self._decoders[number] = head, decode
        fixed = cdr.fixed_layout(types)
        if (fixed is not None and places == list(range(len(others)))
                and all(field in defaults for field in missing)):
            formats = ['<' + code for code in fixed if code != 'x']
            offsets, end = [], len(cdr.ENCAPSULATION)
            for code in fixed:
                if code != 'x':
                    offsets.append(end)
                end += struct.calcsize('<' + code)
            self.fixed[number] = Fixed(head, np.dtype({
                'names': names, 'formats': formats, 'itemsize': end, 'offsets': offsets}), {
                    field: defaults[field] for field in missing})


def _fields_of(topic: Topic) -> dict[str, FieldType]:
    if topic.encoding != 'cdr':
        raise ValueError(f'the encoding is {topic.encoding[:20]!r} instead of cdr')
    if not topic.message_type:
        raise ValueError('there is no schema')
    if topic.definition_encoding != 'ros2msg':
        raise ValueError(
            f'schema encoding {topic.definition_encoding[:20]!r} instead of ros2msg')
    return dict(cdr.parse_ros2msg(topic.definition))


def _check(fields: Mapping[str, FieldType], table: Mapping[str, str]) -> None:
    """Raise ValueError if the file's fields do not fit those of the table."""
    for field, _ in PREAMBLE:
        if field not in fields:
            raise ValueError(f'there is no field {field}')
    for field, kind in (*PREAMBLE, *table.items()):
        if field in fields and fields[field].kind != FieldType.parse(kind).kind:
            raise ValueError(f'field {field} is {fields[field].base} instead of {kind}')
