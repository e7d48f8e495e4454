# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
An imported recording: releases, executions, completions and ends of jobs as tables.

Theory of operation
-------------------
The first pass over the trace identifies nodes and callbacks (``entities``) and matches them with
the declaration (``mapping``).  The second links executions and messages (``linker``) and assigns
them to jobs.

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
from typing import NamedTuple

from mddag_executor.core import DEFAULT_DEADLINE_NS, EXPIRE_AFTER_NS, legs_of, NEVER
from mddag_executor.recording.entities import Callback, Entities, Event, INIT_EVENTS
from mddag_executor.recording.head import Head, named_errors, no_run
from mddag_executor.recording.mapping import Matching, Target
from mddag_executor.recording.tables import (
    EXECUTIONS,
    EXPIRED,
    JOB_ENDS,
    LEG,
    PUBLICATIONS,
    Recording,
    RELEASES,
    Rows,
    TAKES,
    UNKNOWN,
    VERTEX,
    WITHDRAWN,
)
from mddag_executor.replay.doubts import Doubts
from mddag_executor.replay.linker import (
    Execution,
    Linker,
    LinkObserver,
    Losses,
    Publication,
)
from mddag_executor.text import counted, listed
from mddag_executor.trace import TraceReader
from mddag_executor.trace.errors import renamed
from mddag_executor.trace.times import credible
from msg_graph import Dag, TaskSet

_SLACK_NS = 1_000_000
_PROGRESS_STEP = 4096
_KEEP_LEGS = 65_536
_START = 'ros2:callback_start'
_OWN = ('mddag:job_release', 'mddag:dispatch')


class Ended(NamedTuple):
    """
    What ended with a run of a callback in a thread.

    :ivar piece: number of earlier pieces of the execution; ``last``: whether it is the last.
    :ivar start: start of the execution; ``busy``: how long it ran.
    """

    piece: int
    last: bool
    start: int
    busy: int


