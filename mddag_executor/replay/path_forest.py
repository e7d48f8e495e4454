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

from mddag_executor.replay.happenings import Ints
import numpy as np
import numpy.typing as npt

NONE = -1
NEVER = 2 ** 62
_HAS_CHILD, _WENT_ON = 1, 2
# Columns of a step: the number of its parent, where it is on which path, whether it is an
# execution; the start of an execution or the time of a publication (0: not recorded), the end of
# an execution, ns; what was seen of children that are gone: _HAS_CHILD and, of an execution that
# read it, _WENT_ON.
PARENT, _PATH, _POSITION, _IS_RUN, _TIME, END, _MARKS, _N_STEP = range(8)
# Columns of a flow that is over, -1 where there is none: the first publication (or the first
# start, where nothing is published), the start of the last callback's execution, the begin of the
# first and the end of the last one's, ns.
F_PATH, F_FIRST, F_ARRIVAL, F_BEGIN, F_END, _N_FLOW = range(6)

Mask = npt.NDArray[np.bool_]
Bounds = tuple[int, int, int]


class Forest:
    """
    The steps.

    :param last: by path its last position.
    :ivar rows: the steps; those beyond ``len`` mean nothing.
    """

    def __init__(self, last: list[int]) -> None:
        self._last = np.array(last, dtype=np.int64)
        self.rows: Ints = np.empty((1024, _N_STEP), dtype=np.int64)
        self._n = 0

    def __len__(self) -> int:
        return self._n

    @property
    def latest(self) -> int:
        """Return the latest time of any step, ns."""
        return int(self.rows[:self._n, (_TIME, END)].max(initial=0))

    def add(self, path: int, position: int, parent: Ints, is_run: bool, times: Ints) -> Ints:
        """Add steps, where there is a parent or the path begins; return their numbers."""
        wanted = (parent != NONE) | (position == 0)
        count = int(wanted.sum())
        while self._n + count > len(self.rows):
            self.rows = np.concatenate([self.rows, np.empty_like(self.rows)])
        rows = self.rows[self._n:self._n + count]
        rows[:, PARENT], rows[:, _TIME] = parent[wanted], times[wanted]
        rows[:, _PATH], rows[:, _POSITION] = path, position
        rows[:, _IS_RUN], rows[:, END], rows[:, _MARKS] = is_run, NONE, 0
        numbers = np.where(wanted, self._n + np.cumsum(wanted) - 1, NONE)
        self._n += count
        return numbers

    def settle(self, held: Mask) -> tuple[Ints, Ints]:
        """
        Take out the flows that are over.

        :param held: which steps somebody refers to.
        :return: these flows, and the new number of each step, -1 of what is gone and of -1.
        """
        table = self.rows[:self._n]
        parent, is_run = table[:, PARENT].copy(), table[:, _IS_RUN] != 0
        last = table[:, _POSITION] == self._last[table[:, _PATH]]
        child = parent != NONE
        marks = table[:, _MARKS].copy()
        marks[parent[child]] |= _HAS_CHILD
        inner = (marks & _HAS_CHILD) != 0
        marks[parent[child & is_run & inner]] |= _WENT_ON
        live = held.copy()
        above = np.flatnonzero(live)
        while len(above):
            above = parent[above]
            above = above[above != NONE]
            fresh = np.zeros(len(table), dtype=np.bool_)
            fresh[above] = True
            above = np.flatnonzero(fresh & ~live)
            live[above] = True
        over = ~inner & ~live
        keep = live.copy()
        ends = np.flatnonzero(over & child & is_run & ~last)
        dead = (marks[parent[ends]] & _WENT_ON) != 0
        waits = ~dead & live[parent[ends]]
        over[ends[dead | waits]] = False
        keep[ends[waits]] = True
        # what is known of children that stay is found again: they may get another parent
        gone = child & ~keep
        table[parent[gone], _MARKS] |= _HAS_CHILD
        table[parent[gone & is_run & inner], _MARKS] |= _WENT_ON
        flows = _flows(table, last, np.flatnonzero(over))
        numbers = np.append(np.where(keep, np.cumsum(keep) - 1, NONE), NONE)
        rest = table[keep]
        rest[:, PARENT] = numbers[rest[:, PARENT]]
        self.rows[:len(rest)] = rest
        self._n = len(rest)
        return flows, numbers

    def bounds(self, now: int) -> list[Bounds]:
        """
        Return by path what flows that are not over will have at least, ns.

        :param now: nothing happens before it any more.
        :return: least first publication and begin, least arrival, least end.
        """
        rows = self.rows[:self._n]
        path, is_run, times = rows[:, _PATH], rows[:, _IS_RUN] != 0, rows[:, _TIME]
        last = is_run & (rows[:, _POSITION] == self._last[path])
        found = np.full((len(self._last), 3), now, dtype=np.int64)
        for column, chosen, values in (
                (0, (rows[:, _POSITION] == 0) & (is_run | (times != 0)), times),
                (1, last, times), (2, last & (rows[:, END] != NONE), rows[:, END])):
            np.minimum.at(found[:, column], path[chosen], values[chosen])
        return [(start, arrival, end) for start, arrival, end in found.tolist()]


def _flows(table: Ints, last: Mask, leaves: Ints) -> Ints:
    """Return the flows that end in these steps."""
    flows = np.full((len(leaves), _N_FLOW), NONE, dtype=np.int64)
    flows[:, F_PATH] = table[leaves, _PATH]
    flow, step = np.arange(len(leaves)), leaves
    while len(step):
        rows = table[step]
        run, time, first = rows[:, _IS_RUN] != 0, rows[:, _TIME], rows[:, _POSITION] == 0
        for chosen, into, values in (
                (run & last[step], F_ARRIVAL, time), (run & first, F_BEGIN, time),
                (run & last[step], F_END, rows[:, END]),
                (~run & first & (time != 0), F_FIRST, time)):
            flows[flow[chosen], into] = values[chosen]
        more = rows[:, PARENT] != NONE
        flow, step = flow[more], rows[more, PARENT]
    flows[:, F_FIRST] = np.where(flows[:, F_FIRST] == NONE, flows[:, F_BEGIN], flows[:, F_FIRST])
    return flows
