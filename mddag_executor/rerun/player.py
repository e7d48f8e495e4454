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
        self._has_begun = self._gives_clock = False

    @property
    def _topics(self) -> Collection[str]:
        return () if self._recording is None else self._recording.topics

    def begin(self) -> None:
        """Deliver from now on."""
        self._has_begun = True
        self._load()

    def refresh(self) -> None:
        """Note which topics nodes subscribe to now."""
        if not self._gives_clock and self._messages.inlets(CLOCK) and (
                CLOCK not in self._topics and CLOCK not in self._messages.offered):
            self._gives_clock = True
            self._publish_time()
        if self._has_begun:
            self._load()

    def _load(self) -> None:
        """Load the messages that nodes need by now, and begin to deliver them."""
        recording = self._recording
        if recording is None:
            return
        topics = self._messages.topics()
        new = recording.load({*topics, *self._messages.offered})
        for topic, kind in topics.items():
            recorded = recording.kinds.get(topic)
            if recorded is not None and topic not in self._messages.offered and (
                    recorded != type_name(kind)):
                raise RerunError(
                    f'{recording.name}: {topic} was recorded as {recorded}, and the node '
                    f'subscribes to it as {type_name(kind)}: record it again, or correct the node')
        if new:
            self._schedule_next(recording.messages(new, self._loop.now))

    def _schedule_next(self, coming: Iterator[RecordedMessage]) -> None:
        message = next(coming, None)
        if message is not None:
            self._loop.at(message.time, RECORDED, self._deliver, coming, message)

    def _deliver(self, coming: Iterator[RecordedMessage], message: RecordedMessage) -> None:
        self._messages.recorded(message.topic, message.data, message.published)
        self._schedule_next(coming)

    def _publish_time(self) -> None:
        now = self._loop.now
        stamp = Time(nanoseconds=now).to_msg()
        self._messages.recorded(CLOCK, serialize_message(Clock(clock=stamp)), now)
        if now + CLOCK_EVERY_NS < self._loop.end:
            self._loop.at(now + CLOCK_EVERY_NS, RECORDED, self._publish_time)
