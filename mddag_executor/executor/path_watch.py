# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Requirements of paths, judged while the run goes on.

Theory of operation
-------------------
The rules are those of ``core.requirements``.  Each execution gets the input that its data has,
which is the start of an execution of the first callback:

* Over a trigger edge it is that of the previous vertex in the same job.
* Over a queue edge it is that of the latest value when this execution starts: of a topic the last
  publication, of a variable the last end.

Threads report executions some time after they have ended, and not in the order of their starts
and ends.  A thread may be interrupted just between an end and its report, and what another thread
has reported meanwhile may depend on it.  So verdicts are found from the recorded times alone:
starts, publications and ends wait here, and take effect in the order of their times, when none
with an earlier time can come any more.  Executions that are dispatched but not reported may still
bring times from their dispatch on.  The order at the same instant is: ends, publications, starts,
each in the order of the path.
A result in between takes what still waits as complete, on a copy.

A change that is not due when an output answers it may still turn out to be due: an output with
just this input may come after that of a newer one, or a value with which nothing was published is
read again and leads to an output.  So the last answered changes are kept, in order, from the first
one that may still change.

A path is only judged in a process that runs all of its callbacks.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Iterable, Iterator
import copy
from heapq import heappop, heappush
from typing import Any, NamedTuple

from mddag_executor.core.requirements import RequirementTally, Rules
from msg_graph import Path, TaskSet
from msg_graph.segments import Hop, hops, may_end

_KEEP_RESPONSES = 2_000
_REMEMBERED = 256
"""Jobs of a vertex that are remembered."""
_MOST_ANSWERED = 200
"""Answered changes that are kept because it may turn out that they were due after all."""
_FORGOTTEN = -1
"""Instead of the number of a value with which nothing was published."""
_MOST_PENDING = 1_000
_MOST_WAITING = 3_000
"""Starts, publications and ends that wait for an execution that does not end."""

_END, _PUBLICATION, _START = range(3)


class PathWatch:
    """
    The requirements of the paths of one process.

    :param process: the declared process that this is; None: the only one.
    :ivar vertices: the (global) vertices whose executions are wanted.
    :ivar topics: the topics of queue edges, whose publications are wanted.
    """

    def __init__(self, task_set: TaskSet, process: str | None) -> None:
        self._paths = [
            _Path(task_set, path) for path in task_set.paths if path.requirements
            and (process is None or not is_divided(task_set, path)
                 and task_set.process_of(path.callbacks[0].partition(':')[0]) == process)]
        self._of: dict[int, list[tuple[_Path, int]]] = {}
        for path in self._paths:
            for vertex, position in path.positions.items():
                self._of.setdefault(vertex, []).append((path, position))
        self.vertices = self._of.keys()
        self.topics = frozenset().union(*(path.topics for path in self._paths))
        # executions that go on later
        self._paused: dict[Hashable, _Paused] = {}

    def begun(self, work: Hashable, vertex: int, now: int) -> None:
        """Note that an execution is dispatched, or goes on; its start is not before now."""
        for path, _ in self._of.get(vertex, ()):
            path.open.setdefault(work, now)

    def paused(
        self, work: Hashable, vertex: int, job: int, start: int, end: int,
        sent: Iterable[tuple[str, int]],
    ) -> None:
        """Note a piece of an execution that goes on later, and its publications so far."""
        if vertex in self._of:
            before = self._paused[work].pieces if work in self._paused else []
            self._paused[work] = _Paused(vertex, job, [*before, (start, end)], sent)

    def ended(
        self, work: Hashable, vertex: int, job: int, start: int, end: int,
        sent: Iterable[tuple[str, int]], published: set[str] | None, judge_from: int,
    ) -> None:
        """
        Note an execution that has ended; ``left`` follows.

        :param start: of its last piece.
        :param sent: its publications on ``topics`` with their times.
        :param published: which topics of ``may_publish`` it published; None: it has none.
        :param judge_from: earlier changes and inputs are not judged.
        """
        before = self._paused[work].pieces if work in self._paused else []
        for path, position in self._of[vertex]:
            path.ended(position, vertex, job, [*before, (start, end)], sent, published, judge_from)

    def left(self, work: Hashable) -> None:
        """Note that an execution brings no more times: it has ended, or will not run."""
        self._paused.pop(work, None)
        for path in self._paths:
            path.open.pop(work, None)
            path.go_on()

    def result(self, now: int, judge_from: int) -> dict[str, Any]:
        """Return by path, and 'reaction' or 'age', its result in the format of a sink."""
        return {path.name: path.result(now, judge_from, self._paused.values())
                for path in self._paths}


