# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Cuts a time range out of a recording.

Theory of operation
-------------------
1. A part has the jobs that were released in the range, begin included, end excluded.  They keep
   all their rows, also later ones, so their verdicts and response times equal those in the whole
   recording.
2. The part ends when the last of these jobs ended, but not before the end of the range.  Other
   executions that ended within the part are also kept, because they may have delayed a job; their
   jobs are not judged.
3. Rows are not cut.  An execution that began before the range and ended in it is in the part.
4. Usual times are those of the whole recording (``whole``), not of the part.
5. Times stay on the clock of the recording; ``start`` becomes the begin of the range.
"""

from __future__ import annotations

from mddag_executor.recording.columns import Mask, Places
from mddag_executor.recording.joins import RowNumbers
from mddag_executor.recording.recorded_jobs import Jobs
from mddag_executor.recording.run import Run
from mddag_executor.recording.tables import Columns, VERTEX
from msg_graph.model import topological_order
import numpy as np


def part(
    columns: Columns, run: Run, jobs: Jobs, job_of: Places, begin: int, end: int
) -> tuple[Columns, int]:
    """
    Return the tables of a time range, and when this part ends.

    :param job_of: by execution the place of its job; ``begin``, ``end``: of the range, ns.
    """
    table, released = columns.executions, columns.releases
    in_range = (released['release'] >= begin) & (released['release'] < end)
    judged = jobs.marked(in_range)
    own = judged[job_of] | _followed(columns, run, end)
    ends = columns.job_ends
    until = max(
        min(end, run.end), *(int(times.max(initial=begin)) for times in (
            table['end'][own], ends['time'][judged[jobs.places(ends)]])))
    last = max(until, end)      # undeclared callbacks may run after the end of the recording

    begun = np.where(table['ready'] >= 0, table['ready'], table['start'])
    begun = np.where(begun >= 0, begun, table['end'])
    kept = own | ((begun < last) & ((table['end'] >= begin) | (table['end'] < 0)))
    seen = judged | jobs.marked((released['release'] >= begin) & (released['release'] < last))
    seen[job_of[kept]] = True
    seen[-1] = False
    sent, takes = columns.publications, columns.takes
    executions = RowNumbers(kept)
    of_kept = executions.has(sent['execution']) | (
        (sent['execution'] < 0) & (sent['time'] >= begin) & (sent['time'] < last))
    takes = takes[executions.has(takes['execution'])]
    for message in (table['message'][kept] if run.links else table['message'][:0],
                    takes['message']):
        of_kept[message[message >= 0]] = True
    messages = RowNumbers(of_kept)
    table, sent = table[kept], sent[of_kept]
    sent['execution'] = executions.new(sent['execution'])
    if run.links:
        table['message'] = messages.new(table['message'])
    takes['execution'] = executions.new(takes['execution'])
    takes['message'] = messages.new(takes['message'])
    stops, drops, demotions = columns.stops, columns.drops, columns.demotions
    gaps = columns.spin_gaps
    losses, unfinished = columns.losses, columns.unfinished
    return Columns(
        releases=released[seen[jobs.places(released)]], executions=table,
        publications=sent, takes=takes, job_ends=ends[seen[jobs.places(ends)]],
        stops=stops[(stops['start'] < last) & (stops['end'] > begin)],
        spin_gaps=gaps[(gaps['start'] < last) & (gaps['end'] > begin)],
        drops=drops[(drops['time'] >= begin) & (drops['time'] < last)],
        losses=losses[(losses['time'] >= begin) & (losses['time'] < last)],
        demotions=demotions[(demotions['time'] >= begin) & (demotions['time'] < last)],
        unfinished=unfinished[unfinished['start'] < last],
        misses=columns.misses[judged[jobs.places(columns.misses)]]), until


def _followed(columns: Columns, run: Run, end: int) -> Mask:
    """
    Return which executions later jobs may complete those of the range with (``driven_by``).

    Those are the executions of the first jobs after the range in which a driven sync, or a vertex
    after it, has completed.
    """
    table, released = columns.executions, columns.releases
    found = np.zeros(len(table), dtype=np.bool_)
    first = 0
    for dag in run.task_set.dags:
        after: set[int] = set()
        for v in topological_order(dag):
            vertex = dag.vertices[v]
            if vertex.callback.driven_by is not None or not after.isdisjoint(vertex.predecessors):
                after.add(v)
        later = released[(released['dag'] == dag.index) & (released['release'] >= end)]['job']
        for v in sorted(after):
            mine = np.flatnonzero(
                (table['vertex'] == first + v) & (table['completes'] == VERTEX))
            numbers = table['job'][mine]
            numbers = numbers[np.isin(numbers, later)]
            if len(numbers):
                found |= (table['dag'] == dag.index) & (table['job'] == numbers.min())
        first += len(dag.vertices)
    return found
