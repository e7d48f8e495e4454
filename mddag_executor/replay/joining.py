# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The traces of several processes as the trace of one run.

Theory of operation
-------------------
The joined trace has the events of all in the order of time, and is replayed like any other.

1. *Clocks.*  Each process counts its trace's time from the steady clock of the machine, by an
   offset that is recorded (``caret_init``).  So the times of one machine are put on the first
   trace's clock exactly; those of others by an offset that is given, or that messages show
   (``clocks``), else they are taken as they are.
2. *Who is who.*  Addresses, which are those of one process, get the number of the trace above
   their 48 bits; workers are counted through.  A process or thread with a number that another
   trace has already, as in containers or on another machine, gets a number of its own.
3. *Jobs* are numbered anew, in the order of their first release.  A release is that of a job that
   another process has released already if it is the same, to ``SAME_RELEASE``; of a DAG whose jobs
   header stamps join, also if it follows that within the DAG's period: the stamp is taken later
   than a timer is due.  What fits nothing is a job of its own.  A stamp is a time of the source's
   clock, wherever it is recorded.
4. Of a DAG that several run, those vertices are expected that are in any of the processes.  Jobs
   are judged from the time on from which all processes have judged that were there at first.
5. A process whose end is not recorded was killed.  Its open jobs are said, and the run goes on.
6. *One run.*  Traces are of one run if their times, from the first event to the last, overlap, or
   others' bridge them; but a vertex runs in one process at a time.  All else is refused.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
import heapq
import os
from typing import Any

from mddag_executor.core import legs_of, NEVER
from mddag_executor.errors import UsageError
from mddag_executor.recording.head import (
    declared,
    Head,
    is_declared,
    named_errors,
    read_head,
    ReplayError,
    TASK_SET,
)
from mddag_executor.replay import clocks
from mddag_executor.text import counted, listed
from mddag_executor.trace import TraceFile, TraceReader
from mddag_executor.trace.errors import renamed
from mddag_executor.trace.numbers import Numbers
from mddag_executor.trace.schema import EVENTS
from msg_graph import Dag, Process

SAME_RELEASE = 100_000
_KEPT = 1024
_BITS = 48
_INIT, _SHUTDOWN = 'ros2_caret:caret_init', 'mddag:shutdown'
_JUDGE_FROM, _HOSTED, _RELEASE = 'mddag:judge_from', 'mddag:hosted', 'mddag:job_release'
_COMPLETE, _DISPATCH = 'mddag:complete', 'mddag:dispatch'
_ENDS = ('mddag:expire', 'mddag:abort', 'mddag:fail')
_OF_DAG = ('mddag:deadline', 'mddag:drop', _DISPATCH, _COMPLETE, *_ENDS)
_TIMES = {'release', 'ready', 'reference_deadline', 'completed', 'deadline', 'begin', 'end'}
_NO_ADDRESSES = {'queue_depth', 'message_timestamp'}

Event = tuple[Any, ...]


def label_of(path: str) -> str:
    """Return the name of a trace's process: `up` of `run.up.mcap`, `up.2` of `run.up.2.mcap`."""
    rest, _, word = os.path.basename(path).removesuffix('.mcap').rpartition('.')
    return f'{rest.rpartition(".")[2]}.{word}' if rest and word.isdecimal() else word


def names_of(paths: Iterable[str]) -> set[str]:
    """Return what an offset may call traces: by their paths, or their processes."""
    return {name for path in paths for name in (path, label_of(path))}


