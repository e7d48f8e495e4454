# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What a rerun takes from recordings: the messages of a bag, and how long everything takes."""

from __future__ import annotations

import os

from mddag_executor.core import NEVER, Tables
from mddag_executor.errors import UsageError
from mddag_executor.replay.as_recorded import Replay
from mddag_executor.replay.bags import is_ordinary
from mddag_executor.replay.load import LoadBuilder
from mddag_executor.replay.run import open_run
from mddag_executor.rerun.recording import Recording
from mddag_executor.rerun.times import AsRecorded, SameInEachJob, Times
from mddag_executor.simulate import draw_execution_times, read_execution_times
from msg_graph import TaskSet

RECORDED, DECLARED = 'recorded', 'declared'


class Source:
    """
    What a run takes from recordings.

    :ivar messages: the bag, where there is one.
    :ivar times: how long callbacks and messages take.
    """

    def __init__(
        self, name: str, start: int, end: int, messages: Recording | None, times: Times
    ) -> None:
        self.name = name
        self.start = start
        self.end = end
        self.messages = messages
        self.times = times

    def first_release(self, dag: int) -> int | None:
        """Return when the first job of a DAG was released in the recorded run; None: unknown."""
        return self.times.first_release(dag) if isinstance(self.times, AsRecorded) else None

    @property
    def topics(self) -> frozenset[str]:
        """Return the topics that are recorded."""
        return frozenset() if self.messages is None else self.messages.topics


def open_source(
    path: str, task_set: TaskSet, times: str | None = None, seed: int = 0, name: str | None = None,
) -> Source:
    """
    Open what a rerun begins with.

    :param path: a bag, or a trace of this executor.
    :param times: ``recorded`` (as in that trace), ``declared`` (drawn with the seed), or a file: a
        trace, or JSON with execution times; None: recorded where a trace is given.
    :param name: what messages call the recording, where that is not its path.
    :raises mddag_executor.errors.MddagError: where anything of it cannot be used.
    """
    name = name or path
    bag = is_ordinary(path)
    if times is None:
        times = DECLARED if bag else RECORDED
    if times == RECORDED and bag:
        raise UsageError(
            f'--times recorded: {name} is a bag, which does not say how long callbacks took: give '
            '--times declared, or a trace or a file of execution times')
    run: _Recorded | None = None
    if not bag:
        run = _Recorded(path, task_set, name)
    taken = _times(path, times, task_set, seed, run)
    messages = _messages(path, name)
    if messages is not None and messages.start is not None and messages.end is not None:
        return Source(name, messages.start, messages.end, messages, taken)
    if run is None:
        raise UsageError(f'{name}: no message is recorded in it: record it with ros2 bag record')
    return Source(name, run.start, run.end, None, taken)


def _messages(path: str, name: str) -> Recording | None:
    """Return the messages of nodes that a recording has; None where it is a mere trace."""
    recording = Recording(path, name)
    if all(topic.startswith('/trace/') for topic in recording.topics):
        recording.close()
        return None
    return recording


def _times(
    path: str, times: str, task_set: TaskSet, seed: int, run: _Recorded | None
) -> Times:
    if times == DECLARED:
        return SameInEachJob(draw_execution_times(task_set, seed, undeclared=0))
    if times == RECORDED:
        assert run is not None
        return run.times
    if os.path.isdir(times) or _begins_as_mcap(times):
        return _Recorded(times, task_set, times).times
    with open(times, encoding='utf-8') as file:
        return SameInEachJob(read_execution_times(task_set, file.read(), times))


def _begins_as_mcap(path: str) -> bool:
    with open(path, 'rb') as file:
        return file.read(5) == b'\x89MCAP'


class _Recorded:
    """A recorded run: from when to when it was, and its times."""

    def __init__(self, path: str, task_set: TaskSet, name: str) -> None:
        run = open_run(path, task_set, name)
        tables = Tables.build(task_set, max_active_jobs=NEVER)
        head = run.head
        builder = LoadBuilder(task_set, tables, run.who, head.workers, max(0, head.cpus))
        Replay(run, more=lambda replay: [builder], paths=False)
        self.times = AsRecorded(tables, builder.build())
        start = run.end if run.start is None else run.start
        self.start = min(start, head.time or start)
        self.end = run.end
