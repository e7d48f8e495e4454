# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The messages of a bag, to be delivered one after the other.

A bag is read twice: first for which topics it has and how long it is, then, when the nodes are
there, for the messages that they need.  These are kept in a temporary file, in memory while they
are few.
"""

from __future__ import annotations

from array import array
from collections.abc import Collection, Iterator
import tempfile
from typing import NamedTuple

from mddag_executor.replay.bags import Bag
from mddag_executor.rerun.errors import RerunError
from mddag_executor.trace.channels import Topic

_IN_MEMORY = 256 << 20


class Recorded(NamedTuple):
    """
    A recorded message: when it came, when it was published, its topic with its type.

    :ivar place: identifies it.
    """

    time: int
    published: int
    topic: str
    kind: str
    data: bytes
    place: int


class Recording:
    """
    A bag.

    :ivar start: when its first message came, ns; ``end``: the last.
    :ivar topics: every topic in it.
    :ivar kinds: the type of each topic, as far as it has been loaded.
    :raises mddag_executor.replay.bags.BagError: where there is no bag.
    """

    def __init__(self, path: str, name: str | None = None) -> None:
        self.path = path
        self.name = name or path
        bag = Bag(path, (), name)
        self.start, self.end = bag.start, bag.end
        self.topics = frozenset(bag.topics)
        self.warnings = list(bag.warnings)
        self.kinds: dict[str, str] = {}
        self._file = tempfile.SpooledTemporaryFile(max_size=_IN_MEMORY, prefix='mddag-')
        self._times, self._published = array('q'), array('q')
        self._places, self._sizes = array('q'), array('q')
        self._topics: list[Topic] = []
        self._loaded: set[str] = set()
        self._order: list[int] = []

    def close(self) -> None:
        """Let go of the messages."""
        self._file.close()

    def load(self, topics: Collection[str]) -> bool:
        """Load the messages of topics, unless that was done; return whether there were more."""
        wanted = self.topics.intersection(topics) - self._loaded
        if not wanted:
            return False
        self._loaded |= wanted
        Bag(self.path, sorted(wanted), self.name, self._keep)
        self._order = sorted(range(len(self._times)), key=lambda i: self._times[i])
        return True

    def _keep(self, topic: Topic, time: int, published: int, data: bytes) -> None:
        if topic.encoding != 'cdr':
            raise RerunError(
                f'{self.name}: {topic.name} is encoded as {topic.encoding or "nothing"}, which '
                'ROS 2 nodes do not read: convert it, as with rosbags-convert')
        if self.start is None or self.end is None or not self.start <= time <= self.end:
            return  # of damage
        self.kinds[topic.name] = topic.message_type
        self._times.append(time)
        self._published.append(published if published >= 0 else time)
        self._places.append(self._file.seek(0, 2))
        self._sizes.append(len(data))
        self._topics.append(topic)
        self._file.write(data)

    def messages(self, since: int = 0) -> Iterator[Recorded]:
        """Yield what has been loaded, in order of time; of equal times in the order of the bag."""
        for i in self._order:
            if self._times[i] >= since:
                yield self._message(i)

    def _message(self, i: int) -> Recorded:
        self._file.seek(self._places[i])
        topic = self._topics[i]
        return Recorded(
            self._times[i], self._published[i], topic.name, topic.message_type,
            self._file.read(self._sizes[i]), i)
