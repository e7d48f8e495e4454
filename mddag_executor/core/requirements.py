# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Verdicts about paths: reaction times and data ages against what is required.

Theory of operation
-------------------
An *input* is an execution of a path's first callback, an *output* one of its last callback.

1. *Reaction* has one result for each input but the first.  It is about a change that happens right
   after the input before, which has to wait for this one (Günzel et al., "Timing Analysis of
   Asynchronized Distributed Cause-Effect Chains", RTAS 2021).  It is answered by the end of the
   first output that is based on this input or on a later one.  If the source of the path is
   sporadic or fires once, the input itself is the change, and each input has a result.
2. A change that is not answered is late as soon as the required time has passed.  It is not due if
   the input, or a later one that replaced it, led to an execution that did not publish a topic of
   ``may_publish``.
3. *Age* has one result for each output: from the newest input that it is based on to its end.  An
   output that does not come within the period of its segment and the required age is late; so are
   those that should have followed it.  That holds if nothing on the path comes only sometimes.
4. Equal to the required time is in time.

Results are in a row by inputs or outputs, which counts for ``tolerate``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, TYPE_CHECKING

from mddag_executor.core.state import SINK_IN_TIME, SINK_LATE, SINK_MISSED, SINK_NOT_DUE
from mddag_executor.core.tally import counts, is_kept, SinkTally
from mddag_executor.core.weakly_hard import MissWindow
from mddag_executor.text import counted
from msg_graph import format_duration, Path, TaskSet
from msg_graph.segments import may_end, segments

if TYPE_CHECKING:
    from mddag_executor.results.sinks import SinkCounts


class Rules:
    """
    What the rules say about a path.

    :ivar sampled: whether a change waits for the next input (rule 1).
    :ivar output_every: the period within which an output has to follow the last one, ns; None:
        there is none (rule 3).
    """

    def __init__(self, task_set: TaskSet, path: Path) -> None:
        parts = segments(task_set, path)
        self.sampled = parts[0].period_ns is not None
        waits = [part.period_ns for part in parts]
        sometimes = any(may_end(task_set, path))
        self.output_every = None if None in waits or sometimes else waits[-1]

    def missing_outputs(self, since: int, until: int, required: int) -> int:
        """Return how many outputs have not come since the last one, or the first input."""
        if self.output_every is None:
            return 0
        return max(0, (until - since - required) // self.output_every)


class RequirementTally(SinkTally):
    """The results of a path about its reaction or age."""

    def __init__(self, path: Path, required_ns: int, keep: int | None = None) -> None:
        super().__init__(required_ns, keep)
        self._tolerate = path.tolerate
        self._window = None if path.tolerate is None else MissWindow(path.tolerate.of)
        self._results = 0

    def add(self, took: int) -> None:
        """Count a reaction or an age."""
        late = took > self.relative_deadline_ns
        self.done(took, late)
        self._next(late)

    def add_missed(self, n: int = 1) -> None:
        """Count changes that are not answered, or outputs that have not come."""
        self.numbers[SINK_MISSED] += n
        # more misses in a row than the window has change nothing
        last = 0 if self._window is None else min(n, self._window.of)
        self._results += n - last
        for _ in range(last):
            self._next(True)

    def add_not_due(self) -> None:
        """Count a change that is not due."""
        self.numbers[SINK_NOT_DUE] += 1

    def add_all(
        self, kinds: Iterable[int], took: Iterable[int], numbers: Iterable[int]
    ) -> None:
        """Count results in order; their times are used if they have one."""
        for kind, each, n in zip(kinds, took, numbers):
            if kind == SINK_NOT_DUE:
                self.add_not_due()
            elif kind == SINK_MISSED:
                self.add_missed(n)
            else:
                assert kind in (SINK_IN_TIME, SINK_LATE)
                self.add(each)

    def _next(self, late: bool) -> None:
        self._results += 1
        if late and self._window is not None:
            self._window.add(self._results)

    def result_with(self, missed: int = 0, not_due: int = 0) -> SinkCounts:
        """
        Return the requirement's part of the result, in the format of a sink.

        :param missed: further results that are missed so far; ``not_due``: that are not due.
        """
        found = self.result()
        if not_due:
            found['not_due'] = found.get('not_due', 0) + not_due
        found['late'] += missed
        found['overdue'] += missed
        if self._tolerate is not None and self._window is not None:
            found['tolerate'] = {
                'misses': self._tolerate.misses, 'of': self._tolerate.of,
                'worst': self._window.worst_with(
                    range(self._results + 1, self._results + 1 + min(missed, self._window.of)))}
        return found


Requirements = Mapping[str, Mapping[str, Mapping[str, Any]]]
"""By path, and 'reaction' or 'age', results in the format of sinks."""


def as_dags(requirements: Requirements) -> dict[str, Any]:
    """Return the requirements in the format of DAGs with sinks: 'PATH reaction', 'PATH age'."""
    return {name: {'sinks': {f'{name} {what}': each for what, each in required.items()}}
            for name, required in requirements.items()}


def not_met(requirements: Requirements) -> dict[tuple[str, str], str]:
    """
    Return by path and requirement why it is not met; empty: all are.

    A requirement without a result was never tested, so it is not met.
    """
    found = {}
    for name, required in requirements.items():
        for what, each in required.items():
            if is_never_due(each):
                found[name, what] = _NOTHING_DUE[what]
            elif not is_kept(each):
                found[name, what] = _reason(what, each)
    return found


def is_never_due(requirement: Mapping[str, Any]) -> bool:
    """Return whether nothing was judged, and not because nothing was published."""
    verdicts = counts(requirement)
    return not verdicts.due and not verdicts.not_due


_NOTHING_DUE = {
    'reaction': 'no reaction was due, as its first callback hardly ran',
    'age': 'no age was judged, as no output was based on an input'}


def _reason(what: str, result: Mapping[str, Any]) -> str:
    verdicts, tolerate = counts(result), result.get('tolerate')
    results = {'reaction': 'reaction', 'age': 'output'}[what]
    late = f'later than required ({format_duration(result["relative_deadline_ns"])})'
    if tolerate is None:
        return f'{verdicts.missed} of {counted(verdicts.due, results)} {late}'
    return (f'{tolerate["worst"]} of {tolerate["of"]} {results}s in a row {late}, '
            f'tolerated: {tolerate["misses"]} of {tolerate["of"]}')
