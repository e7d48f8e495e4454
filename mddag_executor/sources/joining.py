# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Joins the traces of several processes of a declared run into one recording.

Theory of operation
-------------------
Each trace becomes a recording; their tables are merged in the order of time.

1. *Clocks.*  A trace's times are the machine's steady clock plus a recorded offset
   (``caret_init``).  So all traces of one machine are converted exactly to the first trace's
   clock. For other machines the offset is given or estimated from messages (``clocks``), otherwise
   0.
2. *Numbers.*  Addresses are unique within a process; the number of the trace is added above their
   48 bits.  Workers are numbered consecutively.  A process or thread id that another trace
   also uses (containers, other machines) is replaced by an unused one.
3. *Jobs* (``joined_jobs``) are renumbered in the order of their first release.  Releases of two
   processes belong to the same job if they are equal within ``SAME_RELEASE``: releases of a burst
   are closer, so the nearest one counts, of equally near ones the oldest.  If header stamps join
   the jobs of a DAG, a release also belongs to the job that was released up to one period of the
   DAG earlier: the stamp is later than the timer was due.  Any other release is a new job.  A
   stamp is a time of the source machine's clock, no matter which machine recorded it.
4. If several processes run a DAG, the vertices of all of them are expected.  Jobs are judged as
   soon as all processes that existed at the beginning judge.
5. A process without recorded end was killed.  Its open jobs are reported, and the run continues.
6. *One run.*  Traces belong to one run if their time ranges, from first to last event, overlap
   directly or through other traces, and no vertex runs in two processes at a time.  Otherwise they
   are refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
import os
from typing import Any

from mddag_executor.core import NEVER
from mddag_executor.errors import UsageError
from mddag_executor.recording.columns import concatenate, Ints, Mask, Table
from mddag_executor.recording.head import Head, ReplayError
from mddag_executor.recording.joins import different, RowNumbers, sort_by
from mddag_executor.recording.losses import Loss, Losses
from mddag_executor.recording.names import Names
from mddag_executor.recording.recorded_jobs import Jobs
from mddag_executor.recording.recording import Recording
from mddag_executor.recording.run import Run
from mddag_executor.recording.tables import ALL_LEGS, Columns, NOTHING, TABLES, UNKNOWN
from mddag_executor.sources import clocks
from mddag_executor.sources.entities import Entities
from mddag_executor.sources.executions import Numbering
from mddag_executor.sources.head import declared, no_run, read_head
from mddag_executor.sources.joined_jobs import JoinedJobs, Released
from mddag_executor.sources.own import begin_of, end_losses, Read, read_process
from mddag_executor.sources.progress import Progress, progress_from
from mddag_executor.text import counted, listed
from mddag_executor.trace import TraceReader
from mddag_executor.trace.numbers import Numbers
from mddag_executor.trace.schema import EVENTS
from msg_graph import Process, TaskSet
import numpy as np

_BITS = 48
_NO_ADDRESSES = {'queue_depth', 'message_timestamp'}
_TIMES = {
    'releases': ('release', 'noticed'),
    'executions': ('ready', 'began', 'start', 'end', 'inherited'),
    'publications': ('time', 'source_timestamp'), 'job_ends': ('time',),
    'drops': ('time',), 'losses': ('time',), 'demotions': ('time',),
    'misses': ('deadline', 'completed'), 'stops': ('start', 'end'), 'unfinished': ('start',),
    'spin_gaps': ('start', 'end')}
_HAPPENED = {
    'releases': 'noticed', 'executions': 'end', 'publications': 'time', 'job_ends': 'time',
    'drops': 'time', 'demotions': 'time', 'stops': 'end'}

Event = tuple[Any, ...]


def label_of(path: str) -> str:
    """Return the name of a trace's process: `up` of `run.up.mcap`, `up.2` of `run.up.2.mcap`."""
    rest, _, word = os.path.basename(path).removesuffix('.mcap').rpartition('.')
    return f'{rest.rpartition(".")[2]}.{word}' if rest and word.isdecimal() else word


