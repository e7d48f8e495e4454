# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
End-to-end figures: how a path's data flows from its first callback to its last.

Theory of operation
-------------------
A path is a list of callbacks; from each to the next leads a *hop*:

* trigger: the one publishes a topic that starts the other.  A flow goes on with the execution that
  the message started.
* topic: the other takes the topic itself (queue edge).  A flow goes on with the executions that
  took the message, where takes are recorded, else with those for which it was the latest.
* variable: the other reads what the one left in a variable of their node (queue edge).  A flow
  goes on with the executions that began when it was the latest that had ended (CARET: variable
  passing, `left_use_latest`).

What a callback publishes belongs to the execution that published it.  What is published outside
of executions, or by another leg of a sync callback, belongs to the execution that began last
before it (CARET: use_latest_message).

A *flow* is what became of one publication of the first callback; with each execution that reads a
value again it branches.  A flow that arrives nowhere is left out where another branch of the same
execution went on.

By default, as in CARET, a path's time runs from the first publication to the start of the last
callback's execution; ``whole`` figures run from the start of the first callback's execution to the
end of the last one's.

Which message an execution of a job ran for is known from the job: it is the one that the vertex
before it published in the same job.  The topic that started a leg of a sync callback is its
subscription's.  A simulated trace has no publications: there every topic is published when the
callback ends.  In an imported recording the linker has found the messages.  An execution of
several pieces (a coroutine) is one, from its first start to its last end.

A *place* is a position in a path, a *step* an execution or a publication there.  Steps are made
for many events at once: place by place along each path, as what a place needs is known once the
place before it is done.  Flows that are over are counted and forgotten (see ``path_flows``).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

from mddag_executor.replay.happenings import (
    Batch,
    BEGAN,
    different,
    Ints,
    Observer,
    OVER,
    PUBLISHED,
    RAN,
    SENT,
    STARTED,
    TOOK,
)
from mddag_executor.replay.linker import KEEP
from mddag_executor.replay.path_flows import (
    END,
    F_PATH,
    Forest,
    NEVER,
    NONE,
    PARENT,
    PathFigures,
)
from mddag_executor.replay.run import Run
from msg_graph import Callback, Path, TaskSet
import numpy as np

HopKind = Literal['trigger', 'topic', 'variable']

SETTLE = 1 << 18
"""Events from which on steps are made of them, and flows that are over are taken out."""
KEPT = 1024
"""Executions and messages of a place that may still be referred to, by default."""
LAG_NS = 1_000_000_000
"""Nothing comes later than this after it happened."""
_ORDER = 40     # bits of an event's number in the order
_JOB = 42   # bits: no execution is ready more than an hour before one of the job before it

# Columns of the input; all begin with the place in the order and the callback's number.
S_RUN, S_TIME, S_TOPIC, S_MESSAGE, S_VERTEX, _N_STARTED = range(2, 8)
_E_RUN, _E_TIME, _N_ENDED = range(2, 5)
_U_NODE, _U_RUN, _U_TOPIC, _U_MESSAGE, _U_TIME, _N_PUBLISHED = range(2, 8)
_T_RUN, _T_MESSAGE, _N_TOOK = range(2, 5)


class Hop(NamedTuple):
    """How data gets from a callback of a path to the next."""

    kind: HopKind
    topics: frozenset[str]


class _Place:
    """A position in a path, and what is known there from one round to the next."""

    def __init__(self, number: int, position: int, callback: int, node: int, sync: bool) -> None:
        self.number = number
        self.position = position
        self.callback = callback
        self.node = node
        self.sync = sync
        # by vertex of the callback: those of the callback before it that lead to it
        self.before: dict[int, list[int]] = {}
        self.hop: Hop | None = None             # to it
        self.hop_topics: list[int] = []         # of it
        self.topics: list[int] = []             # behind it
        # the last steps that were started, done and published
        self.last = np.full(3, NONE, dtype=np.int64)
        # runs and messages with their steps
        self.runs = np.empty((0, 2), dtype=np.int64)
        self.messages = np.empty((0, 3), dtype=np.int64)    # message, place in the order, step


