# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A recording in memory: what happened in a run, and whatever is missing of that."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

from mddag_executor.core import NEVER
from mddag_executor.recording import cut, frames
from mddag_executor.recording.columns import Ints, Mask, Places, Table
from mddag_executor.recording.head import ReplayError
from mddag_executor.recording.joins import different, distinct
from mddag_executor.recording.losses import Losses
from mddag_executor.recording.names import Names
from mddag_executor.recording.recorded_jobs import Jobs
from mddag_executor.recording.run import Run
from mddag_executor.recording.tables import Columns, UNKNOWN, WITHDRAWN
from msg_graph import TaskSet
import numpy as np


class Closed(NamedTuple):
    """
    When executions of one program in one process could not start: starts and ends.

    :ivar executions: of the program, or of the process and no program of one callback at a time.
    :ivar runs: of its executions that kept others waiting (``Recording.runs_of_programs``).
    :ivar gaps: between its spins; ``halts``: between those of the executor of the process.
    """

    executions: Mask
    runs: tuple[Ints, Ints]
    gaps: tuple[Ints, Ints]
    halts: tuple[Ints, Ints]

    @property
    def times(self) -> tuple[Ints, Ints]:
        """Return all of them; they may overlap."""
        starts, ends = map(np.concatenate, zip(self.runs, self.gaps, self.halts))
        return starts, ends


