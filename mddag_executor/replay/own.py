# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A trace of this executor as a run: what its events say, in batches.

Theory of operation
-------------------
1. The executor records `job_release`, `fail`, `complete`, `expire`, `abort`, `deadline` and `drop`
   in the order in which its scheduler core saw them, with times that never decrease.  So in the
   order of time (a stable one: what has the same time stays in the order of the file) they are the
   same sequence again, and a core that gets it gives the same verdicts.
2. `dispatch`, `callback_start` and `callback_end` come from the thread that ran the callback; they
   belong together by thread and by the callback's address.  `complete` is of the execution whose
   piece ended last in its thread.
3. Events come as columns (``trace.events``), sorted by thread here: so what belongs together is
   what stands next to each other, and numpy finds it for some thousand at a time.  What a thread
   runs at the end of a batch is put in front of the next.
4. Events that are no numbers only, or say who is who, are taken in one by one; where one of them
   changes what others mean, the batch is cut.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from mddag_executor.core import NEVER
from mddag_executor.replay.entities import Entities, OWN_INIT_EVENTS
from mddag_executor.replay.happenings import (
    Batch,
    COMPLETED,
    different,
    ENDED,
    Event,
    FAILED,
    FIELD,
    Ints,
    MISSED,
    NOW,
    Numbers,
    Observer,
    PUBLISHED,
    RAN,
    RELEASED,
    STARTED,
    tell_end,
    THREAD,
)
from mddag_executor.replay.mapping import Mapping
from mddag_executor.replay.recording import declared, Head, named_errors, no_end, TASK_SET
from mddag_executor.text import counted
from mddag_executor.trace import TraceReader
from mddag_executor.trace.errors import renamed
from mddag_executor.trace.events import Events
from mddag_executor.trace.times import FAR_NS
from msg_graph import Process, TaskSet
import numpy as np

_KEEP_UNDECLARED = 4096
_RELEASE, _DISPATCH, _COMPLETE = 'mddag:job_release', 'mddag:dispatch', 'mddag:complete'
_START, _END, _PUBLISH = 'ros2:callback_start', 'ros2:callback_end', 'ros2:rclcpp_publish'
_DEADLINE, _FAIL, _EXPIRE, _ABORT, _LOST, STOP = (
    f'mddag:{name}' for name in ('deadline', 'fail', 'expire', 'abort', 'lost', 'stop'))
_NUMBERS = (_START, _END, _PUBLISH, _RELEASE, _DISPATCH, _COMPLETE, _DEADLINE,
            _FAIL, _EXPIRE, _ABORT, _LOST, STOP)
_DROP, _HOSTED, _SHUTDOWN = 'mddag:drop', 'mddag:hosted', 'mddag:shutdown'
_JUDGE_FROM = 'mddag:judge_from'
_CUT = OWN_INIT_EVENTS | {_HOSTED, _JUDGE_FROM, _SHUTDOWN}     # what others mean changes there
_WIDTH = 10     # of a dispatch
# Columns of an execution.
X_DAG, X_VERTEX, X_JOB, X_READY, X_START, X_END, X_BUSY, X_NUMBER, _N_EXECUTION = range(9)
# What is sorted by thread.
_OF_THREAD = (_DISPATCH, _START, _END, _COMPLETE, _PUBLISH)
_IS_DISPATCH, _IS_START, _IS_END, _IS_COMPLETE, _IS_PUBLISH = range(5)

_OF_LINE = (THREAD, NOW, FIELD)

Add = Callable[..., None]