class PathBook:
    """
    Collects the flows along the declared paths from what happened, in order of time.

    Callbacks, topics and nodes are given by their numbers, executions and messages by any
    numbers that differ; -1 stands for none.

    :param kept: how many executions and messages of a place may still be referred to.
    :param by_job: whether executions come with their job in place of their message; the number of
        a message is then ``message``.
    """

    def __init__(self, task_set: TaskSet, kept: int = KEPT, by_job: bool = False) -> None:
        self._by_job, self._n_vertices = by_job, len(task_set.vertices)
        self.paths: list[Path] = list(task_set.paths)
        self.hops = [hops(task_set, path) for path in self.paths]
        self.callbacks = task_set.places()
        self.nodes = {node: i for i, node in enumerate(
            dict.fromkeys(c.node for c in task_set.callbacks))}
        #: The topics that paths lead over; publications on others are not needed.
        self.topics = {topic: i for i, topic in enumerate(sorted(
            {topic for path in self.hops for hop in path for topic in hop.topics}))}
        self.on_path = {key for path in self.paths for key in path.callbacks}
        # by vertex
        self._topics_of = [[self.topics[topic] for topic in v.callback.topics
                            if topic in self.topics] for v in task_set.vertices]
        self._figures = [PathFigures() for _ in self.paths]
        self._places = [self._place(task_set, number, position)
                        for number, path in enumerate(self.paths)
                        for position in range(len(path.callbacks))]
        self._kept = kept
        self._new_rows: list[list[Ints]] = [[], [], [], []]
        self._order = 1     # 0: in a round before
        self._waiting = 0
        self._forest = Forest([len(path.callbacks) - 1 for path in self.paths])
        self._results: dict[str, Any] | None = None

    def __bool__(self) -> bool:
        """Return whether there is any path."""
        return bool(self.paths)

    def _place(self, task_set: TaskSet, number: int, position: int) -> _Place:
        path_hops, key = self.hops[number], self.paths[number].callbacks[position]
        callback = task_set.callback(key)
        place = _Place(number, position, self.callbacks[key], self.nodes[callback.node],
                       callback.kind == 'sync')
        if position:
            place.hop = path_hops[position - 1]
            place.hop_topics = [self.topics[topic] for topic in place.hop.topics]
            before = self.paths[number].callbacks[position - 1]
            place.before = {
                v: [v - vertex.index + p for p in vertex.predecessors
                    if task_set.vertices[v - vertex.index + p].callback.key == before]
                for v, vertex in enumerate(task_set.vertices) if vertex.callback.key == key}
        if position < len(path_hops):
            place.topics = [self.topics[topic] for topic in path_hops[position].topics]
        return place

    # --- input -----------------------------------------------------------------------------------

    def add(
        self, length: int, started: Ints, ended: Ints, published: Ints,
        took: Ints | None = None,
    ) -> None:
        """
        Collect a stretch of what happened; the first column has the places in its order.

        :param length: how many places there are.
        :param started: executions: callback, run, start, the topic that started it, the message
            (or the job), the vertex.
        :param ended: callback, run, end.
        :param published: the callback (-1: outside of executions), its node, run, topic,
            message, time.
        :param took: messages that running callbacks took themselves: callback, run, message.
        """
        if took is None:
            took = np.empty((0, _N_TOOK), dtype=np.int64)
        for new_rows, rows in zip(self._new_rows, (started, ended, published, took)):
            if len(rows):
                rows = rows.copy()
                rows[:, 0] += self._order
                new_rows.append(rows)
                self._waiting += len(rows)
        self._order += length
        if self._waiting >= SETTLE:
            self._round()
            self._settle(False)

    def message(self, job: Ints, vertex: Ints | int, topic: Ints | int) -> Ints:
        """Return the numbers of the messages that vertices publish in jobs."""
        return (job * self._n_vertices + vertex) * (len(self.topics) + 1) + topic

    def _messages_for(self, place: _Place, started: Ints) -> list[Ints]:
        """Return what may have started executions at a place; what is known later counts."""
        if not self._by_job:
            return [started[:, S_MESSAGE]]
        found: list[Ints] = []
        for vertex in different(started[:, S_VERTEX]):
            mine = started[:, S_VERTEX] == vertex
            topics, job = started[:, S_TOPIC], started[:, S_MESSAGE]
            for before in place.before.get(vertex, ()):
                for topic in self._topics_of[vertex]:
                    fits = mine & ((topics == topic) | (topics == NONE))
                    found.append(np.where(fits, self.message(job, before, topic), NONE))
        return found

    # --- steps -----------------------------------------------------------------------------------

    def _round(self) -> None:
        """Make steps of the input."""
        new_rows = [np.concatenate(each) if each else np.empty((0, width), dtype=np.int64)
                    for each, width in zip(
                        self._new_rows, (_N_STARTED, _N_ENDED, _N_PUBLISHED, _N_TOOK))]
        self._new_rows = [[], [], [], []]
        self._order, self._waiting = 1, 0
        columns = (1, 1, _U_TOPIC, 1)
        sorted_out = [by_column(rows, column) for rows, column in zip(new_rows, columns)]
        before: list[tuple[Ints, Ints]] = []
        for number, place in enumerate(self._places):
            before = self._at(number, place, before, *(
                [rows.get(key, none[:0]) for key in keys] for rows, none, keys in zip(
                    sorted_out, new_rows, ([place.callback], [place.callback], place.topics,
                                           [place.callback]))))

    def _at(
        self, number: int, place: _Place, before: list[tuple[Ints, Ints]],
        started: list[Ints], ended: list[Ints], published: list[Ints], took: list[Ints],
    ) -> list[tuple[Ints, Ints]]:
        """
        Make the steps of a place; return what was done and published there when.

        :param before: the same of the place before it.
        :param started: by the callback; so ``ended`` and ``took``, but ``published`` by topic.
        """
        rows, = started
        if place.hop is not None and place.hop.kind == 'trigger':
            # else another leg of a sync callback
            fits = rows[:, S_TOPIC] == NONE
            for topic in place.hop_topics:
                fits |= rows[:, S_TOPIC] == topic
            rows = rows[fits]
        # a coroutine that goes on is started already
        rows = rows[np.sort(np.unique(rows[:, S_RUN], return_index=True)[1])]
        kept = np.sort(place.runs[:, 0])
        at = np.searchsorted(kept, rows[:, S_RUN])
        if len(kept):
            rows = rows[kept[np.minimum(at, len(kept) - 1)] != rows[:, S_RUN]]
        parent = np.full(len(rows), NONE, dtype=np.int64)
        if place.hop is not None:
            last = self._places[number - 1]
            if place.hop.kind == 'trigger':
                for messages in self._messages_for(place, rows):
                    found = _message(last.messages, messages, rows[:, 0])
                    parent = np.where(found != NONE, found, parent)
            else:
                which = int(place.hop.kind == 'topic')
                parent = _as_of(*before[which], rows[:, 0])
        steps = self._forest.add(
            place.number, place.position, parent, True, rows[:, S_TIME])
        begun = _timeline(place, 0, rows[:, 0], steps)
        place.runs = np.concatenate([place.runs, np.column_stack((rows[:, S_RUN], steps))])
        order = np.argsort(place.runs[:, 0], kind='stable')
        runs = place.runs[order]
        if place.hop is not None and place.hop.kind == 'topic':
            rows, = took
            step = _step_of(runs, rows[:, _T_RUN])
            rows, step = rows[step != NONE], step[step != NONE]
            self._forest.rows[step, PARENT] = _message(
                self._places[number - 1].messages, rows[:, _T_MESSAGE], rows[:, 0])

        rows, = ended
        step = _step_of(runs, rows[:, _E_RUN])
        self._forest.rows[step[step != NONE], END] = rows[step != NONE, _E_TIME]
        counts = (step != NONE) | (not place.sync)
        done = _timeline(place, 1, rows[counts, 0], step[counts])

        if not published:
            return [done]
        rows = published[0] if len(published) == 1 else np.concatenate(published)
        rows = rows[(rows[:, 1] == place.callback)
                    | (rows[:, 1] == NONE) & (rows[:, _U_NODE] == place.node)]
        if len(published) > 1:
            rows = rows[np.argsort(rows[:, 0], kind='stable')]
        parent = np.where(rows[:, 1] == NONE, NONE, _step_of(runs, rows[:, _U_RUN]))
        latest = (parent == NONE) & (place.sync | (rows[:, 1] == NONE))
        parent[latest] = _as_of(*begun, rows[latest, 0])
        steps = self._forest.add(
            place.number, place.position, parent, False, rows[:, _U_TIME])
        sent = _timeline(place, 2, rows[:, 0], steps)
        known = (steps != NONE) & (rows[:, _U_MESSAGE] != NONE)
        place.messages = np.concatenate([place.messages, np.column_stack(
            (rows[known, _U_MESSAGE], rows[known, 0], steps[known]))])
        return [done, sent]

    # --- flows -----------------------------------------------------------------------------------

    def _settle(self, at_end: bool) -> None:
        """Count the flows that are over, and forget their steps."""
        forest, n_paths = self._forest, len(self.paths)
        if not len(forest) and not at_end:
            return
        held = np.zeros(len(forest), dtype=np.bool_)
        if not at_end:
            for place in self._places:
                place.runs = place.runs[-self._kept:]
                place.messages = place.messages[-self._kept:]
                for numbers in (place.last, place.runs[:, 1], place.messages[:, 2]):
                    held[numbers[numbers != NONE]] = True
        now = max(0, forest.latest - LAG_NS)
        flows, numbers = forest.settle(held)
        to_come = [(NEVER, NEVER, NEVER)] * n_paths if at_end else forest.bounds(now)
        for number, figures in enumerate(self._figures):
            figures.add(flows[flows[:, F_PATH] == number], to_come[number])
        for place in self._places:
            place.last = numbers[place.last]
            place.runs[:, 1] = numbers[place.runs[:, 1]]
            place.messages[:, 1] = 0
            place.messages[:, 2] = numbers[place.messages[:, 2]]

    def results(self) -> dict[str, Any]:
        """
        Return by path its figures, all times in ns, once all input is there.

        ``flows`` counts the inputs and ``arrived`` those whose flow reached the last callback.
        ``response_time`` has CARET's cases (see ``path_flows``) from the first publication to the
        start of the last callback, ``whole`` those from the start of the first to the end of the
        last.  ``reaction_time`` is the worst case with external latency, ``data_age`` that of
        every output.  Median and p99 are exact up to 32,768 response times; where there are more,
        ``quantiles_within`` says how exact they are, as a share.
        """
        if self._results is None:
            self._round()
            self._settle(True)
            self._results = {
                path.name: {'callbacks': list(path.callbacks), 'hops': [hop.kind for hop in hops],
                            **figures.result()}
                for path, hops, figures in zip(self.paths, self.hops, self._figures)}
        return self._results


