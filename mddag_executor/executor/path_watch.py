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
bring times from their dispatch on.  The order at the same instant is: ends, publications, starts.
A result in between takes what still waits as complete, on a copy.

A path is only judged in a process that runs all of its callbacks.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Iterable
import copy
from heapq import heappop, heappush
from typing import Any

from mddag_executor.core.requirements import RequirementTally, Rules
from msg_graph import Path, TaskSet
from msg_graph.segments import hops

_KEEP_RESPONSES = 2_000
_REMEMBERED = 256
"""Jobs of a vertex that are remembered."""
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
        # by execution the starts and ends of its pieces before the last
        self._pieces: dict[Hashable, list[tuple[int, int]]] = {}

    def begun(self, work: Hashable, vertex: int, now: int) -> None:
        """Note that an execution is dispatched, or goes on; its start is not before now."""
        for path, _ in self._of.get(vertex, ()):
            path.open.setdefault(work, now)

    def paused(self, work: Hashable, start: int, end: int) -> None:
        """Note a piece of an execution that goes on later."""
        self._pieces.setdefault(work, []).append((start, end))

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
        pieces = [*self._pieces.get(work, ()), (start, end)]
        for path, position in self._of[vertex]:
            path.ended(position, vertex, job, pieces, sent, published, judge_from)

    def left(self, work: Hashable) -> None:
        """Note that an execution brings no more times: it has ended, or will not run."""
        self._pieces.pop(work, None)
        for path in self._paths:
            path.open.pop(work, None)
            path.go_on()

    def result(self, now: int, judge_from: int) -> dict[str, Any]:
        """Return by path, and 'reaction' or 'age', its result in the format of a sink."""
        return {path.name: path.result(now, judge_from) for path in self._paths}


def is_divided(task_set: TaskSet, path: Path) -> bool:
    """Return whether the callbacks of a path run in several processes."""
    return len({task_set.process_of(key.rpartition(':')[0]) for key in path.callbacks}) > 1


class _Run:
    """An execution; ``found`` is the input that its data has, None: none is known."""

    __slots__ = ('position', 'vertex', 'job', 'is_silent', 'judge_from', 'is_begun', 'found')

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


class _Path:
    """
    A path; ``positions`` has by vertex its position, ``topics`` those of its queue edges.

    ``open`` has by execution that is dispatched and not reported when it was dispatched, in order.
    """

    def __init__(self, task_set: TaskSet, path: Path) -> None:
        self.name = path.name
        self._hops = hops(task_set, path)
        self._may_end = [
            bool(hop.topics) and hop.topics <= {*task_set.callback(key).may_publish}
            for key, hop in zip(path.callbacks, self._hops)]
        self.topics = frozenset().union(
            *(hop.topics for hop in self._hops if hop.kind == 'topic'))
        self._state = _State(task_set, path)
        self.positions = self._state.positions
        self.open: dict[Hashable, int] = {}
        # time, kind, a number, the execution, and whether it is the last end
        self._events: list[tuple[int, int, int, _Run, bool]] = []
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
        self._add(pieces[0][0], _START, run)
        for time in times:
            self._add(time, _PUBLICATION, run)
        for _, end in pieces[:-1]:
            self._add(end, _END, run)
        self._add(pieces[-1][1], _END, run, True)

    def _add(self, time: int, kind: int, run: _Run, is_last: bool = False) -> None:
        self._number += 1
        heappush(self._events, (time, kind, self._number, run, is_last))

    def go_on(self) -> None:
        """Let those times take effect that nothing earlier can follow."""
        events = self._events
        until = next(iter(self.open.values()), None)
        while events and (
                until is None or events[0][0] < until or len(events) > _MOST_WAITING):
            self._state.take(*heappop(events))

    def result(self, now: int, judge_from: int) -> dict[str, Any]:
        state = self._state
        if self._events:
            state, events = copy.deepcopy((state, sorted(self._events)))
            for event in events:
                state.take(*event)
        return state.result(now, judge_from)


