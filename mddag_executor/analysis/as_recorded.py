# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Replay as recorded: judge the deadlines of a run and break down its response times."""

from __future__ import annotations

from functools import cached_property
from typing import Any, TYPE_CHECKING

from mddag_executor.analysis.chains import Chains
from mddag_executor.analysis.communications import communications, recorded_callbacks
from mddag_executor.analysis.deadlines import Judged
from mddag_executor.analysis.drift import drift_of
from mddag_executor.analysis.explain import Explanation
from mddag_executor.analysis.paths import Paths
from mddag_executor.analysis.requirements import Requirements
from mddag_executor.analysis.usage import OtherWaits, share, Usage
from mddag_executor.core import NEVER
from mddag_executor.memory import give_back
from mddag_executor.recording.columns import Table
from mddag_executor.recording.head import ReplayError
from mddag_executor.recording.recording import Recording
from mddag_executor.recording.tables import TABLES
from mddag_executor.sources.open import Given, open_recording
from mddag_executor.sources.progress import Progress
from mddag_executor.text import counted
from msg_graph import Dag, TaskSet
from msg_graph.drift import Drift

if TYPE_CHECKING:
    from mddag_executor.analysis.result_table import ResultTable
    from mddag_executor.results.replays import (
        RecordedFile,
        ReplayedDag,
        ReplayResult,
        ReplayResultRare,
    )
    from mddag_executor.results.sinks import DagCounts, SinkCounts, SlackTimes, UnfinishedRun


class Replay:
    """
    A recording and its evaluation.

    :param skip: warm-up time after the first release; jobs released in it are not judged, ns.
    :ivar judged: the verdicts; ``tally`` has their sums.
    :ivar warnings: missing or doubtful data, one line each.
    """

    def __init__(self, recording: Recording, skip: int = 0) -> None:
        self.recording, self.task_set = recording, recording.task_set
        self.judged = Judged(recording, skip)
        self.tally = self.judged.tally
        self.warnings = list(recording.missing.lines())
        if self.judged.contradictions:
            self.warnings.append(
                f'{recording.name}: left out: ' + counted(
                    self.judged.contradictions, 'event that contradicts earlier ones',
                    'events that contradict earlier ones'))
        verdicts = self.judged.verdicts
        early = (verdicts['completed'] >= 0) & (verdicts['completed'] < verdicts['release'])
        if early.any():
            self.warnings.append(
                f'{recording.name}: {counted(int(early.sum()), "result")} before the release of '
                'the job: clocks differ, or times are damaged')
        differences = self.judged.differences() if recording.run.shut_down else None
        if differences is not None:
            self.warnings.append(f'{recording.name}: {differences}')

    @cached_property
    def chains(self) -> Chains:
        """Return the critical chains of jobs."""
        return Chains(self.judged, self.recording.executions, self._waited)

    @cached_property
    def usage(self) -> Usage:
        """Return how much time callbacks and workers used."""
        end = self.recording.end
        return Usage(self.recording, self._waited, end - self.duration_ns, end)

    @cached_property
    def explanation(self) -> Explanation:
        """Return the causes of missed deadlines."""
        return Explanation(self.recording, self.judged, self.chains)

    @cached_property
    def paths(self) -> Paths:
        """Return the flows along the declared paths."""
        return Paths(self.recording, self.judged.judge_from if self.judged.skip else -NEVER)

    @cached_property
    def requirements(self) -> Requirements:
        """Return the verdicts about what is required of paths."""
        return Requirements(self.recording, self.paths, self.judged.judge_from)

    @cached_property
    def _waited(self) -> OtherWaits:
        return OtherWaits.of(self.recording)

    def table(self, name: str) -> Table:
        """
        Return a table of results, or a table of the recording.

        :param name: its name on the page about tables, for instance ``verdicts``.
        :raises KeyError: if there is no such table.
        """
        found = _result_table(name)
        table: Table = getattr(self.recording, name) if found is None else found.table(self)
        return table

    def to_arrow(self, name: str) -> Any:
        """Return a table as an Arrow table, with names instead of numbers; see ``table``."""
        found = _result_table(name)
        return self.recording.to_arrow(name) if found is None else found.to_arrow(self)

    def to_pandas(self, name: str) -> Any:
        """Return a table as a pandas data frame, with names instead of numbers; see ``table``."""
        from mddag_executor.recording.frames import frame_of
        return frame_of(self.to_arrow(name))

    def unfinished(self) -> list[UnfinishedRun]:
        """Return the executions that had not ended when the recording did."""
        recording = self.recording
        return [{'callback': recording.callback_name(callback), 'since_ns': start,
                 'for_ns': max(0, recording.end - start), 'where': recording.names.places[where]}
                for _, callback, start, where in recording.unfinished.tolist()]

    def drift(self) -> list[Drift]:
        """Return the differences between the run and the declaration."""
        return drift_of(self.recording, self.judged.skip)

    @property
    def duration_ns(self) -> int:
        """
        Return the time from the first release or execution to the end of the run, ns.

        Without jobs it is the duration of the recording.
        """
        recording, begun = self.recording, self.recording.run.head.time
        start = begun if recording.start is None else recording.start
        return max(0, recording.end - (
            start if len(recording.releases) else min(start, begun)))

    def result(self) -> ReplayResult:
        """Return the result format of ``replay --json``."""
        recording, head, duration = self.recording, self.recording.run.head, self.duration_ns
        give_back()
        paths = self.paths.results()    # first, because they need the most memory
        give_back()
        guesses: ReplayResultRare = {}
        if unfinished := self.unfinished():
            guesses['unfinished'] = unfinished
        if guessed := recording.guessed:
            guesses['guessed'] = guessed
        more: ReplayResultRare = {}
        if requirements := self.requirements.result():
            more['requirements'] = requirements
        if recording.run.imported or not self.task_set.dags:
            more['recorded_callbacks'] = recorded_callbacks(recording)
            more['communications'] = communications(recording)
        verdicts = self.tally.result()
        return {
            'policy': head.policy, 'workers': head.workers, 'preemptive': head.preemptive,
            'duration_ns': duration,
            'utilisation': share(self.usage.busy, head.workers, duration),
            **verdicts, 'dags': {
                dag.name: self._dag_result(dag, verdicts['dags'][dag.name])
                for dag in self.task_set.dags},
            'rescheduled': False, 'skip_ns': self.judged.skip,
            'callbacks': self.usage.callbacks(),
            'undeclared': self.usage.undeclared(),
            'worker_use': self.usage.workers(head.workers),
            'dropped': dict(sorted(recording.dropped.items())),
            'messages_lost': recording.messages_lost,
            **guesses, 'misses': self.explanation.summary(),
            'paths': paths, **more,
            'recording': recording_result(recording),
            'warnings': self.warnings}

    def _dag_result(self, dag: Dag, counts: DagCounts) -> ReplayedDag:
        breakdown, first = self.chains.breakdown(), self.judged.tables.first_vertex[dag.index]
        places = {dag.vertices[local].name: first + local for local in dag.sinks}
        found: ReplayedDag = {
            'jobs': counts['jobs'], 'ends': counts['ends'], 'sinks': {
                name: {**sink, 'breakdown': breakdown.get(places[name]), 'slack_ns': slack(sink)}
                for name, sink in counts['sinks'].items()}}
        if self.recording.unjudged is not None:
            found['unjudged'] = self.recording.unjudged.get(dag.index, 0)
        return found


