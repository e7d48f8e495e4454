# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
End-to-end times: how data flows along a path from its first callback to its last.

Theory of operation: flows
--------------------------
A path is a list of callbacks.  A *hop* leads from each callback A to the next, B:

* trigger: A publishes a topic that starts B.  A flow continues with the execution that the message
  started.
* topic: B takes the topic itself (queue edge).  A flow continues with the executions that took the
  message, if takes are recorded, otherwise with those that began when it was the latest message.
* variable: B reads a variable of the node that A writes (queue edge).  A flow continues with the
  executions of B that began when this execution of A was the latest that had ended (CARET:
  variable passing, `left_use_latest`).

A publication belongs to the execution that published it.  A publication outside of executions, or
by another leg of a sync callback, belongs to the last execution that began before it (CARET:
use_latest_message).

A *flow* is the way of one publication of the first callback; it branches with each execution that
reads a value again.  A flow that does not arrive is dropped if another branch of the same
execution continued.

An execution of a job was started by the message that the previous vertex published in the same
job.  The topic that started a leg of a sync callback is that of its subscription.  A computed run
has no publications: each topic counts as published when the callback ends, or before that if a
callback that it starts was ready earlier.  In an imported recording the tables link messages and
executions.  An execution of several pieces (a coroutine) is one, from its first start to its last
end.

A *step* is an execution or a publication at a position of a path; its parent is the step whose
data it has.  A flow is a branch from a step without parent to one without children.  All steps of
a position are made at once.  The order at the same instant is: ends, publications, starts.

Theory of operation: response times
-----------------------------------
By default, as in CARET, a path's time is from the first publication (*start*) to the start of the
last callback's execution (*end*); ``whole`` times are from the start of the first callback's
execution to the end of the last one's.  Source: caret_analyze, ``ResponseTime`` (0.5), and CARET's
documentation of its response time cases.

* An input whose flow did not arrive gets the earliest end of later inputs: the first output that
  is at least as new.  Of several outputs of an input the earliest counts.  Inputs of the earliest
  output are ignored, because earlier inputs are unknown.
* `all`: every input.  `best`: the newest input of each output.  `worst`: the oldest one.
  `worst-with-external-latency`: from the input before the oldest one, because an external change
  right after that input waits for the next.  This is the *reaction time* to external changes.
* The *data age* of an output is the time since its newest input, for every output, including later
  outputs of the same input.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast, NamedTuple, TYPE_CHECKING

from mddag_executor.analysis.spread import spread
from mddag_executor.recording.columns import concatenate, in_parts, Ints, Mask, rows, Table
from mddag_executor.recording.joins import (
    as_of,
    different,
    distinct,
    equal,
    last_before,
    last_of,
    later_pieces,
    rows_by,
    sort_by,
)
from mddag_executor.recording.recording import Recording
from mddag_executor.recording.tables import EXECUTIONS
from msg_graph import Callback, Path
from msg_graph.segments import hops, may_end
import numpy as np

if TYPE_CHECKING:
    from mddag_executor.results.replays import PathResult, PathTimes, ResponseCases

NONE = -1
_NEVER = 2 ** 62
_CASES = ('all', 'best', 'worst', 'worst_with_external_latency')


STEPS = np.dtype([
    ('parent', 'i4'), ('position', 'i2'), ('is_run', '?'), ('row', 'i4'), ('time', 'i8'),
    ('end', 'i8')])
"""
Columns of a step: its parent's number or -1, its position, whether it is an execution.

``row`` is the row of the first piece of an execution (-1: a publication), ``time`` the start of an
execution or the time of a publication (0: not recorded), ``end`` the end of an execution (-1: not
recorded), ns.
"""


_SENT = np.dtype([('known', '?'), ('run', 'i4'), ('message', 'i8'), ('time', 'i8')])
"""
Columns of a publication; -1: unknown.

``known``: whether the callback that published it is known; ``run`` is the row of the first piece
of the execution, ``message`` the number of the message.
"""


class Executions(NamedTuple):
    """
    The executions of a callback, in order of their starts.

    ``runs`` are the rows of their first pieces, ``topics`` the numbers of the topics that started
    them (-1: none, -2: a topic of no path).
    """

    runs: Ints
    start: Ints
    topics: Ints
    vertex: Ints
    job: Ints