class _State:
    """The flows of a path and their results up to a time."""

    def __init__(self, task_set: TaskSet, path: Path) -> None:
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
        self._kinds = [hop.kind for hop in hops(task_set, path)]
        self._is_sync = [task_set.callback(key).kind == 'sync' for key in path.callbacks]
        # by vertex and job the input that its execution had
        self._inputs: dict[int, dict[int, int]] = {vertex: {} for vertex in self.positions}
        # by position of a queue edge the input of the latest value
        self._latest: list[int | None] = [None for _ in path.callbacks]
        # inputs, and the changes that they will have seen, that are not answered yet
        self._pending: deque[tuple[int, int]] = deque()
        self._last_input: int | None = None
        # changes up to this input are not due, unless an output is based on just their input
        self._silent_to: int | None = None
        self._silent_since: int | None = None
        self._tallies = {what: RequirementTally(path, required, _KEEP_RESPONSES)
                         for what, required in path.requirements.items()}

    def take(self, time: int, kind: int, number: int, run: _Run, is_last: bool) -> None:
        """Let a start, a publication or an end take effect."""
        if kind == _START:
            self._begin(run, time)
            return
        if not run.is_begun:    # all at the same instant
            self._begin(run, time)
        position, found = run.position, run.found
        if position == self._last:
            if is_last and found is not None:
                self._output(found, time, run.judge_from)
            return
        if is_last and run.is_silent and found is not None:
            self._silent_to = max(found, found if self._silent_to is None else self._silent_to)
        if kind == _PUBLICATION or self._kinds[position] == 'variable':
            if found is not None or not self._is_sync[position]:
                self._latest[position] = found

    def _begin(self, run: _Run, start: int) -> None:
        if run.is_begun:
            return
        run.is_begun = True
        if not run.position:
            self._input(start, run.judge_from)
            run.found = start
        elif self._kinds[run.position - 1] == 'trigger':
            run.found = max((
                self._inputs[each][run.job] for each in self._before[run.vertex]
                if run.job in self._inputs[each]), default=None)
        else:
            run.found = self._latest[run.position - 1]
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
            if 'reaction' not in self._tallies:
                pass
            elif self._is_silent(newest):
                self._tallies['reaction'].add_not_due()
            else:
                self._tallies['reaction'].add_missed()

    def _is_silent(self, newest: int) -> bool:
        """Return whether nothing was published for an input, or for a later one."""
        return self._silent_to is not None and newest <= self._silent_to

    def _output(self, found: int, end: int, judge_from: int) -> None:
        reaction, age = self._tallies.get('reaction'), self._tallies.get('age')
        while self._pending and self._pending[0][0] <= found:
            newest, since = self._pending.popleft()
            if reaction is None:
                continue
            if newest != found and self._is_silent(newest):
                reaction.add_not_due()
            else:
                reaction.add(end - since)
        if age is not None and found >= judge_from:
            age.add(end - found)
            self._silent_since = end

    def result(self, now: int, judge_from: int) -> dict[str, Any]:
        found = {}
        for what, tally in self._tallies.items():
            required = tally.relative_deadline_ns
            not_due = 0
            if what == 'reaction':
                silent = [self._is_silent(newest) for newest, _ in self._pending]
                not_due = sum(silent)
                missed = sum(since + required <= now and not is_silent
                             for (_, since), is_silent in zip(self._pending, silent))
            else:
                missed = 0 if self._silent_since is None else self._rules.missing_outputs(
                    self._silent_since, now, required)
            found[what] = tally.result_with(missed, not_due)
        return found


def divided(task_set: TaskSet) -> Iterable[str]:
    """Return the names of the paths with requirements that no process runs alone."""
    return [path.name for path in task_set.paths
            if path.requirements and is_divided(task_set, path)]