class OwnRun:
    """
    A recorded run of this executor.

    :param reader: of the trace.
    :param task_set: the declaration that judges; None: the one in the trace.
    """

    declared = True
    imported = False

    def __init__(
        self, reader: TraceReader, name: str, head: Head, task_set: TaskSet | None
    ) -> None:
        self._reader = reader
        self.name, self.head = name, head
        #: What ``open_run`` is to be given to open it again.
        self.recording = reader.path, task_set, name
        #: Who is who in it.
        self.who = Entities(by_address=True)
        #: The DAG tasks that it was recorded with; its events refer to them by index.
        self.recorded_set = declared(head, name)
        self._mapping = mapping = Mapping(name, self.recorded_set, task_set)
        #: The declaration that judges, and whether it is the recorded one.
        self.task_set, self.same = mapping.task_set, mapping.same
        #: The first release or the time at which the first execution became ready, ns.
        self.start: int | None = None
        #: The run's end, ns: as recorded, or the last thing that the executor's core saw.
        self.end = 0
        self.shut_down = False
        #: How many processes' traces are in it; each has so many workers of its own.
        self.processes = 1
        self.workers_each = head.workers
        #: Which nodes ran in which of them; empty: all in one.
        self.placed: Sequence[Process] = ()
        #: Called when it has been played.
        self.when_played: Callable[[], object] | None = None
        #: What is to be said of it beside: of the traces that it was joined from.
        self.notes: list[str] = []
        #: What its workers are called, where that is more than a number.
        self.worker_names: list[str] = []
        self.jobs = 0
        self.lost = 0
        self.dropped: Counter[str] = Counter()
        self._strange: Counter[str] = Counter()
        self._newest = [-1] * len(mapping.dag)
        self._targets = _Targets(mapping)
        self._threads = _Threads(self, self._targets)

    def play(
        self, observers: Sequence[Observer], progress: Callable[[int], None] | None = None
    ) -> None:
        """Give the observers everything."""
        self._observers = observers
        count = 0
        with named_errors(self._reader.path, self.name):
            for events in self._reader.batches(
                    {*_NUMBERS, *_CUT, TASK_SET, _DROP}):
                self._play(events)
                count += len(events)
                if progress is not None:
                    progress(count)
        if not self.shut_down:
            if self.end == 0:
                self.end = min(max(0, self.head.time), NEVER - 1)
            tell_end(self._observers, self.end)
        self._observers = ()
        if self.when_played is not None:
            self.when_played()

    @property
    def events(self) -> int:
        """Return how many events are in it, 0 where that is not known before it is played."""
        return self._reader.message_count or 0

    @property
    def warnings(self) -> list[str]:
        """Return what is missing or wrong, one line each, once it has been played."""
        name, path = self.name, self._reader.path
        lines = [renamed(text, path, name) for text in self._reader.warnings]
        lines += self._mapping.warnings + self.notes
        if not self.shut_down:
            lines.append(no_end(name))
        if self.lost:
            lines.append(
                f'{name}: {counted(self.lost, "event")} lost while recording: jobs may be '
                'missing, or count as late that were not')
        if self._strange:
            what, n = min(self._strange.items(), key=lambda item: (-item[1], item[0]))
            lines.append(
                f'{name}: left out: {counted(sum(self._strange.values()), "event")} that make no '
                f'sense, most often ({n}) {what}')
        if self.jobs == 0:
            lines.append(f'{name}: no job was released in it')
        return lines

    # --- batches ---------------------------------------------------------------------------------

    def _play(self, events: Events) -> None:
        """Report a batch of the trace's events, in parts where it must be cut."""
        numbers, others = self._sorted_out(events)
        cuts = [place for place, event in others
                if event[0] in _CUT]
        first, at = 0, 0
        for cut in (*cuts, len(events)):
            part = {}
            for name, (places, rows) in numbers.items():
                begin, end = np.searchsorted(places, (first, cut)) if cuts else (0, len(places))
                if end > begin:
                    part[name] = places[begin:end] - first, rows[begin:end]
            while at < len(others) and others[at][0] < cut:
                self._one(others[at][1])
                at += 1
            if part:
                self._pass_on(part, cut - first)
            if at < len(others) and others[at][0] == cut:
                self._one(others[at][1])
                at += 1
            first = cut + 1

    def _sorted_out(
        self, events: Events
    ) -> tuple[dict[str, Numbers], list[tuple[int, Event]]]:
        """Return the numbers of events by name, and those that are taken in one by one."""
        found: dict[str, list[Numbers]] = {}
        others: list[tuple[int, Event]] = []
        for (name,), rows, places in events.tables():
            if name in _NUMBERS:
                columns = np.empty((len(rows.dtype.names), len(rows)), dtype=np.int64)
                for i, field in enumerate(rows.dtype.names):
                    columns[i] = rows[field]
                found.setdefault(name, []).append((places, columns.T))
            else:
                others += [(place, (name, *row))
                           for place, row in zip(places.tolist(), rows.tolist())]
        for place, event in events.others():
            if None in event:
                self._strange[f'{event[0]} without some of its fields'] += 1
            elif event[0] in _NUMBERS:
                signed = [n - 2 ** 64 if n >= 2 ** 63 else n for n in event[1:]]
                found.setdefault(event[0], []).append(
                    (np.array([place]), np.array([signed], dtype=np.int64)))
            else:
                others.append((place, event))
        others.sort(key=lambda item: item[0])
        numbers = {}
        for name, parts in found.items():
            if len(parts) > 1:
                places = np.concatenate([part[0] for part in parts])
                order = np.argsort(places)
                parts = [(places[order], np.concatenate([part[1] for part in parts])[order])]
            numbers[name] = parts[0]
        return numbers, others

    def _pass_on(self, numbers: dict[str, Numbers], length: int) -> None:
        """Give the observers what some events say; their places are below the length."""
        rows: dict[int, Ints] = {}
        places: dict[int, Ints] = {}

        def add(kind: int, where: Ints, *columns: Any) -> None:
            if len(where):
                places[kind] = where
                rows[kind] = np.column_stack(np.broadcast_arrays(*columns))

        self._advance(numbers)
        self._threads.find(numbers, length, add)
        if _RELEASE in numbers:
            self._released(*numbers[_RELEASE], add)
        if _FAIL in numbers:
            where, of = numbers[_FAIL]
            dag, vertex = self._targets.of(of[:, FIELD], of[:, FIELD + 1])
            known = dag >= 0
            add(FAILED, where[known], dag[known], vertex[known], of[known, FIELD + 2],
                of[known, NOW])
        if _DEADLINE in numbers:
            where, of = numbers[_DEADLINE]
            add(MISSED, where, *self._targets.of(of[:, FIELD], of[:, FIELD + 1]),
                *of[:, FIELD + 2:FIELD + 5].T)
        self._job_ends(numbers, add)
        if _LOST in numbers:
            self.lost += sum(numbers[_LOST][1][:, FIELD].tolist())
        where = np.concatenate([*places.values()]) if places else np.empty(0, dtype=np.int64)
        kinds = np.repeat(list(places), [len(each) for each in places.values()]).astype(np.int64)
        order = kinds[np.argsort(where, kind='stable')]
        batch = Batch(order, rows, numbers)
        for observer in self._observers:
            observer.take(batch)

    def _advance(self, numbers: dict[str, Numbers]) -> None:
        """Move the run's end on to what the executor's core saw last."""
        if not self.shut_down:
            for name in (_RELEASE, _COMPLETE, _DEADLINE, _FAIL, _EXPIRE, _ABORT):
                if name in numbers:
                    self.end = max(self.end, int(numbers[name][1][:, NOW].max()))

    def begin(self, times: Ints) -> None:
        """Let the run begin no later than any of these times."""
        if len(times):
            least = int(times.min())
            self.start = least if self.start is None else min(self.start, least)

    def left_out(self, name: str, why: str, rows: Any) -> None:
        """Count events that make no sense; ``rows`` says which."""
        count = int(rows.sum())
        if count:
            self._strange[f'{name} {why}'] += count

    def _released(self, where: Ints, of: Ints, add: Add) -> None:
        now, dag, job, release = of[:, NOW], *of[:, FIELD:].T
        good = (dag >= 0) & (dag < len(self._mapping.dag))
        self.left_out(_RELEASE, 'of a DAG that is not declared', ~good)
        to_come = good & ~((release >= 0) & (release <= now))
        self.left_out(_RELEASE, 'of a release that is still to come', to_come)
        good &= ~to_come
        old = good & (release > 0) & (now - np.where(good, release, now) >= FAR_NS)
        self.left_out(_RELEASE, 'of a release years ago', old)
        good &= ~old
        again = np.zeros(len(dag), dtype=np.bool_)
        for number in different(dag[good]):
            mine = np.flatnonzero(good & (dag == number))
            newest = np.maximum.accumulate(np.r_[self._newest[number], job[mine]])
            again[mine] = job[mine] <= newest[:-1]
            self._newest[number] = int(newest[-1])
        self.left_out(_RELEASE, 'of a job that is not newer than the last', again)
        good &= ~again
        self.jobs += int(good.sum())
        self.begin(release[good])
        target = np.array([*self._mapping.dag, -1])[np.where(good, dag, -1)]
        good &= target >= 0
        add(RELEASED, where[good], target[good], job[good], release[good], now[good])

    def _job_ends(self, numbers: dict[str, Numbers], add: Add) -> None:
        found = [(*numbers[name], name == _ABORT) for name in (_EXPIRE, _ABORT) if name in numbers]
        parts: list[tuple[Any, ...]] = []
        for where, of, aborted in found:
            dag = of[:, FIELD]
            good = (dag >= 0) & (dag < len(self._mapping.dag))
            self.left_out(
                _ABORT if aborted else _EXPIRE, 'of a DAG that is not declared', ~good)
            target = np.array([*self._mapping.dag, -1])[np.where(good, dag, -1)]
            good = target >= 0
            parts.append((where[good], target[good], of[good, FIELD + 1],
                          np.full(int(good.sum()), int(aborted)), of[good, NOW]))
        if parts:
            columns = [np.concatenate(each) for each in zip(*parts)]
            order = np.argsort(columns[0])
            add(ENDED, *(each[order] for each in columns))

    # --- events that are taken in one by one -----------------------------------------------------

    def _one(self, event: Event) -> None:
        name = event[0]
        if name in OWN_INIT_EVENTS:
            self.who.take(event)
        if name in (_DROP, _HOSTED, _JUDGE_FROM) and not self.shut_down:
            self.end = max(self.end, event[1])
        if name == _DROP:
            self.dropped[event[8]] += 1
            self._dropped(*event[5:9])
        elif name == _HOSTED:
            self._hosted(event)
        elif name == _JUDGE_FROM:
            if not 0 <= event[4] <= NEVER:
                self._strange[f'{name} an impossible time'] += 1
                return
            for observer in self._observers:
                observer.judging(event[4])
        elif name == TASK_SET:
            if event[4] != self.head.yaml:
                self._strange[f'{name} with another declaration'] += 1
        elif name == _SHUTDOWN and not self.shut_down:
            if not (self.end <= event[1] < NEVER and 0 <= event[4] <= event[1]):
                self._strange[f'{name} at an impossible time'] += 1
                return
            self.end = event[1]
            self.shut_down = True
            tell_end(self._observers, event[4])

    def _dropped(self, dag: int, vertex: int, job: int, reason: str) -> None:
        if 0 <= dag < len(self._mapping.vertex) and 0 <= vertex < len(self._mapping.vertex[dag]):
            for observer in self._observers:
                observer.was_dropped(self._mapping.vertex[dag][vertex], job, reason)

    def _hosted(self, event: Event) -> None:
        dag, text = event[4:6]
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