class Ends(NamedTuple):
    """The rows of the ended pieces of a callback, in order of their ends, and their jobs."""

    rows: Ints
    time: Ints
    job: Ints


class Flows(NamedTuple):
    """
    The flows of a path; -1: none.

    Times of the first publication (of the first start, if nothing is published), start of the last
    callback's execution, start of the first callback's execution, end of the last one's, ns.
    ``silent`` is the end of an execution with which the flow ended because it did not publish a
    topic of ``may_publish``.  ``step`` is the last step.
    """

    first: Ints
    arrival: Ints
    begin: Ints
    end: Ints
    silent: Ints
    step: Ints


class Paths:
    """
    The flows along the declared paths of a recording.

    :param judge_from: earlier inputs are left out of the figures, ns.
    """

    def __init__(self, recording: Recording, judge_from: int = -_NEVER) -> None:
        self._judge_from = judge_from
        task_set = recording.task_set
        self._recording, self._task_set = recording, task_set
        self.paths: list[Path] = list(task_set.paths)
        self.hops = [hops(task_set, path) for path in self.paths]
        if not self.paths:
            return
        self._topics = {topic: i for i, topic in enumerate(sorted(
            {topic for path in self.hops for hop in path for topic in hop.topics}))}
        self._nodes = {node: i for i, node in enumerate(
            dict.fromkeys(c.node for c in task_set.callbacks))}
        self._places = task_set.callback_indices()
        # by vertex the index of its callback; the last entry is for none
        self._place = np.array([*task_set.places_of_vertices(), NONE], dtype=np.int32)
        table = recording.executions
        if not len(table):      # row -1 must exist
            table = rows(EXECUTIONS, 1, vertex=NONE, start=NONE, end=NONE)
        self._table = table
        self._vertex = table['vertex']
        if recording.names.vertices:
            self._add_vertices(recording.names.vertices)
        # by the index of a callback the rows of its executions
        place = np.empty(len(table), dtype=np.int32)
        for part, vertex in zip(in_parts(place), in_parts(self._vertex)):
            part[:] = self._place[vertex]
        self._of_place = [
            each.astype(np.int32) for each in rows_by(place, len(self._places))]
        self._later = later_pieces(table)
        # by topic its publications, if they are recorded, and by publication the index of its node
        self._of_topic: list[Ints] | None = None
        if recording.names.publishers or recording.run.links:
            self._published()
        # messages that running callbacks took themselves, by execution
        self._took = self._first(recording.takes['execution']), recording.takes['message']

    def _add_vertices(self, of: Mapping[int, int]) -> None:
        """Find the declared callbacks of executions without job."""
        self._vertex = self._vertex.copy()
        callbacks = np.array(sorted(of), dtype=np.int64)
        unknown = np.flatnonzero(self._vertex < 0)
        callback = self._recording.executions['callback'][unknown]
        at = equal(callbacks, callback)
        known = at >= 0
        self._vertex[unknown[known]] = np.array(
            [of[each] for each in callbacks.tolist()])[at[known]]

    def _published(self) -> None:
        """Find the recorded publications on the topics of paths."""
        publishers = self._recording.names.publishers
        numbers, which = different(self._recording.publications['publisher'])
        known = [publishers.get(number) for number in numbers.tolist()]
        topics, nodes = np.array(
            [(NONE, NONE) if each is None else (
                self._topics.get(each.topic, NONE),
                self._nodes.get(each.node.name if each.node is not None else '', NONE))
             for each in known], dtype=np.int16).reshape(-1, 2).T
        self._of_topic, self._node = rows_by(topics[which], len(self._topics)), nodes[which]

    def _sent(self, callback: Callback, topics: list[int], ended: Ends) -> Table:
        """Return the publications of a callback on topics in order of time, a table of _SENT."""
        found = [rows(_SENT)]
        for topic in topics:
            if self._of_topic is not None:
                found.append(self._recorded(callback, topic, self._of_topic[topic]))
                continue
            found.append(rows(
                _SENT, len(ended.rows), known=True, run=self._first(ended.rows),
                time=self._sent_at(callback, topic, ended),
                message=self._message(ended.job, self._vertex[ended.rows], topic)
                )[self._is_sent(callback, topic, ended)])
        sent = concatenate(found)
        time = sent['time']
        return sent[sort_by(time)] if (time[1:] < time[:-1]).any() else sent

    def _sent_at(self, callback: Callback, topic: int, ended: Ends) -> Ints:
        """Return when executions of a computed run published a topic: at their ends or before."""
        found, by = ended.time.copy(), self._vertex[ended.rows]
        for number, before in enumerate(self._task_set.vertices):
            if before.callback is not callback:
                continue
            mine = np.flatnonzero(by == number)
            for place in before.successors:
                after = number - before.index + place
                topics = self._task_set.vertices[after].callback.topics
                if topic not in map(self._topics.get, topics):
                    continue
                begun = self._of_place[self._place[after]]
                begun = begun[(self._vertex[begun] == after) & (self._table['start'][begun] >= 0)]
                at = equal(self._table['job'][begun], ended.job[mine])
                known = at >= 0
                published = mine[known]
                found[published] = np.minimum(
                    found[published], self._table['ready'][begun[at[known]]])
        return found

    def _is_sent(self, callback: Callback, topic: int, ended: Ends) -> Mask:
        """Return in which executions a callback of a computed run published a topic."""
        sent = np.ones(len(ended.rows), dtype=np.bool_)
        vertex, vertices = self._vertex[ended.rows], self._task_set.vertices
        for (before, after), jobs in self._recording.run.unsent.items():
            if vertices[before].callback is callback and any(
                    self._topics.get(t) == topic for t in vertices[after].callback.topics):
                sent &= (vertex != before) | ~np.isin(ended.job, jobs)
        return sent

    def _recorded(self, callback: Callback, topic: int, mine: Ints) -> Table:
        """Return the recorded publications of a callback among those on a topic."""
        table, sent = self._table, self._recording.publications
        vertex = sent['vertex'][mine]
        # one outside of callbacks is none of a callback; of an imported execution, events are lost
        is_callback = (sent['execution'][mine] >= 0) | self._recording.run.links
        mine = mine[np.where(
            vertex >= 0, self._place[vertex] == self._places[callback.key],
            is_callback & (self._node[mine] == self._nodes[callback.node]))]
        by, known = sent['execution'][mine], sent['vertex'][mine] >= 0
        message = mine if self._recording.run.links else np.where(
            (by >= 0) & known, self._message(table['job'][by], table['vertex'][by], topic), NONE)
        return rows(_SENT, len(mine), known=known, message=message, time=sent['time'][mine],
                    run=self._first(by))

    def _first(self, rows: Any) -> Any:
        """Return the rows of the first pieces of executions."""
        later, first = self._later
        if not len(later):
            return rows
        at = equal(later, rows)
        return np.where(at >= 0, np.append(first, NONE)[at], rows)

    def _message(self, job: Any, vertex: Any, topic: Any) -> Ints:
        """Return the numbers of the messages that vertices publish in jobs."""
        number: Ints = (job * len(self._place) + vertex) * (len(self._topics) + 1) + topic
        return number

    def _ran(self, callback: Callback) -> tuple[Executions, Ends]:
        """Return the executions of a callback, and the ends of their pieces."""
        rows: Any = self._of_place[self._places[callback.key]]
        table = self._table[['start', 'end', 'callback', 'job', 'worker']][rows]
        started = table['start'] >= 0
        # those of this executor that waited at the end have no worker
        started &= (table['end'] >= 0) | (table['worker'] >= 0) | (
            ~self._recording.own_executions[rows])
        ended = np.flatnonzero(started & (table['end'] >= 0))
        ended = ended[sort_by(table['end'][ended])]
        mine = np.flatnonzero(started & (self._first(rows) == rows))
        mine = mine[sort_by(table['start'][mine])]
        if not callback.topics:
            topics = np.full(len(mine), NONE)
        else:
            numbers, which = different(table['callback'][mine])
            names = [self._recording.names.topic(number) for number in numbers.tolist()]
            topics = np.array([self._topics.get(name, -2) if name else NONE
                               for name in names], dtype=np.int64)[which]
        return Executions(
            rows[mine], table['start'][mine], topics, self._vertex[rows[mine]],
            table['job'][mine]), Ends(rows[ended], table['end'][ended], table['job'][ended])

    def flows(self, number: int) -> Flows:
        """Return the flows of a path."""
        return flows_of(self.steps(number), self.may_end(number))

    def may_end(self, number: int) -> Mask:
        """Return by position of a path whether a flow may end there, as nothing is published."""
        return np.array([*may_end(self._task_set, self.paths[number]), False])

    def steps(self, number: int) -> Table:
        """Return the steps of a path, a table of ``STEPS``."""
        path, path_hops = self.paths[number], self.hops[number]
        steps = _Steps()
        # by execution its step at the position
        step_of: Any = np.full(len(self._table), NONE, dtype=np.int32)
        before: tuple[_Timeline, _Timeline] | None = None
        messages = _Messages(*[np.empty(0, dtype=np.int64)] * 3)
        for position, key in enumerate(path.callbacks):
            callback = self._task_set.callback(key)
            hop = path_hops[position - 1] if position else None
            ran, ended = self._ran(callback)
            if hop is not None and hop.kind == 'trigger':
                # otherwise another leg of a sync callback
                fits = np.isin(ran.topics, [NONE, *(self._topics[t] for t in hop.topics)])
                if not fits.all():
                    ran = Executions(*(each[fits] for each in ran))
            parent = np.full(len(ran.runs), NONE)
            if hop is not None and before is not None:
                if hop.kind == 'trigger':
                    for message in self._messages_for(path.callbacks[position - 1], ran):
                        found = messages.as_of(message, ran.start)
                        parent = np.where(found != NONE, found, parent)
                else:
                    timeline = before[hop.kind == 'topic']
                    parent = timeline.as_of(ran.start)
            if hop is not None and hop.kind == 'topic':
                taker, taken = self._took
                at = equal(ran.runs, taker)
                mine = at != NONE
                parent[at[mine]] = messages.as_of(taken[mine], np.full(int(mine.sum()), _NEVER))
            step = step_of[ran.runs] = steps.add(position, parent, ran.start, ran.runs)
            topics = [self._topics[t] for t in path_hops[position].topics] \
                if position < len(path_hops) else []
            before = self._done(steps, callback, ended, step_of), _Timeline(
                np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64))
            if topics:
                made = _Timeline(ran.start, step)
                sent = self._sent(callback, topics, ended)
                timeline, messages = self._publish(steps, position, callback, made, step_of, sent)
                before = before[0], timeline
            step_of[ran.runs] = NONE
        return steps.table()

    def _messages_for(self, before: str, ran: Executions) -> list[Ints]:
        """Return the messages that may have started executions; later entries have priority."""
        if self._recording.run.links:
            return [self._table['message'][ran.runs]]
        found: list[Ints] = []
        vertices = self._task_set.vertices
        for v in distinct(ran.vertex).tolist():
            mine = ran.vertex == v
            for local in vertices[v].predecessors:
                publisher = v - vertices[v].index + local
                if vertices[publisher].callback.key != before:
                    continue
                for name in vertices[v].callback.topics:
                    if name in self._topics:
                        topic = self._topics[name]
                        fits = mine & ((ran.topics == topic) | (ran.topics == NONE))
                        found.append(np.where(
                            fits, self._message(ran.job, publisher, topic), -2))
        return found

    def _done(
        self, steps: _Steps, callback: Callback, ended: Ends, step_of: Ints
    ) -> _Timeline:
        """Note when executions ended."""
        of = step_of[self._first(ended.rows)]
        known = of != NONE
        steps.end(of[known], ended.time[known])
        if callback.kind != 'sync':
            return _Timeline(ended.time, of)
        return _Timeline(ended.time[known], of[known])

    def _publish(
        self, steps: _Steps, position: int, callback: Callback, ran: _Timeline, step_of: Ints,
        sent: Table,
    ) -> tuple[_Timeline, _Messages]:
        """
        Make the steps of the publications at a position; return times and messages.

        :param ran: the steps of the executions; ``step_of``: the same by row.
        """
        known, run, message, time = (sent[name] for name in _SENT.names or ())
        parent = np.where(known & (run != NONE), step_of[run], NONE)
        latest = (parent == NONE) & ((callback.kind == 'sync') | ~known)
        parent[latest] = ran.as_of(time[latest], before=True)
        made = steps.add(position, parent, time)
        there = (made != NONE) & (message != NONE)
        return _Timeline(time, made), _Messages(message[there], time[there], made[there])

    def results(self) -> dict[str, PathResult]:
        """
        Return by path its end-to-end times, ns.

        ``flows`` counts the inputs and ``arrived`` those whose flow reached the last callback.
        ``response_time`` has CARET's cases from the first publication to the start of the last
        callback, ``whole`` those from the start of the first to the end of the last.
        ``reaction_time`` is the worst case with external latency, ``data_age`` that of every
        output.
        """
        found: dict[str, PathResult] = {}
        for number, (path, path_hops) in enumerate(zip(self.paths, self.hops)):
            flows = self.flows(number)
            judged = flows.begin >= self._judge_from if self._judge_from > -_NEVER else slice(None)
            first, arrival, begin, end = (each[judged] for each in flows[:4])
            found[path.name] = {
                'callbacks': list(path.callbacks), 'hops': [hop.kind for hop in path_hops],
                'flows': len(arrival), 'arrived': int((arrival != NONE).sum()),
                **figures(first, arrival), 'whole': figures(begin, end)}
        return found


