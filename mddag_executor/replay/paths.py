# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
End-to-end figures: how a path's data flows from its first callback to its last.

Theory of operation
-------------------
A path is a list of callbacks; from each to the next leads a *hop*:

* trigger: the one publishes a topic that starts the other.  A flow goes on with the execution that
  the message started.
* topic: the other takes the topic itself (queue edge).  A flow goes on with the executions that
  took the message, where takes are recorded, else with those for which it was the latest.
* variable: the other reads what the one left in a variable of their node (queue edge).  A flow
  goes on with the executions that began when it was the latest that had ended (CARET: variable
  passing, `left_use_latest`).

What a callback publishes belongs to the execution that published it.  What is published outside
of executions, or by another leg of a sync callback, belongs to the execution that began last
before it (CARET: use_latest_message).

A *flow* is what became of one publication of the first callback; with each execution that reads a
value again it branches.  Its columns are those of CARET's path records: the times of each
publication and of the start of each execution that a message started.  A flow that arrives nowhere
has empty columns from there on; it is left out where another branch of the same execution went on.

By default, as in CARET, a path's time runs from the first publication to the start of the last
callback's execution; ``whole`` figures run from the start of the first callback's execution to the
end of the last one's.

Flows that are over are counted and forgotten (see ``path_forest`` and ``path_stream``).
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator
import copy
from typing import Any, Literal, NamedTuple
import weakref

from mddag_executor.replay.path_forest import Bounds, bounds, NEVER, settle, Steps
from mddag_executor.replay.path_stream import PathFigures
from mddag_executor.replay.spread import KEEP_EXACT
from msg_graph import Callback, Path, TaskSet
import numpy as np

HopKind = Literal['trigger', 'topic', 'variable']
Place = tuple[int, int]         # path, position in it

SETTLE = 65_536
"""Steps of a path from which on flows that are over are taken out."""
LAG_NS = 1_000_000_000
"""Nothing is told later than this after it happened."""
_NONE = -1


class Places(dict[Place, int]):
    """The steps that an execution or a message has in paths; kept for as long as they count."""

    __slots__ = ('__weakref__',)


_NOWHERE = Places()


class Hop(NamedTuple):
    """How data gets from a callback of a path to the next."""

    kind: HopKind
    topics: frozenset[str]


class Flow(NamedTuple):
    """
    A row of a path's records.

    :ivar columns: for each position the times of its publication (rclcpp, rcl and DDS; None where
        that is not recorded or it did not arrive so far) and the start of its execution.
    :ivar begin: start of the first callback's execution, None where none published.
    :ivar end: end of the last callback's execution, None where it did not arrive or end.
    """

    columns: list[tuple[int | None, int | None, int | None, int | None]]
    begin: int | None
    end: int | None


class _Book:
    """The flows of one path: a forest of steps, each an execution or a publication."""

    def __init__(
        self, number: int, path: Path, hops: list[Hop], legs: list[bool], settle_at: int,
        keep: int,
    ) -> None:
        self.number = number
        self.path = path
        self.hops = hops
        self.sync = legs
        n = len(path.callbacks)
        self.parent = array('q')
        self.position = array('q')
        self.is_run = bytearray()
        # start and end of an execution, or times of a publication
        self.times = array('q')
        self.started = [_NONE] * n
        self.done = [_NONE] * n
        self.published = [_NONE] * n
        #: What is known of children that are gone.
        self.marks = bytearray()
        self.figures = PathFigures(keep)
        #: Who refers to steps, besides `started`, `done` and `published`.
        self.holders: list[weakref.ref[Places]] = []
        self.settled = False
        self.full = self._least_full = settle_at

    def add(self, position: int, parent: int, is_run: bool, times: tuple[int, int, int]) -> int:
        self.parent.append(parent)
        self.position.append(position)
        self.is_run.append(is_run)
        self.times.extend(times)
        self.marks.append(0)
        return len(self.parent) - 1

    def hold(self, places: Places, position: int, step: int) -> None:
        """Let a step be referred to by what has it."""
        places[self.number, position] = step
        self.holders.append(weakref.ref(places))

    def steps(self) -> Steps:
        """Return all steps as columns."""
        n = len(self.parent)
        position = np.array(self.position, dtype=np.int64)
        times = np.array(self.times, dtype=np.int64).reshape(-1, 3)
        is_run = np.frombuffer(bytes(self.is_run), dtype=np.bool_)
        return Steps(
            np.array(self.parent, dtype=np.int64), np.zeros(n, dtype=np.int64), position == 0,
            position == len(self.path.callbacks) - 1, is_run, times[:, 0],
            np.where(is_run, times[:, 1], _NONE),
            np.frombuffer(bytes(self.marks), dtype=np.uint8))

    def tidy(self) -> None:
        """Count the flows that are over, and forget their steps."""
        steps = self.steps()
        self.holders = [ref for ref in self.holders if ref() is not None]
        places = [each for each in (ref() for ref in self.holders) if each is not None]
        every = [each for each in (
            *self.started, *self.done, *self.published,
            *(step for each in places for (path, _), step in each.items()
              if path == self.number)) if each != _NONE]
        held = np.zeros(len(self.parent), dtype=np.bool_)
        held[every] = True
        found = settle(steps, held)
        now = max(0, int(max(steps.time.max(), steps.end.max())) - LAG_NS)
        self.figures.add(found.flows, bounds(steps, found.keep, now)[0])
        self._forget(steps, found.keep, found.marks, found.numbers(), places)
        self.settled = True
        self.full = max(self._least_full, 2 * len(self.parent))

    def _forget(self, steps: Steps, keep: Any, marks: Any, numbers: Any,
                places: list[Places]) -> None:
        """Keep some of the steps only."""
        parent = steps.parent[keep]
        self.parent = array('q', np.where(parent == _NONE, _NONE, numbers[parent]).tobytes())
        self.position = array('q', np.array(self.position, dtype=np.int64)[keep].tobytes())
        self.is_run = bytearray(steps.is_run[keep].tobytes())
        times = np.array(self.times, dtype=np.int64).reshape(-1, 3)
        self.times = array('q', times[keep].tobytes())
        self.marks = bytearray(marks[keep].tobytes())
        renumbered = [*numbers.tolist(), _NONE]     # the last is of no step
        for steps_of in (self.started, self.done, self.published):
            steps_of[:] = [renumbered[step] for step in steps_of]
        for each in {id(each): each for each in places}.values():
            for place, step in each.items():
                if place[0] == self.number:
                    each[place] = renumbered[step]


