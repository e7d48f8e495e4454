# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
An imported recording as a run: releases, executions, completions, ends of jobs.

Theory of operation
-------------------
A first pass over the trace finds out who is who (``entities``) and which of them the declaration
means (``mapping``).  The second links executions and messages (``linker``); jobs are made from
what is linked, and go to the observers.

1. *Releases.*  A timer is due at t_init + n * period (rcl keeps that grid, also after it was late
   by more than a period: it leaves out what it missed).  An execution's release is the last such
   time at its start; because `rcl_timer_init` is recorded a little after the timer has read its
   clock, one that starts up to `_SLACK_NS` before it has that release, too, then as of its start.
   Where t_init is not recorded, or the execution before has that release already (the timer was
   reset, or goes by another clock), it is released when it starts, and that is said.
   A subscription or service that nobody in the graph feeds is released as declared: by the stamp
   in the header or of the source, or when its message was taken.
2. *Jobs.*  Any other execution belongs to the job of the execution that published its message, as
   the successor of that one's vertex.  What ran for a message that is not in the recording, or of
   a callback that published for no job, ran as an undeclared callback.
3. *Ready* is a timer's release, else the source timestamp (the publication, within a process):
   when a message has reached its reader is not recorded, so the way there counts as waiting.
4. A job that has not completed `EXPIRE_AFTER_NS` past its latest deadline, and of which nothing
   runs, counts as expired, as in the executor's core does it.  What is open at the end of the
   recording is judged as of the last event.  A job of which it is not known what it did, because
   of what is missing in the recording (see ``doubts``), is withdrawn instead: it is not judged.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable as Function
from collections.abc import Sequence
from typing import NamedTuple