class _Timeline(NamedTuple):
    """The last step at each time; in order of time."""

    times: Ints
    steps: Ints

    def as_of(self, times: Ints, before: bool = False) -> Ints:
        """Return the last steps at given times, or ``before`` them."""
        if not len(self.times):
            return np.full(len(times), NONE)
        at = (last_before if before else as_of)(self.times, times)
        found: Ints = np.where(at >= 0, self.steps[at], NONE)
        return found


class _Messages(NamedTuple):
    """The messages that were published at a position: numbers, times, and steps."""

    numbers: Ints
    times: Ints
    steps: Ints

    def as_of(self, wanted: Ints, times: Ints) -> Ints:
        """Return the last step of each wanted message up to a time; -1: none."""
        if not len(self.numbers):
            return np.full(len(wanted), NONE)
        if (self.numbers[1:] > self.numbers[:-1]).all():    # each message was published once
            at = np.minimum(np.searchsorted(self.numbers, wanted), len(self.numbers) - 1)
            there = (self.numbers[at] == wanted) & (self.times[at] <= times)
            return np.where(there, self.steps[at], NONE)
        n = len(self.numbers)
        number = np.r_[self.numbers, wanted]
        is_asked = np.r_[np.zeros(n, dtype=np.int64), np.ones(len(wanted), dtype=np.int64)]
        order = sort_by(number, np.r_[self.times, times], is_asked)
        is_message: Mask = order < n
        last = last_of(is_message, number[order])
        good = ~is_message & (last >= 0)
        found = np.full(len(wanted), NONE)
        found[order[good] - n] = self.steps[order[last[good]]]
        return found


