# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The hops and segments of a path, and how long its reaction and its data can take at most.

Theory of operation
-------------------
Data moves along a path from callback to callback, by *hops*.  A hop over a trigger edge stays in
the job.  At a queue edge the reader belongs to another job, which was released by a timer or a
source of its own.  So a path is cut at its queue edges into *segments*, each of which lies in one
DAG with period T.  D is the time from the release of a job to the end of the segment's last
callback: its deadline if it is a sink, otherwise the earliest deadline among the sinks that it
leads to, because it completes before each of them.

If all sinks are in time, and the executions of a callback do not overtake each other:

1. A segment reads data that is new at some time in its next job at the latest, which is released
   within T after that time and ends D after its release.  So an external change right after an
   input reaches the end of the path within the sum of T + D over all segments (A. Davare et al.,
   "Period Optimization for Hard Real-time Distributed Automotive Systems", DAC 2007).
2. If the first callback's source is sporadic or fires once, the input itself is the change, and
   nothing waits for the next one: the first T is 0.
3. When an output ends, its last job was released at most D before.  The data that it read then
   was at most T + D old for each segment before it.  So the age is at most the sum of T + D
   without the last T.  Until the next output replaces this one, it is at most the whole sum.

A segment after a queue edge whose source is sporadic or fires once bounds nothing that waits for
its next job: the reaction, and the age unless it is the last segment.

A callback may have vertices in several DAGs; the segment with the largest T + D is taken.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Literal, NamedTuple

from msg_graph.model import Callback, Dag, Path, TaskSet, Vertex

HopKind = Literal['trigger', 'topic', 'variable']


class Hop(NamedTuple):
    """How data gets from a callback of a path to the next."""

    kind: HopKind
    topics: frozenset[str]


def hops(task_set: TaskSet, path: Path) -> list[Hop]:
    """Return how data gets from each callback of a path to the next."""
    return [_hop(task_set.callback(before), task_set.callback(after))
            for before, after in pairwise(path.callbacks)]


def _hop(before: Callback, after: Callback) -> Hop:
    topics = frozenset(before.publishes).intersection(after.triggers)
    if topics:
        return Hop('trigger', topics)
    if before.node == after.node and before.name in after.reads:
        return Hop('variable', frozenset())
    return Hop('topic', frozenset(before.publishes).intersection(
        after.reads + after.other_topics))


def may_end(task_set: TaskSet, path: Path) -> list[bool]:
    """Return by callback of a path but the last whether it may publish nothing for the next."""
    return [bool(hop.topics) and hop.topics <= {*task_set.callback(key).may_publish}
            for key, hop in zip(path.callbacks, hops(task_set, path))]


class Segment(NamedTuple):
    """
    The callbacks of a path between two queue edges.

    :ivar dag: the DAG that runs them; the one with the largest T + D if there are several.
    :ivar period_ns: T; None: there is no time within which the next job comes.
    :ivar deadline_ns: D, None if no sink with a deadline comes after it.
    """

    callbacks: tuple[str, ...]
    dag: str
    period_ns: int | None
    deadline_ns: int | None


def segments(task_set: TaskSet, path: Path) -> list[Segment]:
    """Return the segments of a path, in order."""
    parts = [[path.callbacks[0]]]
    for hop, key in zip(hops(task_set, path), path.callbacks[1:]):
        if hop.kind == 'trigger':
            parts[-1].append(key)
        else:
            parts.append([key])
    return [max(
        (_segment(dag, tuple(part), last) for dag, last in ends_of(task_set, part)),
        key=lambda s: (_or_most(s.period_ns) + _or_most(s.deadline_ns))) for part in parts]


def _or_most(time: int | None) -> float:
    return float('inf') if time is None else time


def _segment(dag: Dag, part: tuple[str, ...], last: Vertex) -> Segment:
    deadlines = [dag.vertices[sink].deadline_ns for sink in sinks_after(dag, last.index)]
    found = [deadline for deadline in deadlines if deadline is not None]
    return Segment(part, dag.name, None if dag.sporadic or dag.once else dag.period_ns,
                   min(found, default=None))


def ends_of(task_set: TaskSet, callbacks: list[str]) -> Iterator[tuple[Dag, Vertex]]:
    """Yield the vertices of the last of callbacks that start each other, with their DAGs."""
    for dag in task_set.dags:
        reached = {v.index for v in dag.vertices if v.callback.key == callbacks[0]}
        for key in callbacks[1:]:
            reached = {after for index in reached for after in dag.vertices[index].successors
                       if dag.vertices[after].callback.key == key}
        for index in sorted(reached):
            yield dag, dag.vertices[index]


def sinks_after(dag: Dag, index: int) -> list[int]:
    """Return the judged sinks that a vertex leads to, itself included."""
    reached, stack = {index}, [index]
    while stack:
        for after in dag.vertices[stack.pop()].successors:
            if after not in reached:
                reached.add(after)
                stack.append(after)
    return [sink for sink in dag.sinks if sink in reached]


def times_of(parts: list[Segment], what: str) -> list[int | None]:
    """Return the times that count for a bound: T and D of each segment."""
    times: list[int | None] = []
    for number, part in enumerate(parts):
        waits = part.period_ns
        if what == 'reaction' and not number and waits is None:
            waits = 0       # the input itself is the event
        if what == 'age' and number == len(parts) - 1:
            waits = 0
        times += [waits, part.deadline_ns]
    return times


def bound(task_set: TaskSet, path: Path, what: str) -> int | None:
    """Return the longest reaction or age if all sinks are in time, ns; None: not bounded."""
    found = 0
    for time in times_of(segments(task_set, path), what):
        if time is None:
            return None
        found += time
    return found


def why_unbounded(task_set: TaskSet, path: Path, what: str) -> str | None:
    """Return why ``bound`` is None; None: it is not."""
    parts = segments(task_set, path)
    for number, time in enumerate(times_of(parts, what)):
        if time is None:
            part = parts[number // 2]
            if number % 2:
                last = part.callbacks[-1]
                is_sink = all(not vertex.successors for vertex in task_set.vertices
                              if vertex.callback.key == last)
                return f"'{last}' {'has' if is_sink else 'leads to'} no deadline"
            return f"nothing says when '{part.callbacks[0]}' runs next"
    return None