class _Targets:
    """Where recorded vertices are in the declaration that judges, for columns."""

    def __init__(self, mapping: Mapping) -> None:
        lengths = [len(vertices) for vertices in mapping.vertex]
        self._first = np.cumsum([0, *lengths])
        # by recorded vertex, of which the last stands for none
        self._vertex = np.array([v for dag in mapping.vertex for v in dag] + [-1])
        legs = [each for dag in mapping.leg for each in dag] + [[]]
        self._n_legs = np.array([len(each) for each in legs])
        self._first_leg = np.cumsum([0, *self._n_legs[:-1]])
        self._leg = np.array([leg for each in legs for leg in each] + [-1])
        self._vertex[self._n_legs == 0] = -1
        self._dag = np.array([
            *np.repeat(mapping.dag, lengths).tolist(), -1])

    def declared(self, dag: Ints, vertex: Ints) -> Ints:
        """Return the places of recorded vertices, -1 where there is no such vertex."""
        good = (dag >= 0) & (dag < len(self._first) - 1)
        dag = np.where(good, dag, 0)
        good &= (vertex >= 0) & (vertex < (self._first[1:] - self._first[:-1])[dag]) \
            if len(self._first) > 1 else False
        return np.where(good, self._first[dag] + np.where(good, vertex, 0), -1)

    def of(self, dag: Ints, vertex: Ints) -> tuple[Ints, Ints]:
        """Return DAG and vertex of the declaration that judges, -1 for none."""
        place = self.declared(dag, vertex)
        return np.where(self._vertex[place] >= 0, self._dag[place], -1), self._vertex[place]

    def of_legs(self, dag: Ints, vertex: Ints, leg: Ints) -> tuple[Ints, Ints, Ints]:
        """Return DAG, vertex and leg of the declaration that judges, -1 for none."""
        place = self.declared(dag, vertex)
        good = (self._vertex[place] >= 0) & (leg >= 0) & (leg < self._n_legs[place])
        at = np.where(good, self._first_leg[place] + np.where(good, leg, 0), -1)
        return (np.where(good, self._dag[place], -1), np.where(good, self._vertex[place], -1),
                self._leg[at])