class _Steps:
    """The steps of a path."""

    def __init__(self) -> None:
        self._parts = [rows(STEPS)]
        self._count = 0

    def add(
        self, position: int, parent: Ints, times: Ints, runs: Ints | None = None
    ) -> Ints:
        """
        Add steps that have a parent, or begin the path; return their numbers.

        :param runs: the rows of executions; None: they are publications.
        """
        wanted = (parent != NONE) | (position == 0)
        numbers = np.where(wanted, self._count + np.cumsum(wanted) - 1, NONE)
        self._parts.append(rows(
            STEPS, int(wanted.sum()), parent=parent[wanted], position=position,
            is_run=runs is not None, row=NONE if runs is None else runs[wanted],
            time=times[wanted], end=NONE))
        self._count += len(self._parts[-1])
        return numbers

    def end(self, steps: Ints, times: Ints) -> None:
        """Note when steps ended, which were added last."""
        last = self._parts[-1]
        last['end'][steps - (self._count - len(last))] = times

    def table(self) -> Table:
        """Return the steps as a table of ``STEPS``."""
        return concatenate(self._parts)


def leaves(steps: Table, last: int) -> Ints:
    """
    Return the last steps of flows: those without children, except dead ends.

    :param last: the last position of the path.
    """
    parent, is_run = steps['parent'], steps['is_run']
    child = parent != NONE
    inner = np.zeros(len(steps), dtype=np.bool_)
    inner[parent[child]] = True
    # a dead end: another execution that read the same step continued
    went_on = np.zeros(len(steps), dtype=np.bool_)
    went_on[parent[child & is_run & inner]] = True
    dead = ~inner & child & is_run & (steps['position'] != last)
    dead[dead] = went_on[parent[dead]]
    return np.flatnonzero(~inner & ~dead)


