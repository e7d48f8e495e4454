# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A run of several recordings that declared jobs do not join: undeclared or imported ones.

This executor ran and recorded some of the processes, or all of them, and LTTng recorded others.

Theory of operation
-------------------
The events of all recordings become those of one run, and messages say which execution belongs to
which job, as in an imported recording (``imported_jobs``).  The jobs that the executors of this
project have recorded end at the border of their process, so they are not used; what they recorded
of executions is (``declared_events``).

1. *Messages.*  LTTng records the source timestamp of a publication; a trace of this executor the
   one of each message that it takes, and when each publication began and ended.  So messages in
   both directions are found by their topics and source timestamps (``links``,
   ``undeclared_run``).  If LTTng has recorded no source timestamps, a warning names each topic
   whose messages are not found.
2. *Clocks.*  Times are those of the steady clock of the computer plus an offset, which LTTng and
   this executor read when they begin.  If both have recorded it, and the boot of the computer is
   the same, times of this executor are converted exactly to those of LTTng or, without LTTng, of
   the first trace.  The clocks of other
   computers are compared by messages (``imported_clocks``).  Source timestamps are of the system
   clock, so they are compared with recorded times before these are converted.
3. *Twice.*  If LTTng has also recorded a process of this executor, its events are left out: those
   of the executor's trace say more.  It is the same process if the computers are not known to
   differ, the process ids are equal, and a node is in both or, if LTTng has none of it, neither
   an execution.  Otherwise the process of this executor gets another id, as containers have ids
   of their own.
4. *Begin and end.*  Recordings begin and end at different times.  Jobs are judged from the first
   one on that had an execution in each recording, after the first release that its executor
   judges.  After the end of a recording, its events are missing like events that a tracer
   discards: jobs that need them are not judged.  If a process of this executor has recorded no
   end, it was killed, and the run goes on without it.  Recordings whose times do not overlap are
   of several runs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from mddag_executor.core import NEVER
from mddag_executor.recording.columns import concatenate, Ints, Mask, rows
from mddag_executor.recording.head import Head, is_declared, ReplayError
from mddag_executor.recording.joins import distinct, sort_by
from mddag_executor.recording.losses import Loss
from mddag_executor.recording.recording import Recording
from mddag_executor.recording.tables import FAILED, JOB_ENDS, NOTHING, UNKNOWN
from mddag_executor.sources.declared_events import DeclaredEvents
from mddag_executor.sources.entities import full_name
from mddag_executor.sources.head import damage, declared, named_errors, no_run, read_head, steps
from mddag_executor.sources.imported_events import (
    Events,
    KINDS,
    LOST,
    moved,
    OWN_KINDS,
    read_events,
    SHUTDOWN,
    START,
)
from mddag_executor.sources.imported_run import hosts_in, ImportedRun, OFF_THE_GRID
from mddag_executor.sources.joining import label_of
from mddag_executor.sources.progress import Progress, progress_from
from mddag_executor.sources.undeclared_run import CLOCK_STEP, UndeclaredRun
from mddag_executor.text import counted
from mddag_executor.trace import TraceReader
from mddag_executor.trace.events import Event
from mddag_executor.trace.numbers import Numbers
from mddag_executor.trace.schema import HOST
from msg_graph import TaskSet
import numpy as np

_CARET_INIT, _JUDGE_FROM, _NODE = (
    'ros2_caret:caret_init', 'mddag:judge_from', 'ros2:rcl_node_init')
_NO_EVENTS = 0      # of a gap in which a recording had ended


class _Clock(NamedTuple):
    """
    The clock of a process.

    :ivar boot: that of its computer, without its ways of writing; '': unknown.
    :ivar offset: from the steady clock of the computer to the recorded times, ns; 0: unknown.
    """

    boot: str
    offset: int


