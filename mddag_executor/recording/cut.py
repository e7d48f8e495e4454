# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Cuts a time range out of a recording.

Theory of operation
-------------------
1. Judged are the jobs that were released in the range, begin included, end excluded.  They keep
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

from dataclasses import replace

from mddag_executor.recording.head import ReplayError
from mddag_executor.recording.tables import (
    Mask,
    Recording,
    RowNumbers,
    VERTEX,
)
from msg_graph.model import topological_order
import numpy as np


def cut(recording: Recording, begin: int, end: int) -> Recording:
    """
    Return a time range of a recording.

    :param begin: begin of the range, ns after the start of the recording; ``end``: likewise.
    :raises ValueError: if the range is empty or begins before the recording.
    :raises mddag_executor.ReplayError: if it begins after the recording.
    """
    if not 0 <= begin < end:
        raise ValueError(f'from {begin} to {end} ns is no range of time')
    if recording.start is None:     # empty recording
        return recording
    length = recording.end - recording.start
    if begin > length:
        raise ReplayError(
            recording.name, f'it ends {length / 1e9:.3f} s after its first release',
            'give an earlier time')
    begin, end = recording.start + begin, recording.start + end
    table, released = recording.executions, recording.releases
    jobs, job_of = recording.jobs, recording.job_places
    in_range = (released['release'] >= begin) & (released['release'] < end)
    judged = jobs.marked(in_range)
    own = judged[job_of] | _followed(recording, end)
    ends = recording.job_ends
    until = max(
        min(end, recording.end), *(int(times.max(initial=begin)) for times in (
            table['end'][own], ends['time'][judged[jobs.places(ends)]])))
    last = max(until, end)      # undeclared callbacks may run after the end of the recording

    begun = np.where(table['ready'] >= 0, table['ready'], table['start'])
    begun = np.where(begun >= 0, begun, table['end'])
    kept = own | ((begun < last) & ((table['end'] >= begin) | (table['end'] < 0)))
    seen = judged | jobs.marked((released['release'] >= begin) & (released['release'] < last))
    seen[job_of[kept]] = True
    seen[-1] = False
    sent, takes = recording.publications, recording.takes
    executions = RowNumbers(kept)
    of_kept = executions.has(sent['execution']) | (
        (sent['execution'] < 0) & (sent['time'] >= begin) & (sent['time'] < last))
    takes = takes[executions.has(takes['execution'])]
    for message in (table['message'][kept] if recording.links else table['message'][:0],
                    takes['message']):
        of_kept[message[message >= 0]] = True
    messages = RowNumbers(of_kept)
    table, sent = table[kept], sent[of_kept]
    sent['execution'] = executions.new(sent['execution'])
    if recording.links:
        table['message'] = messages.new(table['message'])
    takes['execution'] = executions.new(takes['execution'])
    takes['message'] = messages.new(takes['message'])
    stops, drops, demotions = recording.stops, recording.drops, recording.demotions
    losses = recording.losses
    return replace(
        recording, releases=released[seen[jobs.places(released)]], executions=table,
        publications=sent, takes=takes, job_ends=ends[seen[jobs.places(ends)]],
        stops=stops[(stops['start'] < last) & (stops['end'] > begin)],
        drops=drops[(drops['time'] >= begin) & (drops['time'] < last)],
        losses=losses[(losses['time'] >= begin) & (losses['time'] < last)],
        demotions=demotions[(demotions['time'] >= begin) & (demotions['time'] < last)],
        misses=recording.misses[judged[jobs.places(recording.misses)]],
        start=begin, end=until, judged_releases=(begin, end), whole=recording.whole or recording)


def _followed(recording: Recording, end: int) -> Mask:
    """
    Return which executions later jobs may complete those of the range with (``driven_by``).

    Those are the executions of the first jobs after the range in which a driven sync, or a vertex
    after it, has completed.
    """
    table, released = recording.executions, recording.releases
    found = np.zeros(len(table), dtype=np.bool_)
    first = 0
    for dag in recording.task_set.dags:
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
