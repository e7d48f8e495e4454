# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Replay as recorded: the deadlines of a run, and where its time went."""

from __future__ import annotations

from collections.abc import Callable
import os
from typing import Any

from mddag_executor.replay.follower import Follower
from mddag_executor.replay.judge import Judge
from mddag_executor.replay.mapping import Mapping
from mddag_executor.replay.recording import Recording
from mddag_executor.replay.usage import share, Usage
from msg_graph import TaskSet

Progress = Callable[[int], None]


class Replay:
    """
    What came of a recorded run.

    :ivar warnings: what is missing or doubtful, one line each.
    """

    def __init__(
        self, recording: Recording, mapping: Mapping, judge: Judge, usage: Usage,
        follower: Follower,
    ) -> None:
        self._recording = recording
        self._judge = judge
        self._usage = usage
        self._follower = follower
        self.task_set = mapping.task_set
        self.tally = judge.tally
        self.warnings = [*recording.warnings, *mapping.warnings, *follower.warnings()]
        if judge.contradictions:
            self.warnings.append(
                f'{recording.name}: {judge.contradictions} events contradict those before them '
                'and are left out')
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
                sinks[dag.vertices[local].name]['breakdown'] = self._judge.chains.result(
                    self.task_set, first + local)
        return {
            **result, 'rescheduled': False, 'callbacks': self._usage.callbacks(),
            'undeclared': self._usage.undeclared.result(),
            'worker_use': self._usage.workers(head.workers, duration),
            'dropped': dict(sorted(self._follower.dropped.items())),
            'recording': recording_result(self._recording, self._follower),
            'warnings': self.warnings}


def recording_result(recording: Recording, follower: Follower) -> dict[str, Any]:
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
) -> Replay:
    """
    Replay a trace as recorded.

    Memory depends on the jobs that are open at one time, and on the number of sinks' completions
    (their response times are kept), not on the trace's length.

    :param path: a trace of this executor.
    :param task_set: the declaration that judges; None: the one in the trace.
    :param name: what messages call the trace, where that is not its path.
    :param progress: told now and then how many events have been read.
    :raises mddag_executor.trace.TraceError: when it is no trace.
    :raises mddag_executor.replay.ReplayError: when there is nothing in it to replay, or none of
        the declaration's callbacks.
    """
    return replay_recording(Recording(path, name), task_set, progress)


def replay_recording(
    recording: Recording, task_set: TaskSet | None, progress: Progress | None = None
) -> Replay:
    """Replay an open recording as recorded; see ``replay``."""
    mapping = Mapping(recording, task_set)
    judge = Judge(mapping.task_set, compare=mapping.same)
    usage = Usage(mapping.task_set)
    follower = Follower(recording, mapping, [judge, usage])
    follower.run(progress)
    return Replay(recording, mapping, judge, usage, follower)