class Paths(Observer):
    """
    Tells a book what happens in a run.

    :param run: which knows who publishes and takes what.
    :ivar book: has the figures of the paths.
    """

    def __init__(self, run: Run) -> None:
        task_set, self._who, self._by_job = run.task_set, run.who, run.declared
        self.book = book = PathBook(task_set, KEPT if self._by_job else KEEP, self._by_job)
        self._n_dags, self._n_vertices = max(1, len(task_set.dags)), len(task_set.vertices) + 1
        # by vertex; the last stands for none
        self._callback = np.array([
            *(book.callbacks[v.callback.key] if v.callback.key in book.on_path else NONE
              for v in task_set.vertices), NONE])
        self._takes_topics = np.array(
            [*(bool(v.callback.topics) for v in task_set.vertices), False])
        self._publishes = [[book.topics[topic] for topic in v.callback.publishes
                            if topic in book.topics] for v in task_set.vertices]

    def take(self, batch: Batch) -> None:
        """Tell it what callbacks on paths did."""
        if self.book:
            self.book.add(len(batch.order) + 1,
                          *(self._of_jobs(batch) if self._by_job else self._of_links(batch)))

    def _of_links(self, batch: Batch) -> tuple[Ints, ...]:
        """Return what the linker of an imported recording found."""
        began, ended, took = (self._on_paths(batch, kind, 1) for kind in (BEGAN, OVER, TOOK))
        callback, vertex, run, start, message = began[:, 2:7].T
        publisher, vertex_of, run_of, sent, time = batch.columns(SENT).T
        return (
            np.column_stack((began[:, :2], run, start, self._topics(vertex, callback), message,
                             vertex)),
            ended[:, [0, 1, 4, 5]],
            self._sent(batch.places(SENT), publisher, vertex_of, run_of, lambda row, _: sent[row],
                       time),
            took[:, [0, 1, 4, 5]])

    def _of_jobs(self, batch: Batch) -> tuple[Ints, ...]:
        """Return what ran in jobs."""
        started, ran = (
            self._on_paths(batch, kind, column) for kind, column in ((STARTED, 1), (RAN, 2)))
        dag, vertex, job, ready, start, callback, _ = started[:, 2:].T
        begun = np.column_stack((
            started[:, :2], self._run(vertex, job, ready), start, self._topics(vertex, callback),
            job * self._n_dags + dag, vertex))
        ended = np.column_stack((
            ran[:, :2], self._run(ran[:, 4], ran[:, 5], ran[:, 7]), ran[:, 9]))
        if not self._who.every_publisher:     # what is published is not recorded
            return begun, ended, self._at_ends(ended, ran)
        publisher, _, dag, vertex, job, ready, time = batch.columns(PUBLISHED).T

        def message(row: Ints, topic: Ints) -> Ints:
            return np.where(dag[row] < 0, NONE, self.book.message(
                job[row] * self._n_dags + dag[row], vertex[row], topic))

        return begun, ended, self._sent(
            batch.places(PUBLISHED), publisher, vertex, self._run(vertex, job, ready), message,
            time)

    def _on_paths(self, batch: Batch, kind: int, column: int) -> Ints:
        """Return the rows of a kind of vertices on paths, behind place and callback's number."""
        rows = batch.columns(kind)
        callback = self._callback[rows[:, column]]
        chosen = np.flatnonzero(callback != NONE)
        return np.column_stack((batch.places(kind)[chosen], callback[chosen], rows[chosen]))

    def _run(self, vertex: Ints, job: Ints, ready: Ints) -> Ints:
        """Return the numbers of executions: nearly ascending, which is quick to sort."""
        return (ready + (job << _JOB)) * self._n_vertices + vertex

    def _topics(self, vertex: Ints, callbacks: Ints) -> Ints:
        """Return the numbers of callbacks' topics: -2 of one that no path leads over."""
        different, which = np.unique(callbacks, return_inverse=True)
        topics = [self._who.topic(callback) for callback in different.tolist()]
        numbers = np.array([self.book.topics.get(topic, -2) if topic else NONE
                            for topic in topics], dtype=np.int64)
        return np.where(self._takes_topics[vertex], numbers[which], NONE)

    def _at_ends(self, ended: Ints, ran: Ints) -> Ints:
        """Return what is published when a callback ends, of which nothing is recorded."""
        parts = [np.empty((0, _N_PUBLISHED), dtype=np.int64)]
        for vertex, mine in by_column(np.column_stack((ended, ran[:, [3, 5, 4]])), 6).items():
            place, callback, run, time, dag, job, _ = mine.T
            parts += [np.column_stack(np.broadcast_arrays(
                place, callback, NONE, run, topic,
                self.book.message(job * self._n_dags + dag, vertex, topic), time))
                for topic in self._publishes[vertex]]
        found = np.concatenate(parts)
        return found[np.argsort(found[:, 0], kind='stable')]

    def _sent(
        self, places: Ints, publisher: Ints, vertex: Ints, run: Ints,
        message: Callable[[Ints, Ints], Ints], time: Ints,
    ) -> Ints:
        """
        Return what is published on topics that paths lead over.

        :param message: returns the numbers of the messages in some rows, of their topics.
        """
        different, which = np.unique(publisher, return_inverse=True)
        known = [self._who.every_publisher.get(number) for number in different.tolist()]
        topic, node = np.array(
            [(NONE, NONE) if each is None else (
                self.book.topics.get(each.topic, NONE),
                self.book.nodes.get(each.node.name if each.node is not None else '', NONE))
             for each in known], dtype=np.int64).reshape(-1, 2)[which].T
        callback = self._callback[vertex]
        row = np.flatnonzero((topic != NONE) & ((callback != NONE) | (vertex < 0)))
        return np.column_stack((
            places[row], callback[row], node[row], run[row], topic[row],
            message(row, topic[row]), time[row]))