class _Threads:
    """What threads ran."""

    def __init__(self, run: OwnRun, targets: _Targets) -> None:
        self._run = run
        self._of = targets
        # of what threads run: the columns of its dispatch, and when it started
        self._running = np.empty((0, _WIDTH + 1), dtype=np.int64)
        # of the executions whose pieces ended last in threads: the thread, and columns as below
        self._last = np.empty((0, 1 + _N_EXECUTION), dtype=np.int64)
        # by vertex, job and ready: first start and time so far of what is not complete
        self._open: dict[tuple[int, ...], tuple[int, int]] = {}
        self._undeclared: dict[tuple[int, int], None] = {}
        self._number = 0

    def find(self, numbers: dict[str, Numbers], length: int, add: Add) -> None:
        """Add what was dispatched, ran, completed and was published."""
        if not any(name in numbers for name in _OF_THREAD):
            return
        none = np.empty(0, dtype=np.int64), np.empty((0, _WIDTH), dtype=np.int64)
        where, of = zip(*(numbers.get(name, none) for name in _OF_THREAD))
        n_running = len(self._running)
        dispatch = np.concatenate([self._running[:, :_WIDTH], of[_IS_DISPATCH]])
        since = np.concatenate([self._running[:, _WIDTH], of[_IS_DISPATCH][:, NOW]])
        dag, vertex = self._of.of(dispatch[:, FIELD + 1], dispatch[:, FIELD + 2])
        ready = dispatch[:, FIELD + 5]
        good = (ready >= 0) & (ready <= dispatch[:, NOW])
        self._run.left_out(_DISPATCH, 'before it was ready', ~good)
        declared = good & (dag >= 0)
        declared[:n_running] = False
        add(STARTED, where[_IS_DISPATCH][declared[n_running:]], dag[declared], vertex[declared],
            dispatch[declared, FIELD + 3], ready[declared], dispatch[declared, NOW],
            *dispatch[declared][:, [FIELD, FIELD + 4]].T)
        line = _Line(length, self._last[:, 0], self._running, where, of)

        # dispatches and ends change what a thread runs
        is_dispatch, is_end = line.kind == _IS_DISPATCH, line.kind == _IS_END
        before = line.before(is_dispatch | is_end)
        runs = (before >= 0) & is_dispatch[before]
        runs[runs] = good[line.row[before[runs]]]
        same = np.zeros(len(runs), dtype=np.bool_)
        same[runs] = line.callback[runs] == line.callback[before[runs]]
        started = line.latest((line.kind == _IS_START) & same)

        def begun(events: Ints, dispatches: Ints) -> Ints:
            """Return since when what was dispatched runs, as of some events."""
            start = started[events]
            return np.where(start > dispatches, line.now[start], since[line.row[dispatches]])

        ended = np.flatnonzero(is_end & same)
        ended = ended[np.argsort(line.place[ended])]
        by = line.row[before[ended]]
        executions = np.column_stack((
            dag[by], vertex[by], dispatch[by, FIELD + 3], ready[by],
            begun(ended, before[ended]), line.now[ended],
            np.zeros((len(ended), 2), dtype=np.int64)))
        executions[:, X_BUSY] = executions[:, X_END] - executions[:, X_START]
        executions[:, X_NUMBER] = np.arange(self._number, self._number + len(ended))
        self._number += len(ended)
        start = executions[:, X_START].copy()
        self._run.begin(executions[:, X_READY])

        # by event: the execution whose piece ended there
        execution = np.full(len(line.kind), -1, dtype=np.int64)
        execution[ended] = np.where(dag[by] >= 0, np.arange(len(ended)), -1)
        kept = is_end & (line.place < 0)
        execution[kept] = len(ended) + line.row[kept]
        executions = np.concatenate([executions, self._last[:, 1:]])
        first = self._complete(
            line, where, of, is_end, execution, executions, line.place[ended], add)
        self._first_undeclared(first, executions, dispatch[by, FIELD])
        add(RAN, line.place[ended], dispatch[by, FIELD], dag[by], vertex[by],
            dispatch[by, FIELD + 3], dispatch[by, FIELD + 4], ready[by], start, line.now[ended],
            first)
        self._publish(line, of, before, runs, dispatch, (dag, vertex), add)

        at_end = line.at_end
        changed = line.latest(is_dispatch | is_end)[at_end]
        runs_still = at_end[(changed >= 0) & is_dispatch[changed]]
        changed = changed[(changed >= 0) & is_dispatch[changed]]
        fine = good[line.row[changed]]
        runs_still, changed = runs_still[fine], changed[fine]
        self._running = np.column_stack(
            (dispatch[line.row[changed]], begun(runs_still, changed)))
        last = line.latest(is_end)[at_end]
        last = last[last >= 0]
        last = last[execution[last] >= 0]
        self._last = np.column_stack((line.thread[last], executions[execution[last]]))

    def _complete(
        self, line: _Line, where: Any, of: Any, is_end: Any, execution: Ints, executions: Ints,
        ended: Ints, add: Add,
    ) -> Ints:
        """
        Add what was completed; return which pieces are the first of their execution.

        Of executions in several pieces the columns are put right.
        """
        events = np.flatnonzero(line.kind == _IS_COMPLETE)
        events = events[np.argsort(line.place[events])]
        complete = of[_IS_COMPLETE]
        now, end = complete[:, NOW], complete[:, FIELD + 5]
        known = self._of.declared(complete[:, FIELD + 1], complete[:, FIELD + 2]) >= 0
        self._run.left_out(_COMPLETE, 'of a vertex that is not declared', ~known)
        to_come = known & ~((end >= 0) & (end <= now))
        self._run.left_out(_COMPLETE, 'of an end that is still to come', to_come)
        dag, vertex, leg = self._of.of_legs(
            complete[:, FIELD + 1], complete[:, FIELD + 2], complete[:, FIELD + 6])
        declared = known & ~to_come & (dag >= 0)
        last = line.before(is_end)[events]
        found = np.where(last >= 0, execution[last], -1)
        of_job = np.column_stack((dag, vertex, complete[:, FIELD + 3]))
        found[~declared] = -1
        matched = found >= 0
        matched[matched] = (executions[found[matched], :X_READY] == of_job[matched]).all(axis=1)
        found[~matched] = -1
        first = self._join(executions, ended, found, line.place[events])
        times = np.full((len(found), 5), -1, dtype=np.int64)
        times[matched] = executions[found[matched], X_READY:]
        add(COMPLETED, where[_IS_COMPLETE][declared], *of_job[declared].T, leg[declared],
            complete[declared, FIELD + 4], end[declared], *times[declared].T,
            *complete[declared, FIELD + 7:FIELD + 9].T)
        return first

    def _join(self, executions: Ints, ended: Ints, found: Ints, places: Ints) -> Ints:
        """
        Join pieces of one execution; return which pieces are the first of theirs.

        :param ended: the places of the pieces' ends.
        :param found: the executions that were completed, at these places; -1: none.
        """
        n_ended = len(ended)
        first = np.ones(n_ended, dtype=np.int64)
        keys = executions[:, X_VERTEX:X_START]
        hashed = (keys[:, 0] * 31 + keys[:, 1]) * 0x9E3779B97F4A7C1 + keys[:, 2]
        declared = np.flatnonzero(executions[:n_ended, X_DAG] >= 0)
        ordered = np.sort(hashed[declared])
        several = set(ordered[1:][ordered[1:] == ordered[:-1]].tolist())
        if self._open:
            old = np.array(list(self._open), dtype=np.int64)
            several |= set(((old[:, 0] * 31 + old[:, 1]) * 0x9E3779B97F4A7C1 + old[:, 2]).tolist())
        done = np.zeros(len(executions), dtype=np.bool_)
        done[found[found >= 0]] = True
        slow = np.isin(hashed, list(several)) if several else np.zeros(len(done), dtype=np.bool_)
        for piece in declared[~done[declared] & ~slow[declared]].tolist():
            key = tuple(keys[piece].tolist())
            self._open[key] = int(executions[piece, X_START]), int(executions[piece, X_BUSY])
        if not slow.any():
            return first
        # one after the other, in the order in which they came
        slow[:n_ended] &= executions[:n_ended, X_DAG] >= 0
        steps = [(int(ended[piece]), 0, piece)
                 for piece in np.flatnonzero(slow[:n_ended]).tolist()]
        for row in np.flatnonzero((found >= 0) & slow[found]).tolist():
            steps.append((int(places[row]), 1, int(found[row])))
        for _, completes, piece in sorted(steps):
            key = tuple(keys[piece].tolist())
            if completes:
                self._open.pop(key, None)
                continue
            start, busy = int(executions[piece, X_START]), int(executions[piece, X_BUSY])
            before = self._open.get(key)
            if before is not None:
                first[piece] = 0
                start, busy = before[0], before[1] + busy
                executions[piece, X_START], executions[piece, X_BUSY] = start, busy
            self._open[key] = start, busy
        return first

    def _first_undeclared(self, first: Ints, executions: Ints, callbacks: Ints) -> None:
        """Find out which pieces of undeclared callbacks are the first of their execution."""
        recent = self._undeclared
        for piece in np.flatnonzero(executions[:len(first), X_DAG] < 0).tolist():
            key = int(callbacks[piece]), int(executions[piece, X_READY])
            if key in recent:
                first[piece] = 0
                continue
            recent[key] = None
            if len(recent) > _KEEP_UNDECLARED:
                del recent[next(iter(recent))]

    def _publish(
        self, line: _Line, of: Any, before: Ints, runs: Any, dispatch: Ints,
        found: tuple[Ints, Ints], add: Add,
    ) -> None:
        """Add what was published, and by what."""
        events = np.flatnonzero(line.kind == _IS_PUBLISH)
        if not len(events):
            return
        events = events[np.argsort(line.place[events])]
        rows = of[_IS_PUBLISH]
        by = np.where(runs[events], line.row[before[events]], -1)
        dag, vertex = (np.where(by >= 0, column[by], -1) if len(column) else by
                       for column in found)
        callback, job, ready = (
            np.where(by >= 0, dispatch[by, FIELD + i], -1) if len(dispatch) else by
            for i in (0, 3, 5))
        add(PUBLISHED, line.place[events], rows[:, FIELD], callback, dag, vertex, job, ready,
            rows[:, NOW])


