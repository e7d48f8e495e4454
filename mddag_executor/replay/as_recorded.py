# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Replay as recorded: the deadlines of a run, and where its time went."""

from __future__ import annotations

from collections.abc import Callable
import os
from typing import Any

from mddag_executor.replay.batches import BatchWatcher, Watcher
from mddag_executor.replay.drift import WatchedRecording
from mddag_executor.replay.fast_compile import worth_it
from mddag_executor.replay.follower import Follower, Observer
from mddag_executor.replay.following import (
    AnyFollower,
    AnyMapping,
    AnyRecording,
    make_follower,
    map_recording,
    merged,
    open_recording,
)
from mddag_executor.replay.groups import RecordedGroups
from mddag_executor.replay.imported import ImportedRecording
from mddag_executor.replay.imported_jobs import ImportedFollower
from mddag_executor.replay.judge import Judge
from mddag_executor.replay.mapping import Mapping
from mddag_executor.replay.names import CallbackNames
from mddag_executor.replay.own_paths import OwnPaths
from mddag_executor.replay.path_flows import Flows
from mddag_executor.replay.path_results import path_results
from mddag_executor.replay.paths import PathBook
from mddag_executor.replay.recording import Recording
from mddag_executor.replay.seen import Seen
from mddag_executor.replay.usage import share, Usage
from mddag_executor.replay.waits import GroupWaits
from mddag_executor.simulate.compiled import available
from mddag_executor.text import counted
from msg_graph import TaskSet

Progress = Callable[[int], None]


class Replay:
    """
    What came of a recorded run.

    :ivar warnings: what is missing or doubtful, one line each.
    """

    def __init__(
        self, recording: AnyRecording, mapping: AnyMapping, judge: Judge, usage: Usage,
        follower: AnyFollower, paths: PathBook | Flows | None = None,
        seen: Seen | None = None,
    ) -> None:
        self._paths = paths
        self._seen = seen
        self._recording = recording
        self._judge = judge
        self._usage = usage
        self._follower = follower
        self.task_set = mapping.task_set
        self.tally = judge.tally
        self.warnings = [*recording.warnings, *mapping.warnings, *follower.warnings()]
        if judge.contradictions:
            self.warnings.append(
                f'{recording.name}: left out: {counted(judge.contradictions, "event")} that '
                'contradict earlier ones')
        differences = judge.differences() if follower.shut_down else None
        if differences is not None:
            self.warnings.append(f'{recording.name}: {differences}')

    @property
    def duration_ns(self) -> int:
        """Return the time from the first release (or execution) to the end of the run."""
        start = self._follower.start
        return 0 if start is None else max(0, self._follower.end - start)

    def result(self) -> dict[str, Any]:
        """Return the result format of ``replay --json``."""
        head = self._recording.head
        duration = self.duration_ns
        result = {
            'policy': head.policy, 'workers': head.workers, 'preemptive': head.preemptive,
            'duration_ns': duration,
            'utilisation': share(self._usage.busy, head.workers, duration),
            **self.tally.result()}
        for dag in self.task_set.dags:
            sinks = result['dags'][dag.name]['sinks']
            first = self._judge.tables.first_vertex[dag.index]
            for local in dag.sinks:
                sink = sinks[dag.vertices[local].name]
                sink['breakdown'] = self._judge.chains.result(self.task_set, first + local)
                sink['slack_ns'] = slack(sink)
            if isinstance(self._follower, ImportedFollower):
                withdrawn = self._follower.doubts.withdrawn
                result['dags'][dag.name]['unjudged'] = withdrawn.get(dag.index, 0)
        return {
            **result, 'rescheduled': False, 'skip_ns': self._judge.skip,
            'callbacks': self._usage.callbacks(),
            'undeclared': self._usage.undeclared.result(),
            'worker_use': self._usage.workers(head.workers, duration),
            'dropped': dict(sorted(self._follower.dropped.items())),
            'paths': {} if self._paths is None else path_results(self._paths),
            **({} if self._seen is None else {
                'recorded_callbacks': self._seen.callbacks(),
                'communications': self._seen.communications()}),
            'recording': recording_result(self._recording, self._follower),
            'warnings': self.warnings}


def slack(sink: dict[str, Any]) -> dict[str, int] | None:
    """
    Return how much before its deadline a sink completed, ns; negative where it was late.

    ``p1`` is what 99 % of the completions had at least.
    """
    response, deadline = sink['response_ns'], sink['relative_deadline_ns']
    if response is None:
        return None
    return {name: deadline - response[of] for name, of in (
        ('min', 'max'), ('p1', 'p99'), ('median', 'median'), ('max', 'min'))}