class ImportedRun(LinkObserver):
    """
    A run of another executor; ``read`` turns it into tables.

    :param reader: a trace without declaration.
    :param task_set: the declaration to judge by; None: none.
    :param head: head of a trace of this executor; None: another executor recorded it.
    :param linker: links its events.
    """

    def __init__(
        self, reader: TraceReader, name: str, task_set: TaskSet | None, head: Head | None = None,
        linker: type[Linker] = Linker,
    ) -> None:
        self._reader = reader
        self.name = name
        first: int | None = None if head is None else head.time
        threads: set[tuple[int, int]] = set()
        own = False
        init: list[Event] = []
        for event in reader.layout_events(INIT_EVENTS | {_START, *_OWN}):
            name_of_event = event[0].name
            if name_of_event == _START:
                threads.add(event[2:4])
                first = event[1] if first is None else first
            elif name_of_event in _OWN:
                own = True      # recorded by this executor, but its executions are lost
            else:
                init.append(event)
        if first is None or own and head is None:
            raise no_run(reader)
        #: The nodes and callbacks.
        self.who = Entities()
        self.who.read(init)
        # The policy of another executor is not recorded; its name replaces the pool.
        self.head = head or Head(
            first, '', '', 'ros2', len(threads), DEFAULT_DEADLINE_NS, 0, False)
        self._imported = head is None
        self._matching = Matching(name, self.who, threads, task_set)
        #: The declaration to judge by; none is recorded.
        self.task_set = self.recorded_set = self._matching.task_set
        self.targets = self._matching.target
        #: The first release, or when the first execution became ready, ns.
        self.start: int | None = None
        #: The last event's time, ns.
        self.end = min(max(0, first), NEVER - 1)
        self.jobs = 0
        self._order = 0
        self._doubts = Doubts(self.task_set.dags)
        self._linker = linker(self.who, self)
        self._workers: dict[tuple[int, int], int] = {}
        self._timers = _Timers()
        self._fallbacks: Counter[str] = Counter()
        self._releases = Rows(RELEASES, 'dag', 'job', 'release', 'noticed', 'order')
        self._executions = Rows(
            EXECUTIONS, 'callback', 'thread', 'ready', 'start', 'dag', 'vertex', 'job', 'leg',
            'worker', 'end', 'completes', 'message', 'order', 'piece', 'began', 'busy')
        self._sent = Rows(PUBLICATIONS, 'publisher', 'execution', 'vertex', 'time',
                          'source_timestamp')
        self._taken = Rows(TAKES, 'execution', 'message', 'time')
        self._ends = Rows(JOB_ENDS, 'dag', 'job', 'time', 'reason', 'order')
        self._graph()

    def _graph(self) -> None:
        """Index the graph: sources by callback, successors by vertex and callback."""
        self._dags: tuple[Dag, ...] = self.task_set.dags
        self._source: dict[str, tuple[int, int]] = {}
        self._next: dict[tuple[int, str], int] = {}
        self._sizes: dict[int, int] = {}
        vertices = {v.callback.key: number for number, v in enumerate(self.task_set.vertices)}
        self._vertex = {number: vertices[target.callback.key]
                        for number, target in self.targets.items()}
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

    @property
    def lost(self) -> int:
        """Return how many events the tracer discarded, as it reports."""
        return self._linker.discarded

    @property
    def unjudged(self) -> dict[int, int]:
        """Return by DAG the number of jobs whose fate is unknown."""
        return self._doubts.withdrawn

    def read(self, progress: Function[[int], None] | None = None) -> Recording:
        """Return the recording; ``progress`` is called regularly with the number of events."""
        count, take = 0, self._linker.take
        with named_errors(self._reader.path, self.name):
            for event in self._reader.layout_events(self._linker.events):
                take(event)
                count += 1
                if event[1] > self.end:
                    self.end = event[1]
                if progress is not None and count % _PROGRESS_STEP == 0:
                    progress(count)
        self._linker.finish()
        for dag, jobs in enumerate(self._open):
            for release, job in jobs:
                self._close(dag, job, release)
        executions = self._executions.table()
        executions['cpu'] = UNKNOWN
        return Recording(
            self.name, self.head, self.task_set, self.recorded_set, self.who, declared=False,
            imported=self._imported, same=False, releases=self._releases.table(),
            executions=executions, publications=self._sent.table(), job_ends=self._ends.table(),
            takes=self._taken.table(), start=self.start, end=self.end,
            judged_until=self._judged_until(), lost=self.lost,
            workers_each=self.head.workers, links=True,
            callback_vertex=self._vertex, unjudged=self.unjudged, warnings=self.warnings)

    def _judged_until(self) -> int:
        """Return the time at which open jobs are judged."""
        return self.end

    def _next_order(self) -> int:
        self._order += 1
        return self._order

    # --- executions ------------------------------------------------------------------------------

    def began(self, run: Execution, message: Publication | None) -> None:
        """Find the job of an execution that has begun, and report it."""
        target = self.targets.get(run.callback.number)
        run.ready = self._ready(run, message)
        if target is not None:
            self._assign(run, target, message)
        if self.start is None or run.ready < self.start:
            self.start = run.ready
        dag, vertex, job = run.of or (-1, -1, -1)
        number = UNKNOWN if message is None else message.number
        run.number = self._executions.add(
            run.callback.number, run.thread[1], run.ready, run.start, dag, vertex, job, run.leg,
            UNKNOWN, UNKNOWN, 0, number, UNKNOWN, 0, run.start, UNKNOWN)
        if run.of is not None:
            self._active[(dag, job)] += 1

    def _ready(self, run: Execution, message: Publication | None) -> int:
        if run.callback.kind == 'timer':
            return self._timers.release(run.callback, run.start)
        stamp = run.stamp if credible(run.stamp, run.start) else 0
        sent = stamp or (message.stamp or message.time if message is not None else 0)
        return min(sent or run.taken or run.start, run.start)

    def _assign(self, run: Execution, target: Target, message: Publication | None) -> None:
        """Find the job of an execution."""
        key = target.callback.key
        if key in self._source:
            dag, vertex = self._source[key]
            job = self._newest[dag] = self._newest[dag] + 1
            release = self._release(run, self._dags[dag], target)
            if run.callback.kind != 'timer':
                run.ready = max(run.ready, min(release, run.start))
            run.of = dag, vertex, job
            self._expire(run.start)
            self.jobs += 1
            self._doubts.opened(dag, job)
            self._open[dag].append((release, job))
            if self.start is None or release < self.start:
                self.start = release
            self._releases.add(dag, job, release, run.start, self._next_order())
        elif message is None or message.run is None:
            self._doubts.ran_for_unknown(key, run.start, message is not None or run.stamp != 0)
        elif message.run.of is not None:
            dag, before, job = message.run.of
            after = self._next.get((before, key))
            if after is not None:
                run.of = dag, after, job
                run.leg = self._leg.get((before, after, target.leg), 0)

    def _release(self, run: Execution, dag: Dag, target: Target) -> int:
        """Return the release of a source's execution."""
        if run.callback.kind == 'timer':
            return run.ready
        wanted = dag.release_from
        if wanted == 'header_stamp' and credible(run.stated, run.start):
            return min(run.stated, run.start)
        if wanted != 'arrival':
            known = credible(run.stamp, run.start)
            if not known or wanted == 'header_stamp':
                self._fallbacks[f'{target.callback.key} ({wanted})'] += 1
            if known:
                return min(run.stamp, run.start)
        return min(run.taken or run.start, run.start)

    def over(self, run: Execution) -> None:
        """Note the end of an execution, and what it completed."""
        columns = self._executions.columns
        columns['end'][run.number] = run.end
        columns['worker'][run.number] = self._workers.setdefault(run.thread, len(self._workers))
        ended = self._ended(run)
        columns['piece'][run.number] = ended.piece
        columns['began'][run.number], columns['busy'][run.number] = ended.start, ended.busy
        if run.of is None:
            return
        dag, vertex, job = run.of
        self._active[(dag, job)] -= 1
        if not ended.last:
            return
        whole = self._is_whole(vertex, job, run.leg)
        if whole:
            self._doubts.done(dag, vertex, job)
        columns['completes'][run.number] = VERTEX if whole else LEG
        columns['order'][run.number] = self._next_order()

    def _ended(self, run: Execution) -> Ended:
        """Return the ended execution; here each has one piece."""
        return Ended(0, True, run.start, run.end - run.start)

    def _is_whole(self, vertex: int, job: int, leg: int) -> bool:
        """Return whether an execution completes its vertex: the last leg of a sync vertex does."""
        if self._sizes[vertex] == 1:
            return True
        done = self._legs.setdefault((vertex, job), set())
        done.add(leg)
        if len(done) < self._sizes[vertex]:
            if len(self._legs) > _KEEP_LEGS:
                del self._legs[next(iter(self._legs))]
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

    def lost_sight(self, callback: Callback | None, run: Execution | None, time: int) -> None:
        """Doubt jobs: those of a callback that ran for an unknown one, or all open ones."""
        if callback is None:
            self._doubts.discarded(time)
        elif (target := self.targets.get(callback.number)) is not None:
            self._doubts.ran_for_unknown(target.callback.key, time)
        if run is not None and run.of is not None:
            dag, _, job = run.of
            self._active[(dag, job)] -= 1

    def sent(self, message: Publication) -> None:
        """Store a publication, and note that its job has sent it."""
        of = None if message.run is None else message.run.of
        if of is not None and (message.stamp or message.within):
            self._doubts.sent(of[0], of[2], message.topic)
        publisher, run = message.publisher, message.run
        vertex = number = UNKNOWN
        if run is not None:
            number = run.number
            target = self.targets.get(run.callback.number)
            if target is not None and publisher is not None and publisher.node is not None and (
                    target.callback.node == publisher.node.name):
                vertex = self._vertex[run.callback.number]
        message.number = self._sent.add(
            UNKNOWN if publisher is None else publisher.number, number, vertex, message.time,
            message.stamp)

    def took(self, run: Execution, message: Publication) -> None:
        """Note that a callback took a message itself."""
        if run.number >= 0:
            self._taken.add(run.number, message.number, run.start)

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
        if self.lost:
            lines.append(
                f'{name}: the tracer discarded {counted(self.lost, "event")} or more: executions '
                'and messages may be missing')
        lines += [f'{name}: {text}' for text in self._linker.losses.lines()]
        if self._doubts.withdrawn:
            dags = [f'{self._dags[dag].name} ({n})' for dag, n in self._doubts.withdrawn.items()]
            lines.append(
                f'{name}: not judged, because what is missing may be theirs: '
                f'{counted(sum(self._doubts.withdrawn.values()), "job")}: {listed(dags)}')
        lines.extend(f'{name}: {text}' for text in self._timers.odd.lines())
        if self._fallbacks:
            lines.append(
                f'{name}: {counted(sum(self._fallbacks.values()), "release")} by the next best '
                'stamp, because the declared one is not recorded or '
                'years away: '
                f'{listed(list(self._fallbacks))}')
        if self._dags and self.jobs == 0:
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
