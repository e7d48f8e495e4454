# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
An imported recording: releases, executions, completions and ends of jobs as tables.

Theory of operation
-------------------
Nodes and callbacks are identified (``entities``) and matched with the declaration (``mapping``).
Executions are linked with messages (``links``), and assigned to jobs in the order of time.

1. *Releases.*  A timer is due at t_init + n * period.  rcl keeps this grid even if a timer is more
   than a period late: it skips the missed times.  The release of an execution is the last due time
   at its start.  `rcl_timer_init` is recorded shortly after the timer has read its clock, so an
   execution that starts up to `_SLACK_NS` before a due time has that release, too, at its start.
   If t_init is unknown, or the previous execution has the same release (the timer was reset, or
   uses another clock), the release is the start; a warning reports it. A subscription or service
   without publisher in the graph is released as declared: by header stamp, source timestamp, or
   the time at which its message was taken.
2. *Jobs.*  Any other execution belongs to the job of the execution that published its message, as
   a successor of that vertex.  An execution for a message that is not recorded, or that was
   published for no job, counts as undeclared.
3. *Ready* is a timer's release, otherwise the source timestamp (within a process: the
   publication). Arrival at the reader is not recorded, so transport counts as waiting.
4. A job that has not completed `EXPIRE_AFTER_NS` after its latest deadline, with no execution
   running, has expired, as in the executor's core.  Open jobs at the end of the recording are
   judged at the last event.  A job whose fate is unknown because of missing events (see
   ``doubts``) is withdrawn: it is not judged.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable as Function
from collections.abc import Sequence
from typing import Any

from mddag_executor.core import DEFAULT_DEADLINE_NS, EXPIRE_AFTER_NS, legs_of, NEVER
from mddag_executor.memory import give_back
from mddag_executor.recording.entities import Callback, Entities, INIT_EVENTS
from mddag_executor.recording.head import Head, named_errors, no_run
from mddag_executor.recording.mapping import Matching, Target
from mddag_executor.recording.tables import (
    earliest,
    EXECUTIONS,
    EXPIRED,
    JOB_ENDS,
    LEG,
    PUBLICATIONS,
    Recording,
    RELEASES,
    Rows,
    rows,
    sort_by,
    Table,
    TAKES,
    UNKNOWN,
    VERTEX,
    WITHDRAWN,
)
from mddag_executor.replay.doubts import Doubts
from mddag_executor.replay.imported_events import KINDS, read_events, START
from mddag_executor.replay.links import Links, Losses, Lost
from mddag_executor.text import counted, listed
from mddag_executor.trace import TraceReader
from mddag_executor.trace.errors import renamed
from mddag_executor.trace.times import credible
from msg_graph import Dag, TaskSet
import numpy as np

_SLACK_NS = 1_000_000
_OWN = ('mddag:job_release', 'mddag:dispatch')