def is_divided(task_set: TaskSet, path: Path) -> bool:
    """Return whether the callbacks of a path run in several processes."""
    return len({task_set.process_of(key.rpartition(':')[0]) for key in path.callbacks}) > 1


class _Paused(NamedTuple):
    """The pieces and publications of an execution that goes on later."""

    vertex: int
    job: int
    pieces: list[tuple[int, int]]
    sent: Iterable[tuple[str, int]]


class _Run:
    """
    An execution.

    :ivar found: the input that its data has; None: none is known.
    :ivar number: its number; ``value``: that of the value of a queue edge that it has read, or its
        own.
    """

    __slots__ = (
        'position', 'vertex', 'job', 'is_silent', 'judge_from', 'is_begun', 'found',
        'number', 'value')

    def __init__(
        self, position: int, vertex: int, job: int, is_silent: bool, judge_from: int,
    ) -> None:
        self.position = position
        self.vertex = vertex
        self.job = job
        self.is_silent = is_silent
        self.judge_from = judge_from
        self.is_begun = False
        self.found: int | None = None
        self.number = self.value = 0


class _Answered:
    """
    A change that an output has answered.

    :ivar newest: the first input that sees it; ``took``: the time until the output.
    :ivar silent: the values because of which it is not due; empty: it is due.
    """

    __slots__ = ('newest', 'took', 'silent')

    def __init__(self, newest: int, took: int, silent: set[int]) -> None:
        self.newest = newest
        self.took = took
        self.silent = silent

    def count_in(self, tally: RequirementTally) -> None:
        if self.silent:
            tally.add_not_due()
        else:
            tally.add(self.took)


_Event = tuple[int, int, int, int, _Run, bool]
"""Time, kind, position, a number, the execution, and whether it is its last end."""


class _Path:
    """
    A path; ``positions`` has by vertex its position, ``topics`` those of its queue edges.

    ``open`` has by execution that is dispatched and not reported when it was dispatched, in order.
    """

    def __init__(self, task_set: TaskSet, path: Path) -> None:
        self.name = path.name
        self._hops = hops(task_set, path)
        self._may_end = may_end(task_set, path)
        self.topics = frozenset().union(
            *(hop.topics for hop in self._hops if hop.kind == 'topic'))
        self._state = _State(task_set, path, self._hops, self._may_end)
        self.positions = self._state.positions
        self.open: dict[Hashable, int] = {}
        self._events: list[_Event] = []
        self._number = 0

    def ended(
        self, position: int, vertex: int, job: int, pieces: list[tuple[int, int]],
        sent: Iterable[tuple[str, int]], published: set[str] | None, judge_from: int,
    ) -> None:
        is_silent, times = False, []
        if position < len(self._hops):
            hop = self._hops[position]
            if hop.kind == 'topic':
                times = [time for topic, time in sent if topic in hop.topics]
                is_silent = self._may_end[position] and not times
            elif published is not None:
                is_silent = self._may_end[position] and published.isdisjoint(hop.topics)
        run = _Run(position, vertex, job, is_silent, judge_from)
        for event in self._all_of(run, pieces, times):
            heappush(self._events, event)
        end = pieces[-1][1]
        heappush(self._events, (end, _END, position, self._next(), run, True))

    def _all_of(
        self, run: _Run, pieces: list[tuple[int, int]], times: list[int],
    ) -> Iterator[_Event]:
        """Yield the start of an execution, its publications, and the ends of all but the last."""
        position = run.position
        yield pieces[0][0], _START, position, self._next(), run, False
        for time in times:
            yield time, _PUBLICATION, position, self._next(), run, False
        for _, end in pieces[:-1]:
            yield end, _END, position, self._next(), run, False

    def _next(self) -> int:
        self._number += 1
        return self._number

    def go_on(self) -> None:
        """Let those times take effect that nothing earlier can follow."""
        events = self._events
        until = next(iter(self.open.values()), None)
        while events and (
                until is None or events[0][0] < until or len(events) > _MOST_WAITING):
            self._state.take(*heappop(events))

    def result(
        self, now: int, judge_from: int, paused: Iterable[_Paused] = (),
    ) -> dict[str, Any]:
        state, events = self._state, [*self._events]
        for each in paused:
            position = self.positions.get(each.vertex)
            if position is not None:    # all of its pieces so far have ended
                hop = self._hops[position] if position < len(self._hops) else None
                run = _Run(position, each.vertex, each.job, False, judge_from)
                last = each.pieces[-1][1]
                events += self._all_of(run, [*each.pieces, (last, last)], [
                    time for topic, time in each.sent
                    if hop is not None and hop.kind == 'topic' and topic in hop.topics])
        if events:
            state, events = copy.deepcopy((state, sorted(events)))
            for event in events:
                state.take(*event)
        return state.result(now, judge_from)


