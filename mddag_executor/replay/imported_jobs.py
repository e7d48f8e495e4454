# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What an imported recording says: releases, executions, completions, ends of jobs.

Theory of operation
-------------------
The follower of recordings of other executors (see ``follower`` for our own): it makes jobs from
what the linker says (see ``links``), and tells the same observers.

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
   runs, is told to have expired, as the executor's core does it.  What is open at the end of the
   recording is judged as of the last event.  A job of which nobody can tell what it did, because
   of what is missing in the recording (see ``doubts``), is withdrawn instead: it is not judged.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable as Function
from collections.abc import Sequence
from typing import Any

from mddag_executor.core import legs_of, NEVER
from mddag_executor.replay.doubts import Doubts
from mddag_executor.replay.entities import Callback
from mddag_executor.replay.follower import Execution, Observer, Piece
from mddag_executor.replay.imported import ImportedMapping, ImportedRecording, Target
from mddag_executor.replay.linked import Publication, Run
from mddag_executor.replay.links import Linker
from mddag_executor.replay.paths import PathBook
from mddag_executor.text import counted, listed
from mddag_executor.trace.times import credible
from msg_graph import Dag

EXPIRE_AFTER_NS = 1_000_000_000
_SLACK_NS = 1_000_000
_PROGRESS_STEP = 4096
_KEEP_LEGS = 65_536

Event = tuple[Any, ...]
Handlers = dict[str, Function[[Event], None]]


