# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator
from typing import Literal, NamedTuple

from msg_graph import Callback, Path, TaskSet

HopKind = Literal['trigger', 'topic', 'variable']
Place = tuple[int, int]         # path, position in it
Places = dict[Place, int]

_NONE = -1


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


class Ends(NamedTuple):
    """
    The ends of a flow, ns, None for what there is not.

    :ivar first: the first publication, or where it is not recorded the first start.
    :ivar arrival: start of the last callback's execution.
    """

    first: int | None
    arrival: int | None
    begin: int | None
    end: int | None


class _Book:
    """The flows of one path: a forest of steps, each an execution or a publication."""

    def __init__(self, path: Path, hops: list[Hop], legs: list[bool]) -> None:
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

    def add(self, position: int, parent: int, is_run: bool, times: tuple[int, int, int]) -> int:
        self.parent.append(parent)
        self.position.append(position)
        self.is_run.append(is_run)
        self.times.extend(times)
        return len(self.parent) - 1


class PathBook:
    """
    Collects the flows along the declared paths while it is told what happened, in order of time.

    Executions and publications are told by their ``places``, an empty dict for each at first,
    which their owner keeps for as long as they may be referred to.
    """

    def __init__(self, task_set: TaskSet) -> None:
        self._books = [
            _Book(path, hops(task_set, path),
                  [task_set.callback(key).kind == 'sync' for key in path.callbacks])
            for path in task_set.paths]
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
                    parent = (message or {}).get((number, position - 1), _NONE)
                elif hop.kind == 'variable':
                    parent = book.done[position - 1]
                else:
                    parent = book.published[position - 1]
                if parent == _NONE:
                    book.started[position] = _NONE
                    continue
            step = book.add(position, parent, True, (start, _NONE, 0))
            places[(number, position)] = step
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
    ) -> list[tuple[int, int]]:
        """
        Take in a publication.

        :param node: of the publisher.
        :param key: the callback that published it; None: published outside of executions.
        :param run: places of the execution that published it.
        :param message: its own places, to be filled.
        :param times: of rclcpp, rcl and DDS; what is not recorded is 0.
        :return: path and step of each place, for ``correct``.
        """
        steps = []
        candidates = [key] if key is not None else [
            k for k in self._at if self._node_of[k] == node]
        for candidate in candidates:
            for number, position in self._at.get(candidate, ()):
                book = self._books[number]
                if position >= len(book.hops) or topic not in book.hops[position].topics:
                    continue
                parent = (run or {}).get((number, position), _NONE)
                if parent == _NONE and (key is None or book.sync[position]):
                    parent = book.started[position]
                if parent == _NONE and position:
                    book.published[position] = _NONE
                    continue
                step = book.add(position, parent, False, times)
                message[(number, position)] = step
                book.published[position] = step
                steps.append((number, step))
        return steps

    def flows(self, number: int) -> list[Flow]:
        """Return the flows along a path, by the time of their beginning."""
        book = self._books[number]
        rows = [_flow(book, leaf) for leaf in _leaves(book)]
        return sorted(rows, key=_order)

    def ends(self, number: int) -> Iterator[Ends]:
        """Yield of each flow along a path its ends, in no order."""
        book = self._books[number]
        return (_ends(book, leaf) for leaf in _leaves(book))

    @property
    def paths(self) -> list[Path]:
        """Return the declared paths."""
        return [book.path for book in self._books]

    def hops(self, number: int) -> list[Hop]:
        """Return the hops of a path."""
        return self._books[number].hops


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


def _leaves(book: _Book) -> Iterable[int]:
    """Return where flows end, without the dead ends beside a branch that went on."""
    n = len(book.parent)
    has_child = bytearray(n)
    for parent in book.parent:
        if parent != _NONE:
            has_child[parent] = 1
    # executions that another execution reads, one of which went on
    went_on = bytearray(n)
    for step in range(n):
        parent = book.parent[step]
        if parent != _NONE and book.is_run[step] and has_child[step]:
            went_on[parent] = 1
    last = len(book.path.callbacks) - 1
    for step in range(n):
        if has_child[step]:
            continue
        parent = book.parent[step]
        if (parent != _NONE and book.is_run[step] and book.position[step] < last
                and went_on[parent]):
            continue
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


def _ends(book: _Book, leaf: int) -> Ends:
    last = len(book.path.callbacks) - 1
    first = arrival = begin = end = None
    step = leaf
    while step != _NONE:
        position = book.position[step]
        if position == 0 or position == last:
            time, second = book.times[3 * step], book.times[3 * step + 1]
            if not book.is_run[step]:
                first = time or None if position == 0 else first
            else:
                if position == last:
                    arrival = time
                    end = second if second != _NONE else end
                if position == 0:
                    begin = time
        step = book.parent[step]
    return Ends(begin if first is None else first, arrival, begin, end)


def _order(flow: Flow) -> tuple[int, ...]:
    return tuple(time or 0 for column in flow.columns for time in column[:3] + column[3:])
