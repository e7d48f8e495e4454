# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The forest of steps that the flows along paths are made of, and how it is kept small.

Theory of operation
-------------------
A *step* is an execution or a publication at a place of a path; its parent is the step whose data
it has (see ``paths``).  A flow is a branch from a step without a parent to one without children, a
*leaf*.

Now and then the forest is *settled*.  Steps that nobody refers to any more, and no step below
them, can get no further children: those of them that are leaves are flows that are over, which
are taken out.  What is still referred to, and what is above it, stays.

A leaf that is an execution is a dead end, and no flow, where another execution that read the same
step went on (its data was published).  As long as that may still happen, it stays, too.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

NONE = -1
NEVER = 2 ** 62
HAS_CHILD, WENT_ON = 1, 2

Column = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]


class Steps(NamedTuple):
    """
    Steps as columns; times in ns.

    ``parent`` is the number of another step or -1, ``path`` the path's number; ``first`` and
    ``last`` say whether it is at the first and the last place of it, ``is_run`` whether it is an
    execution.  ``time`` is the start of an execution or the time of a publication (0: not
    recorded), ``end`` the end of an execution (-1: none).  ``marks`` holds what was seen of
    children that are gone: bits HAS_CHILD and, of an execution that read it, WENT_ON.
    """

    parent: Column
    path: Column
    first: Mask
    last: Mask
    is_run: Mask
    time: Column
    end: Column
    marks: npt.NDArray[np.uint8]


class FlowColumns(NamedTuple):
    """
    Flows that are over; what there is not is -1.  All times in ns.

    ``first`` is the first publication (or the first start, where nothing is published),
    ``arrival`` the start of the last callback's execution, ``begin`` and ``end`` the begin of the
    first and the end of the last one's.
    """

    path: Column
    first: Column
    arrival: Column
    begin: Column
    end: Column


class Settled(NamedTuple):
    """Which steps stay, their marks, and the flows that are over."""

    keep: Mask
    marks: npt.NDArray[np.uint8]
    flows: FlowColumns

    def numbers(self) -> Column:
        """Return the new number of each step that stays, -1 of others."""
        return np.where(self.keep, np.cumsum(self.keep) - 1, NONE)


def settle(steps: Steps, held: Mask) -> Settled:
    """
    Take out the flows that are over.

    :param held: which steps somebody refers to.
    """
    n = len(steps.parent)
    parent = steps.parent
    child = parent != NONE
    marks = steps.marks.copy()
    marks[parent[child]] |= HAS_CHILD
    inner = (marks & HAS_CHILD) != 0
    marks[parent[child & steps.is_run & inner]] |= WENT_ON
    live = held.copy()
    above = np.flatnonzero(live)
    while len(above):
        above = parent[above]
        above = above[above != NONE]
        fresh = np.zeros(n, dtype=np.bool_)
        fresh[above] = True
        above = np.flatnonzero(fresh & ~live)
        live[above] = True
    over = ~inner & ~live
    keep = live.copy()
    ends = np.flatnonzero(over & child & steps.is_run & ~steps.last)
    dead = (marks[parent[ends]] & WENT_ON) != 0
    waits = ~dead & live[parent[ends]]
    over[ends[dead | waits]] = False
    keep[ends[waits]] = True
    # what is known of children that stay is found again: they may get another parent
    kept = steps.marks.copy()
    gone = child & ~keep
    kept[parent[gone]] |= HAS_CHILD
    kept[parent[gone & steps.is_run & inner]] |= WENT_ON
    assert n == 0 or not (keep & child & ~keep[parent]).any()
    return Settled(keep, kept, _flows(steps, np.flatnonzero(over)))


def _flows(steps: Steps, leaves: Column) -> FlowColumns:
    first, arrival, begin, end = (np.full(len(leaves), NONE, dtype=np.int64) for _ in range(4))
    flow, step = np.arange(len(leaves)), leaves
    while len(step):
        run, time = steps.is_run[step], steps.time[step]
        for chosen, into, values in (
                (run & steps.last[step], arrival, time), (run & steps.first[step], begin, time),
                (run & steps.last[step], end, steps.end[step]),
                (~run & steps.first[step] & (time != 0), first, time)):
            into[flow[chosen]] = values[chosen]
        step = steps.parent[step]
        more = step != NONE
        flow, step = flow[more], step[more]
    return FlowColumns(
        steps.path[leaves], np.where(first == NONE, begin, first), arrival, begin, end)


class Bounds(NamedTuple):
    """
    What flows that are not over yet will have at least, ns.

    ``start`` of their first publication and begin, ``arrival`` and ``end`` as in ``FlowColumns``.
    """

    start: int
    arrival: int
    end: int


def bounds(steps: Steps, keep: Mask, now: int) -> list[Bounds]:
    """
    Return by path what flows that are not over will have at least.

    :param now: nothing happens before it any more.
    """
    n = 1 + int(steps.path.max(initial=NONE))
    found: list[Any] = []
    for chosen, times in (
            (steps.first & (steps.is_run | (steps.time != 0)), steps.time),
            (steps.last & steps.is_run, steps.time),
            (steps.last & steps.is_run & (steps.end != NONE), steps.end)):
        least = np.full(n, now, dtype=np.int64)
        np.minimum.at(least, steps.path[keep & chosen], times[keep & chosen])
        found.append(least.tolist())
    return [Bounds(*each) for each in zip(*found)]
