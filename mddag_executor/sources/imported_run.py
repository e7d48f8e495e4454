# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
An imported recording: releases, executions, completions and ends of jobs as tables.

Theory of operation
-------------------
Nodes and callbacks are identified (``entities``) and matched with the declaration (``mapping``).
Executions are linked with messages (``links``), and assigned to jobs (``imported_jobs``).

1. *Releases.*  A timer is due at t_init + n * period.  rcl keeps this grid even if a timer is more
   than a period late: it skips the missed times.  The release of an execution is the last due time
   at its start.  `rcl_timer_init` is recorded shortly after the timer has read its clock, so an
   execution that starts up to `_SLACK_NS` before a due time also has that release, at its start;
   but if no execution has the due time before, and the next execution has this one, or few start
   so early, it was late.
   If t_init is unknown, or an earlier execution has the same release (the timer was reset, or
   uses another clock), the release is the start; a warning reports it. A subscription or service
   without publisher in the graph is released as declared: by header stamp, source timestamp, or
   the time at which its message was taken.
2. An execution has not ended if nothing followed it in its thread until the recording ended.
3. *Ready* is a timer's release, otherwise the source timestamp (within a process: the
   publication). Arrival at the reader is not recorded, so transport counts as waiting.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
import re

from mddag_executor.core import DEFAULT_DEADLINE_NS, NEVER
from mddag_executor.memory import give_back
from mddag_executor.recording.columns import Ints, Mask, rows, Table
from mddag_executor.recording.head import Head
from mddag_executor.recording.joins import different, distinct, earliest, groups, sort_by
from mddag_executor.recording.losses import Loss, Losses
from mddag_executor.recording.mapping import Matching
from mddag_executor.recording.recording import Recording
from mddag_executor.recording.run import Run
from mddag_executor.recording.tables import Columns, EXECUTIONS, PUBLICATIONS, TAKES, UNKNOWN
from mddag_executor.recording.timers import made_again
from mddag_executor.sources.entities import Entities, INIT_EVENTS
from mddag_executor.sources.executions import unfinished_rows
from mddag_executor.sources.head import damage, named_errors, no_jobs, no_run
from mddag_executor.sources.imported_clocks import ImportedClocks
from mddag_executor.sources.imported_events import (
    END,
    Events,
    KINDS,
    moved,
    read_events,
    START,
)
from mddag_executor.sources.imported_jobs import ImportedJobs, SKIPPED
from mddag_executor.sources.links import Links, Oddities
from mddag_executor.sources.progress import Progress
from mddag_executor.text import counted, listed
from mddag_executor.trace import TraceReader
from mddag_executor.trace.events import Event
from mddag_executor.trace.schema import DAMAGED, DISCARDED, HOST, MISSING
from mddag_executor.trace.times import credible
from msg_graph import Process, TaskSet
import numpy as np

LEAST_UNFINISHED_NS = 1_000_000_000
"""An execution whose end is not recorded, so long before that of the recording, has not ended."""
_SLACK_NS = 1_000_000
_OWN = ('mddag:job_release', 'mddag:dispatch')
_LOST = {
    DISCARDED: ('the tracer discarded {}', 'event'),
    MISSING: ('without {} of events, which the tracer has overwritten (flight recorder), or whose '
              'files were gone (rotated away) when it was imported', 'packet'),
    DAMAGED: ('damaged in {} of its files when it was imported', 'place')}
"""By cause what is missing, and what is counted."""
OFF_THE_GRID = {
    'off': ('execution', 'of timers off the grid of the period (reset, by another clock, or '
            'without initialisation in it): released when it started'),
    'skipped': ('period', 'of timers passed without an execution (late by more than one, '
                'or events were lost): without a job')}