class PathBook:
    """
    Collects the flows along the declared paths while it is told what happened, in order of time.

    Executions and publications are told by their ``places``, empty ones for each at first, which
    their owner keeps for as long as they may be referred to.  Before he looks at what is in them
    he calls ``tidy``, which may renumber the steps there.

    :param settle_at: how many steps of a path there are when those of flows that are over go.
    :param keep: up to how many response times quantiles are exact.
    """

    def __init__(
        self, task_set: TaskSet, settle_at: int = SETTLE, keep: int = KEEP_EXACT
    ) -> None:
        self._books = [
            _Book(number, path, hops(task_set, path),
                  [task_set.callback(key).kind == 'sync' for key in path.callbacks], settle_at,
                  keep)
            for number, path in enumerate(task_set.paths)]
        # by callback: its places in paths
        self._at: dict[str, list[Place]] = {}
        for number, path in enumerate(task_set.paths):
            for position, key in enumerate(path.callbacks):
                self._at.setdefault(key, []).append((number, position))
        self._node_of = {c.key: c.node for c in task_set.callbacks}
        #: The topics that paths lead over; publications on others need not be told.
        self.topics = frozenset(
            topic for book in self._books for hop in book.hops for topic in hop.topics)

    def __bool__(self) -> bool:
        """Tell whether there is any path."""
        return bool(self._books)

    def tidy(self) -> None:
        """Forget flows that are over, where there are many steps; to be called now and then."""
        for book in self._books:
            if len(book.parent) >= book.full:
                book.tidy()

    def concerns(self, key: str) -> bool:
        """Tell whether a callback is on a path."""
        return key in self._at

    def started(self, key: str, places: Places, start: int, message: Places | None,
                topic: str = '') -> None:
        """
        Take in an execution of a callback.

        :param places: its own, to be filled.
        :param message: places of the message that started it, None where that is not known.
        :param topic: that message's topic; empty: any.
        """
        for number, position in self._at.get(key, ()):
            book = self._books[number]
            parent = _NONE
            if position > 0:
                hop = book.hops[position - 1]
                if hop.kind == 'trigger':
                    if topic and topic not in hop.topics:
                        continue        # another leg of a sync callback
                    parent = (message or _NOWHERE).get((number, position - 1), _NONE)
                elif hop.kind == 'variable':
                    parent = book.done[position - 1]
                else:
                    parent = book.published[position - 1]
                if parent == _NONE:
                    book.started[position] = _NONE
                    continue
            step = book.add(position, parent, True, (start, _NONE, 0))
            book.hold(places, position, step)
            book.started[position] = step

    def took(self, key: str, places: Places, message: Places) -> None:
        """Take in that a running callback took a message itself (a queue edge)."""
        for number, position in self._at.get(key, ()):
            book = self._books[number]
            step = places.get((number, position))
            if position and step is not None and book.hops[position - 1].kind == 'topic':
                book.parent[step] = message.get((number, position - 1), _NONE)

    def ended(self, key: str, places: Places, end: int) -> None:
        """Take in that an execution has ended."""
        for place in self._at.get(key, ()):
            book = self._books[place[0]]
            step = places.get(place, _NONE)
            if step != _NONE:
                book.times[3 * step + 1] = end
                book.done[place[1]] = step
            elif not book.sync[place[1]]:
                book.done[place[1]] = _NONE

    def published(
        self, topic: str, node: str, key: str | None, run: Places | None, message: Places,
        times: tuple[int, int, int],
    ) -> None:
        """
        Take in a publication.

        :param node: of the publisher.
        :param key: the callback that published it; None: published outside of executions.
        :param run: places of the execution that published it.
        :param message: its own places, to be filled.
        :param times: of rclcpp, rcl and DDS; what is not recorded is 0.
        """
        candidates = [key] if key is not None else [
            k for k in self._at if self._node_of[k] == node]
        for candidate in candidates:
            for number, position in self._at.get(candidate, ()):
                book = self._books[number]
                if position >= len(book.hops) or topic not in book.hops[position].topics:
                    continue
                parent = (run or _NOWHERE).get((number, position), _NONE)
                if parent == _NONE and (key is None or book.sync[position]):
                    parent = book.started[position]
                if parent == _NONE and position:
                    book.published[position] = _NONE
                    continue
                step = book.add(position, parent, False, times)
                book.hold(message, position, step)
                book.published[position] = step

    def flows(self, number: int) -> list[Flow]:
        """Return the flows along a path, by the time of their beginning; none may be forgotten."""
        book = self._books[number]
        assert not book.settled
        return sorted((_flow(book, leaf) for leaf in _leaves(book)), key=_order)

    def figures(self) -> list[dict[str, Any]]:
        """Return the figures of each path, as if no more flows came."""
        return [_finished(book).result() for book in self._books]

    @property
    def paths(self) -> list[Path]:
        """Return the declared paths."""
        return [book.path for book in self._books]

    @property
    def hops(self) -> list[list[Hop]]:
        """Return the hops of each path."""
        return [book.hops for book in self._books]