def recording_result(recording: AnyRecording, follower: AnyFollower) -> dict[str, Any]:
    """Return the part of a result that tells of the trace itself."""
    return {
        'trace': recording.name, 'declaration': recording.head.file,
        'start_ns': follower.start, 'end_ns': follower.end, 'shut_down': follower.shut_down,
        'lost': follower.lost}


def replay(
    path: str | os.PathLike[str],
    task_set: TaskSet | None = None,
    *,
    name: str | None = None,
    progress: Progress | None = None,
    watcher: Watcher | None = None,
    compiled: bool | None = None,
    skip: int = 0,
) -> Replay:
    """
    Replay a trace as recorded.

    Memory depends on the jobs that are open at one time and on the number of sinks' completions
    (their response times are kept).

    :param path: a trace of this executor, or an imported one.
    :param task_set: the declaration that judges; None: the one in the trace, if it has one.
    :param name: what messages call the trace, where that is not its path.
    :param progress: told now and then how many events have been read.
    :param watcher: who else is told of the run.
    :param compiled: whether to use compiled code where that can be; None: for long traces.
    :param skip: how long after the first release jobs are not judged (a warm-up), ns.
    :raises mddag_executor.trace.TraceError: when it is no trace.
    :raises mddag_executor.replay.ReplayError: when there is nothing in it to replay, or none of
        the declaration's callbacks.
    """
    return replay_recording(
        open_recording(path, name), task_set, progress, watcher, compiled, skip)


def replay_recording(
    recording: AnyRecording, task_set: TaskSet | None, progress: Progress | None = None,
    watcher: Watcher | None = None, compiled: bool | None = None, skip: int = 0,
) -> Replay:
    """
    Replay an open recording as recorded; see ``replay``.

    Only a trace of this executor is replayed in compiled code, and only where whoever watches can
    be told in batches.
    """
    mapping = map_recording(recording, task_set)
    batches = watcher if isinstance(watcher, BatchWatcher) else None
    if watcher is batches and isinstance(recording, Recording) and (
            worth_it(recording.message_count) if compiled is None else compiled and available()):
        found = replay_compiled(recording, mapping, progress, batches, skip)
        if found is not None:
            return found
    parts = _Parts(recording, mapping, watcher, skip)
    follower = parts.follower
    follower.run(progress)
    if isinstance(follower, ImportedFollower):
        return Replay(recording, mapping, parts.judge, parts.usage, follower, follower.paths,
                      parts.seen)
    return Replay(recording, mapping, parts.judge, parts.usage, follower, parts.paths.book)


def replay_compiled(
    recording: Recording, mapping: AnyMapping, progress: Progress | None = None,
    watcher: BatchWatcher | None = None, skip: int = 0,
) -> Replay | None:
    """Replay a recording in compiled code; None where that can only be done in Python."""
    from mddag_executor.replay.fast import FastReplay
    from mddag_executor.replay.fast_arrays import Declined
    assert isinstance(mapping, Mapping)
    parts = _Parts(recording, mapping, watcher, skip, in_batches=True)
    follower = parts.follower
    assert isinstance(follower, Follower)
    try:
        FastReplay(recording, mapping, parts.judge, parts.usage, follower, parts.paths,
                   parts.groups, watcher).run(progress)
    except Declined:
        if isinstance(recording, WatchedRecording):
            recording.forget()
        return None
    return Replay(recording, mapping, parts.judge, parts.usage, follower, parts.paths.flows)


class _Parts:
    """All that is told of a run."""

    def __init__(
        self, recording: AnyRecording, mapping: AnyMapping,
        watcher: Watcher | None, skip: int, in_batches: bool = False,
    ) -> None:
        self.groups = RecordedGroups()
        waits = GroupWaits(self.groups)
        self.judge = Judge(mapping.task_set, mapping.same, waits, skip)
        self.usage = Usage(mapping.task_set, waits)
        observers: list[Observer] = [waits, self.judge, self.usage]
        self.paths = OwnPaths(mapping.task_set)
        handlers = [self.groups.handlers()]
        if self.paths.book and not isinstance(recording, ImportedRecording):
            observers.append(self.paths)
            handlers.append(self.paths.handlers())
        if watcher is not None:
            if isinstance(watcher, BatchWatcher) and in_batches:
                watcher.begin(mapping.task_set, self.judge, self.usage)
            else:
                observers.extend(watcher.observers(mapping.task_set, self.judge))
            names = CallbackNames()
            watcher.name_by(names)
            handlers.append(names.handlers())
        self.seen = Seen()
        self.follower = make_follower(
            recording, mapping, observers, merged(*handlers), [self.seen])
        if not isinstance(self.follower, ImportedFollower):
            self.paths.follower = self.follower