class _Line:
    """
    Events of threads, thread by thread and in order.

    :ivar kind: of each, an index of ``_OF_THREAD``; ``row`` its number among those of its kind,
        ``place`` its place in the batch (below 0: kept from before), ``thread`` its thread,
        ``now`` its time, ``callback`` its first field.
    :ivar at_end: the last event of each thread.
    """

    def __init__(
        self, length: int, last: Ints, running: Ints, where: Sequence[Ints], of: Sequence[Ints]
    ) -> None:
        n_last, kept = len(last), len(last) + len(running)
        kind = np.full(kept + length, -1, dtype=np.int8)
        row = np.zeros(kept + length, dtype=np.int64)
        columns = np.zeros((3, kept + length), dtype=np.int64)
        kind[:n_last], kind[n_last:kept] = _IS_END, _IS_DISPATCH
        row[:n_last], row[n_last:kept] = np.arange(n_last), np.arange(len(running))
        columns[0, :n_last] = last
        columns[:, n_last:kept] = running[:, _OF_LINE].T
        before = {_IS_END: n_last, _IS_DISPATCH: len(running)}
        for number, (places, rows) in enumerate(zip(where, of)):
            at = places + kept
            kind[at] = number
            row[at] = np.arange(len(places)) + before.get(number, 0)
            for column, field in zip(columns, _OF_LINE):
                column[at] = rows[:, field]
        at = np.flatnonzero(kind >= 0)
        order = at[_by_thread(columns[0, at])]
        self.kind, self.row, self.place = kind[order], row[order], order - kept
        self.thread, self.now, self.callback = columns[:, order]
        self._numbers = np.arange(len(order))
        begins = np.r_[True, self.thread[1:] != self.thread[:-1]]
        self._begin = np.maximum.accumulate(np.where(begins, self._numbers, 0))
        self.at_end = np.r_[np.flatnonzero(begins)[1:] - 1, len(order) - 1]

    def latest(self, which: Any) -> Ints:
        """Return by event the last one so far of its thread that is one of these, or -1."""
        found = np.maximum.accumulate(np.where(which, self._numbers, -1))
        return np.where(found >= self._begin, found, -1)

    def before(self, which: Any) -> Ints:
        """Return the same of those before the event."""
        found = np.r_[-1, np.maximum.accumulate(np.where(which, self._numbers, -1))[:-1]]
        return np.where(found >= self._begin, found, -1)


def _by_thread(threads: Ints) -> Ints:
    """Return the order that sorts events by thread and keeps those of one in order."""
    low = threads.astype(np.uint16)     # there are few, and 16 bits are sorted in no time
    order = np.argsort(low, kind='stable')
    low, found = low[order], threads[order]
    if ((low[1:] == low[:-1]) & (found[1:] != found[:-1])).any():
        order = np.argsort(threads, kind='stable')
    return order