class ImportedRun:
    """
    A run of another executor; ``read`` turns it into tables.

    :param reader: a trace without declaration.
    :param task_set: the declaration to judge by; None: none.
    :param head: head of a trace of this executor; None: another executor recorded it.
    :param progress: called regularly with the number of events read.
    """

    kinds = KINDS
    others: Sequence[str] = (*INIT_EVENTS, *_OWN, HOST)
    links_type = Links
    odd = OFF_THE_GRID
    #: What is missing if no cause is recorded, as before version 3, and what is counted.
    lost = 'the tracer discarded {} or more, or files were damaged', 'event'

    def __init__(
        self, reader: TraceReader, name: str, task_set: TaskSet | None, head: Head | None = None,
        progress: Progress | None = None,
    ) -> None:
        self._reader = reader
        self.name = name
        self._events = self._with_unfinished(self._read(progress))
        give_back()     # memory of the batches
        # this executor recorded it, but its executions are lost
        own = any(event[0].name in _OWN for event in self._events.others)
        if head is None and (own or not (self._events.table['kind'] == START).any()):
            raise no_run(reader)
        self._link()
        self._clocks = ImportedClocks(self.links, hosts_in(self._events.others))
        if self._clocks.shift:
            self._events = moved(self._events, self._clocks.shift)
            self._link()
        # The policy of another executor is not recorded; its name replaces the pool.
        self.head = head or Head(
            int(self.links.runs['start'][0]), '', '', 'ros2', len(distinct(
                self.links.runs['thread'])), DEFAULT_DEADLINE_NS, 0, False)
        self._imported = head is None
        self._matching = Matching(name, self.who.names, task_set)
        #: The declaration to judge by; none is recorded.
        self.task_set = self._matching.task_set
        self._targets = self._matching.target
        vertices = {v.callback.key: number for number, v in enumerate(self.task_set.vertices)}
        self._vertex = {number: vertices[target.callback.key]
                        for number, target in self._targets.items()}
        #: The last event's time, ns.
        self.end = max(min(max(0, self.head.time), NEVER - 1), *self._last_times())
        self._odd = Oddities(self.odd, 5)
        self._fallbacks: Counter[str] = Counter()

    def _read(self, progress: Progress | None) -> Events:
        """Return the events."""
        with named_errors(self._reader.path, self.name):
            return read_events(self._reader, self.kinds, self.others, progress)

    def _link(self) -> None:
        """Link executions and messages."""
        #: The nodes and callbacks.
        self.who = Entities()
        self.who.read([
            event for event in self._events.others if event[0].name in INIT_EVENTS])
        self.links = self.links_type(self._events, self.who)

    def read(self) -> Recording:
        """Return the recording."""
        links, table = self.links, self._executions()
        targets = [self._targets.get(each.number) for each in links.callbacks]
        first, last = self._pieces()
        jobs = ImportedJobs(self.task_set, links, targets, first, self._clocks.distrusted)
        table['ready'], release = self._times(jobs)
        jobs.fill(table, release, last, self._skipped(jobs))
        self._number_pieces(table)
        unfinished, places = self._end_unfinished(table)
        self._label_timers(table)
        run = Run(
            self.name, self.head, self.task_set, self.task_set, declared=False,
            imported=self._imported, same=False,
            start=earliest(table['ready'], jobs.releases['release']), end=self.end,
            judged_until=self._judged_until(), workers_each=self.head.workers, links=True)
        names = replace(self.who.names, vertices=self._vertex, workers=self._worker_names(),
                        places=places)
        if self._imported:
            processes = dict(zip(self._pids, process_names(self._pids, self._events.names)))
            names = replace(
                names, processes=processes, process_names=tuple(processes.values()))
            run = replace(
                run, placed=self._placed(processes), workers_each=self._workers_each())
        found = self._completed(Recording(run, Columns(
            releases=jobs.releases, executions=table, publications=self._publications(),
            job_ends=jobs.ends, takes=self._takes(), unfinished=unfinished), names))
        return replace(found, missing=Losses(self._missing(found)))

    def _label_timers(self, table: Table) -> None:
        """Give timers that were made again one label."""
        numbers, index = different(table['callback'])
        last = np.zeros(len(numbers), dtype=np.int64)
        np.maximum.at(last, index, table['start'])
        timers = [each for each in self.who.names.callbacks if each.kind == 'timer']
        again = made_again(
            sorted(timers, key=lambda each: (each.made, each.number)),
            dict(zip(numbers.tolist(), last.tolist())), self.end)
        self.who.label({timer.number: first for timer, first in again})

    def _last_times(self) -> Iterator[int]:
        """Yield times at which it still ran."""
        yield int(self._events.table['time'].max(initial=0))

    def _with_unfinished(self, events: Events) -> Events:
        """Return the events with the starts of executions that only other events show."""
        return events

    def _have_workers(self, mine: Ints) -> list[bool]:
        """Return which executions that have not ended kept their workers."""
        return [True] * len(mine)

    def _places(self, mine: Ints) -> list[str]:
        """Return where executions were that have not ended."""
        return [''] * len(mine)

    def _end_unfinished(self, table: Table) -> tuple[Table, Sequence[str]]:
        """
        Let executions that have run for ``LEAST_UNFINISHED_NS`` and not ended end with the run.

        An execution has not ended if nothing else began or ended in its thread after its start.

        :return: these, and where they were.
        """
        events, runs = self._events.table, self.links.runs
        pids = np.array([pid for pid, _ in self._events.threads], dtype=np.int64)
        last_events = np.zeros(len(pids), dtype=np.int64)
        last_events[events['thread']] = events['time']      # the last one is written last
        ends = np.zeros(len(pids), dtype=np.int64)      # by process
        _, process = different(pids)
        np.maximum.at(ends, process, last_events)
        at = np.flatnonzero(events['kind'] <= END)
        last = np.full(len(pids), UNKNOWN)      # by thread its last start or end
        last[events['thread'][at]] = at
        end = ends[process[runs['thread']]] if self._imported else np.full(len(runs), self.end)
        mine = np.flatnonzero((runs['end_at'] < 0) & (last[runs['thread']] == runs['at']) & (
            end - runs['start'] >= LEAST_UNFINISHED_NS))
        table['end'][mine] = end[mine]
        table['busy'][mine] = end[mine] - runs['start'][mine]
        workers = {each: number for number, each in enumerate(self._workers)}
        table['worker'][mine] = [
            workers.get(self._events.threads[thread], UNKNOWN) if has_worker else UNKNOWN
            for thread, has_worker in zip(runs['thread'][mine].tolist(), self._have_workers(mine))]
        return unfinished_rows([*zip(
            table['callback'][mine].tolist(), table['start'][mine].tolist(), self._places(mine),
            table['process'][mine].tolist())])

    def _number_pieces(self, table: Table) -> None:
        """Do nothing: each execution has one piece."""

    def _skipped(self, jobs: ImportedJobs) -> Table:
        """Return the releases that are known to be skipped: none, without due times."""
        return rows(SKIPPED)

    def _completed(self, found: Recording) -> Recording:
        """Return the recording with what other events say."""
        return found

    def _worker_names(self) -> list[str]:
        """Return the names of the threads that ran callbacks, by worker."""
        names = self._events.names
        return [f'{names.get((pid, tid)) or "process"} {pid}, thread {tid}'
                for pid, tid in self._workers] if self._imported else []

    def _executions(self) -> Table:
        """Return the executions, without jobs."""
        runs, events = self.links.runs, self._events
        ended = runs['end_at'] >= 0
        # workers are numbered by their first execution that ended
        first = np.full(len(events.threads), NEVER)
        np.minimum.at(first, runs['thread'][ended], runs['end_at'][ended])
        threads = sort_by(first)[:int((first < NEVER).sum())]
        worker = np.full(len(events.threads), UNKNOWN)
        worker[threads] = np.arange(len(threads))
        self._workers = [events.threads[each] for each in threads.tolist()]
        table = rows(
            EXECUTIONS, len(runs), callback=_values(
                [each.number for each in self.links.callbacks], runs['callback']),
            thread=_values([tid for _, tid in events.threads], runs['thread']),
            start=runs['start'], began=runs['start'], end=runs['end'], message=runs['message'],
            busy=np.where(runs['end'] >= 0, runs['end'] - runs['start'], UNKNOWN),
            cpu=UNKNOWN, order=UNKNOWN, worker=np.where(ended, worker[runs['thread']], UNKNOWN),
            process=self._process_of(runs), due=runs['due'])
        return table

    def _process_of(self, runs: Table) -> Ints:
        """
        Return the process of each execution, those with declared callbacks first.

        Threads of this executor are workers of one pool.
        """
        declared = [each.number in self._vertex for each in self.links.callbacks]
        known = np.array(declared, dtype=np.bool_)[runs['callback']]
        by_thread = [pid for pid, _ in self._events.threads]
        sent = self._events.table['thread'][self.links.messages['at']]
        of_declared, every, sending = (
            sorted({by_thread[each] for each in distinct(threads).tolist()})
            for threads in (runs['thread'][known], runs['thread'], sent))
        self._pids = list(dict.fromkeys([*of_declared, *every, *sending]))
        self._n_declared = len(of_declared)
        #: By process id its number in tables; of this executor there is one.
        self._process = {pid: place if self._imported else 0
                         for place, pid in enumerate(self._pids)}
        return self._process_of_threads(runs['thread'])

    def _process_of_threads(self, threads: Ints) -> Ints:
        """Return the number of the process of each thread."""
        return _values([self._process.get(pid, UNKNOWN) for pid, _ in self._events.threads],
                       threads)

    def _placed(self, names: Mapping[int, str]) -> list[Process]:
        """Return the nodes of each process in which declared callbacks ran, if it has several."""
        pids = self._pids[:self._n_declared]
        if len(pids) < 2:
            return []
        nodes = dict.fromkeys(callback.node for callback in self.task_set.callbacks)
        # a node that did not run belongs to the first process, as in declarations
        pid_of = dict.fromkeys(nodes, pids[0])
        for each in reversed(self.links.callbacks):
            if each.node is not None and each.node.name in nodes and each.node.pid in pids:
                pid_of[each.node.name] = each.node.pid
        return [Process(names[pid], tuple(node for node in nodes if pid_of[node] == pid))
                for pid in pids]

    def _workers_each(self) -> int:
        """Return the largest number of threads of a process in which declared callbacks ran."""
        pids = self._pids[:self._n_declared]
        threads = Counter(pid for pid, _ in self._workers)
        return max((threads[pid] for pid in pids), default=0) or self.head.workers

    def _publications(self) -> Table:
        messages, publishers = self.links.messages, self.links.publishers
        run = messages['run']
        callback = np.append(self.links.runs['callback'], UNKNOWN)[run]
        width = len(publishers) + 1     # -1: unknown
        pairs, which = different(callback * width + messages['publisher'] + 1)
        vertices = [self._publisher_vertex(pair // width, pair % width - 1)
                    for pair in pairs.tolist()]
        return rows(
            PUBLICATIONS, len(messages), process=self._process_of_threads(
                self._events.table['thread'][messages['at']]), publisher=_values(
                [each.number for each in publishers], messages['publisher']),
            execution=run, time=messages['time'], source_timestamp=messages['stamp'],
            header_stamp=np.where(messages['header'] > 0, messages['header'], UNKNOWN),
            vertex=np.array(vertices, dtype=np.int64)[which])

    def _publisher_vertex(self, callback: int, publisher: int) -> int:
        """Return a vertex of a declared callback that publishes with its node's publisher."""
        if callback < 0 or publisher < 0:
            return UNKNOWN
        number, node = self.links.callbacks[callback].number, self.links.publishers[publisher].node
        target = self._targets.get(number)
        known = target is not None and node is not None and target.callback.node == node.name
        return self._vertex[number] if known else UNKNOWN

    def _takes(self) -> Table:
        run, message = self.links.takes
        return rows(TAKES, len(run), execution=run, message=message,
                    time=self.links.runs['start'][run])

    def _judged_until(self) -> int:
        """Return the time at which open jobs are judged."""
        return self.end

    def _pieces(self) -> tuple[Ints, Mask]:
        """
        Return by run of a callback the first run of its execution, and whether it ends with it.

        Here each run is an execution.
        """
        return np.arange(len(self.links.runs)), self.links.runs['end_at'] >= 0

    # --- times -----------------------------------------------------------------------------------

    def _times(self, jobs: ImportedJobs) -> tuple[Ints, Ints]:
        """Return by execution when it was ready, and by source execution its release."""
        ready = self._ready()
        timers = np.flatnonzero(self._is_any('timer')[self.links.runs['callback']])
        ready[timers] = self._due(timers, self.links.runs['start'][timers])
        return ready, self._releases(jobs, ready, 'timer')

    def _ready(self) -> Ints:
        """Return when executions were ready by their messages; else when they started."""
        runs, messages = self.links.runs, self.links.messages
        sent = self._stamps('stamp')
        if len(messages):
            message = messages[['stamp', 'time']][runs['message']]
            published = np.where(
                message['stamp'] != 0, message['stamp'] + self._of_sender, message['time'])
            sent = np.where((sent == 0) & (runs['message'] >= 0), published, sent)
        ready: Ints = np.minimum(np.where(sent != 0, sent, _arrival(runs)), runs['start'])
        return ready

    @property
    def _of_sender(self) -> Ints:
        """Return by execution how the clock of the sender of its message was moved, ns."""
        if not self.links.shift.any():
            return np.zeros(len(self.links.runs), dtype=np.int64)
        at = self.links.messages['at']
        shift = self.links.shift[self._events.table['thread'][at]]
        found: Ints = np.append(shift, 0)[self.links.runs['message']]
        return found

    def _stamps(self, name: str) -> Ints:
        """Return the stamps of messages by execution, on the recording's clock; 0: unknown."""
        runs = self.links.runs
        known = credible(runs[name], runs['start'])
        found: Ints = np.where(known, runs[name] + self._of_sender, 0)
        return found

    def _is_any(self, *kinds: str) -> Mask:
        """Return by callback whether it is of one of the kinds."""
        return np.array([each.kind in kinds for each in self.links.callbacks], dtype=np.bool_)

    def _releases(self, jobs: ImportedJobs, ready: Ints, *by_ready: str) -> Ints:
        """
        Return the releases of source executions, which are not ready before.

        :param by_ready: kinds of callbacks that are released when they are ready.
        """
        stamps, stated_stamps = (
            self._stamps(name)[jobs.sources] for name in ('stamp', 'stated'))
        runs = self.links.runs[jobs.sources]
        start, number = runs['start'], runs['callback']
        wanted = np.array([dag.release_from for dag in self.task_set.dags])[jobs.releases['dag']]
        by_header, by_stamp = wanted == 'header_stamp', wanted != 'arrival'
        known, stated = stamps != 0, stated_stamps != 0
        stamp = np.where(by_stamp & known, stamps, _arrival(runs))
        stamp = np.minimum(np.where(by_header & stated, stated_stamps, stamp), start)
        other = self._is_any(*by_ready)[number]
        release: Ints = np.where(other, ready[jobs.sources], stamp)
        ready[jobs.sources] = np.maximum(ready[jobs.sources], release)
        missing = np.flatnonzero(~other & np.where(by_header, ~stated, by_stamp & ~known))
        for each, first, n in zip(*np.unique(
                number[missing], return_index=True, return_counts=True)):
            name = self._targets[self.links.callbacks[each].number].callback.key
            self._fallbacks[f'{name} ({wanted[missing[first]]})'] += int(n)
        return release

    def _due(self, which: Ints, time: Ints) -> Ints:
        """Return the last due times of timers' executions (rule 1); off the grid: the given."""
        due, number = time.copy(), self.links.runs['callback'][which]
        order = sort_by(number)
        for begin, until in zip(*groups(number[order])):
            mine = order[begin:until]
            timer = self.links.callbacks[number[mine[0]]]
            grid, period = timer.grid, timer.period
            if grid is None or abs(grid) >= NEVER or period <= 0:
                self._odd.count('off', timer.label, len(mine))
                continue
            n = _due_times(time[mine] - grid, period)
            newer = n > np.maximum.accumulate(np.append(0, n))[:-1]
            mine, n = mine[newer], n[newer]
            due[mine] = np.minimum(grid + n * period, time[mine])
            self._odd.count('off', timer.label, int((~newer).sum()))
            self._odd.count('skipped', timer.label, int((np.diff(n) - 1).sum()))
        return due

    # --- warnings --------------------------------------------------------------------------------

    def _damage(self) -> Iterator[Loss]:
        """Yield what is damaged."""
        yield from damage(self._reader.warnings, self._reader.path, self.name)

    def _missing(self, found: Recording) -> Iterator[Loss]:
        """Yield missing or doubtful data."""
        name = self.name
        yield from self._damage()
        named = [all(those) for those in zip(*(
            self._events.threads[each] for each in distinct(self.links.runs['thread']).tolist()))]
        if self._imported and not all(named):
            lacking = [what for what, has in zip(('vpid', 'vtid'), named) if not has]
            yield Loss('strange', 1, (
                f'{name}: its events lack the context{"s" * (len(lacking) > 1)} '
                f'{" and ".join(lacking)}, so what ran in several threads is mixed up, and '
                'verdicts may be wrong: record with vpid and vtid'))
        if self.who.incomplete:
            yield Loss('strange', self.who.incomplete, (
                f'{name}: left out: {counted(self.who.incomplete, "event")} of the '
                'initialisation without some of the fields'))
        yield from self._matching.losses
        if self._events.warning:
            yield Loss('strange', 1, f'{name}: {self._events.warning}')
        for cause, count in sorted(self.links.gaps.items()):
            if not count:
                continue
            what, things = _LOST.get(cause, self.lost)
            yield Loss('events', count, (
                f'{name}: {what.format(counted(count, things))}: executions and messages may be '
                'missing'))
        for each in self.links.callbacks:   # the messages of a source come from outside
            vertex = self._vertex.get(each.number)
            if vertex is not None and not self.task_set.vertices[vertex].predecessors:
                self.links.losses.forget('messages', each.label)
        for text in self._clocks.lines():
            yield Loss('clock', 1, f'{name}: {text}')
        yield from self.links.losses.found(name, 'events')
        unjudged = found.unjudged
        if unjudged:
            dags = [f'{found.task_set.dags[dag].name} ({n})' for dag, n in unjudged.items()]
            total = sum(unjudged.values())
            yield Loss('unjudged', total, (
                f'{name}: not judged, because their events may be missing: '
                f'{counted(total, "job")}: {listed(dags)}'))
        yield from self._odd.found(name, 'stamps')
        if self._fallbacks:
            total = self._fallbacks.total()
            yield Loss('stamps', total, (
                f'{name}: {counted(total, "release")} by the next best stamp, because the '
                f'declared one is not recorded or years away: {listed(list(self._fallbacks))}'))
        if found.task_set.dags and not len(found.releases):
            yield no_jobs(name)


def hosts_in(events: Sequence[Event]) -> dict[int, tuple[str, str]]:
    """Return by process its computer, if it is known: its name, and that of its boot."""
    return {event[2]: (event[4], event[5]) for event in events if event[0].name == HOST
            and [type(each) for each in event[4:6]] == [str, str]}


def process_names(pids: Sequence[int], names: Mapping[tuple[int, int], str]) -> list[str]:
    """
    Return a name for each process that a declaration may have, all different.

    :param names: by process and thread its recorded name; that of the process is its first one's.
    """
    plain = [re.sub('[^A-Za-z0-9_.-]', '_', names.get((pid, pid), '')) or 'process'
             for pid in pids]
    unique = Counter(plain)
    numbered = {f'{name}_{pid}' for name, pid in zip(plain, pids)}
    return [name if unique[name] == 1 and name != 'process' and name not in numbered
            else f'{name}_{pid}' for name, pid in zip(plain, pids)]


def _due_times(since: Ints, period: int) -> Ints:
    """
    Return which due times of a timer its executions have (rule 1).

    :param since: when they started, since the recorded begin of the grid, in order.
    """
    slack = min(_SLACK_NS, period // 10)
    started, phase = np.divmod(since, period)
    found: Ints = (since + slack) // period
    is_early = found > started
    # A grid that was recorded late makes most executions near a due time early, and more than
    # those that are late by any time at all.
    early = int(is_early.sum())
    are_few = (2 * early < int((is_early | (phase < slack)).sum())
               or early * period < 2 * slack * len(since))
    is_twice = np.append(found[1:] == found[:-1], False)
    is_free = np.append(started[:1] > 0, found[:-1] < started[1:])
    times: Ints = np.where(is_early & is_free & (is_twice | are_few), started, found)
    return times


def _arrival(runs: Table) -> Ints:
    """Return when messages were taken; if unknown, when their executions started."""
    taken: Ints = np.where(runs['taken'] != 0, runs['taken'], runs['start'])
    return taken


def _values(by_number: list[int], numbers: Ints) -> Ints:
    """Return the values of numbers; ``UNKNOWN`` for -1."""
    found: Ints = np.array([*by_number, UNKNOWN], dtype=np.int64)[numbers]
    return found
