# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Replay as recorded: the deadlines of a run, and where its time went."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from mddag_executor.replay.beside import pays, play_beside
from mddag_executor.replay.communications import Communications
from mddag_executor.replay.drift import DriftObserver
from mddag_executor.replay.explain import Explainer
from mddag_executor.replay.happenings import Observer
from mddag_executor.replay.judge import Judge
from mddag_executor.replay.own import OwnRun
from mddag_executor.replay.paths import Paths
from mddag_executor.replay.run import open_run, Recording, Run
from mddag_executor.replay.usage import GroupWaits, share, Usage
from mddag_executor.text import counted
from msg_graph import TaskSet
from msg_graph.derive import no_garbage
from msg_graph.drift import Drift

Progress = Callable[[int], None]


class Replay:
    """
    Plays a recorded run, and says what came of it.

    :param more: makes further observers, who come after the judge.
    :param paths: whether to follow the declared paths, to look for drift, and to count why
        deadlines were missed.
    :param jobs: whether to keep of each miss why.
    :ivar explainer: knows why; None without ``paths``.
    :ivar warnings: what is missing or doubtful, one line each.
    """

    def __init__(
        self, run: Run, skip: int = 0, progress: Progress | None = None,
        more: Callable[[Replay], Sequence[Observer]] | None = None, paths: bool = True,
        jobs: bool = False,
    ) -> None:
        self.run = run
        self.task_set = run.task_set
        waits = GroupWaits(run.who)
        self.judge = Judge(run.task_set, run.same, waits, skip)
        self.usage = Usage(run.task_set, waits)
        self.tally = self.judge.tally
        self._seen = Communications(run.who) if run.imported else None
        self._paths = Paths(run) if paths else None
        self._drift = DriftObserver(run) if paths else None
        self.explainer = Explainer(run, self.judge, jobs) if paths else None
        with no_garbage():
            if paths and not jobs and more is None and isinstance(run, OwnRun) and pays(run):
                self.run, self._paths, self._drift = play_beside(
                    run, waits, [self.judge, self.usage, *filter(None, [self.explainer])],
                    progress)
            else:
                observers = [waits, self.judge, self.usage, self._paths, self._drift, self._seen,
                             self.explainer, *(more(self) if more is not None else ())]
                run.play([each for each in observers if each is not None], progress)
            if self.explainer is not None:
                self.explainer.finish()
        run = self.run
        self.warnings = run.warnings
        if self.judge.contradictions:
            self.warnings.append(
                f'{run.name}: left out: {counted(self.judge.contradictions, "event")} that '
                'contradict earlier ones')
        differences = self.judge.differences() if run.shut_down else None
        if differences is not None:
            self.warnings.append(f'{run.name}: {differences}')

    def drift(self) -> list[Drift]:
        """Return where the run and the declaration disagree."""
        return [] if self._drift is None else self._drift.drift(self.task_set)

    @property
    def duration_ns(self) -> int:
        """
        Return the time from the first release (or execution) to the end of the run.

        Of a run without jobs it is that of the recording.
        """
        run = self.run
        start = run.head.time if run.start is None else run.start
        return max(0, run.end - (start if run.jobs else min(start, run.head.time)))

    def result(self) -> dict[str, Any]:
        """Return the result format of ``replay --json``."""
        head = self.run.head
        duration = self.duration_ns
        result = {
            'policy': head.policy, 'workers': head.workers, 'preemptive': head.preemptive,
            'duration_ns': duration,
            'utilisation': share(self.usage.busy, head.workers, duration),
            **self.tally.result()}
        for dag in self.task_set.dags:
            sinks = result['dags'][dag.name]['sinks']
            first = self.judge.tables.first_vertex[dag.index]
            for local in dag.sinks:
                sink = sinks[dag.vertices[local].name]
                sink['breakdown'] = self.judge.chains.result(self.task_set, first + local)
                sink['slack_ns'] = slack(sink)
            if not isinstance(self.run, OwnRun):
                result['dags'][dag.name]['unjudged'] = self.run.unjudged.get(dag.index, 0)
        return {
            **result, 'rescheduled': False, 'skip_ns': self.judge.skip,
            'callbacks': self.usage.callbacks(),
            'undeclared': self.usage.undeclared(),
            'worker_use': self.usage.workers(head.workers, duration),
            'dropped': dict(sorted(self.run.dropped.items())),
            'misses': None if self.explainer is None else self.explainer.summary(),
            'paths': {} if self._paths is None else self._paths.book.results(),
            **({} if self._seen is None else {
                'recorded_callbacks': self._seen.callbacks(),
                'communications': self._seen.communications()}),
            'recording': recording_result(self.run),
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


def recording_result(run: Run) -> dict[str, Any]:
    """Return the part of a result about the trace itself."""
    return {
        'trace': run.name, 'declaration': run.head.file, 'start_ns': run.start,
        'end_ns': run.end, 'shut_down': run.shut_down, 'lost': run.lost}


def replay(
    path: Recording,
    task_set: TaskSet | None = None,
    *,
    name: str | None = None,
    progress: Progress | None = None,
    more: Callable[[Replay], Sequence[Observer]] | None = None,
    skip: int = 0,
    jobs: bool = False,
) -> Replay:
    """
    Replay a trace as recorded.

    Memory depends on the jobs that are open at one time and on the number of sinks' completions
    (their response times are kept).

    :param path: a trace of this executor, or an imported one.
    :param task_set: the declaration that judges; None: the one in the trace, if it has one.
    :param name: what messages call the trace, where that is not its path.
    :param progress: called now and then with the number of events read so far.
    :param more: makes further observers; see ``Replay``.
    :param skip: how long after the first release jobs are not judged (a warm-up), ns.
    :param jobs: whether to keep of each miss why.
    :raises mddag_executor.trace.TraceError: when it is no trace.
    :raises mddag_executor.replay.ReplayError: when there is nothing in it to replay, or none of
        the declaration's callbacks.
    """
    return Replay(open_run(path, task_set, name), skip, progress, more, jobs=jobs)
