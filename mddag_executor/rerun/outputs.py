# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What a run leaves: the digest of what its nodes have published, the bag that has it, and a trace.

The digest is that of all messages in their order: of each its virtual time, the name of its topic,
that of its type, and its bytes.
"""

from __future__ import annotations

from collections.abc import Container
import hashlib
import itertools
import os
import struct
from typing import Any, BinaryIO, NamedTuple

from mddag_executor.rerun.message_types import definition, type_name
from mddag_executor.trace.trace_file import TraceFile

_HEAD = struct.Struct('<qII')


class Output(NamedTuple):
    """A message that was published."""

    time: int
    topic: str
    kind: Any
    data: bytes


class Outputs:
    """
    Collects what is published.

    :param file: gets it as a bag, as rosbag2 writes it; None: no bag.
    :param keep: which topics' messages to keep; None: those of all.
    :ivar messages: what was kept.
    :ivar counts: how many messages were published, by topic.
    """

    def __init__(self, file: BinaryIO | None, keep: Container[str] | None = None) -> None:
        self.messages: list[Output] = []
        self.counts: dict[str, int] = {}
        self._keep = keep
        # of each topic and type: their names, and their channel in the bag
        self._channels: dict[tuple[str, Any], tuple[bytes, int]] = {}
        self._hash = hashlib.sha256()
        self._numbers = itertools.count(1)
        self._bag: Any = None
        if file is not None:
            from mcap.writer import CompressionType, Writer
            self._bag = Writer(file, compression=CompressionType.ZSTD)
            self._bag.start(profile='ros2', library='mddag_executor rerun')

    def add(self, time: int, topic: str, kind: Any, data: bytes, publisher: Any) -> None:
        """Add a message."""
        self.counts[topic] = self.counts.get(topic, 0) + 1
        if self._keep is None or topic in self._keep:
            self.messages.append(Output(time, topic, kind, data))
        known = self._channels.get((topic, kind))
        if known is None:
            known = self._channels[topic, kind] = (
                f'{topic}\n{type_name(kind)}\n'.encode(), self._new_channel(
                    topic, kind, publisher))
        head, channel = known
        self._hash.update(_HEAD.pack(time, len(head), len(data)) + head + data)
        if self._bag is not None:
            self._bag.add_message(channel, time, data, time, next(self._numbers))

    def _new_channel(self, topic: str, kind: Any, publisher: Any) -> int:
        if self._bag is None:
            return 0
        schema = self._bag.register_schema(type_name(kind), 'ros2msg', definition(kind).encode())
        return int(self._bag.register_channel(
            topic, 'cdr', schema, {'offered_qos_profiles': _qos(publisher.qos_profile)}))

    @property
    def digest(self) -> str:
        """Return the digest of all messages so far."""
        return f'sha256:{self._hash.hexdigest()}'

    def finish(self) -> None:
        """Complete the bag."""
        if self._bag is not None:
            self._bag.finish()


def _qos(profile: Any) -> str:
    """Return a QoS profile as rosbag2 writes it, so that it plays the topic with it."""
    never = '\n    sec: 9223372036\n    nsec: 854775807\n'
    return (
        f'- history: {profile.history.short_key}\n  depth: {profile.depth}\n'
        f'  reliability: {profile.reliability.short_key}\n'
        f'  durability: {profile.durability.short_key}\n  deadline:{never}  lifespan:{never}'
        f'  liveliness: {profile.liveliness.short_key}\n  liveliness_lease_duration:{never}'
        '  avoid_ros_namespace_conventions: false\n')


class VirtualTraceWriter(TraceFile):
    """Records events as ``TraceWriter`` does, but at once: nothing waits, and nothing is lost."""

    close = TraceFile.finish

    def record(self, *event: Any) -> None:
        """Record one event, or several at once as an entry of ``groups``."""
        self.extend((event,), os.getpid())
