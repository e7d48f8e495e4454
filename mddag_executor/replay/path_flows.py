# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The flows that steps along paths make, and their response times as CARET defines them.

Definitions
-----------
The records of a path are pairs of an input's time (*start*) and an output's (*end*); where a flow
did not arrive there is no end.  Source: caret_analyze, ``ResponseTime`` (0.5), and CARET's
documentation of the response time's cases.

* An input whose flow did not arrive takes the earliest of the ends of the inputs after it: that is
  when something at least as new came out.  Of several outputs of an input the earliest counts.
  The inputs of the earliest output are left out: what came before them is not known.
* `all`: every input.  `best`: of the inputs with the same output the newest.  `worst`: the oldest.
  `worst-with-external-latency`: the same, from the input before it on: what happened right after
  that one had to wait for the next.  That is the *reaction time* to something outside.
* The *data age* of an output is the time since the newest input that it is made of, for every
  output, also where an earlier one was made of that input.

Theory of operation: the forest of steps
----------------------------------------
A *step* is an execution or a publication at a place of a path; its parent is the step whose data
it has (see ``paths``).  A flow is a branch from a step without a parent to one without children, a
*leaf*.

Now and then the forest is *settled*.  Steps that nobody refers to any more, and no step below
them, can get no further children: those of them that are leaves are flows that are over, which
are taken out.  What is still referred to, and what is above it, stays.

A leaf that is an execution is a dead end, and no flow, where another execution that read the same
step went on (its data was published).  As long as that may still happen, it stays, too.

Theory of operation: response times
-----------------------------------
The definitions look at all flows of a recording in the order of their starts.  Here flows come in
as they are over, in batches, and with each batch bounds of what is still to come.

* *Data age*: of each output the newest input.  It is known once no more flows with that output can
  come.
* *The other cases*: inputs in the order of their starts, each with the output that it counts for;
  an input whose flow did not arrive takes the earliest of the outputs of later inputs.  The order
  is cut where nothing before the cut can change any more and no output belongs to inputs on both
  sides of it.  What is before the cut is counted and forgotten.

