# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Response times of a path as CARET defines them, counted while flows come in.

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

Theory of operation
-------------------
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
from mddag_executor.replay.path_forest import (
    Bounds,
    F_ARRIVAL,
    F_BEGIN,
    F_END,
    F_FIRST,
    NEVER,
    NONE,
)
from mddag_executor.replay.spread import KEEP_EXACT, Spread
import numpy as np

_CASES = ('all', 'best', 'worst', 'worst_with_external_latency')


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
