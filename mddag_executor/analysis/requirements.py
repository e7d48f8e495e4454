# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Judges the requirements of paths in a recording, and says where the time of late ones went.

The rules are those of ``core.requirements``, applied to all flows of a path at once.
``test/analysis/test_requirements.py`` compares both with a third implementation.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

from mddag_executor.analysis.paths import Flows, NONE, Paths
from mddag_executor.core import NEVER
from mddag_executor.core.requirements import RequirementTally, Rules
from mddag_executor.core.state import SINK_IN_TIME, SINK_LATE, SINK_MISSED, SINK_NOT_DUE
from mddag_executor.recording.columns import concatenate, Ints, Mask, rows, Table
from mddag_executor.recording.joins import sort_by
from mddag_executor.recording.recording import Recording
from msg_graph import Path
import numpy as np

if TYPE_CHECKING:
    from mddag_executor.results.replays import LatePart, LatePath
    from mddag_executor.results.sinks import Requirements as Results

RESULTS = np.dtype([
    ('kind', 'i1'), ('since', 'i8'), ('end', 'i8'), ('step', 'i8'), ('count', 'i8')])
"""
Columns of a result: the core's decision, the time of the change or input, the end of the output.

``step`` is that of the output.  Both are -1 if there is none.  ``count`` is the number of equal
results: all outputs that did not come are one row.
"""