class _Part:
    """
    One trace: the position of its times, workers and addresses in the joined recording.

    :ivar ran: by vertex the time of its first and last execution.
    :ivar number: by release the number of its job; ``is_first``: whether no other process released
        it before; ``expected``: the number of legs to complete here.
    :ivar open_jobs: DAGs and numbers of the jobs that are open at the end.
    """

    ran: dict[int, tuple[int, int]]
    number: Ints
    is_first: Mask
    expected: Ints
    open_jobs: list[tuple[int, int]]
    found: Read
    seen_at: Ints

    def __init__(self, place: int, path: str, first_worker: int) -> None:
        self.place, self.name, self.first_worker = place, path, first_worker
        self.reader = TraceReader(path)
        head = read_head(self.reader)
        if head is None:
            raise no_run(self.reader)
        self.head: Head = head
        self.shift = self.last = 0
        self.label = label_of(path)

    @property
    def first(self) -> int:
        """Return the time of its first event, by the joined clock."""
        return self.head.time + self.shift

    def read(
        self, task_set: TaskSet, who: Entities, threads: Numbers, workers: int, count: int,
        progress: Progress | None,
    ) -> None:
        """Read its tables, with joined addresses and ``workers`` (rule 2), by its own clock."""
        found = self.found = read_process(
            self.reader, self.name, self.head, task_set, who, self._edited,
            progress_from(progress, count))
        tables = found.tables
        self.seen_at = found.seen_at
        for addresses in (
                tables['executions']['callback'], tables['losses']['callback'],
                tables['unfinished']['callback'], tables['drops']['callback'],
                tables['publications']['publisher']):
            addresses[(addresses > 0) & (addresses < 1 << _BITS)] |= self.place << _BITS
        worker = tables['executions']['worker']
        # other threads, with higher numbers, lent themselves
        worker += np.where(worker < 0, 0, self.first_worker + np.where(
            worker < self.head.workers, 0, workers)).astype(worker.dtype)
        thread = tables['executions']['thread']
        numbers, of = different(thread)
        thread[:] = np.array([threads.of(self.place, each) for each in numbers.tolist()],
                             dtype=np.int64)[of]

    def move(self, names: Names) -> None:
        """Convert its times, and those of its callbacks, to the joined clock (rule 1)."""
        tables = self.found.tables
        if self.shift:
            for callback in names.callbacks:
                place = callback.address[1] >> _BITS if callback.address is not None else -1
                if place == self.place and callback.gone is not None:
                    callback.gone += self.shift
            self.seen_at = self.seen_at + self.shift
            for name, columns in _TIMES.items():
                for column in columns:
                    times = tables[name][column]
                    tables[name].replace(column, np.where(times > 0, times + self.shift, times))
        self.last = max(self.first, int(self.seen_at.max(initial=0)), *(
            int(tables[name][column].max(initial=0))
            for name, column in _HAPPENED.items()))

    def _edited(self, event: Event) -> Event:
        """Return an event of the initialisation with joined addresses."""
        kinds = EVENTS[event[0]].fields
        return (*event[:4], *(
            value | self.place << _BITS if kind == 'uint64' and field not in _NO_ADDRESSES
            and 0 < value < 1 << _BITS else value
            for value, (field, kind) in zip(event[4:], kinds)))

    def renumber(self, legs: Ints, dag_of: Ints) -> RowNumbers:
        """
        Renumber the jobs in all tables; drop rows of unknown jobs.

        :param legs: by vertex the number of its legs; ``dag_of``: its DAG, at the end -1.
        :return: the new numbers of executions.
        """
        tables = self.found.tables
        releases = tables['releases']
        jobs = Jobs(len(self.found.run.task_set.dags), releases)
        rows = np.append(jobs.rows, UNKNOWN)
        table = tables['executions']
        row = rows[jobs.places(table)]
        kept = (row >= 0) | (table['vertex'] < 0)
        done = np.flatnonzero((table['completes'] != NOTHING) & (row >= 0))
        is_open = self.expected > np.bincount(row[done], np.where(
            table['leg'][done] == ALL_LEGS, legs[table['vertex'][done]], 1),
            minlength=len(self.number))
        ended = rows[jobs.places(tables['job_ends'])]
        is_open[ended[ended >= 0]] = False
        self.open_jobs = list(zip(
            releases['dag'][is_open].tolist(), self.number[is_open].tolist()))
        started = (row >= 0) & (table['vertex'] >= 0) & (table['start'] >= 0)
        self._note_ran(table, started, len(legs))
        known = row >= 0
        table['job'][known] = self.number[row[known]]
        for name in ('job_ends', 'misses', 'demotions'):
            table = tables[name]
            row = rows[jobs.places(table)]
            table['job'] = self.number[row] if len(self.number) else UNKNOWN
            tables[name] = table[row >= 0]
        drops = tables['drops']     # those of unknown jobs are still counted
        row = rows[jobs.places_of(dag_of[drops['vertex']], drops['job'])]
        drops['job'] = np.append(self.number, UNKNOWN)[row]
        new = RowNumbers(kept)
        if not kept.all():
            tables['executions'] = tables['executions'][kept]
        releases['job'] = self.number
        tables['releases'] = releases[self.is_first]
        return new

    def _note_ran(self, table: Table, started: Mask, n_vertices: int) -> None:
        """Note the first and last execution of vertices, of those that started."""
        vertex, start = table['vertex'][started], table['start'][started]
        first, last = np.full(n_vertices, NEVER), np.full(n_vertices, UNKNOWN)
        np.minimum.at(first, vertex, start)
        np.maximum.at(last, vertex, start)
        self.ran = {each: (int(first[each]), int(last[each]))
                    for each in sort_by(first).tolist() if last[each] >= 0}


