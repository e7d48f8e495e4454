# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What a trace with a declaration says of its jobs, as columns of its executions.

Theory of operation
-------------------
In a run in which other executors ran some of the processes, messages say which execution belongs
to which job (``imported_jobs``), and the jobs of the trace are not used.  The events of an
execution without a job have all that is needed (``undeclared_run``).  For executions of jobs,
three other kinds of events have the rest:

1. ``job_release`` has the due time of a timer, and the stamp of a message that is released by
   its header stamp.  It is the due time of the dispatch of that job's source (column ``c``).
2. ``complete`` has the CPU time of the execution, and whether it held the interpreter (column
   ``d``).  It is that of the last dispatch of its callback and job.
3. ``fail`` means that an execution has raised an exception: the one with the next ``complete`` of
   the same vertex and job.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mddag_executor.recording.columns import concatenate, Ints, rows, Table
from mddag_executor.recording.joins import equal, equal_pairs, last_of, sort_by
from mddag_executor.sources.imported_events import START
from msg_graph import TaskSet
import numpy as np

_DISPATCH, _RELEASE, _COMPLETE, _FAIL = (
    f'mddag:{name}' for name in ('dispatch', 'job_release', 'complete', 'fail'))
_FIELDS = {
    _DISPATCH: ('callback', 'dag', 'vertex', 'job'), _RELEASE: ('dag', 'job', 'release'),
    _COMPLETE: ('callback', 'dag', 'vertex', 'job', 'cpu_time', 'held_interpreter'),
    _FAIL: ('dag', 'vertex', 'job')}
_JOB_BITS = 40


class DeclaredEvents:
    """
    The events of the jobs of a trace.

    :param task_set: its declaration.
    :ivar names: full names of the events that it needs.
    """

    names: Sequence[str] = tuple(_FIELDS)

    def __init__(self, task_set: TaskSet) -> None:
        self._parts = {name: [rows(_type(name))] for name in self.names}
        counts = [len(dag.vertices) for dag in task_set.dags]
        self._first = np.cumsum([0, *counts])
        self._counts = np.array([*counts, 0])
        #: By DAG its source if a release says when it was due, or how its message was stamped.
        self._source = np.array([*(
            dag.source if dag.vertices[dag.source].callback.kind == 'timer'
            or dag.release_from == 'header_stamp' else -1 for dag in task_set.dags), -1])

    def take(self, name: str, events: Any, places: Ints) -> None:
        """Receive events of a kind, and their places in the file."""
        fields = [field for field in _FIELDS[name] if field in (events.dtype.names or ())]
        self._parts[name].append(rows(_type(name), len(events), place=places, **{
            field: events[field].astype(np.int64) for field in fields}))

    def fill(self, events: Table) -> Ints:
        """
        Fill in columns of the events of executions.

        :return: the places of the dispatches of executions that have failed.
        """
        dispatched, released, completed, failed = (
            concatenate(self._parts[name]) for name in self.names)
        completed = completed[self._known(completed)]
        dispatched = dispatched[self._known(dispatched)]
        dispatched = dispatched[sort_by(dispatched['place'])]
        starts = np.flatnonzero(events['kind'] == START)
        at = equal(events['place'][starts], dispatched['place'])
        dispatched, row = dispatched[at >= 0], starts[at[at >= 0]]
        source = dispatched['vertex'] == self._source[dispatched['dag']]
        which, _ = equal_pairs(*((each['dag'], each['job']) for each in (released, dispatched)))
        of = np.flatnonzero(source & (which >= 0))
        events['c'][row[of]] = released['release'][which[of]]
        backwards = np.arange(len(dispatched))[::-1]    # the last dispatch is found first
        which, _ = equal_pairs(*(
            (each['callback'], self._key(each)) for each in (dispatched[backwards], completed)))
        of = np.flatnonzero(which >= 0)
        last = backwards[which[of]]
        events['d'][row[last]] = 2 * (completed['cpu_time'][of] + 1) + (
            completed['held_interpreter'][of] != 0)
        failed = failed[self._known(failed)]
        next_one = self._next(failed, completed)
        found = which[next_one[next_one >= 0]]
        places: Ints = dispatched['place'][backwards[found[found >= 0]]]
        return places

    def _next(self, failed: Table, completed: Table) -> Ints:
        """Return by failure the next completion of its vertex and job in the file; -1: none."""
        key = np.append(self._key(completed), self._key(failed))
        backwards = -np.append(completed['place'], failed['place'])
        is_end = np.arange(len(key)) < len(completed)
        order = sort_by(key, backwards)
        last = last_of(is_end[order], key[order])
        found = np.empty(len(key), dtype=np.int64)
        found[order] = np.where(last >= 0, order[last], -1)
        return found[len(completed):]

    def _known(self, events: Table) -> Any:
        """Return which events are of declared vertices."""
        dag, vertex = events['dag'], events['vertex']
        known = (dag >= 0) & (dag < len(self._counts) - 1)
        return known & (vertex >= 0) & (vertex < self._counts[np.where(known, dag, -1)])

    def _key(self, events: Table) -> Ints:
        """Return by event its vertex and job in one number."""
        found: Ints = (self._first[events['dag']] + events['vertex'] << _JOB_BITS) + events['job']
        return found


def _type(name: str) -> np.dtype[Any]:
    return np.dtype([('place', 'i8'), *((field, 'i8') for field in _FIELDS[name])])