class _Recording:
    """
    One of the recordings.

    :ivar label: the name of its process, if this executor recorded it.
    :ivar judges_from: the first release that its executor judged, ns; 0: unknown.
    :ivar end: of what it shows, ns; None: it was killed.
    :ivar pids: its processes, by their numbers in the run.
    """

    def __init__(self, path: str) -> None:
        self.path, self.label = path, label_of(path)
        self.reader = TraceReader(path)
        self.head: Head | None = read_head(self.reader)
        self.judges_from = 0
        self.pids: frozenset[int] = frozenset()
        self.end: int | None = None
        self.steps: list[int] = []
        #: Places of the starts of executions that raised.
        self.failed: Ints = np.empty(0, dtype=np.int64)

    @property
    def is_own(self) -> bool:
        """Return whether this executor recorded it."""
        return self.head is not None

    def read(self, progress: Progress | None) -> Events:
        """Return its events, by its own clock and numbers; note from when until when it judges."""
        with named_errors(self.path, self.path):
            events = self._read_own(progress) if self.is_own else read_events(
                self.reader, KINDS, ImportedRun.others, progress)
        table = events.table
        if self.is_own and not len(table):
            raise ReplayError(self.path, 'there is nothing in it but its beginning',
                              'leave it out, or record the process again')
        if not len(table) or not self.is_own and any(
                event[0].name.startswith('mddag:') and event[0].name != HOST
                for event in events.others):
            raise no_run(self.reader)
        self.end = int(table['time'][-1])
        if self.is_own:
            judges = [_field(event, 'release') for event in events.others
                      if event[0].name == _JUDGE_FROM]
            self.judges_from = max([0, *(each for each in judges if each <= self.end)])
            ends = table['a'][table['kind'] == SHUTDOWN]
            self.end = int(ends[-1]) if len(ends) else None
            self.steps = [event[4] for event in events.others
                          if event[0].name == CLOCK_STEP and isinstance(event[4], int)]
        return events

    def _read_own(self, progress: Progress | None) -> Events:
        assert self.head is not None
        others = (*UndeclaredRun.others, HOST, _JUDGE_FROM)
        jobs = DeclaredEvents(declared(self.head, self.path)) if is_declared(self.head) else None
        events = read_events(self.reader, OWN_KINDS, others, progress, jobs)
        if jobs is not None:
            self.failed = jobs.fill(events.table)
        pids = {*(pid for pid, _ in events.threads), *(event[2] for event in events.others)}
        names = dict.fromkeys(events.threads, self.label)
        return events._replace(
            own=frozenset(pids), names={**names, **{(pid, pid): self.label for pid in pids}})

    def clocks(self, events: Events) -> dict[int, _Clock]:
        """Return the clocks of its processes, as far as they are known."""
        offsets = {
            event[2]: _field(event, 'clock_offset') for event in events.others
            if event[0].name == (_CARET_INIT if self.is_own else HOST)}
        hosts = hosts_in(events.others)
        return {pid: _Clock(_plain(hosts[pid][1]) if pid in hosts else '', offsets.get(pid, 0))
                for pid in {*offsets, *hosts}}


