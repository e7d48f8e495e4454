# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What a rerun takes from recordings: the messages of a bag, and how long everything takes."""

from __future__ import annotations

import os
from typing import NamedTuple

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


class Source(NamedTuple):
    """
    What a run takes from recordings.

    :ivar messages: the bag, where there is one.
    :ivar times: how long callbacks and messages take.
    """

    name: str
    start: int
    end: int
    messages: Recording | None
    times: Times

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
    run = None if bag else _recorded(path, task_set, name)
    if times == DECLARED:
        taken: Times = SameInEachJob(draw_execution_times(task_set, seed, undeclared=0))
    elif times == RECORDED and run is not None:
        taken = run.times
    elif os.path.isdir(times) or _begins_as_mcap(times):
        taken = _recorded(times, task_set, times).times
    else:
        with open(times, encoding='utf-8') as file:
            taken = SameInEachJob(read_execution_times(task_set, file.read(), times))
    messages = _messages(path, name)
    if messages is not None and messages.start is not None and messages.end is not None:
        return Source(name, messages.start, messages.end, messages, taken)
    if run is None:
        raise UsageError(f'{name}: no message is recorded in it: record it with ros2 bag record')
    return run._replace(times=taken)


def _messages(path: str, name: str) -> Recording | None:
    """Return the messages of nodes that a recording has; None where it is a mere trace."""
    recording = Recording(path, name)
    if all(topic.startswith('/trace/') for topic in recording.topics):
        recording.close()
        return None
    return recording


def _begins_as_mcap(path: str) -> bool:
    with open(path, 'rb') as file:
        return file.read(5) == b'\x89MCAP'


def _recorded(path: str, task_set: TaskSet, name: str) -> Source:
    """Return what a recorded run has: from when to when it was, and its times."""
    run = open_run(path, task_set, name)
    tables = Tables.build(task_set, max_active_jobs=NEVER)
    head = run.head
    builder = LoadBuilder(task_set, tables, run.who, head.workers, max(0, head.cpus))
    Replay(run, more=lambda replay: [builder], paths=False)
    start = run.end if run.start is None else run.start
    return Source(
        name, min(start, head.time or start), run.end, None, AsRecorded(tables, builder.build()))