class ImportedFollower:
    """
    Goes through the events of an imported recording once.

    :param more: handlers of the events that name callbacks and their groups: they are told of the
        recording's with the numbers of callbacks in place of addresses.
    :param sinks: are told what the linker says, too.
    """

    def __init__(
        self, recording: ImportedRecording, mapping: ImportedMapping,
        observers: Sequence[Observer], more: Handlers | None = None,
        sinks: Sequence[Any] = (),
    ) -> None:
        self._recording = recording
        self._target = mapping.target
        self._observers = observers
        self._sinks = sinks
        #: The flows along the declared paths.
        self.paths = PathBook(mapping.task_set)
        #: The first release or the time at which the first execution became ready, ns.
        self.start: int | None = None
        #: The last event's time, ns.
        self.end = min(max(0, recording.head.time), NEVER - 1)
        self.shut_down = False
        self.jobs = 0
        self.dropped: Counter[str] = Counter()
        self.doubts = Doubts(mapping.task_set.dags)
        self.linker = Linker(recording.entities, self)
        self._workers: dict[tuple[int, int], int] = {}
        self._timers = _Timers()
        self._fallbacks: Counter[str] = Counter()
        self._graph(mapping)
        _tell_groups(recording, more or {})

    def _graph(self, mapping: ImportedMapping) -> None:
        """Look up who starts whom: sources by callback, successors by vertex and callback."""
        self._dags: tuple[Dag, ...] = mapping.task_set.dags
        self._source: dict[str, tuple[int, int]] = {}
        self._next: dict[tuple[int, str], int] = {}
        self._sizes: dict[int, int] = {}
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
        return self.linker.losses.discarded

    def run(self, progress: Function[[int], None] | None = None) -> None:
        """
        Tell the observers everything.

        :param progress: told now and then how many events there have been.
        """
        count = 0
        take = self.linker.take
        for event in self._recording.events(self.linker.events):
            take(event)
            count += 1
            if event[1] > self.end:
                self.end = event[1]
            if progress is not None and count % _PROGRESS_STEP == 0:
                progress(count)
        self.linker.finish()
        for dag, jobs in enumerate(self._open):
            for release, job in jobs:
                self._close(dag, job, release)
        for observer in self._observers:
            observer.finished(self.end)

    # --- executions ------------------------------------------------------------------------------

    def started(self, run: Run, message: Publication | None) -> None:
        """Take in that an execution has begun."""
        for sink in self._sinks:
            sink.started(run, message)
        target = self._target.get(run.callback.number)
        now = run.start
        run.ready = self._ready(run, message)
        if target is not None:
            self._assign(run, target, message)
        if self.start is None or run.ready < self.start:
            self.start = run.ready
        if target is None:
            return
        if run.of is not None:
            dag, vertex, job = run.of
            self._active[(dag, job)] += 1
            for observer in self._observers:
                observer.started(dag, vertex, job, run.ready, now)
        self.paths.tidy()
        self.paths.started(
            target.callback.key, run.places, now, None if message is None else message.places,
            target.topic)

    def _ready(self, run: Run, message: Publication | None) -> int:
        if run.callback.kind == 'timer':
            return self._timers.release(run.callback, run.start)
        stamp = run.stamp if credible(run.stamp, run.start) else 0
        sent = stamp or (message.stamp or message.time if message is not None else 0)
        return min(sent or run.taken or run.start, run.start)

    def _assign(self, run: Run, target: Target, message: Publication | None) -> None:
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
            self.doubts.opened(dag, job)
            self._open[dag].append((release, job))
            if self.start is None or release < self.start:
                self.start = release
            for observer in self._observers:
                observer.released(dag, job, release, run.start)
        elif message is None or message.run is None:
            self.doubts.ran_for_unknown(key, run.start, message is not None or run.stamp != 0)
        elif message.run.of is not None:
            dag, before, job = message.run.of
            after = self._next.get((before, key))
            if after is not None:
                run.of = dag, after, job
                run.leg = self._leg.get((before, after, target.leg), 0)

    def _release(self, run: Run, dag: Dag, target: Target) -> int:
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

    def ended(self, run: Run) -> None:
        """Take in that an execution has ended."""
        for sink in self._sinks:
            sink.ended(run)
        dag, vertex, job = run.of if run.of is not None else (-1, -1, -1)
        worker = self._workers.setdefault(run.thread, len(self._workers))
        piece = Piece(run.callback.number, dag, vertex, job, worker, run.ready, run.start,
                      run.end, True)
        for observer in self._observers:
            observer.ran(piece)
        target = self._target.get(run.callback.number)
        if target is None:
            return
        if dag >= 0:
            self._active[(dag, job)] -= 1
            whole = self._is_whole(vertex, job, run.leg)
            if whole:
                self.doubts.done(dag, vertex, job)
            execution = Execution(run.ready, run.start, run.end, run.end - run.start)
            for observer in self._observers:
                observer.completed(dag, vertex, job, run.leg, whole, run.end, execution)
        self.paths.ended(target.callback.key, run.places, run.end)

    def _is_whole(self, vertex: int, job: int, leg: int) -> bool:
        """Tell whether an execution completes its vertex: of a sync's legs the last one does."""
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
            while jobs and now - jobs[0][0] > self._patience[dag]:
                if self._active[(dag, jobs[0][1])] > 0:
                    break
                release, job = jobs.popleft()
                del self._active[(dag, job)]
                if not self._close(dag, job, release):
                    for observer in self._observers:
                        observer.ended(dag, job, False, now)

    def _close(self, dag: int, job: int, release: int) -> bool:
        """Take a job that cannot be judged out of the run; tell whether it is one."""
        doubted = self.doubts.close(dag, job, release)
        if doubted:
            for observer in self._observers:
                observer.withdrawn(dag, job)
        return doubted

    def missing(self, callback: Callback | None, run: Run | None, time: int) -> None:
        """Take in that something is not recorded."""
        if callback is None:
            self.doubts.discarded(time)
        elif (target := self._target.get(callback.number)) is not None:
            self.doubts.ran_for_unknown(target.callback.key, time)
        if run is not None and run.of is not None:
            dag, _, job = run.of
            self._active[(dag, job)] -= 1

    # --- messages --------------------------------------------------------------------------------

    def published(self, message: Publication) -> None:
        """Take in that a message was published."""
        for sink in self._sinks:
            sink.published(message)
        publisher = message.publisher
        of = None if message.run is None else message.run.of
        if of is not None and (message.stamp or message.within):
            self.doubts.sent(of[0], of[2], message.topic)
        if (publisher is None or publisher.node is None
                or publisher.topic not in self.paths.topics):
            return
        target = None if message.run is None else self._target.get(message.run.callback.number)
        key = places = None
        if target is not None and target.callback.node == publisher.node.name:
            assert message.run is not None
            key, places = target.callback.key, message.run.places
        self.paths.published(
            publisher.topic, publisher.node.name, key, places, message.places,
            (message.rclcpp or message.rcl, message.rcl, message.dds))

    def took(self, run: Run, message: Publication) -> None:
        """Take in that a callback took a message itself."""
        target = self._target.get(run.callback.number)
        if target is not None:
            self.paths.took(target.callback.key, run.places, message.places)

    # --- what to say -----------------------------------------------------------------------------

    def warnings(self) -> list[str]:
        """Return what is missing or doubtful, one line each."""
        name = self._recording.name
        lines = [f'{name}: {text}' for text in self.linker.losses.lines()]
        if self.doubts.withdrawn:
            dags = [f'{self._dags[dag].name} ({n})' for dag, n in self.doubts.withdrawn.items()]
            lines.append(
                f'{name}: not judged, because what is missing may be theirs: '
                f'{counted(sum(self.doubts.withdrawn.values()), "job")}: {listed(dags)}')
        lines.extend(f'{name}: {text}' for text in self._timers.lines())
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
        self._without: Counter[str] = Counter()
        self._off: Counter[str] = Counter()
        self._skipped: Counter[str] = Counter()

    def release(self, timer: Callback, start: int) -> int:
        """Return the release of an execution."""
        if timer.grid is None or timer.period <= 0:
            self._without[timer.label] += 1
            return start
        slack = min(_SLACK_NS, timer.period // 10)
        n = (start - timer.grid + slack) // timer.period
        last = self._last.get(timer.number)
        if n < 1 or (last is not None and n <= last):
            self._off[timer.label] += 1
            return start
        if last is not None and n > last + 1:
            self._skipped[timer.label] += n - last - 1
        self._last[timer.number] = n
        return min(timer.grid + n * timer.period, start)

    def lines(self) -> list[str]:
        """Return what to say about them."""
        said = (
            (self._without, 'execution', 'of timers whose initialisation is not in it: released '
             'when it started'),
            (self._off, 'execution', 'of timers off the grid of the period (reset, or by another '
             'clock): released when it started'),
            (self._skipped, 'period', 'of timers passed without an execution (late by more than '
             'one, or events were lost): without a job'))
        return [f'{counted(sum(counts.values()), noun)} {text}: '
                + listed([f'{name} ({n})' for name, n in counts.most_common()])
                for counts, noun, text in said if counts]


def _tell_groups(recording: ImportedRecording, more: Handlers) -> None:
    """Tell the handlers of callback groups what the recording has, by numbers of callbacks."""
    def tell(name: str, *fields: Any) -> None:
        if name in more:
            more[name]((name, recording.head.time, 0, 0, *fields))

    for callback in recording.entities.every:
        tell('ros2:rclcpp_callback_register', callback.number,
             callback.label or callback.description)
        if callback.group is None or callback.kind not in ('timer', 'subscription', 'service'):
            continue
        kind = 'reentrant' if callback.group < 0 else 'mutually_exclusive'
        tell('ros2_caret:add_callback_group', 0, callback.group, kind)
        tell(f'ros2_caret:callback_group_add_{callback.kind}', callback.group, callback.number)