Where flows overtake one another the cut is further back; so memory depends on what is open, not on
the length of the recording.  Of the response times themselves ``Spread`` keeps the distribution.
"""

from __future__ import annotations

import copy
from typing import Any

from mddag_executor.replay.happenings import Ints
from mddag_executor.replay.spread import KEEP_EXACT, Spread
import numpy as np
import numpy.typing as npt

NONE = -1
NEVER = 2 ** 62
_CASES = ('all', 'best', 'worst', 'worst_with_external_latency')
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


class CaseBook:
    """Counts the response times of flows from their starts to their ends, in all cases."""

    def __init__(self, keep: int = KEEP_EXACT) -> None:
        self.every, self.best, self.worst, self.external, self.data_age = (
            Spread(keep) for _ in range(5))
        none = np.empty(0, dtype=np.int64)
        self._start = self._end = none          # inputs that are not counted
        self._input = self._output = none       # outputs whose age is not counted
        self._least: int | None = None          # the earliest output
        self._before: tuple[int, int] | None = None     # the last input, and its output

    def add(self, start: Ints, end: Ints, least_start: int, least_end: int) -> None:
        """
        Add flows, and count what is complete.

        :param start: of each flow, -1 where it has none: it is left out.
        :param end: of each flow, -1 where it did not arrive.
        :param least_start: no flow that is still to come has an earlier start; ``least_end``: end.
        """
        known = (start != NONE) & ((end == NONE) | (end >= start))
        start, end = start[known], end[known]
        self._count_ages(start, end, least_end)
        start, end = np.concatenate((self._start, start)), np.concatenate((self._end, end))
        order = np.argsort(start, kind='stable')
        start, end = start[order], end[order]
        self._count(start, end, least_start, least_end)

    def _count_ages(self, start: Ints, end: Ints, least_end: int) -> None:
        arrived = end != NONE
        start = np.concatenate((self._input, start[arrived]))
        end = np.concatenate((self._output, end[arrived]))
        later = end >= least_end
        self._input, self._output = start[later], end[later]
        start, end = start[~later], end[~later]
        order = np.lexsort((start, end))
        start, end = start[order], end[order]
        newest = np.flatnonzero(np.r_[end[1:] != end[:-1], True]) if len(end) else order
        self.data_age.add((end - start)[newest])

    def _count(self, start: Ints, end: Ints, least_start: int, least_end: int) -> None:
        """Count inputs up to the last possible cut, keep the others."""
        self._start, self._end = start, end
        if not len(start):
            return
        arrived = end != NONE
        # each input has the earliest of its own ends, or else of those after it
        earliest = np.minimum.accumulate(np.where(arrived, end, NEVER)[::-1])[::-1]
        first = np.flatnonzero(np.r_[True, start[1:] != start[:-1]])
        own = np.minimum.reduceat(np.where(arrived, end, earliest), first)
        inputs = start[first]
        so_far = np.maximum.accumulate(own)
        after = np.r_[np.minimum.accumulate(own[::-1])[::-1][1:], NEVER]
        cuts = np.flatnonzero((inputs < least_start) & (so_far < np.minimum(after, least_end)))
        if not len(cuts):
            return
        cut = int(cuts[-1]) + 1
        rest = first[cut] if cut < len(first) else len(start)
        self._start, self._end = start[rest:].copy(), end[rest:].copy()
        inputs, own = inputs[:cut], own[:cut]
        if self._least is None:
            self._least = int(own.min())    # what came before it is not known
            counted = own != self._least
            inputs, own = inputs[counted], own[counted]
        self._count_inputs(inputs, own)

    def _count_inputs(self, start: Ints, end: Ints) -> None:
        if not len(start):
            return
        times = end - start
        self.every.add(times)
        self.worst.add(times[np.unique(end, return_index=True)[1]])
        self.best.add(times[::-1][np.unique(end[::-1], return_index=True)[1]])
        if self._before is not None:
            start = np.r_[self._before[0], start]
            end = np.r_[self._before[1], end]
        after = np.unique(end[1:], return_index=True)[1]
        self.external.add(end[1:][after] - start[after])
        self._before = int(start[-1]), int(end[-1])

    def finished(self) -> CaseBook:
        """Return what it comes to when no more flows come; this one stays as it is."""
        book = copy.deepcopy(self)
        none = np.empty(0, dtype=np.int64)
        book.add(none, none, NEVER, NEVER)
        return book

    def result(self) -> dict[str, Any]:
        """Return the figures of the cases, of reaction time and data age."""
        cases = (self.every, self.best, self.worst, self.external)
        return {
            'response_time': {name: each.result() for name, each in zip(_CASES, cases)},
            'reaction_time': self.external.result(), 'data_age': self.data_age.result()}


class PathFigures:
    """The figures of one path."""

    def __init__(self, keep: int = KEEP_EXACT) -> None:
        self.flows = 0
        self.arrived = 0
        self.inner = CaseBook(keep)     # from the first publication to the last start
        self.whole = CaseBook(keep)     # from the first begin to the last end

    def add(self, flows: Ints, to_come: Bounds) -> None:
        """Count flows of the path that are over; `to_come` bounds those that are not."""
        start, arrival, end = to_come
        self.flows += len(flows)
        self.arrived += int((flows[:, F_ARRIVAL] != NONE).sum())
        self.inner.add(flows[:, F_FIRST], flows[:, F_ARRIVAL], start, arrival)
        self.whole.add(flows[:, F_BEGIN], flows[:, F_END], start, end)

    def result(self) -> dict[str, Any]:
        """Return the figures, once all flows are in."""
        return {'flows': self.flows, 'arrived': self.arrived, **self.inner.finished().result(),
                'whole': self.whole.finished().result()}