def _result_table(name: str) -> ResultTable | None:
    """Return the table of results with this name; None: it is a table of the recording."""
    from mddag_executor.analysis.result_table import result_tables
    tables = result_tables()
    if name not in tables and name not in TABLES:
        raise KeyError(
            f'there is no table {name!r}: the tables are {", ".join([*tables, *TABLES])}')
    return tables.get(name)


def slack(sink: SinkCounts) -> SlackTimes | None:
    """
    Return the slack of a sink: deadline minus completion, ns; negative for late jobs.

    99 % of the completions had at least the slack ``p1``.
    """
    response, deadline = sink['response_ns'], sink['relative_deadline_ns']
    if response is None:
        return None
    return {
        'min': deadline - response['max'], 'p1': deadline - response['p99'],
        'median': deadline - response['median'], 'max': deadline - response['min']}


def recording_result(recording: Recording) -> RecordedFile:
    """Return the part of a result that describes the trace."""
    run = recording.run
    found: RecordedFile = {
        'trace': run.name, 'declaration': run.head.file, 'start_ns': run.start,
        'end_ns': run.end}
    if run.messages is None:
        found.update({'shut_down': run.shut_down, 'lost': recording.missing.count('events')})
    else:
        found['messages'] = run.messages
    return found


def replay(
    path: Given, task_set: TaskSet | None = None, *, name: str | None = None,
    progress: Progress | None = None, skip: int = 0, span: tuple[int, int] | None = None,
) -> Replay:
    """
    Replay a trace as recorded; see ``open_recording`` and ``Replay``.

    :param skip: warm-up time after the first release; jobs released in it are not judged, ns.
    :param span: begin and end of the part to replay, ns after the start; see ``Recording.cut``.
    :raises mddag_executor.ReplayError: if it cannot be replayed, as an ordinary bag.
    """
    recording = open_recording(path, task_set, name, progress)
    if recording.run.messages is not None:
        raise ReplayError(recording.name, 'it is an ordinary bag, in which no callback ran',
                          'reschedule it')
    return Replay(recording if span is None else recording.cut(*span), skip)