def flows_of(steps: Table, may_end: Mask) -> Flows:
    """
    Return the flows: the branches from steps without a parent to those without children.

    :param may_end: by position whether a flow may end there, as nothing is published.
    """
    last = len(may_end) - 1
    step = leaves(steps, last)
    first, arrival, begin, end, silent_end = (np.full(len(step), NONE) for _ in range(5))
    found = Flows(first, arrival, begin, end, silent_end, step)
    flow = np.arange(len(step))
    ends = steps[step]
    silent = may_end[ends['position']] & ends['is_run'] & (ends['end'] != NONE)
    found.silent[silent] = ends['end'][silent]
    while len(step):
        of = steps[step]
        run, begin, at_last = of['is_run'], of['position'] == 0, of['position'] == last
        for chosen, into, values in (
                (run & at_last, found.arrival, of['time']), (run & begin, found.begin, of['time']),
                (run & at_last, found.end, of['end']),
                (~run & begin & (of['time'] != 0), found.first, of['time'])):
            into[flow[chosen]] = values[chosen]
        more = of['parent'] != NONE
        flow, step = flow[more], of['parent'][more]
    return found._replace(first=np.where(found.first == NONE, found.begin, found.first))


def figures(start: Ints, end: Ints) -> PathTimes:
    """
    Return the statistics of CARET's cases, of reaction time and data age.

    :param start: start of each flow; -1: ignored.
    :param end: end of each flow; -1: it did not arrive.
    """
    times = {name: spread(each) for name, each in cases(start, end).items()}
    return {
        'response_time': cast('ResponseCases', {name: times[name] for name in _CASES}),
        'reaction_time': times['worst_with_external_latency'], 'data_age': times['data_age']}