class Joined:
    """
    Joins traces of this executor.

    :param offsets: how far clocks of other machines are ahead of the first trace's clock, ns, by
        the last word of a trace's name, or its path.
    :raises mddag_executor.trace.TraceError: if a file is not a trace.
    :raises ReplayError: if the traces are of several runs.
    """

    def __init__(self, paths: Sequence[str], offsets: Mapping[str, int]) -> None:
        self._parts: list[_Part] = []
        self._workers = 0
        for place, path in enumerate(paths):
            self._parts.append(_Part(place, path, self._workers))
            self._workers += self._parts[-1].head.workers
        first = self._parts[0]
        self.head, self.name = first.head, ', '.join(paths)
        self.task_set = declared(first.head, first.name)
        self.losses: list[Loss] = []
        for part in self._parts:
            if part.head.yaml != self.head.yaml:
                raise ReplayError(
                    part.name, f'it was recorded with another declaration than {first.name}',
                    'give the traces of one run')
        self._offsets = offsets
        #: By vertex the number of its legs, and its DAG.
        self._legs = Numbering(self.task_set).n_legs
        self._dag_of = np.array([
            *(dag.index for dag in self.task_set.dags for _ in dag.vertices), UNKNOWN])

    def _given(self, offsets: Mapping[str, int]) -> dict[int, int]:
        """Return the given offsets, by machine."""
        found: dict[int, int] = {}
        for label, ahead in offsets.items():
            machine = next(
                (m for m, part in zip(self._machines, self._parts)
                 if label in (part.name, part.label)), None)
            if machine is None:
                raise UsageError(f'--offset: there is no trace of {label}: name one of '
                                 + listed([part.label for part in self._parts]))
            if machine == 0:
                raise UsageError(f"--offset: {label} is on the first trace's machine, whose clock "
                                 'the others are compared with: name a process of another one')
            if machine in found:
                raise UsageError(f'--offset: {label} is on a machine whose offset is given '
                                 'already: give one for each machine')
            found[machine] = ahead
        return found

    def _set_clocks(self) -> None:
        """Convert all traces to the first trace's clock (rule 1)."""
        stated = [part.found.stated for part in self._parts]
        self._machines = clocks.machines([(each.boot, each.clock) for each in stated])
        given = self._given(self._offsets)
        several = set(self._machines) - {0}
        for part, machine in zip(self._parts, self._machines):
            part.shift = stated[machine].clock - part.found.stated.clock
        ways: clocks.Ways = {}
        if several - given.keys():
            ways = clocks.ways(
                [clocks.Messages(part.reader) for part in self._parts], self._machines,
                [part.shift for part in self._parts])
        known = clocks.offsets(several, ways, given)
        for machine in sorted(several):
            parts = [p for p, m in zip(self._parts, self._machines) if m == machine]
            for part in parts:
                part.shift -= known[machine].ahead if machine in known else 0
            if machine not in given:
                self.losses.append(Loss('clock', 1, (
                    f'{", ".join(part.name for part in parts)}: recorded on another machine than '
                    f'{self._parts[0].name}: '
                    + clocks.said(known.get(machine), ways.get((0, machine)), parts[0].label))))

    def recording(self, progress: Progress | None = None) -> Recording:
        """
        Return the recording of the whole run.

        :param progress: called regularly with the number of events read.
        :raises mddag_executor.trace.TraceError: if a trace cannot be read.
        :raises ReplayError: if the traces are of several runs.
        """
        who, threads, count = Entities(by_address=True), Numbers(), 0
        for part in self._parts:
            part.read(self.task_set, who, threads, self._workers, count, progress)
            count += part.reader.message_count or 0
        self._set_clocks()
        for part in self._parts:
            part.move(who.names)
        hosted = self._number_jobs()
        rows = [part.renumber(self._legs, self._dag_of) for part in self._parts]
        self._check_run()
        head = self.head._replace(
            time=min(part.first for part in self._parts), workers=self._workers)
        ranks = self._ranks()
        tables, reasons, places = self._join(ranks, rows)
        run = self._with_end(Run(
            self.name, head, self.task_set, self.task_set, same=False,
            processes=len(self._parts), placed=self._placed(),
            workers_each=max(part.head.workers for part in self._parts),
            own_processes={part.place: part.head.workers for part in self._parts},
            hosted=[(int(ranks[place][order]), dag, vertices)
                    for place, order, dag, vertices in hosted]), tables['executions'])
        run = replace(run, start=begin_of(tables['releases'], tables['executions']))
        lost = sum(part.found.lost for part in self._parts)
        return Recording(
            run, Columns(**tables), replace(
                who.names, drop_reasons=reasons, places=places,
                process_names=tuple(part.label for part in self._parts),
                # the last word of the trace's name
                workers=[f'{part.label} {worker}' for part in self._parts
                         for worker in range(part.head.workers)]),
            Losses((*self.losses, *self._lost(run.end),
                    *end_losses(run, len(tables['releases']), lost))))

    def _join(
        self, ranks: Sequence[Ints], rows: Sequence[RowNumbers]
    ) -> tuple[dict[str, Table], Sequence[str], Sequence[str]]:
        """
        Return the merged tables of all traces, the reasons of drops, and the unfinished's places.

        :param rows: by part the new numbers of executions.
        """
        parts = self._parts
        before = 0
        reasons: dict[str, int] = {}
        places: dict[str, int] = {}
        for part, rank in zip(parts, ranks):
            of = part.found.tables
            by = rows[part.place].new(of['publications']['execution'])
            of['publications']['execution'] = np.where(by >= 0, by + before, UNKNOWN)
            before += len(of['executions'])
            for table in (of['releases'], of['executions'], of['job_ends']):
                known = table['order'] >= 0
                table['order'][known] = rank[table['order'][known]]
            for values, numbers, names in (
                    (of['drops']['reason'], reasons, part.found.drop_reasons),
                    (of['unfinished']['where'], places, part.found.places)):
                values[:] = np.array([
                    numbers.setdefault(each, len(numbers)) for each in names] or [0])[values]
            for table in of.values():
                if 'process' in table.names:
                    table['process'] = part.place
        found = {}
        for name in TABLES:
            found[name] = concatenate([part.found.tables.pop(name) for part in parts])
        for name, column in (('releases', 'order'), ('publications', 'time')):
            found[name] = found[name][sort_by(found[name][column])]
        return found, tuple(reasons), tuple(places)

    def _ranks(self) -> list[Ints]:
        """Return by part the joined positions of its positions in the order; 0 is before all."""
        times = np.concatenate([part.seen_at for part in self._parts])
        rank = np.empty(len(times), dtype=np.int64)
        rank[np.argsort(times, kind='stable')] = np.arange(1, len(times) + 1)
        return np.split(rank, np.cumsum([len(part.seen_at) for part in self._parts])[:-1])

    def _with_end(self, run: Run, executions: Table) -> Run:
        """Return the run with the times at which judging begins and ends (rules 4 and 5)."""
        labels = {part.label for part in self._parts}
        # without restarted processes, and those that have never judged
        judging = [part.found.stated.judges_from + part.shift for part in self._parts
                   if 0 < part.found.stated.judges_from < NEVER
                   and part.label.partition('.')[0] not in labels - {part.label}]
        if judging:
            run = replace(run, judge_from=max(judging))
        ends = [part.found.stated.end + part.shift for part in self._parts
                if part.found.stated.end is not None]
        end = max(int(part.seen_at.max(initial=0)) for part in self._parts)
        run = replace(run, end=min(end, NEVER - 1), judged_until=min(end, NEVER - 1))
        if ends:
            run = replace(run, end=max(max(part.last for part in self._parts), *ends),
                          judged_until=max(ends), shut_down=True)
        # a process may end before the others
        waited = (executions['end'] < 0) & (executions['worker'] < 0)
        executions['start'][waited] = executions['began'][waited] = run.end
        return run

    # --- jobs ------------------------------------------------------------------------------------

    def _number_jobs(self) -> list[tuple[int, int, int, frozenset[int]]]:
        """Assign numbers to jobs; return by change the vertices of all processes (``Hosted``)."""
        jobs = JoinedJobs(self.task_set, [
            Released(part.found.tables['releases'], part.seen_at, part.found.run.hosted, machine,
                     part.shift)
            for part, machine in zip(self._parts, self._machines)], self._legs)
        for part, numbered in zip(self._parts, jobs.numbered):
            part.number, part.is_first, part.expected = (
                numbered.number, numbered.is_first, numbered.expected)
            part.found.tables['releases']['release'] = np.where(
                part.is_first, numbered.release, part.found.tables['releases']['release'])
        return jobs.hosted

    def _check_run(self) -> None:
        """Refuse traces of several runs (rule 6)."""
        runs: list[list[_Part]] = []
        for part in sorted(self._parts, key=lambda part: part.first):
            if not runs or part.first > max(each.last for each in runs[-1]):
                runs.append([])
            for other in runs[-1]:
                for vertex, (first, last) in part.ran.items():
                    began, ended = other.ran.get(vertex, (0, -1))
                    if max(first, began) <= min(last, ended):
                        key = self.task_set.vertices[vertex].callback.key
                        raise ReplayError(
                            part.name, f'{key} ran in it and, at the same time, in {other.name}: '
                            'these are of two runs', 'give the traces of one')
            runs[-1].append(part)
        if len(runs) > 1:
            several = len(set(self._machines)) > 1
            raise ReplayError(
                runs[1][0].name, f'it is of another run than {runs[0][0].name}: no trace goes on '
                'from one to the other', 'give the traces of one run: ' + ', or '.join(
                    ' '.join(part.name for part in run) for run in runs)
                + several * ' (or --offset, if clocks of machines differed)')

    def _placed(self) -> list[Process]:
        """Return the nodes of each process."""
        if self.task_set.processes:
            return list(self.task_set.processes)
        return [
            Process(part.label, tuple(dict.fromkeys(
                self.task_set.vertices[vertex].callback.node for vertex in part.ran)))
            for part in self._parts]

    def _lost(self, end: int) -> Iterator[Loss]:
        """Yield missing data of each trace, and jobs that ended with its process (rule 5)."""
        for part in self._parts:
            yield from part.found.losses
            if part.found.stated.end is not None:
                continue
            jobs = [f'{self.task_set.dags[dag].name} {number}' for dag, number in part.open_jobs]
            yield Loss('end', 1, (
                f'{part.name}: its end is not recorded (the process was killed, or the trace is '
                f'cut): it ends {max(0, end - part.last) / 1e9:.3f} s before the run; '
                + (f'{counted(len(jobs), "job")} ended with it: {listed(jobs)}' if jobs
                   else 'no job was open in it')))