def hops(task_set: TaskSet, path: Path) -> list[Hop]:
    """Return how data gets from each callback of a path to the next."""
    return [_hop(task_set.callback(before), task_set.callback(after))
            for before, after in zip(path.callbacks, path.callbacks[1:])]


def _hop(before: Callback, after: Callback) -> Hop:
    topics = frozenset(before.publishes).intersection(after.topics)
    if topics:
        return Hop('trigger', topics)
    if before.node == after.node and before.name in after.reads:
        return Hop('variable', frozenset())
    return Hop('topic', frozenset(before.publishes).intersection(after.reads))


def _leaves(book: _Book) -> Iterator[int]:
    """Yield where flows end, without the dead ends beside a branch that went on."""
    steps = book.steps()
    has_child = np.zeros(len(steps.parent), dtype=np.bool_)
    has_child[steps.parent[steps.parent != _NONE]] = True
    # executions that another execution reads, one of which went on
    went_on = {book.parent[step] for step in np.flatnonzero(has_child & steps.is_run).tolist()}
    last = len(book.path.callbacks) - 1
    for step in np.flatnonzero(~has_child).tolist():
        parent = book.parent[step]
        if not (parent != _NONE and book.is_run[step] and book.position[step] < last
                and parent in went_on):
            yield step


def _flow(book: _Book, leaf: int) -> Flow:
    empty = (None, None, None, None)
    columns: list[tuple[int | None, int | None, int | None, int | None]] = [
        empty for _ in book.path.callbacks]
    end = None
    begin = None
    step = leaf
    while step != _NONE:
        position = book.position[step]
        first, second, third = book.times[3 * step:3 * step + 3]
        rclcpp, rcl, dds, start = columns[position]
        if book.is_run[step]:
            columns[position] = rclcpp, rcl, dds, first
            if position == len(columns) - 1 and second != _NONE:
                end = second
            if position == 0:
                begin = first
        else:
            columns[position] = first or None, second or None, third or None, start
        step = book.parent[step]
    return Flow(columns, begin, end)


def _finished(book: _Book) -> PathFigures:
    """Return the figures of a path when all flows are over; the book stays as it is."""
    figures = copy.deepcopy(book.figures)
    steps = book.steps()
    flows = settle(steps, np.zeros(len(steps.parent), dtype=np.bool_)).flows
    figures.add(flows, Bounds(*(NEVER,) * 3))
    return figures


def _order(flow: Flow) -> tuple[int, ...]:
    return tuple(time or 0 for column in flow.columns for time in column[:3] + column[3:])