class _Part:
    """One of the traces: where its times, workers and addresses are in the whole."""

    def __init__(self, place: int, path: str, name: str) -> None:
        self.place, self.name = place, name
        with named_errors(path, name):
            self.reader = TraceReader(path)
            head = read_head(self.reader)
            if head is None:
                raise ReplayError(
                    name, 'it was not recorded by this executor', 'replay it by itself')
            if not is_declared(head):
                raise ReplayError(
                    name, 'it was recorded without a declaration, so its jobs have no names that '
                    'other traces know', 'replay it by itself, with a GRAPH')
            self.head: Head = head
            self.clock = self.judges_from = 0
            self.end: int | None = None
            self.boot = ''
            for event in self.reader.events({_INIT, clocks.HOST, _SHUTDOWN, _JUDGE_FROM}):
                if None in event:
                    continue
                if event[0] == _INIT:
                    self.clock = event[4]
                elif event[0] == clocks.HOST:
                    self.boot = event[5]
                elif event[0] == _SHUTDOWN:
                    self.end = event[4]
                else:
                    self.judges_from = event[4]
        self.shift = 0
        self.label = label_of(name)
        # by DAG and vertex: when it ran first, and last
        self.ran: dict[tuple[int, int], tuple[int, int]] = {}
        self.first_worker = 0
        self.first_spare = 0
        self.last = 0
        # by DAG the vertices that are here, where not all are; by job what is to complete here
        self.hosted: dict[int, set[int]] = {}
        self.open: dict[tuple[int, int], int] = {}
        self.numbers: dict[tuple[int, int], int] = {}

    @property
    def first(self) -> int:
        """Return when it begins, by the clock of the whole."""
        return self.head.time + self.shift

    def events(self) -> Iterator[tuple[_Part, Event]]:
        """Yield itself with each event, by the clock and with the addresses of the whole."""
        edits = {}
        with named_errors(self.reader.path, self.name):
            for event in self.reader.events(set(EVENTS), sorted=True):
                if None in event:
                    continue
                if event[0] not in edits:
                    edits[event[0]] = self._edits(event[0])
                changed = list(event)
                changed[1] += self.shift
                for column, edit in edits[event[0]]:
                    changed[column] = edit(changed[column])
                self.last = changed[1]
                yield self, tuple(changed)

    def _edits(self, name: str) -> list[tuple[int, Callable[[int], int]]]:
        """Return which columns of an event change, and how."""
        found: list[tuple[int, Callable[[int], int]]] = []
        for column, (field, kind) in enumerate(EVENTS[name].fields, 4):
            if kind == 'uint64' and field not in _NO_ADDRESSES:
                found.append((column, self._address))
            elif kind == 'int64' and field in _TIMES and self.shift and name != _INIT:
                found.append((column, lambda time: time + self.shift if time > 0 else time))
            elif field == 'worker':
                found.append((column, self._worker))
        return found

    def _address(self, address: int) -> int:
        return address | self.place << _BITS if 0 < address < 1 << _BITS else address

    def _worker(self, worker: int) -> int:
        if worker < 0:      # it was lent
            return worker
        if worker < self.head.workers:
            return self.first_worker + worker
        return self.first_spare + worker