from mddag_executor.core import DEFAULT_DEADLINE_NS, EXPIRE_AFTER_NS, legs_of, NEVER
from mddag_executor.replay.doubts import Doubts
from mddag_executor.replay.entities import Callback, Entities, Event, INIT_EVENTS
from mddag_executor.replay.happenings import (
    Batches,
    BEGAN,
    COMPLETED,
    ENDED,
    Observer,
    OVER,
    PUBLISHED,
    RAN,
    RELEASED,
    SENT,
    STARTED,
    TOOK,
    WITHDRAWN,
)
from mddag_executor.replay.linker import (
    Execution,
    Linker,
    LinkObserver,
    Losses,
    Publication,
)
from mddag_executor.replay.mapping import Matching, Target
from mddag_executor.replay.recording import Head, named_errors, no_run
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
    What has ended with a run of a callback in a thread.

    :ivar first: whether it was the first piece of an execution, ``last``: whether the last.
    :ivar start: of the execution; ``busy``: how long it ran.
    """

    first: bool
    last: bool
    start: int
    busy: int


class ImportedRun(LinkObserver):
    """
    A recorded run of another executor.

    :param reader: of the trace, which no declaration is in.
    :param task_set: the declaration that judges; None: there is none.
    :param head: of a trace of this executor; None: another one recorded it.
    :param linker: links its events.
    """

    declared = False
    same = False
    imported = True

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
                own = True      # of this executor, but what it ran is lost
            else:
                init.append(event)
        if first is None or own and head is None:
            raise no_run(reader)
        #: Who is who in it.
        self.who = Entities()
        self.who.read(init)
        # What another executor goes by is not recorded; it takes the place of the pool.
        self.head = head or Head(
            first, '', '', 'ros2', len(threads), DEFAULT_DEADLINE_NS, 0, False)
        self._matching = Matching(name, self.who, threads, task_set)
        #: The declaration that judges; none is recorded.
        self.task_set = self.recorded_set = self._matching.task_set
        self.targets = self._matching.target
        #: The first release or the time at which the first execution became ready, ns.
        self.start: int | None = None
        #: The last event's time, ns.
        self.end = min(max(0, first), NEVER - 1)
        self.shut_down = False
        self.jobs = 0
        self.dropped: Counter[str] = Counter()
        self._doubts = Doubts(self.task_set.dags)
        self._linker = linker(self.who, self)
        self._workers: dict[tuple[int, int], int] = {}
        self._timers = _Timers()
        self._fallbacks: Counter[str] = Counter()
        self._number = self._messages = 0
        self._graph()

    def _graph(self) -> None:
        """Look up who starts whom: sources by callback, successors by vertex and callback."""
        self._dags: tuple[Dag, ...] = self.task_set.dags
        self._source: dict[str, tuple[int, int]] = {}
        self._next: dict[tuple[int, str], int] = {}
        self._sizes: dict[int, int] = {}
        vertices = {v.callback.key: number for number, v in enumerate(self.task_set.vertices)}
        self._vertex = {number: vertices[target.callback.key]
                        for number, target in self.targets.items()}
        # by the vertices before and after, and the place of the topic
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
        """Return how many events the tracer says to have discarded."""
        return self._linker.discarded

    @property
    def unjudged(self) -> dict[int, int]:
        """Return by DAG for how many jobs it is not known what they did."""
        return self._doubts.withdrawn

    def play(
        self, observers: Sequence[Observer], progress: Function[[int], None] | None = None
    ) -> None:
        """Give the observers everything, with the numbers of callbacks in place of addresses."""
        self._batches = Batches(observers)
        self._add = self._batches.add
        count = 0
        take = self._linker.take
        with named_errors(self._reader.path, self.name):
            for event in self._reader.layout_events(self._linker.events):
                take(event)
                count += 1
                if event[1] > self.end:
                    self.end = event[1]
                self._batches.flush_if_full()
                if progress is not None and count % _PROGRESS_STEP == 0:
                    progress(count)
        self._linker.finish()
        for dag, jobs in enumerate(self._open):
            for release, job in jobs:
                self._close(dag, job, release)
        self._batches.finish(self._judged_until())

    def _judged_until(self) -> int:
        """Return up to when what is open is judged."""
        return self.end

    # --- executions ------------------------------------------------------------------------------

    def began(self, run: Execution, message: Publication | None) -> None:
        """Find the job of an execution that has begun, and report it."""
        target = self.targets.get(run.callback.number)
        run.ready = self._ready(run, message)
        if target is not None:
            self._assign(run, target, message)
        if self.start is None or run.ready < self.start:
            self.start = run.ready
        run.number = self._number = self._number + 1
        callback = run.callback.number
        number = publisher = time = -1
        if message is not None:
            number = message.number
            if message.publisher is not None and message.time:
                publisher, time = message.publisher.number, message.time
        self._add(BEGAN, callback, self._vertex.get(callback, -1), run.number, run.start, number,
                  publisher, time)
        if target is not None and run.of is not None:
            dag, vertex, job = run.of
            self._active[(dag, job)] += 1
            self._add(STARTED, dag, vertex, job, run.ready, run.start, callback, -1)

    def _ready(self, run: Execution, message: Publication | None) -> int:
        if run.callback.kind == 'timer':
            return self._timers.release(run.callback, run.start)
        stamp = run.stamp if credible(run.stamp, run.start) else 0
        sent = stamp or (message.stamp or message.time if message is not None else 0)
        return min(sent or run.taken or run.start, run.start)

    def _assign(self, run: Execution, target: Target, message: Publication | None) -> None:
        """Find the job that an execution belongs to."""
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
            self._add(RELEASED, dag, job, release, run.start)
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
        """Report an execution that has ended, and of what it completes."""
        callback = run.callback.number
        self._add(OVER, callback, self._vertex.get(callback, -1), run.number, run.end)
        dag, vertex, job = run.of if run.of is not None else (-1, -1, -1)
        worker = self._workers.setdefault(run.thread, len(self._workers))
        ended = self._ended(run)
        self._add(RAN, callback, dag, vertex, job, worker, run.ready, run.start,
                  run.end, int(ended.first))
        if dag < 0:
            return
        self._active[(dag, job)] -= 1
        if not ended.last:
            return
        whole = self._is_whole(vertex, job, run.leg)
        if whole:
            self._doubts.done(dag, vertex, job)
        self._add(COMPLETED, dag, vertex, job, run.leg, int(whole), run.end, run.ready,
                  ended.start, run.end, ended.busy, run.number, -1, 0)

    def _ended(self, run: Execution) -> Ended:
        """Return what has ended with a run of a callback: one piece is all of an execution."""
        return Ended(True, True, run.start, run.end - run.start)

    def _is_whole(self, vertex: int, job: int, leg: int) -> bool:
        """Return whether an execution completes its vertex: of a sync's legs the last one does."""
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
                    self._add(ENDED, dag, job, 0, now)
            jobs.extendleft(reversed(running))

    def _close(self, dag: int, job: int, release: int) -> bool:
        """Take a job that cannot be judged out of the run; return whether it is one."""
        doubted = self._doubts.close(dag, job, release)
        if doubted:
            self._add(WITHDRAWN, dag, job)
        return doubted

    def lost_sight(self, callback: Callback | None, run: Execution | None, time: int) -> None:
        """Note what is not known of a callback."""
        if callback is None:
            self._doubts.discarded(time)
        elif (target := self.targets.get(callback.number)) is not None:
            self._doubts.ran_for_unknown(target.callback.key, time)
        if run is not None and run.of is not None:
            dag, _, job = run.of
            self._active[(dag, job)] -= 1

    def sent(self, message: Publication) -> None:
        """Keep in mind which jobs have sent what."""
        of = None if message.run is None else message.run.of
        if of is not None and (message.stamp or message.within):
            self._doubts.sent(of[0], of[2], message.topic)
        message.number = self._messages = self._messages + 1
        publisher, run = message.publisher, message.run
        if publisher is None:
            return
        callback, ready, vertex, number = -1, -1, -1, -1
        if run is not None:
            callback, ready, number = run.callback.number, run.ready, run.number
            target = self.targets.get(callback)
            if target is not None and publisher.node is not None and (
                    target.callback.node == publisher.node.name):
                vertex = self._vertex[callback]
        self._add(PUBLISHED, publisher.number, callback, *(of or (-1, -1, -1)), ready,
                  message.time)
        self._add(SENT, publisher.number, vertex, number, message.number, message.time)

    def took(self, run: Execution, message: Publication) -> None:
        """Report that a callback took a message itself."""
        callback = run.callback.number
        self._add(TOOK, callback, self._vertex.get(callback, -1), run.number, message.number)

    # --- what to say -----------------------------------------------------------------------------

    @property
    def warnings(self) -> list[str]:
        """Return what is missing or doubtful, one line each, once it has been played."""
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
