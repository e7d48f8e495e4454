# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Recorded messages arrive at their recorded times.

The messages of the topics that nodes subscribe to are loaded from the recording, and those of the
topics that they publish, to be compared. If a node subscribes to another topic later, its messages
are loaded then and arrive from then on.

If a node subscribes to ``/clock``, and it is neither recorded nor published by a node, it gives
virtual time.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

from mddag_executor.rerun.errors import RerunError
from mddag_executor.rerun.inputs import MessageBag, RecordedMessage
from mddag_executor.rerun.loop import Loop, RECORDED
from mddag_executor.rerun.message_types import type_name
from mddag_executor.rerun.messages import Messages
from rclpy.serialization import serialize_message
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

CLOCK = '/clock'
CLOCK_EVERY_NS = 10_000_000
"""How often ``/clock`` gives the time."""


class Player:
    """
    Delivers what is recorded.

    :param recording: None: there are no messages.
    """

    def __init__(self, loop: Loop, messages: Messages, recording: MessageBag | None) -> None:
        self._loop = loop
        self._messages = messages
        self._recording = recording
        self._player: Iterator[RecordedMessage] | None = None
        # which messages of this instant have been delivered
        self._instant = -1
        self._delivered: set[int] = set()
        self._clocked = False

    @property
    def _topics(self) -> Collection[str]:
        return () if self._recording is None else self._recording.topics

    def begin(self) -> None:
        """Deliver from now on."""
        self._load()
        self._play()

    def refresh(self) -> None:
        """Note which topics nodes subscribe to now."""
        if not self._clocked and self._messages.inlets(CLOCK) and (
                CLOCK not in self._topics and CLOCK not in self._messages.offered):
            self._clocked = True
            self._publish_time()
        if self._player is not None and self._load():
            self._play()

    def _load(self) -> bool:
        """Load what nodes need; return whether that is more than before."""
        recording = self._recording
        if recording is None:
            return False
        topics = self._messages.topics()
        more = recording.load({*topics, *self._messages.offered})
        for topic, kind in topics.items():
            recorded = recording.kinds.get(topic)
            if recorded is not None and topic not in self._messages.offered and (
                    recorded != type_name(kind)):
                raise RerunError(
                    f'{recording.name}: {topic} was recorded as {recorded}, and the node '
                    f'subscribes to it as {type_name(kind)}: record it anew, or correct the node')
        return more

    def _play(self) -> None:
        if self._recording is not None:
            self._player = self._recording.messages(self._loop.now)
            self._next(self._player)

    def _next(self, playing: Iterator[RecordedMessage]) -> None:
        message = next(playing, None)
        if message is not None:
            self._loop.at(message.time, RECORDED, self._deliver, playing, message)

    def _deliver(self, playing: Iterator[RecordedMessage], message: RecordedMessage) -> None:
        if playing is not self._player:
            return  # it has begun anew, with more topics
        if self._instant != message.time:
            self._instant = message.time
            self._delivered.clear()
        if message.place not in self._delivered:
            self._delivered.add(message.place)
            self._messages.recorded(message.topic, message.data, message.published)
        self._next(playing)

    def _publish_time(self) -> None:
        now = self._loop.now
        stamp = Time(nanoseconds=now).to_msg()
        self._messages.recorded(CLOCK, serialize_message(Clock(clock=stamp)), now)
        if now + CLOCK_EVERY_NS < self._loop.end:
            self._loop.at(now + CLOCK_EVERY_NS, RECORDED, self._publish_time)