@dataclass(frozen=True, repr=False)
class Recording:
    """
    A recording in memory; it cannot be changed.

    :ivar run: the facts of the run.
    :ivar columns: its tables (``tables.TABLES``), which are also attributes of the recording.
    :ivar names: the nodes and callbacks that the tables refer to.
    :ivar missing: what it lacks.
    :ivar whole: the recording that it is a part of; None: it is a whole one.
    """

    run: Run
    columns: Columns = field(default_factory=Columns)
    names: Names = field(default_factory=Names)
    missing: Losses = field(default_factory=Losses)
    whole: Recording | None = None

    def __repr__(self) -> str:
        """Return one line: the name, and how much is recorded."""
        length = self.end - self.run.begin
        return (f'<Recording {self.name}: {length / 1e9:.3f} s, {len(self.releases)} jobs, '
                f'{len(self.executions)} executions>')

    @property
    def name(self) -> str:
        """Return its name in messages."""
        return self.run.name

    @property
    def task_set(self) -> TaskSet:
        """Return the DAG tasks that number DAGs and vertices."""
        return self.run.task_set

    @property
    def start(self) -> int | None:
        """Return the first release, or when the first execution became ready; None: neither."""
        return self.run.start

    @property
    def end(self) -> int:
        """Return the end of the run, ns."""
        return self.run.end

    @property
    def releases(self) -> Table:
        """Return the releases of jobs."""
        return self.columns.releases

    @property
    def executions(self) -> Table:
        """Return the executions of callbacks."""
        return self.columns.executions

    @property
    def publications(self) -> Table:
        """Return the publications of messages."""
        return self.columns.publications

    @property
    def job_ends(self) -> Table:
        """Return the early ends of jobs."""
        return self.columns.job_ends

    @property
    def stops(self) -> Table:
        """Return when the machine or process stood still."""
        return self.columns.stops

    @property
    def spin_gaps(self) -> Table:
        """Return when a program, or (program -1) the executor of a process, did not spin."""
        return self.columns.spin_gaps

    @property
    def takes(self) -> Table:
        """Return the messages that executions took."""
        return self.columns.takes

    @property
    def drops(self) -> Table:
        """Return the dropped executions."""
        return self.columns.drops

    @property
    def losses(self) -> Table:
        """Return the messages that the middleware lost."""
        return self.columns.losses

    @property
    def demotions(self) -> Table:
        """Return the demotions of sinks."""
        return self.columns.demotions

    @property
    def misses(self) -> Table:
        """Return the misses that the run itself noticed."""
        return self.columns.misses

    @property
    def unfinished(self) -> Table:
        """Return the executions that had not ended when the recording did."""
        return self.columns.unfinished

    @property
    def dropped(self) -> Counter[str]:
        """Return the number of dropped executions by reason."""
        counts = np.bincount(self.drops['reason'], minlength=len(self.names.drop_reasons))
        return Counter({
            name: n for name, n in zip(self.names.drop_reasons, counts.tolist()) if n})

    @property
    def messages_lost(self) -> dict[str, int]:
        """Return by callback the number of messages that the middleware lost."""
        counts: Counter[str] = Counter()
        for callback, count in zip(*(self.losses[each].tolist() for each in (
                'callback', 'count'))):
            counts[self.callback_name(callback)] += count
        return dict(counts)

    @property
    def guessed(self) -> dict[str, int]:
        """Return by sync the number of results of which the driving message is a guess."""
        vertex, count = np.unique(
            self.executions['vertex'][self.executions['guessed']], return_counts=True)
        return {self.task_set.vertices[v].callback.key: n for v, n in zip(
            vertex.tolist(), count.tolist()) if v >= 0}

    @property
    def unjudged(self) -> dict[int, int] | None:
        """
        Return by DAG the number of withdrawn jobs.

        None: the run has no links, so that no job can be withdrawn.
        """
        if not self.run.links:
            return None
        ends, released = self.job_ends, self.releases['release']
        begin, end = self.run.judged_releases or (-NEVER, NEVER)
        begin = max(begin, self.run.judge_from)
        judged = self.jobs.marked((released >= begin) & (released < end))[self.jobs.places(ends)]
        dags, counts = np.unique(
            ends['dag'][judged & (ends['reason'] == WITHDRAWN)], return_counts=True)
        return dict(zip(dags.tolist(), counts.tolist()))

    @cached_property
    def jobs(self) -> Jobs:
        """Return the jobs."""
        return Jobs(len(self.task_set.dags), self.releases)

    @cached_property
    def job_places(self) -> Places:
        """Return by execution the place of its job in ``jobs``; -1: none."""
        return self.jobs.places(self.executions)

    @cached_property
    def own_executions(self) -> Mask:
        """Return by execution whether this executor ran it."""
        process, of = self.executions['process'], self.run.own_processes
        own: Mask = np.isin(process, [*of]) if self.run.imported else np.ones(
            len(process), dtype=np.bool_)
        return own

    def runs_of_programs(self) -> dict[int, Table]:
        """
        Return by program that runs one callback at a time its executions that kept others waiting.

        Others run while a callback waits in a call or a spin of its own, so an execution in which
        another one of its program began is left out.
        """
        if not self.names.programs:
            return {}
        table, program = self.executions, self.programs_of_executions
        rows = np.flatnonzero((program >= 0) & (table['worker'] >= 0))
        found = {}
        for number in np.unique(program[rows]).tolist():
            mine = table[rows[program[rows] == number]]
            mine = mine[mine['start'].argsort(kind='stable')]
            found[number] = mine[np.r_[mine['start'][1:] >= mine['end'][:-1], True]]
        return found

    def closed_times(self) -> Iterator[Closed]:
        """Yield by program and process when executions could not start; each is in at most one."""
        gaps, of = self.spin_gaps, self.programs_of_executions
        if not self.names.programs and not len(gaps):
            return
        runs, process = self.runs_of_programs(), self.executions['process']
        for place in distinct(process).tolist():
            of_place = process == place
            halts = gaps[(gaps['program'] == -1) & (gaps['process'] == place)]
            for number in distinct(of[of_place]).tolist():
                ran = runs.get(number, self.executions[:0])
                between = gaps[(gaps['program'] == number) & (number >= 0)]
                if len(ran) or len(between) or len(halts):
                    yield Closed(of_place & (of == number), *(
                        (each['start'], each['end']) for each in (ran, between, halts)))

    def exclusive_groups(self) -> dict[int, int]:
        """
        Return by callback a number that it shares with those that never run while it does.

        These are those of its program, if that runs one callback at a time; else those of its
        callback group (-1: a reentrant one).  A program in which a callback ran while another one
        waited (a coroutine, or in a call or a spin of its own) is left out.
        """
        groups, programs = self.names.groups, self.names.programs
        if not programs:
            return groups
        table, program = self.executions, self.programs_of_executions
        ran = np.bincount(program[(program >= 0) & (table['worker'] >= 0)])
        let_others = {*program[table['piece'] > 0].tolist(), *(
            number for number, runs in self.runs_of_programs().items()
            if len(runs) < ran[number])}
        first = 1 + max(groups.values(), default=0)
        return {**groups, **{callback: first + program for callback, program in programs.items()
                             if program not in let_others}}

    def callbacks(self) -> tuple[Ints, Ints]:
        """Return the numbers of the callbacks that ran, and by execution the callback's index."""
        return self._callbacks

    def vertices_of_callbacks(self, which: Any = slice(None)) -> Ints:
        """Return by index of a callback the vertex it ran as last (in ``which``); -1: none."""
        numbers, index = self.callbacks()
        vertex, index = self.executions['vertex'][which], index[which]
        found = np.full(len(numbers), UNKNOWN)
        declared = vertex >= 0
        found[index[declared]] = vertex[declared]
        return found

    def callback_name(self, number: int) -> str:
        """Return the declared name of a callback, otherwise its node and trigger."""
        return self._keys.get(number) or self.names.name(number)

    def labels(self, numbers: Ints) -> tuple[list[str], Ints]:
        """
        Return the names of callbacks, sorted, and by callback the place of its name.

        A timer that was made again has the name of the first one.
        """
        names, places = np.unique(np.array(
            [self.names.name(number) for number in numbers.tolist()], dtype=np.str_),
            return_inverse=True)
        return names.tolist(), places

    @cached_property
    def programs_of_executions(self) -> Ints:
        """Return by execution its program, if that runs one callback at a time; else -1."""
        numbers, index = self.callbacks()
        of = self.names.programs
        return np.array([of.get(each, -1) for each in numbers.tolist()], dtype=np.int64)[index]

    @cached_property
    def _callbacks(self) -> tuple[Ints, Ints]:
        return different(self.executions['callback'])

    @cached_property
    def _keys(self) -> dict[int, str]:
        """Return by declared callback that ran its name."""
        numbers, _ = self.callbacks()
        return {each: self.task_set.vertices[vertex].callback.key for each, vertex in zip(
            numbers.tolist(), self.vertices_of_callbacks().tolist()) if vertex >= 0}

    def cut(self, begin: int, end: int) -> Recording:
        """
        Return a time range; see ``recording.cut``.

        :param begin: begin of the range, ns after the start of the recording; ``end``: likewise.
        :raises ValueError: if the range is empty or begins before the recording.
        :raises mddag_executor.ReplayError: if it begins after the recording.
        """
        if not 0 <= begin < end:
            raise ValueError(f'from {begin} to {end} ns is not a range of time')
        if self.start is None:      # empty recording
            return self
        if begin > self.end - self.start:
            raise ReplayError(
                self.name, f'it ends {(self.end - self.start) / 1e9:.3f} s after its first '
                'release', 'give an earlier time')
        begin, end = self.start + begin, self.start + end
        columns, until = cut.part(
            self.columns, self.run, self.jobs, self.job_places, begin, end)
        return replace(
            self, columns=columns, whole=self.whole or self, run=replace(
                self.run, start=begin, end=until, judged_releases=(begin, end)))

    def to_arrow(self, name: str) -> Any:
        """Return one of ``TABLES`` as an Arrow table, with names instead of numbers."""
        return frames.arrow_table(self.columns, name, self.name, self._words)

    def to_pandas(self, name: str) -> Any:
        """Return one of ``TABLES`` as a pandas data frame, with names instead of numbers."""
        return frames.frame_of(self.to_arrow(name))

    @cached_property
    def _words(self) -> frames.Words:
        """Return the names that data frames have instead of numbers."""
        publishers = self.names.publishers
        return frames.Words(
            [dag.name for dag in self.task_set.dags],
            [vertex.name for vertex in self.task_set.vertices], self.names.drop_reasons,
            self.names.places, self.callback_name, lambda number: publishers[number].topic
            if number in publishers else 'unknown')