def by_column(rows: Ints, column: int) -> dict[int, Ints]:
    """Return rows by what stands in a column, in order."""
    if not len(rows):
        return {}
    rows = rows[np.argsort(rows[:, column].astype(np.int16), kind='stable')]
    begins = np.flatnonzero(np.r_[True, rows[1:, column] != rows[:-1, column]])
    return dict(zip(rows[begins, column].tolist(), np.split(rows, begins[1:])))


def _timeline(place: _Place, which: int, order: Ints, steps: Ints) -> tuple[Ints, Ints]:
    """Return when which step was the last one, with that of the round before."""
    steps = np.concatenate([place.last[which:which + 1], steps])
    place.last[which] = steps[-1]
    return np.concatenate([np.zeros(1, dtype=np.int64), order]), steps


def _as_of(order: Ints, steps: Ints, when: Ints) -> Ints:
    """Return the last step before each place in the order."""
    return steps[np.searchsorted(order, when) - 1]


def _step_of(runs: Ints, wanted: Ints) -> Ints:
    """Return the steps of runs, of which there is a sorted table."""
    if not len(runs):
        return np.full(len(wanted), NONE, dtype=np.int64)
    at = np.minimum(np.searchsorted(runs[:, 0], wanted), len(runs) - 1)
    return np.where(runs[at, 0] == wanted, runs[at, 1], NONE)