class _State:
    """The flows of a path and their results up to a time."""

    def __init__(
        self, task_set: TaskSet, path: Path, path_hops: list[Hop], may_end_at: list[bool],
    ) -> None:
        self._rules = Rules(task_set, path)
        self._last = len(path.callbacks) - 1
        place = {key: position for position, key in enumerate(path.callbacks)}
        self.positions: dict[int, int] = {}
        self._before: dict[int, list[int]] = {}
        for vertex, each in enumerate(task_set.vertices):
            position = place.get(each.callback.key)
            if position is None:
                continue
            self.positions[vertex] = position
            first = vertex - each.index
            self._before[vertex] = [
                first + local for local in each.predecessors if position
                and task_set.vertices[first + local].callback.key == path.callbacks[position - 1]]
        self._kinds = [hop.kind for hop in path_hops]
        self._is_sync = [task_set.callback(key).kind == 'sync' for key in path.callbacks]
        # by vertex and job the input that its execution had
        self._inputs: dict[int, dict[int, int]] = {vertex: {} for vertex in self.positions}
        self._may_end = may_end_at
        # by position of a queue edge the number and the input of the latest value
        self._latest: list[tuple[int, int | None]] = [(0, None) for _ in path.callbacks]
        # inputs, and the changes that they will have seen, that are not answered yet
        self._pending: deque[tuple[int, int]] = deque()
        self._last_input: int | None = None
        # the last ones that are answered; those of them that are not due, by their input, and by
        # the values because of which they are not
        self._answered: deque[_Answered] = deque()
        self._not_due: dict[int, _Answered] = {}
        self._because: dict[int, list[_Answered]] = {}
        # by value the input with which nothing was published: changes up to it are not due, unless
        # an output is based on just their input; values with which something was published
        self._silent: dict[int, int] = {}
        self._silent_before = -1
        self._went_on: dict[int, None] = {}
        self._silent_since: int | None = None
        self._tallies = {what: RequirementTally(path, required, _KEEP_RESPONSES)
                         for what, required in path.requirements.items()}

    def take(
        self, time: int, kind: int, position: int, number: int, run: _Run, is_last: bool
    ) -> None:
        """Let a start, a publication or an end take effect."""
        if not run.is_begun:    # its start, or all are at the same instant
            self._begin(run, time, number)
        if kind == _START:
            return
        found = run.found
        if position == self._last:
            if is_last and found is not None:
                self._output(found, time, run.judge_from)
            return
        if is_last and found is not None and run.is_silent and run.value not in self._went_on:
            self._silent[run.value] = found
            if len(self._silent) > _REMEMBERED:
                oldest = self._silent.pop(next(iter(self._silent)))
                self._silent_before = max(self._silent_before, oldest)
        if kind == _PUBLICATION or self._kinds[position] == 'variable':
            if found is not None or not self._is_sync[position]:
                self._latest[position] = (
                    number if kind == _PUBLICATION else run.number), found

    def _begin(self, run: _Run, start: int, number: int) -> None:
        run.is_begun = True
        run.number = run.value = number
        if not run.position:
            self._input(start, run.judge_from)
            run.found = start
        elif self._kinds[run.position - 1] == 'trigger':
            run.found = max((
                self._inputs[each][run.job] for each in self._before[run.vertex]
                if run.job in self._inputs[each]), default=None)
        else:
            run.value, run.found = self._latest[run.position - 1]
        if run.position < self._last and self._may_end[run.position] and not run.is_silent:
            self._goes_on(run.value)
            self._went_on[run.value] = None
            if len(self._went_on) > _REMEMBERED:
                del self._went_on[next(iter(self._went_on))]
        if run.found is not None:
            inputs = self._inputs[run.vertex]
            inputs[run.job] = run.found
            if len(inputs) > _REMEMBERED:
                del inputs[next(iter(inputs))]

    def _input(self, start: int, judge_from: int) -> None:
        last = self._last_input
        if last is not None and start <= last:
            return
        self._last_input = start
        if self._silent_since is None and start >= judge_from:
            self._silent_since = start
        since = last if self._rules.sampled else start
        if since is None or since < judge_from:
            return
        self._pending.append((start, since))
        if len(self._pending) > _MOST_PENDING:
            newest, _ = self._pending.popleft()
            reaction = self._tallies.get('reaction')
            if reaction is None:
                return
            self._count_answered(reaction, 0)
            if newest <= self._silent_to():
                reaction.add_not_due()
            else:
                reaction.add_missed()

    def _silent_to(self) -> int:
        """Return the last input with which nothing was published; -1: there is none."""
        return max((*self._silent.values(), self._silent_before))

    def _output(self, found: int, end: int, judge_from: int) -> None:
        reaction, age = self._tallies.get('reaction'), self._tallies.get('age')
        while self._pending and self._pending[0][0] <= found:
            newest, since = self._pending.popleft()
            if reaction is not None:
                self._answer(_Answered(newest, end - since, set() if newest == found else {
                    value for value, silent in (
                        *self._silent.items(), (_FORGOTTEN, self._silent_before))
                    if newest <= silent}))
        if reaction is not None:
            if found in self._not_due:  # of which just this is the output
                self._not_due.pop(found).silent.clear()
            self._count_answered(reaction, _MOST_ANSWERED)
        for value, silent in [*self._silent.items()]:
            if silent <= found:
                del self._silent[value]
        if age is not None and found >= judge_from:
            age.add(end - found)
            self._silent_since = end

    def _answer(self, change: _Answered) -> None:
        self._answered.append(change)
        if change.silent:
            self._not_due[change.newest] = change
        for value in change.silent:
            self._because.setdefault(value, []).append(change)

    def _goes_on(self, value: int) -> None:
        """Note that something is published with a value, perhaps after nothing was."""
        self._silent.pop(value, None)
        for change in self._because.pop(value, ()):
            change.silent.discard(value)
            if not change.silent:
                self._not_due.pop(change.newest, None)

    def _count_answered(self, tally: RequirementTally, most: int) -> None:
        """Count changes that are certainly due, in order, and all but some of the others."""
        answered = self._answered
        while answered and (len(answered) > most or not answered[0].silent):
            change = answered.popleft()
            change.count_in(tally)
            if change.silent:
                del self._not_due[change.newest]
                for value in change.silent:
                    self._because[value].remove(change)
                    if not self._because[value]:
                        del self._because[value]

    def result(self, now: int, judge_from: int) -> dict[str, Any]:
        found = {}
        for what, tally in self._tallies.items():
            required = tally.relative_deadline_ns
            not_due = 0
            if what == 'reaction':
                if self._answered:
                    tally = copy.deepcopy(tally)
                    for change in self._answered:
                        change.count_in(tally)
                silent_to = self._silent_to()
                not_due = sum(newest <= silent_to for newest, _ in self._pending)
                missed = sum(since + required <= now and newest > silent_to
                             for newest, since in self._pending)
            else:
                missed = 0 if self._silent_since is None else self._rules.missing_outputs(
                    self._silent_since, now, required)
            found[what] = tally.result_with(missed, not_due)
        return found


def divided(task_set: TaskSet) -> Iterable[str]:
    """Return the names of the paths with requirements that no process runs alone."""
    return [path.name for path in task_set.paths
            if path.requirements and is_divided(task_set, path)]
