# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What a rerun reads from recordings: messages, and how long callbacks and messages take.

A bag is read twice: first for its topics and its length, then, when the nodes are there, for the
messages that they need. These are in a temporary file, which is in memory while they are few.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace
from itertools import pairwise
from operator import itemgetter
import os
import tempfile
from typing import NamedTuple

from mddag_executor.core import NEVER, Tables
from mddag_executor.errors import UsageError
from mddag_executor.output_rules import is_recording
from mddag_executor.recording.recording import Recording
from mddag_executor.rerun.durations import Durations
from mddag_executor.rerun.errors import RerunError
from mddag_executor.simulate import draw_execution_times, periodic_workload, read_execution_times
from mddag_executor.sources.bags import Bag
from mddag_executor.sources.kinds import is_ordinary
from mddag_executor.sources.open import open_recording
from mddag_executor.trace.channels import Topic
from mddag_executor.whatif.load import LoadBuilder
from msg_graph import TaskSet

RECORDED, DECLARED = 'recorded', 'declared'
_IN_MEMORY = 256 << 20


class RecordedMessage(NamedTuple):
    """A recorded message: when it came, when it was published, its topic with its type."""

    time: int
    published: int
    topic: str
    kind: str
    data: bytes


class MessageBag:
    """
    The messages of nodes in a recording; a trace may have none.

    :ivar start: when its first message came, ns; ``end``: the last.
    :ivar spins: from when timers fire, ns: in a recorded run the programs started before.
    :ivar pauses: from when to when none came (see ``trace.times``).
    :ivar topics: every topic in it.
    :ivar kinds: the type of each topic, as far as it has been loaded.
    :ivar warnings: what is missing or doubtful, as far as it has been loaded, one line each.
    :raises mddag_executor.sources.kinds.BagError: if there is no bag.
    """

    def __init__(self, path: str, name: str | None = None) -> None:
        self.path = path
        self.name = name or path
        bag = Bag(path, (), name)
        self.start, self.end = bag.start or 0, bag.end or 0
        self.spins = self.start
        self.pauses = [(before[1], after[0])
                       for before, after in pairwise(bag.stretches)]
        self.topics = frozenset(
            topic for topic in bag.topics if bag.stretches and not topic.startswith('/trace/'))
        self.warnings = list(bag.warnings)
        self.kinds: dict[str, str] = {}
        self._file = tempfile.SpooledTemporaryFile(max_size=_IN_MEMORY, prefix='mddag-')
        self._loaded: set[str] = set()
        # of each message in the file: its times, its topic, where it is and how long
        self._index: list[tuple[int, int, Topic, int, int]] = []

    def close(self) -> None:
        """Let go of the messages."""
        self._file.close()

    def load(self, topics: Collection[str]) -> frozenset[str]:
        """Load the messages of topics, unless that was done; return the topics that are new."""
        wanted = self.topics.intersection(topics) - self._loaded
        if not wanted:
            return wanted
        self._loaded |= wanted
        # contents are read only now, so damage of them is found now
        for text in Bag(self.path, sorted(wanted), self.name, self._keep).warnings:
            if text not in self.warnings:
                self.warnings.append(text)
        self._index.sort(key=itemgetter(0))
        return wanted

    def _keep(self, topic: Topic, time: int, published: int, data: bytes) -> None:
        if topic.encoding != 'cdr':
            raise RerunError(
                f'{self.name}: {topic.name} is encoded as {topic.encoding or "nothing"}, which '
                'ROS 2 nodes do not read: convert it, as with rosbags-convert')
        if not self.start <= time <= self.end:
            return  # of damage
        self.kinds[topic.name] = topic.message_type
        self._index.append((
            time, published if published >= 0 else time, topic, self._file.seek(0, 2), len(data)))
        self._file.write(data)

    def messages(self, topics: Collection[str], since: int = 0) -> Iterator[RecordedMessage]:
        """Yield what is loaded of topics, in order of time; at equal times in the bag's order."""
        for time, published, topic, place, size in self._index[:]:
            if time >= since and topic.name in topics:
                self._file.seek(place)
                yield RecordedMessage(
                    time, published, topic.name, topic.message_type, self._file.read(size))


def open_input(
    path: str, task_set: TaskSet, times: str | None = None, seed: int = 0, name: str | None = None,
) -> tuple[MessageBag, Durations]:
    """
    Open what a rerun begins with: messages, and how long callbacks and messages take.

    :param path: a bag, or a trace of this executor.
    :param times: ``recorded`` (as in that trace), ``declared`` (drawn with the seed), or a file: a
        trace, or JSON with execution times; None: recorded if a trace is given.
    :param name: what messages call the recording, if not by its path.
    :raises mddag_executor.errors.MddagError: if anything of it cannot be used.
    """
    name = name or path
    processes, task_set = task_set.processes, replace(task_set, processes=())
    is_bag = is_ordinary(path)
    if times is None:
        times = DECLARED if is_bag else RECORDED
    if times == RECORDED and is_bag:
        raise UsageError(
            f'--execution-times recorded: {name} is a bag, which does not say how long callbacks '
            'took: give --execution-times declared, or a trace or a file of execution times')
    run = None if is_bag else open_recording(path, task_set, name)
    if times == DECLARED:
        taken = _fixed(task_set, draw_execution_times(task_set, seed, undeclared=0))
    elif times == RECORDED and run is not None:
        taken = _recorded(run, task_set)
    elif os.path.isdir(times) or is_recording(times):
        taken = _recorded(open_recording(times, task_set, times), task_set)
    else:
        with open(times, 'rb') as file:
            taken = _fixed(task_set, read_execution_times(task_set, file.read(), times))
    messages = MessageBag(path, name)
    if processes:
        messages.warnings.append(
            f'{task_set.file}: processes: all nodes run in one here, with its workers and its '
            'interpreter, and messages between them take no extra time')
    if not messages.topics:
        if run is None:
            raise UsageError(
                f'{name}: no message is recorded in it: record it with ros2 bag record')
        begin = run.run.begin
        messages.start, messages.end = min(begin, run.run.head.time or begin), run.end
        # an executor records the first timers and subscriptions when it begins to spin
        messages.spins = min([begin, *(each.made for each in run.names.made)])
        messages.pauses = []
    return messages, taken


def _fixed(task_set: TaskSet, times: list[list[int]]) -> Durations:
    return Durations(Tables.build(task_set), periodic_workload(task_set, times, 1))


def _recorded(run: Recording, task_set: TaskSet) -> Durations:
    tables = Tables.build(task_set, max_active_jobs=NEVER)
    builder = LoadBuilder(run, tables, (run.run.head.workers,))
    return Durations(tables, builder.build().load, run.jobs)