class MixedRun(UndeclaredRun):
    """
    A run of processes of this executor, and perhaps of others; ``read`` turns it into tables.

    :param paths: the traces of this executor's processes, and at most one imported recording.
    :param task_set: the declaration to judge by; None: the recorded one, if any.
    :raises mddag_executor.trace.TraceError: if a trace cannot be read.
    :raises ReplayError: if there are several imported recordings, or if traces were recorded with
        several declarations, and none is given.
    """

    odd = OFF_THE_GRID

    def __init__(
        self, paths: Sequence[str], task_set: TaskSet | None,
        progress: Progress | None = None,
    ) -> None:
        self._parts = [_Recording(path) for path in paths]
        imported = [part for part in self._parts if not part.is_own]
        if len(imported) > 1:
            raise ReplayError(
                imported[1].path, f'it is an imported recording, as {imported[0].path} is',
                "import all sessions of the run into one: 'mddag import ctf SESSION… -o OUT.mcap'")
        self._parts.sort(key=lambda part: part.is_own)
        self._other_run: ReplayError | None = None
        self._duplicates: list[str] = []
        self._unknown_clocks: list[str] = []
        self._workers_of: dict[int, int] = {}
        self._failed: Ints = np.empty(0, dtype=np.int64)
        super().__init__(
            self._parts[0].reader, ', '.join(paths), self._judge(task_set), None, progress)
        if self._other_run is not None and not self._joins_recordings():
            raise self._other_run
        heads = [part.head for part in self._parts if part.head is not None]
        self.head = self.head._replace(
            default_deadline=heads[0].default_deadline,
            file='' if task_set is not None else next((each.file for each in heads), ''))
        if len(heads) == len(self._parts):
            self.head = self.head._replace(
                policy=heads[0].policy,
                workers=max(self.head.workers, sum(each.workers for each in heads)))

    def _judge(self, given: TaskSet | None) -> TaskSet | None:
        """Return the declaration to judge by."""
        if given is not None:
            return given
        found: dict[str, _Recording] = {}
        for part in self._parts:
            if part.head is not None and is_declared(part.head):
                found.setdefault(part.head.yaml, part)
        if len(found) > 1:
            first, other, *_ = found.values()
            raise ReplayError(
                other.path, f'it was recorded with another declaration than {first.path}',
                'give the GRAPH of the whole system')
        for part in found.values():
            assert part.head is not None
            return declared(part.head, part.path)
        return None

    # --- events ----------------------------------------------------------------------------------

    def _read(self, progress: Progress | None) -> Events:
        several: list[Events] = []
        count = 0
        for part in self._parts:
            several.append(part.read(progress_from(progress, count)))
            count += part.reader.message_count or 0
        several = self._convert_clocks(self._without_duplicates(several))
        self._check_processes(several)
        self._check_run(several)
        return self._merge(several)

    def _check_processes(self, several: Sequence[Events]) -> None:
        """Refuse traces of one process that have the same nodes, as two copies of one have."""
        seen: dict[tuple[str, int, str], str] = {}
        for part, events in zip(self._parts, several):
            if not part.is_own:
                continue
            clocks = part.clocks(events)
            found = [(clocks[pid].boot if pid in clocks else '', pid, node)
                     for pid, nodes in _nodes(events).items() for node in sorted(nodes)]
            for each in found:
                if each in seen:
                    raise ReplayError(
                        part.path, f'it is of the same process as {seen[each]}: both have the '
                        f'node {each[2]}', 'give the trace of each process once')
            seen.update(dict.fromkeys(found, part.path))

    def _check_run(self, several: Sequence[Events]) -> None:
        """
        Refuse recordings of several runs: no recording goes on from one to the other.

        Clocks of several computers may differ by as much; then messages show that it is one run.
        """
        times = [events.table['time'] for events in several]
        ranges = sorted((int(each[0]), int(each[-1]), part.path)
                        for each, part in zip(times, self._parts))
        last = ranges[0][1]
        for begin, end, path in ranges[1:]:
            if begin > last:
                self._other_run = ReplayError(
                    path, f'it is of another run than {ranges[0][2]}: it begins '
                    f'{(begin - last) / 1e9:.3f} s after the end of the others',
                    'give the recordings of one run')
            last = max(last, end)
        boots = {each.boot for part, events in zip(self._parts, several)
                 for each in part.clocks(events).values()}
        if self._other_run is not None and ('' in boots or len(boots) < 2):
            raise self._other_run

    def _without_duplicates(self, several: list[Events]) -> list[Events]:
        """Leave out what is recorded twice (rule 3)."""
        if self._parts[0].is_own:
            return several
        imported, clocks = several[0], self._parts[0].clocks(several[0])
        table, threads = imported.table, np.array([pid for pid, _ in imported.threads])
        of = threads[table['thread']]
        runs = {*distinct(of[table['kind'] == START]).tolist()}
        nodes = _nodes(imported)
        out: set[int] = set()
        for part, events in zip(self._parts[1:], several[1:]):
            own = part.clocks(events)
            for pid in sorted(events.own):
                boots = {each[pid].boot for each in (clocks, own) if pid in each} - {''}
                mine = nodes.get(pid, set())
                is_same = bool(mine & _nodes(events).get(pid, set())) if mine else pid not in runs
                if pid not in threads or len(boots) > 1 or not is_same:
                    continue
                out.add(pid)
                self._duplicates.append(
                    f'{self._parts[0].path}: left out: '
                    f'{counted(int((of == pid).sum()), "event")} of process {pid}, because '
                    f'{part.path} has recorded it as well, and with its executions')
        if not out:
            return several
        kept = ~np.isin(of, [*out])
        if not kept.any():
            raise ReplayError(
                self._parts[0].path, 'all of its processes are in the other traces as well, with '
                'their executions', 'leave it out')
        return [imported._replace(
            table=table[kept], others=[e for e in imported.others if e[2] not in out]),
            *several[1:]]

    def _convert_clocks(self, several: list[Events]) -> list[Events]:
        """Convert times of this executor to those of the first recording (rule 2)."""
        known: dict[str, int] = {}
        found = []
        for part, events in zip(self._parts, several):
            shift = {}
            for pid, (boot, offset) in part.clocks(events).items():
                if not boot:
                    continue
                first = known.setdefault(boot, offset)
                if part.is_own and not first:
                    self._unknown_clocks.append(part.path)
                elif part.is_own and offset and first != offset:
                    shift[pid] = first - offset
            if shift:
                events = moved(events, shift)
                by = shift.get(min(events.own), 0)
                part.judges_from += by if part.judges_from else 0
                part.end = None if part.end is None else part.end + by
            found.append(events)
        return found

    def _merge(self, several: list[Events]) -> Events:
        """Return all events as those of one recording, with different ids of processes."""
        processes, tids = Numbers(), Numbers()
        threads: list[tuple[int, int]] = []
        recording_of: list[int] = []
        tables, others, names = [], list[Event](), dict[tuple[int, int], str]()
        own, shift = set[int](), dict[int, int]()
        failed, place = [self._failed], 0
        boots = {_plain(boot): boot for _, boot in hosts_in(several[0].others).values()}
        for number, (part, events) in enumerate(zip(self._parts, several)):
            new = [(processes.of(number, pid), tids.of(number, tid))
                   for pid, tid in events.threads]
            table = events.table.copy()
            table.replace('thread', table['thread'].astype(np.int64) + len(threads))
            table['place'] += place
            if part.is_own:
                failed.append(part.failed + place)
            place = int(table['place'].max(initial=place)) + 1
            threads += new
            recording_of += [number] * len(new)
            tables.append(table)
            for layout, time, pid, tid, *values in events.others:
                if part.is_own and layout.name in (_CARET_INIT, _JUDGE_FROM, CLOCK_STEP):
                    continue
                event = (layout, time, processes.of(number, pid), tids.of(number, tid), *values)
                # LTTng may write the same boot in another way
                for host, boot in hosts_in([event]).values():
                    event = (*event[:4], host, boots.get(_plain(boot), boot), *event[6:])
                others.append(event)
            names.update({(processes.of(number, pid), tids.of(number, tid)): name
                          for (pid, tid), name in events.names.items()})
            part.pids = frozenset(pid for pid, _ in new)
            own.update(processes.of(number, pid) for pid in events.own)
            if part.head is not None:
                self._workers_of.update(
                    (processes.of(number, pid), part.head.workers) for pid in events.own)
            shift.update({processes.of(number, pid): by for pid, by in events.shift.items()})
        self._failed = np.concatenate(failed)
        nowhere = 0, 0
        if nowhere not in threads:      # gaps are of no thread
            threads.append(nowhere)
            recording_of.append(UNKNOWN)
        self._recording_of = np.array(recording_of, dtype=np.int64)
        table = concatenate([*tables, self._gaps(tables, threads.index(nowhere))])
        return Events(
            table[sort_by(table['time'], table['place'])], threads,
            sorted(others, key=lambda event: event[1]),
            '; '.join(events.warning for events in several if events.warning), names,
            frozenset(own), shift)

    def _gaps(self, tables: Sequence[Any], thread: int) -> Any:
        """Return the times after the end of each recording as gaps in the events (rule 4)."""
        end = max(int(table['time'].max(initial=0)) for table in tables)
        since = [part.end for part in self._parts if part.end is not None and part.end < end]
        return rows(tables[0].dtype, len(since), time=end, thread=thread, kind=LOST,
                    a=_NO_EVENTS, b=since)

    # --- tables ----------------------------------------------------------------------------------

    def _completed(self, found: Recording) -> Recording:
        found = super()._completed(found)
        own = {number: self._workers_of[pid] for number, pid in enumerate(self._pids)
               if pid in self._workers_of}
        return self._with_failures(replace(found, run=replace(
            found.run, own_processes=own, judge_from=self._judge_from(found),
            shut_down=all(part.end is not None for part in self._parts))))

    def _judge_from(self, found: Recording) -> int:
        """Return the first release that is judged (rule 4)."""
        table, release = found.executions, found.releases['release']
        pids = np.array(self._pids, dtype=np.int64)[table['process']]
        jobs = found.job_places
        judged = []
        for part in self._parts:
            mine = np.flatnonzero(
                (jobs >= 0) & np.isin(pids, [*part.pids]))
            of = release[found.jobs.rows[jobs[mine]]]
            of = of[of >= part.judges_from]
            if len(of):
                judged.append(int(of.min()))
        return max(judged, default=-NEVER)

    def _with_failures(self, found: Recording) -> Recording:
        """Let jobs fail with executions that raised: these complete nothing."""
        runs, columns = self.links.runs, found.columns
        mine = np.flatnonzero(np.isin(self._events.table['place'][runs['at']], self._failed) & (
            columns.executions['completes'] != NOTHING))
        if not len(mine):
            return found
        table = columns.executions.copy()
        ends = concatenate([columns.job_ends, rows(
            JOB_ENDS, len(mine), time=table['end'][mine], reason=FAILED, **{name: table[name][mine]
            for name in ('process', 'dag', 'vertex', 'job', 'order')})])
        table['completes'][mine] = NOTHING
        return replace(found, columns=replace(
            columns, executions=table, job_ends=ends[sort_by(ends['order'])]))

    def _judged_until(self) -> int:
        return min([self.end, *(part.end for part in self._parts if part.end is not None)])

    # --- warnings --------------------------------------------------------------------------------

    def _damage(self) -> Iterator[Loss]:
        for part in self._parts:
            yield from damage(part.reader.warnings, part.path, part.path)
        for text in self._duplicates:
            yield Loss('duplicate', 1, text)
        for path in self._unknown_clocks:
            yield Loss('clock', 1, (
                f'{path}: {self._parts[0].path} does not say how its clock was read, so times '
                'between the two are off by what the system clock was changed: import it again'))
        for topic, sent, received in self._missing_topics():
            yield Loss('strange', received, (
                f'{self.name}: {topic} is not joined: {counted(received, "execution")} for '
                f'messages that {sent}'))

    def _joins_recordings(self) -> bool:
        """Return whether a message of one recording started an execution of another one."""
        runs = self.links.runs[self.links.runs['message'] >= 0]
        sent = self._events.table['thread'][self.links.messages['at'][runs['message']]]
        return bool((self._recording_of[sent] != self._recording_of[runs['thread']]).any())

    @property
    def _joined_executions(self) -> Mask:
        """Return which executions of one executor were started by a message of another one."""
        links = self.links
        sender = links.is_own[self._events.table['thread'][links.messages['at']]]
        crossed: Mask = (links.runs['message'] >= 0) & (
            np.append(sender, False)[links.runs['message']] != links.own_runs)
        return crossed

    def _missing_topics(self) -> Iterator[tuple[str, str, int]]:
        """Yield topics of which no message was found in the imported recording, and why not."""
        runs, messages, links, crossed = (
            self.links.runs, self.links.messages, self.links, self._joined_executions)
        topics = {number: topic for topic, number in links.topics.items()}
        start = np.array([links.topics.get(each.start, -1) if each.kind == 'subscription' else -1
                          for each in links.callbacks], dtype=np.int64)[runs['callback']]
        sender = links.is_own[self._events.table['thread'][messages['at']]]
        for by_own in (False, True):
            sent = sender == by_own
            for number in distinct(links.topic_of[sent]).tolist():
                of: Mask = (start == number) & (links.own_runs != by_own)
                if number not in topics or not topics[number] or not of.any() or (
                        crossed & of).any():
                    continue
                mine = sent & (links.topic_of == number)
                if not by_own and not messages['stamp'][mine].any():
                    why = ('LTTng recorded without source timestamps (CARET and ros2_tracing '
                           'record them from Jazzy on)')
                elif by_own and not runs['stamp'][of].any():
                    why = 'LTTng recorded as taken without source timestamps'
                else:
                    continue    # each of these is counted as one whose publication is unknown
                yield topics[number], why, int(of.sum())

    def _missing_end(self, found: Recording) -> Iterator[Loss]:
        for part in self._parts:
            yield from steps(part.path, part.steps)
            if part.is_own and part.end is None:
                yield Loss('end', 1, (
                    f'{part.path}: its end is not recorded (the process was killed, or the trace '
                    'is cut): the run goes on without it'))


def _field(event: Event, name: str) -> int:
    """Return a number of an event; 0: it has none."""
    value = dict(zip(event[0].fields, event[4:])).get(name)
    return value if isinstance(value, int) else 0


def _nodes(events: Events) -> dict[int, set[str]]:
    """Return the nodes of each process."""
    found: dict[int, set[str]] = {}
    for layout, _, pid, _, *values in events.others:
        if layout.name == _NODE:
            fields = dict(zip(layout.fields, values))
            found.setdefault(pid, set()).add(
                full_name(str(fields.get('namespace')), str(fields.get('node_name'))))
    return found


def _plain(boot: str) -> str:
    """Return the id of a boot without its ways of writing."""
    return boot.replace('-', '').lower()