def cases(start: Ints, end: Ints) -> dict[str, Ints]:
    """Return the response times of flows by case, and the data ages (see ``figures``), ns."""
    known = (start != NONE) & ((end == NONE) | (end >= start))
    start, end = start[known], end[known]
    arrived = end != NONE
    order = sort_by(end[arrived], start[arrived])
    inputs, outputs = start[arrived][order], end[arrived][order]
    newest = np.flatnonzero(np.r_[outputs[1:] != outputs[:-1], True][:len(outputs)])
    found = {**{name: np.empty(0, dtype=np.int64) for name in _CASES},
             'data_age': (outputs - inputs)[newest]}
    order = sort_by(start)
    start, end, arrived = start[order], end[order], arrived[order]
    if not arrived.any():
        return found
    # each input has the earliest end of its own and of later inputs
    earliest = np.minimum.accumulate(np.where(arrived, end, _NEVER)[::-1])[::-1]
    first = np.flatnonzero(np.r_[True, start[1:] != start[:-1]])
    own = np.minimum.reduceat(np.where(arrived, end, earliest), first)
    inputs = start[first]
    counted = (own < _NEVER) & (own != own.min())   # inputs before the earliest output are unknown
    inputs, own = inputs[counted], own[counted]
    took = own - inputs
    found['all'] = took
    found['worst'] = took[np.unique(own, return_index=True)[1]]
    found['best'] = took[::-1][np.unique(own[::-1], return_index=True)[1]]
    after = np.unique(own[1:], return_index=True)[1]
    found['worst_with_external_latency'] = own[1:][after] - inputs[after]
    return found