def _message(table: Ints, wanted: Ints, when: Ints) -> Ints:
    """Return the last step of each message before a place in the order."""
    known, number = np.unique(table[:, 0], return_inverse=True)
    if not len(known):
        return np.full(len(wanted), NONE, dtype=np.int64)
    place = number << _ORDER | table[:, 1]
    order = np.argsort(place, kind='stable')
    place, steps = place[order], table[order, 2]
    of = np.minimum(np.searchsorted(known, wanted), len(known) - 1)
    at = np.searchsorted(place, of << _ORDER | when) - 1
    return np.where((known[of] == wanted) & (at >= 0) & (place[at] >> _ORDER == of),
                    steps[at], NONE)


def hops(task_set: TaskSet, path: Path) -> list[Hop]:
    """Return how data gets from each callback of a path to the next."""
    return [_hop(task_set.callback(before), task_set.callback(after))
            for before, after in zip(path.callbacks, path.callbacks[1:])]


def _hop(before: Callback, after: Callback) -> Hop:
    topics = frozenset(before.publishes).intersection(after.topics)
    if topics:
        return Hop('trigger', topics)
    if before.node == after.node and before.name in after.reads:
        return Hop('variable', frozenset())
    return Hop('topic', frozenset(before.publishes).intersection(after.reads))