class Joined:
    """
    Joins traces of this executor.

    :param files: path of each, and what messages call it.
    :param offsets: how far clocks of other machines are ahead of the first trace's, ns, by the
        last word of a trace's name, or its path.
    :ivar warnings: what is to be said of them beside what the joined trace says, once written.
    :raises mddag_executor.trace.TraceError: when one is no trace.
    :raises ReplayError: when they are not of one run.
    """

    def __init__(
        self, files: Sequence[tuple[str, str]], offsets: Mapping[str, int],
    ) -> None:
        self._parts = [_Part(i, path, name) for i, (path, name) in enumerate(files)]
        first = self._parts[0]
        self.head, self.name = first.head, ', '.join(part.name for part in self._parts)
        self.task_set = declared(first.head, first.name)
        self.warnings: list[str] = []
        workers = spare = 0
        for part in self._parts:
            if part.head.yaml != self.head.yaml:
                raise ReplayError(
                    part.name, f'it was recorded with another declaration than {first.name}',
                    'give the traces of one run')
            part.first_worker = workers
            workers += part.head.workers
        for part in self._parts:
            part.first_spare = workers + spare
            spare += part.head.workers
        self._machines = clocks.machines([(part.boot, part.clock) for part in self._parts])
        self._set_clocks(self._given(offsets))
        self._workers = workers
        #: How many workers each process has, at most.
        self.workers_each = max(part.head.workers for part in self._parts)
        #: Which worker is of which process: by the last word of its trace's name.
        self.worker_names = [
            f'{part.label} {worker}' for part in self._parts
            for worker in range(part.head.workers)]
        # of each DAG: releases with their numbers, and in which parts they have been seen
        self._releases: list[deque[tuple[int, int, set[int]]]] = [
            deque(maxlen=_KEPT) for _ in self.task_set.dags]
        self._next = [0] * len(self.task_set.dags)
        self._legs = [[max(1, len(legs_of(v, dag.vertices))) for v in dag.vertices]
                      for dag in self.task_set.dags]

    def _given(self, offsets: Mapping[str, int]) -> dict[int, int]:
        """Return the offsets that are given, by machine."""
        found: dict[int, int] = {}
        for label, ahead in offsets.items():
            machine = next(
                (m for m, part in zip(self._machines, self._parts) if label in names_of(
                    [part.name])), None)
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

    def _set_clocks(self, given: Mapping[int, int]) -> None:
        """Put all on the first trace's clock (rule 1)."""
        several = set(self._machines) - {0}
        for part, machine in zip(self._parts, self._machines):
            part.shift = self._parts[machine].clock - part.clock
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
                self.warnings.append(
                    f'{", ".join(part.name for part in parts)}: recorded on another machine than '
                    f'{self._parts[0].name}: '
                    + clocks.said(known.get(machine), ways.get((0, machine)), parts[0].label))

    def write(self, path: str | os.PathLike[str]) -> None:
        """
        Write the joined trace.

        :raises mddag_executor.trace.TraceError: when that cannot be, or one cannot be read.
        :raises ReplayError: when they are of several runs.
        """
        head = self.head
        begin = min(part.first for part in self._parts)
        judges_from = max(self._judging(), default=0)
        end = judged = 0
        processes, threads = Numbers(), Numbers()
        with TraceFile(path) as file:
            file.add(TASK_SET, begin, 0, 0, head.yaml, head.file, head.policy, self._workers,
                     head.default_deadline, head.max_active_jobs, head.preemptive, head.cpus)
            file.add(_INIT, begin, 0, 0, self._parts[0].clock, 'jazzy')
            if judges_from:
                file.add(_JUDGE_FROM, begin, 0, 0, judges_from)
            streams = [part.events() for part in self._parts]
            for part, event in heapq.merge(*streams, key=lambda each: int(each[1][1])):
                if event[0] == _SHUTDOWN:
                    judged = max(judged, event[4])
                elif event[0] not in (TASK_SET, _INIT, _JUDGE_FROM, clocks.HOST):
                    joined = self._of_whole_run(part, event)
                    if joined is not None:
                        end = max(end, event[1])
                        name, time, process, thread, *fields = joined
                        file.add(name, time, processes.of(part.place, process),
                                 threads.of(part.place, thread), *fields)
            if any(part.end is not None for part in self._parts):
                file.add(_SHUTDOWN, max(end, judged), 0, 0, judged)
        self._check_run()
        self._say(max(end, judged))

    def _check_run(self) -> None:
        """Refuse what several runs have left (rule 6)."""
        runs: list[list[_Part]] = []
        for part in sorted(self._parts, key=lambda part: part.first):
            if not runs or part.first > max(each.last for each in runs[-1]):
                runs.append([])
            for other in runs[-1]:
                for (dag, vertex), (first, last) in part.ran.items():
                    began, ended = other.ran.get((dag, vertex), (0, -1))
                    if max(first, began) <= min(last, ended):
                        key = self.task_set.dags[dag].vertices[vertex].callback.key
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

    def _judging(self) -> Iterator[int]:
        """Yield from when on processes judge; not of one started again, or that never did."""
        labels = {part.label for part in self._parts}
        for part in self._parts:
            if 0 < part.judges_from < NEVER and part.label.partition('.')[0] not in labels - {
                    part.label}:
                yield part.judges_from + part.shift

    def placed(self) -> list[Process]:
        """Return which nodes ran in which process, once the joined trace is written."""
        if self.task_set.processes:
            return list(self.task_set.processes)
        return [
            Process(part.label, tuple(dict.fromkeys(
                self.task_set.dags[dag].vertices[vertex].callback.node
                for dag, vertex in part.ran)))
            for part in self._parts]

    def _of_whole_run(self, part: _Part, event: Event) -> Event | None:
        """Return an event as it is in the joined trace, None where it is not."""
        name = event[0]
        if name == _HOSTED:
            return self._hosted(part, event)
        if name == _RELEASE:
            return self._released(part, event)
        if name not in _OF_DAG:
            return event
        fields = [field for field, _ in EVENTS[name].fields]
        at_dag, at_job = 4 + fields.index('dag'), 4 + fields.index('job')
        number = part.numbers.get((event[at_dag], event[at_job]))
        if number is None:
            return event if event[at_dag] < 0 else None
        job = event[at_dag], number
        if name == _DISPATCH and 0 <= event[at_dag + 1] < len(self._legs[event[at_dag]]):
            what = event[at_dag], event[at_dag + 1]
            part.ran[what] = part.ran.get(what, (event[1],))[0], event[1]
        if name == _COMPLETE and job in part.open:
            part.open[job] -= 1
            if part.open[job] <= 0:
                del part.open[job]
        elif name in _ENDS:
            part.open.pop(job, None)
        return (*event[:at_job], number, *event[at_job + 1:])

    def _hosted(self, part: _Part, event: Event) -> Event | None:
        dag, text = event[4:6]
        if not 0 <= dag < len(self.task_set.dags):
            return event
        part.hosted[dag] = {int(word) for word in text.split(',') if word.isdecimal()}
        vertices = set().union(*(each.hosted.get(dag, ()) for each in self._parts))
        return (*event[:5], ','.join(map(str, sorted(vertices))))

    def _released(self, part: _Part, event: Event) -> Event | None:
        dag, job, release = event[4:7]
        if not 0 <= dag < len(self.task_set.dags):
            return event
        if release < event[1]:      # else that of a stamp which was still to come there
            release = self._by_source(self.task_set.dags[dag], release, part)
        found = self._find(self.task_set.dags[dag], release, part.place)
        joined = None
        if found is None:
            number = self._next[dag]
            self._next[dag] += 1
            self._releases[dag].append((release, number, {part.place}))
            joined = (*event[:5], number, release)
        else:
            number = found[1]
            found[2].add(part.place)
        part.numbers[dag, job] = number
        here = part.hosted.get(dag, range(len(self._legs[dag])))
        part.open[dag, number] = sum(self._legs[dag][v] for v in here if v < len(self._legs[dag]))
        return joined

    def _by_source(self, dag: Dag, release: int, part: _Part) -> int:
        """Return a release from a stamp of another machine, by the clock of that."""
        if dag.release_from != 'header_stamp' or dag.source in part.hosted.get(
                dag.index, (dag.source,)):
            return release
        machine, found = next(
            ((m, p) for m, p in zip(self._machines, self._parts)
             if dag.source in p.hosted.get(dag.index, ())), (0, part))
        if machine == self._machines[part.place]:
            return release
        return release - part.shift + found.shift

    def _find(self, dag: Dag, release: int, place: int) -> tuple[int, int, set[int]] | None:
        """Return the job of a release that another process has announced (rule 3)."""
        stamped = dag.release_from == 'header_stamp'
        best = None
        for known in reversed(self._releases[dag.index]):
            if place in known[2]:
                continue
            away = release - known[0]
            if abs(away) <= SAME_RELEASE:
                return known
            if stamped and best is None and 0 < away < dag.period_ns:
                best = known
            if away > dag.period_ns:
                break
        return best

    def _say(self, end: int) -> None:
        """Say what is missing of each trace, and what ended with its process (rule 5)."""
        for part in self._parts:
            self.warnings += [
                renamed(text, part.reader.path, part.name) for text in part.reader.warnings]
            if part.end is not None:
                continue
            jobs = [f'{self.task_set.dags[dag].name} {number}' for dag, number in part.open]
            self.warnings.append(
                f'{part.name}: its end is not recorded (the process was killed, or the trace is '
                f'cut): it ends {max(0, end - part.last) / 1e9:.3f} s before the run; '
                + (f'{counted(len(jobs), "job")} ended with it: {listed(jobs)}' if jobs
                   else 'no job was open in it'))