class Requirements:
    """
    The verdicts about the paths of a recording.

    :param judge_from: earlier changes and inputs are not judged, ns.
    """

    def __init__(self, recording: Recording, paths: Paths, judge_from: int = -NEVER) -> None:
        begin, end = recording.run.judged_releases or (-NEVER, NEVER)
        self._from, self._to = max(begin, judge_from), end
        if recording.whole is not None:     # a part lacks what answers its last inputs
            recording = recording.whole
            paths = Paths(recording)
        self._recording, self._paths = recording, paths
        self._until = recording.run.judged_until

    @property
    def paths(self) -> list[Path]:
        """Return the declared paths."""
        return self._paths.paths

    @cached_property
    def results(self) -> dict[tuple[int, str], Table]:
        """Return by number of a path and what is required a table of ``RESULTS``."""
        found: dict[tuple[int, str], Table] = {}
        for number, path in enumerate(self._paths.paths):
            if path.requirements:
                flows = self._paths.flows(number)
                rules = Rules(self._recording.task_set, path)
                for what, required in path.requirements.items():
                    judge = {'reaction': self._reactions, 'age': self._ages}[what]
                    found[number, what] = judge(flows, rules, required)
        return found

    def _is_judged(self, times: Ints) -> Mask:
        judged: Mask = (times >= self._from) & (times < self._to)
        return judged

    def _reactions(self, flows: Flows, rules: Rules, required: int) -> Table:
        """Return a result for each change (rules 1 and 2)."""
        order = sort_by(flows.begin)
        order = order[flows.begin[order] != NONE]
        if not len(order):
            return rows(RESULTS)
        begin, end, silent, step = (
            each[order] for each in (flows.begin, flows.end, flows.silent, flows.step))
        end, silent = (np.where(each != NONE, each, NEVER) for each in (end, silent))
        inputs, first = np.unique(begin, return_index=True)
        own = np.minimum.reduceat(end, first)
        # the first answer to this or a later input, and the flow that it came with
        place = np.lexsort((np.arange(len(end)), end))
        rank = np.empty(len(end), dtype=np.int64)
        rank[place] = np.arange(len(end))
        best = place[np.minimum.accumulate(rank[::-1])[::-1]][first]
        answer = end[best]
        silence = np.minimum.accumulate(silent[::-1])[::-1][first]
        not_due = (own == NEVER) & (silence < NEVER) & (silence <= answer)
        since = inputs
        if rules.sampled:
            since = inputs[:-1]
            answer, not_due, best = answer[1:], not_due[1:], best[1:]
        answered = ~not_due & (answer < NEVER)
        overdue = ~not_due & ~answered & (since + required <= self._until) if (
            self._recording.run.judged) else np.zeros(len(since), dtype=np.bool_)
        kind = np.select(
            [not_due, overdue, answer - since > required], [SINK_NOT_DUE, SINK_MISSED, SINK_LATE],
            SINK_IN_TIME)
        judged = self._is_judged(since) & (not_due | answered | overdue)
        found: Table = rows(
            RESULTS, len(since), kind=kind, since=since, end=np.where(answered, answer, NONE),
            step=np.where(answered, step[best], NONE), count=1)[judged]
        return found

    def _ages(self, flows: Flows, rules: Rules, required: int) -> Table:
        """Return a result for each output, and for each one that did not come (rule 3)."""
        known = np.flatnonzero((flows.begin != NONE) & (flows.end != NONE))
        order = known[sort_by(flows.end[known], flows.begin[known])]
        end = flows.end[order]
        newest = order[np.flatnonzero(np.r_[end[1:] != end[:-1], True][:len(end)])]
        since, end = flows.begin[newest], flows.end[newest]
        kind = np.where(end - since > required, SINK_LATE, SINK_IN_TIME)
        found = rows(RESULTS, len(end), kind=kind, since=since, end=end,
                     step=flows.step[newest], count=1)[self._is_judged(since)]
        begins = flows.begin[flows.begin != NONE]
        begins = begins[self._is_judged(begins)]
        if not len(begins) or not self._recording.run.judged:
            return found
        last = int(found['end'].max(initial=begins.min()))
        missing = rules.missing_outputs(last, min(self._until, self._to), required)
        return concatenate([found, rows(
            RESULTS, int(missing > 0), kind=SINK_MISSED, since=last, end=NONE, step=NONE,
            count=missing)])

    def result(self) -> Results:
        """Return by path, and 'reaction' or 'age', its result in the format of a sink."""
        found: Results = {}
        for (number, what), table in self.results.items():
            path = self._paths.paths[number]
            tally = RequirementTally(path, path.requirements[what])
            tally.add_all(*(each.tolist() for each in (
                table['kind'], table['end'] - table['since'], table['count'])))
            found.setdefault(path.name, {})[what] = tally.result_with()
        return found

    # --- where the time went ---------------------------------------------------------------------

    def breakdown(self) -> dict[str, dict[str, LatePath]]:
        """
        Return where the time of late reactions and ages went: by path and requirement.

        ``late`` is the number of late outputs; ``parts`` has a row for each part of the way in
        order: the callback, what happened, the ``mean_ns`` of the late ones, and ``worst_ns``,
        that of the latest.  ``unanswered`` are changes without output, and missing outputs.
        """
        found: dict[str, dict[str, LatePath]] = {}
        for number, path in enumerate(self._paths.paths):
            mine = {what: self.results[number, what] for what in path.requirements}
            if not any((table['kind'] != SINK_IN_TIME).any() for table in mine.values()):
                continue
            steps = self._paths.steps(number)
            for what, table in mine.items():
                late = table[table['kind'] == SINK_LATE]
                unanswered = int(table['count'][table['kind'] == SINK_MISSED].sum())
                if len(late) or unanswered:
                    found.setdefault(path.name, {})[what] = {
                        'late': len(late), 'unanswered': unanswered,
                        'parts': self._parts(path, number, steps, late)}
        return found

    def _parts(
        self, path: Path, number: int, steps: Table, late: Table
    ) -> list[LatePart]:
        if not len(late):
            return []
        last = len(path.callbacks)
        ready, start, sent, end = (np.full((last, len(late)), NONE) for _ in range(4))
        which, step = np.arange(len(late)), late['step']
        executions = self._recording.executions
        while len(step):
            of = steps[step]
            run, position = of['is_run'], of['position'].astype(np.int64)
            place, mine = position[run], which[run]
            start[place, mine], end[place, mine] = of['time'][run], of['end'][run]
            ready[place, mine] = executions['ready'][of['row'][run]]
            sent[position[~run], which[~run]] = of['time'][~run]
            more = of['parent'] != NONE
            which, step = which[more], of['parent'][more]
        longest = int((late['end'] - late['since']).argmax())
        found: list[LatePart] = []

        def add(key: str, what: str, times: Ints) -> None:
            if times.any():
                found.append({'callback': key, 'part': what, 'mean_ns': round(times.mean()),
                              'worst_ns': int(times[longest])})

        left = late['since'].copy()     # up to here each time is explained
        for place, key in enumerate(path.callbacks):
            hop = self._paths.hops[number][place - 1].kind if place else None
            begun = np.maximum(left, start[place])
            queued = np.clip(np.where(ready[place] >= 0, ready[place], begun), left, begun)
            add(key, 'transport' if hop == 'trigger' else
                'waiting for an input that arrives' if hop is None else 'waiting for its next job',
                queued - left)
            add(key, 'queueing', begun - queued)
            out = end[place] if place == last - 1 else sent[place]
            done = np.maximum(begun, np.where(out > 0, out, np.where(
                end[place] >= 0, end[place], begun)))
            if place < last - 1:    # a variable is read from the end on
                done = np.where(start[place + 1] >= 0, np.minimum(done, np.maximum(
                    begun, start[place + 1])), done)
            add(key, 'executing', done - begun)
            left = done
        return found
