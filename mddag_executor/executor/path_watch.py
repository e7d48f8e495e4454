# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Requirements of paths, judged while the run goes on.

Theory of operation
-------------------
The rules are those of ``core.requirements``.  The engine reports each execution of a path's
callbacks when it ends, under its lock.  Each execution gets the input that its data has, which is
the start of an execution of the first callback:

* Over a trigger edge it is that of the previous vertex in the same job.  If that has not ended
  yet, because it still runs after its publication, the execution waits for it here.
* Over a queue edge it is that of the last execution of the previous callback that had ended when
  this one started.  (A replay knows more: it takes the time of the publication, and the message
  that was really taken.)

A path is only judged in a process that runs all of its callbacks.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Any

from mddag_executor.core.requirements import RequirementTally, Rules
from msg_graph import Path, TaskSet
from msg_graph.segments import hops

_KEEP_RESPONSES = 2_000
_REMEMBERED = 256
"""Jobs of a vertex, and values of a queue edge, that are remembered."""
_MOST_PENDING = 1_000


class PathWatch:
    """
    The requirements of the paths of one process.

    :param process: the declared process that this is; None: the only one.
    :ivar vertices: the (global) vertices whose executions are wanted.
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

    def ended(
        self, vertex: int, job: int, start: int, end: int, published: set[str] | None,
        judge_from: int,
    ) -> None:
        """
        Note that an execution has ended.

        :param published: which topics of ``may_publish`` it published; None: it has none.
        :param judge_from: earlier changes and inputs are not judged.
        """
        for path, position in self._of[vertex]:
            path.ended(position, vertex, job, start, end, published, judge_from)

    def result(self, now: int, judge_from: int) -> dict[str, Any]:
        """Return by path, and 'reaction' or 'age', its result in the format of a sink."""
        return {path.name: path.result(now, judge_from) for path in self._paths}


def is_divided(task_set: TaskSet, path: Path) -> bool:
    """Return whether the callbacks of a path run in several processes."""
    return len({task_set.process_of(key.rpartition(':')[0]) for key in path.callbacks}) > 1


class _Path:
    """A path; ``positions`` has by vertex its position."""

    def __init__(self, task_set: TaskSet, path: Path) -> None:
        self.name = path.name
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
        self._hops = hops(task_set, path)
        self._may_end = [
            bool(hop.topics) and hop.topics <= {*task_set.callback(key).may_publish}
            for key, hop in zip(path.callbacks, self._hops)]
        # by vertex and job the input that its execution had
        self._inputs: dict[int, dict[int, int]] = {vertex: {} for vertex in self.positions}
        # by vertex and job what waits for its end
        self._waiting: dict[tuple[int, int], list[tuple[Any, ...]]] = {}
        # by position of a queue edge: when executions ended, and their inputs
        self._written: list[deque[tuple[int, int]]] = [
            deque(maxlen=_REMEMBERED) for _ in path.callbacks]
        # inputs, and the changes that they will have seen, that are not answered yet
        self._pending: deque[tuple[int, int]] = deque()
        self._last_input: int | None = None
        self._silent_since: int | None = None
        self._tallies = {what: RequirementTally(path, required, _KEEP_RESPONSES)
                         for what, required in path.requirements.items()}

    def ended(
        self, position: int, vertex: int, job: int, start: int, end: int,
        published: set[str] | None, judge_from: int,
    ) -> None:
        if not position:
            self._input(start, judge_from)
            found: int | None = start
        elif self._hops[position - 1].kind == 'trigger':
            before = self._before[vertex]
            known = [self._inputs[each][job] for each in before if job in self._inputs[each]]
            if not known:
                if before and len(self._waiting) < _REMEMBERED:
                    self._waiting.setdefault((before[0], job), []).append(
                        (position, vertex, job, start, end, published, judge_from))
                return
            found = max(known)
        else:
            found = next((value for time, value in reversed(self._written[position - 1])
                          if time <= start), None)
        if found is None:
            return
        inputs = self._inputs[vertex]
        inputs[job] = found
        if len(inputs) > _REMEMBERED:
            del inputs[next(iter(inputs))]
        if position == self._last:
            self._output(found, end, judge_from)
        elif published is not None and self._may_end[position] and published.isdisjoint(
                self._hops[position].topics):
            self._answer(found, None)
        elif self._hops[position].kind != 'trigger':
            self._written[position].append((end, found))
        for each in self._waiting.pop((vertex, job), ()):
            self.ended(*each)

    def _input(self, start: int, judge_from: int) -> None:
        last, self._last_input = self._last_input, start
        since = last if self._rules.sampled else start
        if since is None or since < judge_from:
            return
        self._pending.append((start, since))
        if self._silent_since is None:
            self._silent_since = since
        if len(self._pending) > _MOST_PENDING and 'reaction' in self._tallies:
            self._pending.popleft()
            self._tallies['reaction'].add_missed()

    def _answer(self, newest: int, end: int | None) -> None:
        """Note that changes are answered, or (without an end) not due, up to an input."""
        tally = self._tallies.get('reaction')
        while self._pending and self._pending[0][0] <= newest:
            _, since = self._pending.popleft()
            if tally is not None and end is not None:
                tally.add(end - since)
            elif tally is not None:
                tally.add_not_due()

    def _output(self, found: int, end: int, judge_from: int) -> None:
        self._answer(found, end)
        if 'age' in self._tallies and found >= judge_from:
            self._tallies['age'].add(end - found)
            self._silent_since = end

    def result(self, now: int, judge_from: int) -> dict[str, Any]:
        found = {}
        for what, tally in self._tallies.items():
            required = tally.relative_deadline_ns
            if what == 'reaction':
                missed = sum(since + required <= now for _, since in self._pending)
            else:
                missed = 0 if self._silent_since is None else self._rules.missing_outputs(
                    self._silent_since, now, required)
            found[what] = tally.result_with(missed)
        return found


def divided(task_set: TaskSet) -> Iterable[str]:
    """Return the names of the paths with requirements that no process runs alone."""
    return [path.name for path in task_set.paths
            if path.requirements and is_divided(task_set, path)]
