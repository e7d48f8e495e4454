# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What the events of a run say: releases, executions, completions, ends of jobs.

Theory of operation
-------------------
The executor records `job_release`, `fail`, `complete`, `expire`, `abort`, `deadline` and `drop` in
the order in which its scheduler core saw them, with times that never decrease.  So in the order of
time (a stable one: what has the same time stays in the order of the file) they are the same
sequence again, and whoever feeds it to a core gets the same verdicts.

`dispatch`, `callback_start` and `callback_end` come from the thread that ran the callback; they
belong together by thread and by the callback's address.  One such run is a *piece*.  An execution
is one piece, or several where a coroutine was suspended in between; they have the same vertex, job
and ready time.  `complete`, from the same thread, ends an execution of a declared callback;
several in a row end the legs of a sync callback that ran only once (a simulator's).

The observers are told in terms of the declaration that judges (see ``mapping``); DAG and vertex
are -1 for what it does not declare.  Another kind of recording needs another follower, and no
other observers.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from mddag_executor.core import NEVER
from mddag_executor.replay.mapping import Mapping
from mddag_executor.replay.recording import Recording, TASK_SET
from mddag_executor.text import counted
from mddag_executor.trace.times import credible

_PROGRESS_STEP = 4096
_KEEP_UNDECLARED = 4096

Event = tuple[Any, ...]
Key = tuple[int, int, int, int]


class Piece(NamedTuple):
    """One run of a callback in a thread; `first` tells the first piece of an execution."""

    callback: int
    dag: int
    vertex: int
    job: int
    worker: int
    ready: int
    start: int
    end: int
    first: bool


class Execution(NamedTuple):
    """A whole execution: ready, first start, last end, and the time that its pieces took, ns."""

    ready: int
    start: int
    end: int
    busy: int


class Observer:
    """Is told what happened; does nothing with it."""

    def hosted(self, dag: int, vertices: set[int]) -> None:
        """Take in which (global) vertices of a DAG the process has from here on."""

    def judging(self, release: int) -> None:
        """Take in that from here on only jobs released at a time or later are judged."""

    def released(self, dag: int, job: int, release: int, now: int) -> None:
        """Take in the release of a job; `now` is when the executor noticed it."""

    def started(self, dag: int, vertex: int, job: int, ready: int, start: int) -> None:
        """Take in that an execution of a vertex was dispatched (or a coroutine went on)."""

    def ran(self, piece: Piece) -> None:
        """Take in that a callback ran."""

    def completed(
        self, dag: int, vertex: int, job: int, leg: int, whole: bool, end: int,
        execution: Execution | None,
    ) -> None:
        """
        Take in that an execution of a vertex has completed.

        :param whole: whether that completed the vertex, as the executor saw it.
        :param execution: its times, None where they are not in the trace; the same object again
            for further legs that one execution completes.
        """

    def ended(self, dag: int, job: int, aborted: bool, now: int) -> None:
        """Take in that a job was aborted or, else, has expired."""

    def withdrawn(self, dag: int, job: int) -> None:
        """Take in that nobody can tell what became of a job: it is not to be judged."""

    def failed(self, dag: int, vertex: int, job: int, now: int) -> None:
        """Take in that an execution of a vertex failed: its job does; told before it completes."""

    def missed(self, dag: int, vertex: int, job: int, deadline: int, completed: int) -> None:
        """Take in a miss as the executor saw it; `completed` is -1 where it never did."""

    def finished(self, now: int) -> None:
        """Take in that the run has ended; what it had begun may still complete."""


def _who_cares(observers: Sequence[Observer], what: str) -> list[Callable[..., None]]:
    """Return the methods of that name that are not the one of `Observer`, which does nothing."""
    return [getattr(observer, what) for observer in observers
            if getattr(type(observer), what) is not getattr(Observer, what)]


class _Running:
    """What a thread runs."""

    __slots__ = ('callback', 'dag', 'vertex', 'job', 'worker', 'ready', 'start')

    def __init__(
        self, callback: int, dag: int, vertex: int, job: int, worker: int, ready: int, start: int,
    ) -> None:
        self.callback = callback
        self.dag = dag
        self.vertex = vertex
        self.job = job
        self.worker = worker
        self.ready = ready
        self.start = start


class Follower:
    """
    Goes through the events of a recording once.

    :param more: handlers of further events, by full name.
    """

    def __init__(
        self, recording: Recording, mapping: Mapping, observers: Sequence[Observer],
        more: dict[str, Callable[[Event], None]] | None = None,
    ) -> None:
        self._recording = recording
        self._mapping = mapping
        self._observers = observers
        # what happens most often is told only to those who do something with it
        self._tell_started = _who_cares(observers, 'started')
        self._tell_ran = _who_cares(observers, 'ran')
        self._tell_completed = _who_cares(observers, 'completed')
        self._handlers: dict[str, Callable[[Event], None]] = {
            'ros2:callback_start': self._start,
            'ros2:callback_end': self._end,
            TASK_SET: self._task_set,
            'mddag:hosted': self._hosted,
            'mddag:judge_from': self._judge_from,
            'mddag:job_release': self._release,
            'mddag:dispatch': self._dispatch,
            'mddag:complete': self._complete,
            'mddag:deadline': self._deadline,
            'mddag:drop': self._drop,
            'mddag:fail': self._fail,
            'mddag:expire': self._expire,
            'mddag:abort': self._abort,
            'mddag:lost': self._lost,
            'mddag:shutdown': self._shutdown,
            **(more or {}),
        }
        #: The first release or the time at which the first execution became ready, ns.
        self.start: int | None = None
        #: The run's end, ns: as recorded, or the last thing that the executor's core saw.
        self.end = 0
        self.shut_down = False
        #: The callback of which observers are told that it has started.
        self.starting = 0
        self.jobs = 0
        self.lost = 0
        self.dropped: Counter[str] = Counter()
        self._strange: Counter[str] = Counter()
        self._newest = [-1] * len(mapping.dag)
        self._running: dict[int, _Running] = {}
        # by thread: the execution whose piece ended last; by execution that is not complete: its
        # pieces so far
        self._last: dict[int, tuple[Key, Execution]] = {}
        self._open: dict[Key, Execution] = {}
        self._undeclared: dict[tuple[int, int], None] = {}

    def run(self, progress: Callable[[int], None] | None = None) -> None:
        """
        Tell the observers everything.

        :param progress: told now and then how many events there have been.
        """
        handlers = self._handlers
        count = 0
        for event in self._recording.events(set(handlers)):
            if None in event:
                self._strange[f'{event[0]} without some of its fields'] += 1
                continue
            handlers[event[0]](event)
            count += 1
            if progress is not None and count % _PROGRESS_STEP == 0:
                progress(count)
        if not self.shut_down:
            if self.end == 0:
                self.end = min(max(0, self._recording.head.time), NEVER - 1)
            for observer in self._observers:
                observer.finished(self.end)

    @property
    def handlers(self) -> dict[str, Callable[[Event], None]]:
        """Return what takes in the events, by full name."""
        return self._handlers

    @property
    def strange(self) -> bool:
        """Tell whether there were events that make no sense."""
        return bool(self._strange)

    def warnings(self) -> list[str]:
        """Return what was wrong with the events, one line each."""
        name = self._recording.name
        lines = []
        if not self.shut_down:
            lines.append(
                f'{name}: the end of the run is not recorded (the process was killed, or the '
                'trace is cut): what was open is judged at the last recorded instant')
        if self.lost:
            lines.append(
                f'{name}: {counted(self.lost, "event")} lost while recording: jobs may be '
                'missing, or count as late that were not')
        if self._strange:
            what, n = self._strange.most_common(1)[0]
            lines.append(
                f'{name}: left out: {counted(sum(self._strange.values()), "event")} that make no '
                f'sense, most often ({n}) {what}')
        if self.jobs == 0:
            lines.append(f'{name}: no job was released in it')
        return lines

    # --- what a thread runs ----------------------------------------------------------------------

    def running_in(self, thread: int) -> tuple[int, int, int, int, int] | None:
        """Return callback, DAG, vertex, job and ready time of what a thread runs."""
        running = self._running.get(thread)
        if running is None:
            return None
        return running.callback, running.dag, running.vertex, running.job, running.ready

    def _dispatch(self, event: Event) -> None:
        _, now, _, thread, callback, dag, vertex, job, worker, ready, _ = event
        if not 0 <= ready <= now:
            self._strange[f'{event[0]} before it was ready'] += 1
            self._running.pop(thread, None)
            return
        # what no DAG declares has -1; look_up answers that to other nonsense, too
        dag, vertex, _ = self._mapping.look_up(dag, vertex, 0)
        self._running[thread] = _Running(callback, dag, vertex, job, worker, ready, now)
        self.starting = callback
        if dag >= 0:
            for started in self._tell_started:
                started(dag, vertex, job, ready, now)

    def _start(self, event: Event) -> None:
        running = self._running.get(event[3])
        if running is not None and running.callback == event[4]:
            running.start = event[1]

    def _end(self, event: Event) -> None:
        _, now, _, thread, callback = event
        running = self._running.pop(thread, None)
        self._last.pop(thread, None)
        if running is None or running.callback != callback:
            return  # no executor of ours ran it
        ready, start = running.ready, running.start
        if self.start is None or ready < self.start:
            self.start = ready
        if running.dag >= 0:
            key = (running.dag, running.vertex, running.job, ready)
            before = self._open.get(key)
            execution = Execution(ready, start, now, now - start) if before is None \
                else Execution(ready, before.start, now, before.busy + now - start)
            self._open[key] = execution
            self._last[thread] = key, execution
            first = before is None
        else:
            first = self._is_new(callback, ready)
        piece = Piece(
            callback, running.dag, running.vertex, running.job, running.worker, ready, start, now,
            first)
        for ran in self._tell_ran:
            ran(piece)

    def _is_new(self, callback: int, ready: int) -> bool:
        """Tell whether an undeclared callback's piece is the first of its execution."""
        recent = self._undeclared
        if (callback, ready) in recent:
            return False
        recent[(callback, ready)] = None
        if len(recent) > _KEEP_UNDECLARED:
            del recent[next(iter(recent))]
        return True

    # --- what the executor's core saw ------------------------------------------------------------

    def _advance(self, now: int) -> None:
        if now > self.end and not self.shut_down:
            self.end = now

    def _hosted(self, event: Event) -> None:
        _, now, _, _, dag, text = event
        self._advance(now)
        words = text.split(',') if text else []
        declared = self._mapping.vertex
        if not 0 <= dag < len(declared) or not all(
                w.isascii() and w.isdigit() and int(w) < len(declared[dag]) for w in words):
            self._strange[f'{event[0]} of a vertex that is not declared'] += 1
            return
        vertices = {declared[dag][int(word)] for word in words} - {-1}
        dag = self._mapping.dag[dag]
        if dag >= 0:
            for observer in self._observers:
                observer.hosted(dag, vertices)

    def _judge_from(self, event: Event) -> None:
        _, now, _, _, release = event
        self._advance(now)
        if not 0 <= release <= NEVER:
            self._strange[f'{event[0]} an impossible time'] += 1
            return
        for observer in self._observers:
            observer.judging(release)

    def _release(self, event: Event) -> None:
        _, now, _, _, dag, job, release = event
        self._advance(now)
        if not 0 <= dag < len(self._mapping.dag):
            self._strange[f'{event[0]} of a DAG that is not declared'] += 1
            return
        if not 0 <= release <= now:
            self._strange[f'{event[0]} of a release that is still to come'] += 1
            return
        if release and not credible(release, now):
            self._strange[f'{event[0]} of a release years ago'] += 1
            return
        if job <= self._newest[dag]:
            self._strange[f'{event[0]} of a job that is not newer than the last'] += 1
            return
        self._newest[dag] = job
        self.jobs += 1
        if self.start is None or release < self.start:
            self.start = release
        dag = self._mapping.dag[dag]
        if dag >= 0:
            for observer in self._observers:
                observer.released(dag, job, release, now)

    def _complete(self, event: Event) -> None:
        _, now, _, thread, _, dag, vertex, job, whole, end, leg = event
        self._advance(now)
        last = self._last.get(thread)
        declared = self._mapping.vertex
        if not 0 <= dag < len(declared) or not 0 <= vertex < len(declared[dag]):
            self._strange[f'{event[0]} of a vertex that is not declared'] += 1
            return
        if not 0 <= end <= now:
            self._strange[f'{event[0]} of an end that is still to come'] += 1
            return
        dag, vertex, leg = self._mapping.look_up(dag, vertex, leg)
        if dag < 0:
            return
        execution = None
        if last is not None and last[0][:3] == (dag, vertex, job):
            execution = last[1]
            self._open.pop(last[0], None)
        for completed in self._tell_completed:
            completed(dag, vertex, job, leg, whole, end, execution)

    def _fail(self, event: Event) -> None:
        _, now, _, _, dag, vertex, job = event
        self._advance(now)
        dag, vertex, _ = self._mapping.look_up(dag, vertex, 0)
        if dag >= 0:
            for observer in self._observers:
                observer.failed(dag, vertex, job, now)

    def _expire(self, event: Event) -> None:
        self._job_end(event, False)

    def _abort(self, event: Event) -> None:
        self._job_end(event, True)

    def _job_end(self, event: Event, aborted: bool) -> None:
        _, now, _, _, dag, job = event
        self._advance(now)
        if not 0 <= dag < len(self._mapping.dag):
            self._strange[f'{event[0]} of a DAG that is not declared'] += 1
            return
        dag = self._mapping.dag[dag]
        if dag >= 0:
            for observer in self._observers:
                observer.ended(dag, job, aborted, now)

    def _deadline(self, event: Event) -> None:
        _, now, _, _, dag, vertex, job, deadline, completed = event
        self._advance(now)
        dag, vertex, _ = self._mapping.look_up(dag, vertex, 0)
        for observer in self._observers:
            observer.missed(dag, vertex, job, deadline, completed)

    def _drop(self, event: Event) -> None:
        self._advance(event[1])
        self.dropped[event[8]] += 1

    def _lost(self, event: Event) -> None:
        self.lost += event[4]

    def _task_set(self, event: Event) -> None:
        head = self._recording.head
        if event[4] != head.yaml:
            self._strange[f'{event[0]} with another declaration'] += 1

    def _shutdown(self, event: Event) -> None:
        if self.shut_down:
            return
        if not self.end <= event[4] < NEVER:
            self._strange[f'{event[0]} at an impossible time'] += 1
            return
        self.end = event[4]
        self.shut_down = True
        for observer in self._observers:
            observer.finished(self.end)