class ImportedRun:
    """
    A run of another executor; ``read`` turns it into tables.

    :param reader: a trace without declaration.
    :param task_set: the declaration to judge by; None: none.
    :param head: head of a trace of this executor; None: another executor recorded it.
    :param progress: called regularly with the number of events read.
    """

    kinds = KINDS
    others: Sequence[str] = (*INIT_EVENTS, *_OWN)
    links_type = Links

    def __init__(
        self, reader: TraceReader, name: str, task_set: TaskSet | None, head: Head | None = None,
        progress: Function[[int], None] | None = None,
    ) -> None:
        self._reader = reader
        self.name = name
        with named_errors(reader.path, name):
            self._events = read_events(
                reader, self.kinds, self.others, progress)
        give_back()     # memory of the batches
        table = self._events.table
        starts = table[table['kind'] == START]
        init = [event for event in self._events.others if event[0].name not in _OWN]
        # this executor recorded it, but its executions are lost
        own = len(init) < len(self._events.others)
        if head is None and (own or not len(starts)):
            raise no_run(reader)
        #: The nodes and callbacks.
        self.who = Entities()
        self.who.read(init)
        threads = {self._events.threads[each] for each in np.unique(starts['thread']).tolist()}
        # The policy of another executor is not recorded; its name replaces the pool.
        self.head = head or Head(
            int(starts['time'][0]), '', '', 'ros2', len(threads), DEFAULT_DEADLINE_NS, 0, False)
        self._imported = head is None
        self._matching = Matching(name, self.who, threads, task_set)
        #: The declaration to judge by; none is recorded.
        self.task_set = self._matching.task_set
        self._targets = self._matching.target
        #: The last event's time, ns.
        self.end = max(min(max(0, self.head.time), NEVER - 1), int(table['time'].max(initial=0)))
        self._order = 0
        self._doubts = Doubts(self.task_set.dags)
        self.links = self.links_type(self._events, self.who)
        self._timers = _Timers()
        self._fallbacks: Counter[str] = Counter()
        self._releases = Rows(RELEASES, 'dag', 'job', 'release', 'noticed', 'order')
        self._ends = Rows(JOB_ENDS, 'dag', 'job', 'time', 'reason', 'order')
        self._add_executions()
        self._graph()

    def _add_executions(self) -> None:
        """Make the columns of executions, and those that are found in the order of time."""
        runs, events = self.links.runs, self._events
        count = len(runs)
        table = self._executions = rows(EXECUTIONS, count)
        callbacks = self.links.callbacks
        table['callback'] = np.array([each.number for each in callbacks], dtype=np.int64)[
            runs['callback']]
        table['thread'] = np.array([tid for _, tid in events.threads], dtype=np.int64)[
            runs['thread']]
        table['start'] = table['began'] = runs['start']
        table['end'], table['message'] = runs['end'], runs['message']
        table['busy'] = np.where(runs['end'] >= 0, runs['end'] - runs['start'], UNKNOWN)
        table['cpu'] = table['order'] = table['worker'] = UNKNOWN
        ended = np.flatnonzero(runs['end_at'] >= 0)
        ended = ended[sort_by(runs['end_at'][ended])]
        threads, first = np.unique(runs['thread'][ended], return_index=True)
        worker = np.full(len(events.threads), UNKNOWN)
        worker[threads[sort_by(first)]] = np.arange(len(threads))
        table['worker'][ended] = worker[runs['thread'][ended]]
        #: By execution: DAG, vertex and job; its leg; when it was ready; what it completed, when.
        self._of: list[tuple[int, int, int] | None] = [None] * count
        self._leg_of = [0] * count
        self._completes: list[tuple[int, int, int]] = []
        self._runs: list[tuple[int, ...]] = list(zip(*(runs[name].tolist() for name in (
            'callback', 'start', 'ready', 'stamp', 'stated', 'taken', 'message'))))
        self._ready_of: list[int] = runs['ready'].tolist()

    def _graph(self) -> None:
        """Index the graph: sources by callback, successors by vertex and callback."""
        self._dags: tuple[Dag, ...] = self.task_set.dags
        self._source: dict[str, tuple[int, int]] = {}
        self._next: dict[tuple[int, str], int] = {}
        self._sizes: dict[int, int] = {}
        vertices = {v.callback.key: number for number, v in enumerate(self.task_set.vertices)}
        self._vertex = {number: vertices[target.callback.key]
                        for number, target in self._targets.items()}
        # by the vertices before and after, and the index of the topic
        self._leg: dict[tuple[int, int, int], int] = {}
        first = 0
        for dag in self._dags:
            source = dag.vertices[dag.source]
            self._source[source.callback.key] = dag.index, first + dag.source
            for vertex in dag.vertices:
                legs = legs_of(vertex, dag.vertices)
                self._sizes[first + vertex.index] = max(1, len(legs))
                for leg, (topic, before) in enumerate(legs):
                    self._leg[(first + before, first + vertex.index, topic)] = leg
                for after in vertex.successors:
                    key = dag.vertices[after].callback.key
                    self._next[(first + vertex.index, key)] = first + after
            first += len(dag.vertices)
        self._newest = [-1] * len(self._dags)
        self._open: list[deque[tuple[int, int]]] = [deque() for _ in self._dags]
        self._active: Counter[tuple[int, int]] = Counter()
        self._patience = [
            EXPIRE_AFTER_NS + max(dag.vertices[s].deadline_ns or 0 for s in dag.sinks)
            for dag in self._dags]
        self._legs: dict[tuple[int, int], set[int]] = {}

    def read(self) -> Recording:
        """Return the recording."""
        links = self.links
        messages, runs = links.messages, links.runs
        ended = np.flatnonzero(runs['end_at'] >= 0)
        parts: list[tuple[Function[[int], None], Any]] = [
            (self._lost, [each.at for each in links.lost]), (self._began, runs['at']),
            (self._sent, messages['at']), (self._over, runs['end_at'][ended])]
        at = np.concatenate([np.array(each, dtype=np.int64) for _, each in parts])
        kind = np.repeat(np.arange(len(parts)), [len(each) for _, each in parts])
        number = np.concatenate([*(np.arange(len(each)) for _, each in parts[:3]), ended])
        order = sort_by(at, kind)
        reports = [report for report, _ in parts]
        self._messages = list(zip(*(messages[name].tolist() for name in (
            'run', 'stamp', 'within'))))
        for which, each in zip(kind[order].tolist(), number[order].tolist()):
            reports[which](each)
        for dag, jobs in enumerate(self._open):
            for release, job in jobs:
                self._close(dag, job, release)
        releases, executions = self._releases.table(), self._all_executions()
        return Recording(
            self.name, self.head, self.task_set, self.task_set, self.who, declared=False,
            imported=self._imported, same=False, releases=releases, executions=executions,
            publications=self._publications(), job_ends=self._ends.table(), takes=self._takes(),
            start=earliest(executions['ready'], releases['release']), end=self.end,
            judged_until=self._judged_until(), lost=links.discarded,
            workers_each=self.head.workers, links=True, callback_vertex=self._vertex,
            unjudged=self._doubts.withdrawn, warnings=self.warnings)

    def _all_executions(self) -> Table:
        table = self._executions
        table['ready'] = self._ready_of
        none = UNKNOWN, UNKNOWN, UNKNOWN
        for name, values in zip(('dag', 'vertex', 'job'), zip(*(of or none for of in self._of))):
            table[name] = values
        table['leg'] = self._leg_of
        if self._completes:
            at, what, order = np.array(self._completes).T
            table['completes'][at], table['order'][at] = what, order
        return table

    def _publications(self) -> Table:
        messages, publishers = self.links.messages, self.links.publishers
        numbers = np.array([*(each.number for each in publishers), UNKNOWN], dtype=np.int64)
        callback = np.where(messages['run'] >= 0,
                            self.links.runs['callback'][messages['run']], UNKNOWN) \
            if len(self.links.runs) else messages['run']
        pairs, which = np.unique(np.stack((callback, messages['publisher'])), axis=1,
                                 return_inverse=True)
        vertices = [self._publisher_vertex(*pair) for pair in pairs.T.tolist()]
        return rows(
            PUBLICATIONS, len(messages), publisher=numbers[messages['publisher']],
            execution=messages['run'], time=messages['time'], source_timestamp=messages['stamp'],
            vertex=np.array(vertices, dtype=np.int64)[which.ravel()])

    def _publisher_vertex(self, callback: int, publisher: int) -> int:
        """Return a vertex of a declared callback that publishes with its node's publisher."""
        if callback < 0 or publisher < 0:
            return UNKNOWN
        number, node = self.links.callbacks[callback].number, self.links.publishers[publisher].node
        target = self._targets.get(number)
        known = target is not None and node is not None and target.callback.node == node.name
        return self._vertex[number] if known else UNKNOWN

    def _takes(self) -> Table:
        found = self.links.takes
        run = np.array([run for _, run, _ in found], dtype=np.int64)
        return rows(TAKES, len(found), execution=run, message=[each for _, _, each in found],
                    time=self.links.runs['start'][run])

    def _judged_until(self) -> int:
        """Return the time at which open jobs are judged."""
        return self.end

    def _next_order(self) -> int:
        self._order += 1
        return self._order

    # --- executions ------------------------------------------------------------------------------

    def _began(self, run: int) -> None:
        """Find the job of an execution."""
        callback = self.links.callbacks[self._runs[run][0]]
        self._ready_of[run] = self._ready(run, callback)
        target = self._targets.get(callback.number)
        if target is not None:
            self._assign(run, callback, target)
        of = self._of[run]
        if of is not None:
            self._active[of[0], of[2]] += 1

    def _ready(self, run: int, callback: Callback) -> int:
        _, start, _, stamp, _, taken, message = self._runs[run]
        if callback.kind == 'timer':
            return self._timers.release(callback, start)
        sent = stamp if credible(stamp, start) else 0
        if not sent and message >= 0:
            _, sent, _ = self._messages[message]
            sent = sent or int(self.links.messages['time'][message])
        return min(sent or taken or start, start)

    def _assign(self, run: int, callback: Callback, target: Target) -> None:
        """Find the job of an execution."""
        _, start, _, stamp, _, _, message = self._runs[run]
        key = target.callback.key
        if key in self._source:
            dag, vertex = self._source[key]
            job = self._newest[dag] = self._newest[dag] + 1
            release = self._release(run, callback, self._dags[dag], target)
            if callback.kind != 'timer':
                self._ready_of[run] = max(self._ready_of[run], min(release, start))
            self._of[run] = dag, vertex, job
            self._expire(start)
            self._doubts.opened(dag, job)
            self._open[dag].append((release, job))
            self._releases.add(dag, job, release, start, self._next_order())
            return
        sender = UNKNOWN if message < 0 else self._messages[message][0]
        if sender < 0:
            self._doubts.ran_for_unknown(key, start, message >= 0 or stamp != 0)
        elif (of := self._of[sender]) is not None:
            dag, before, job = of
            after = self._next.get((before, key))
            if after is not None:
                self._of[run] = dag, after, job
                self._leg_of[run] = self._leg.get((before, after, target.leg), 0)

    def _release(self, run: int, callback: Callback, dag: Dag, target: Target) -> int:
        """Return the release of a source's execution."""
        _, start, _, stamp, stated, taken, _ = self._runs[run]
        if callback.kind == 'timer':
            return self._ready_of[run]
        wanted = dag.release_from
        if wanted == 'header_stamp' and credible(stated, start):
            return min(stated, start)
        if wanted != 'arrival':
            known = credible(stamp, start)
            if not known or wanted == 'header_stamp':
                self._fallbacks[f'{target.callback.key} ({wanted})'] += 1
            if known:
                return min(stamp, start)
        return min(taken or start, start)

    def _over(self, run: int) -> None:
        """Note what the end of an execution completed."""
        last = self._ends_with(run)
        of = self._of[run]
        if of is None:
            return
        dag, vertex, job = of
        self._active[(dag, job)] -= 1
        if not last:
            return
        whole = self._is_whole(vertex, job, self._leg_of[run])
        if whole:
            self._doubts.done(dag, vertex, job)
        self._completes.append((run, VERTEX if whole else LEG, self._next_order()))

    def _ends_with(self, run: int) -> bool:
        """Return whether an execution ends with a run of its callback; here it always does."""
        return True

    def _is_whole(self, vertex: int, job: int, leg: int) -> bool:
        """Return whether an execution completes its vertex: the last leg of a sync vertex does."""
        if self._sizes[vertex] == 1:
            return True
        done = self._legs.setdefault((vertex, job), set())
        done.add(leg)
        if len(done) < self._sizes[vertex]:
            return False
        del self._legs[(vertex, job)]
        return True

    def _expire(self, now: int) -> None:
        for dag, jobs in enumerate(self._open):
            running: list[tuple[int, int]] = []
            while jobs and now - jobs[0][0] > self._patience[dag]:
                release, job = jobs.popleft()
                if self._active[(dag, job)] > 0:
                    running.append((release, job))
                    continue
                del self._active[(dag, job)]
                if not self._close(dag, job, release):
                    self._ends.add(dag, job, now, EXPIRED, self._next_order())
            jobs.extendleft(reversed(running))

    def _close(self, dag: int, job: int, release: int) -> bool:
        """Withdraw a job that cannot be judged; return whether it is one."""
        doubted = self._doubts.close(dag, job, release)
        if doubted:
            self._ends.add(dag, job, UNKNOWN, WITHDRAWN, self._next_order())
        return doubted

    def _lost(self, number: int) -> None:
        """Doubt jobs: those of a callback that ran for an unknown one, or all open ones."""
        lost: Lost = self.links.lost[number]
        if lost.callback < 0:
            self._doubts.discarded(lost.time)
        elif (target := self._targets.get(self.links.callbacks[lost.callback].number)) is not None:
            self._doubts.ran_for_unknown(target.callback.key, lost.time)
        of = self._of[lost.run] if lost.run >= 0 else None
        if of is not None:
            self._active[(of[0], of[2])] -= 1

    def _sent(self, message: int) -> None:
        """Note that a job has sent a message."""
        run, stamp, within = self._messages[message]
        of = self._of[run] if run >= 0 else None
        if of is not None and (stamp or within):
            self._doubts.sent(of[0], of[2], self.links.topic(message))

    # --- warnings --------------------------------------------------------------------------------

    @property
    def warnings(self) -> list[str]:
        """Return missing or doubtful data, one line each; only valid after ``read``."""
        name, path = self.name, self._reader.path
        lines = [renamed(text, path, name) for text in self._reader.warnings]
        if self.who.incomplete:
            lines.append(
                f'{name}: left out: {counted(self.who.incomplete, "event")} of the '
                'initialisation without some of the fields')
        lines += self._matching.warnings
        if self._events.warning:
            lines.append(f'{name}: {self._events.warning}')
        if self.links.discarded:
            lines.append(
                f'{name}: the tracer discarded {counted(self.links.discarded, "event")} or more: '
                'executions and messages may be missing')
        lines += [f'{name}: {text}' for text in self.links.losses.lines()]
        if self._doubts.withdrawn:
            dags = [f'{self._dags[dag].name} ({n})' for dag, n in self._doubts.withdrawn.items()]
            lines.append(
                f'{name}: not judged, because their events may be missing: '
                f'{counted(sum(self._doubts.withdrawn.values()), "job")}: {listed(dags)}')
        lines.extend(f'{name}: {text}' for text in self._timers.odd.lines())
        if self._fallbacks:
            lines.append(
                f'{name}: {counted(sum(self._fallbacks.values()), "release")} by the next best '
                'stamp, because the declared one is not recorded or '
                'years away: '
                f'{listed(list(self._fallbacks))}')
        if self._dags and not len(self._releases):
            lines.append(f'{name}: no job was released in it')
        return lines


class _Timers:
    """The releases of timers (rule 1)."""

    def __init__(self) -> None:
        self._last: dict[int, int] = {}
        self.odd = Losses({
            'without': ('execution', 'of timers whose initialisation is not in it: released when '
                        'it started'),
            'off': ('execution', 'of timers off the grid of the period (reset, or by another '
                    'clock): released when it started'),
            'skipped': ('period', 'of timers passed without an execution (late by more than one, '
                        'or events were lost): without a job')}, 5)

    def release(self, timer: Callback, start: int) -> int:
        """Return the release of an execution."""
        if timer.grid is None or timer.period <= 0:
            self.odd.count('without', timer.label)
            return start
        slack = min(_SLACK_NS, timer.period // 10)
        n = (start - timer.grid + slack) // timer.period
        last = self._last.get(timer.number)
        if n < 1 or (last is not None and n <= last):
            self.odd.count('off', timer.label)
            return start
        if last is not None and n > last + 1:
            self.odd.count('skipped', timer.label, n - last - 1)
        self._last[timer.number] = n
        return min(timer.grid + n * timer.period, start)
