# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Drafts systems from traces: nodes, callbacks, published topics, rates, execution times.

Theory of operation
-------------------
1. A first pass reads the initialisation into ``Entities``.  Entities of every node (parameter
   services and the like) are ignored, and nodes without others, too.
2. A second pass reads executions and publications.  Both addresses that rclcpp gives the callback
   of a subscription are one callback.  A coroutine is one execution, however often it was resumed:
   its pieces have the same ``ready`` time in their ``mddag:dispatch`` events.
3. A callback in the recorded declaration keeps its name and the declared properties that a trace
   does not show: deadline, queue edges, period, sync, group, name of the DAG.  Other callbacks are
   named by their recorded function, otherwise ``callback_0``, ``callback_1``, … by node, in the
   order of creation.
4. A topic of a node is published by the callbacks that were seen to publish it. If none was, every
   callback of the node may publish it; for a node without callbacks a timer is assumed.
5. A service without calls, and a subscription without messages whose topic no callback publishes,
   have no rate, so they cannot be the source of a DAG.  They are left out and reported.
6. Execution times are the quantiles of ``PERCENT``. For a sync callback they are of the executions
   that completed it: the others only store a message.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
import os
from typing import Any

from mddag_executor.core import quantile
from mddag_executor.errors import InputError
from mddag_executor.recording.entities import (
    Callback,
    Entities,
    Event,
    INIT_EVENTS,
    KINDS,
    Publisher,
)
from mddag_executor.trace import TraceReader
from msg_graph import Callback as Declared
from msg_graph import ExecutionTime, GraphError, loads, TaskSet
from msg_graph.binding import function_of, is_background
from msg_graph.draft import Draft, DraftCallback, DraftNode, leave_out_sources
from msg_graph.language import CALLBACK, NODE, SERVICE, TOPIC

PERCENT = (0.0, 50.0, 90.0, 99.0, 100.0)
_STEP = 4096
_KEEP_TIMES = 100_000
_KEEP_PIECES = 1_024

Fields = dict[str, Any]
Thread = tuple[int, int]
"""Process and thread."""
Piece = tuple[int, ...]
"""Identity of an execution with pieces: DAG, vertex, job and ready time."""


@dataclass
class Runs:
    """
    The executions of a callback.

    :ivar count: their number; ``first``, ``last``: starts of the first and the last, ns.
    :ivar times: duration of each of the first ``_KEEP_TIMES``, all pieces together, ns; -1 if the
        end is not recorded.
    :ivar publishers: numbers of the publishers that they used.
    """

    count: int = 0
    first: int = 0
    last: int = 0
    times: array[int] = field(default_factory=lambda: array('q'))
    publishers: dict[int, Publisher] = field(default_factory=dict)
    _recent: dict[Piece, int] = field(default_factory=dict)

    @property
    def interval_ns(self) -> int | None:
        """Return the mean time between two executions; None with fewer than two."""
        return (self.last - self.first) // (self.count - 1) if self.count > 1 else None

    def begin(self, now: int, piece: Piece | None) -> int:
        """Note the begin or resumption of an execution; return its number."""
        if piece is not None and piece in self._recent:
            return self._recent[piece]
        number = self.count
        self.first = self.first if number else now
        self.last = now
        self.count += 1
        if number < _KEEP_TIMES:
            self.times.append(-1)
        if piece is not None:
            self._recent[piece] = number
            if len(self._recent) > _KEEP_PIECES:
                del self._recent[next(iter(self._recent))]
        return number

    def end(self, number: int, took: int) -> None:
        """Note the duration of an execution, or of a piece of it."""
        if number < len(self.times):
            self.times[number] = max(0, self.times[number]) + took


class System:
    """
    The recorded system, as far as a trace shows it.

    :param path: a trace of this executor, or an imported recording of CARET or ros2_tracing.
    :ivar warnings: missing data of the trace, one line each.
    """

    def __init__(
        self, path: str | os.PathLike[str], name: str | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> None:
        self.name = name or os.fspath(path)
        self.task_set: TaskSet | None = None
        self.workers: int | None = None
        # by callback's number
        self._declared: dict[int, Declared] = {}
        self._runs: dict[int, Runs] = {}
        # by sync callback: durations of completing executions
        self._whole: dict[str, array[int]] = {}
        # by thread: next piece; running execution and its start; last ended execution
        self._next: dict[Thread, tuple[int, Piece]] = {}
        self._running: dict[Thread, list[tuple[int, int, int]]] = {}
        self._ended: dict[Thread, tuple[int, int]] = {}
        reader = TraceReader(path)
        self._who = Entities()
        self._who.read(reader.layout_events(INIT_EVENTS))
        self._entities = [entity for entity in sorted(
            self._who.made, key=lambda e: (e.made, KINDS.index(e.kind))) if _is_shown(entity)]
        if not self._entities:
            raise InputError(
                self.name, 'no timer, subscription or service of a node is recorded in it',
                'record the start of the nodes, too')
        self._read(reader, progress)
        self.warnings = list(reader.warnings)
        #: By node its published topics, and whether a callback was seen to publish them.
        self._publishers: dict[str, dict[str, bool]] = {
            name: {} for name in self._who.names_of_nodes}
        for publisher in self._who.every_publisher.values():
            if publisher.node is not None:
                self._publishers[publisher.node.name][publisher.topic] = False
        for runs in self._runs.values():
            for publisher in runs.publishers.values():
                if publisher.node is not None:
                    self._publishers[publisher.node.name][publisher.topic] = True

    def _read(self, reader: TraceReader, progress: Callable[[int], None] | None) -> None:
        """Note executions and publications."""
        handlers = {
            'mddag:task_set': self._recorded,
            'mddag:dispatch': self._dispatch,
            'mddag:complete': self._complete,
            'ros2:callback_start': self._start,
            'ros2:callback_end': self._end,
            'ros2:rclcpp_publish': self._publish,
            'ros2:rclcpp_intra_publish': self._publish,
            'ros2:rcl_publish': self._publish}
        for count, event in enumerate(reader.layout_events(frozenset(handlers))):
            fields = dict(zip(event[0].fields, event[4:]))
            handlers[event[0].name](event, fields)
            if progress is not None and count % _STEP == 0:
                progress(count)

    def _number(self, event: Event, fields: Fields) -> int:
        return self._who.callback(event[2], fields['callback'], event[1]).number

    def _start(self, event: Event, fields: Fields) -> None:
        if not isinstance(fields.get('callback'), int):
            return
        thread, now, callback = event[2:4], event[1], self._number(event, fields)
        expected, piece = self._next.pop(thread, (0, ()))
        number = self._runs.setdefault(callback, Runs()).begin(
            now, piece if expected == callback else None)
        self._running.setdefault(thread, []).append((callback, number, now))

    def _end(self, event: Event, fields: Fields) -> None:
        if not isinstance(fields.get('callback'), int):
            return
        thread, callback = event[2:4], self._number(event, fields)
        stack = self._running.get(thread, [])
        if all(each[0] != callback for each in stack):
            return      # it began before the recording
        while True:     # ends of nested executions were lost
            running, number, since = stack.pop()
            if running == callback:
                break
        self._runs[callback].end(number, event[1] - since)
        self._ended[thread] = callback, number

    def _publish(self, event: Event, fields: Fields) -> None:
        """Note a publisher; executions nest in a thread, because a callback may spin."""
        stack, handle = self._running.get(event[2:4]), fields.get('publisher_handle')
        if not stack or not handle:
            return
        publisher = self._who.publishers.latest(event[2], handle, event[1])
        if publisher is not None:
            self._runs[stack[-1][0]].publishers[publisher.number] = publisher

    def _recorded(self, event: Event, fields: Fields) -> None:
        text = fields.get('yaml')
        if self.task_set is not None or not text or not text.strip():
            return
        try:
            self.task_set = loads(text, fields.get('file') or self.name)
        except GraphError:
            return  # the declaration is unusable, the entities are not
        self.workers = fields.get('workers')

    def _dispatch(self, event: Event, fields: Fields) -> None:
        piece = tuple(value for name in ('dag', 'vertex', 'job', 'ready')
                      if isinstance(value := fields.get(name), int))
        if len(piece) < 4 or fields.get('callback') is None:
            return
        callback = self._number(event, fields)
        self._next[event[2:4]] = callback, piece
        dag, vertex = piece[:2]
        if (self.task_set is not None and 0 <= dag < len(self.task_set.dags)
                and 0 <= vertex < len(self.task_set.dags[dag].vertices)):
            self._declared[callback] = self.task_set.dags[dag].vertices[vertex].callback

    def _complete(self, event: Event, fields: Fields) -> None:
        if fields.get('callback') is None or not fields.get('last_leg'):
            return
        callback = self._number(event, fields)
        declared = self._declared.get(callback)
        ended, number = self._ended.get(event[2:4], (0, 0))
        if declared is None or declared.kind != 'sync' or ended != callback:
            return
        times = self._runs[callback].times
        if number < len(times):
            self._whole.setdefault(declared.key, array('q')).append(times[number])

    def draft(self) -> Draft:
        """Return the whole system."""
        nodes: dict[str, DraftNode] = {}
        for entity in self._entities:
            node = nodes.setdefault(entity.node_name, DraftNode(entity.node_name))
            callback = self._callback(entity, node)
            node.callbacks.setdefault(callback.name, callback)
        for name, topics in self._publishers.items():
            unseen = [t for t, seen in topics.items()
                      if not seen and not is_background(t, name) and TOPIC.check(t) is None]
            if unseen and name not in nodes and NODE.check(name) is None:
                timer = DraftCallback(name, 'callback_0', 'timer', guessed=True)
                nodes[name] = DraftNode(name, {timer.name: timer})
            if unseen:
                for callback in nodes[name].callbacks.values() if name in nodes else ():
                    callback.maybe.extend(t for t in unseen if t not in callback.publishes)
        draft = Draft(f'the trace {self.name}', self._ordered(nodes), workers=self.workers)
        declared = {callback.key for callback in self._declared.values()}
        leave_out_sources(draft, lambda callback: (
            'it never ran' if callback.runs == 0 and callback.kind != 'timer'
            and callback.key not in declared else ''))
        return draft

    def _ordered(self, nodes: dict[str, DraftNode]) -> list[DraftNode]:
        """Return the nodes in the order of the recorded declaration, which decides ties."""
        if self.task_set is None:
            return list(nodes.values())
        place = self.task_set.places()
        every = [callback for node in nodes.values() for callback in node.callbacks.values()]
        found: list[DraftNode] = []
        for callback in sorted(every, key=lambda c: place.get(c.key, len(place))):
            if not found or found[-1].name != callback.node:
                found.append(DraftNode(callback.node))  # a node may have several entries
            found[-1].callbacks[callback.name] = callback
        return found

    def _callback(self, entity: Callback, node: DraftNode) -> DraftCallback:
        declared = self._declared.get(entity.number)
        if declared is not None and declared.node == entity.node_name:
            known = node.callbacks.get(declared.name)
            callback = known or _from_declared(declared)
        else:
            callback = DraftCallback(
                entity.node_name, self._free_name(entity, node), entity.kind,
                [entity.start] if entity.start else [], entity.period or None)
            callback.group = self._group_name(entity)
        self._measure(callback, entity)
        return callback

    def _free_name(self, entity: Callback, node: DraftNode) -> str:
        """Return a free name for a callback without name."""
        declared = () if self.task_set is None else self.task_set.callbacks
        taken = {*node.callbacks, *(c.name for c in declared if c.node == entity.node_name)}
        name = function_of(entity.symbol)
        if name is None or CALLBACK.check(name) is not None:
            names = [f'callback_{number}' for number in range(len(taken), 2 * len(taken) + 1)]
        else:
            names = [name, *(f'{name}_{number}' for number in range(2, len(taken) + 2))]
        return next(each for each in names if each not in taken)

    def _group_name(self, entity: Callback) -> str | None:
        """Return a name for a group that several callbacks of the node share."""
        groups = [e.group for e in self._entities
                  if e.node_name == entity.node_name and e.group not in (None, -1)]
        if entity.group is None or groups.count(entity.group) < 2:
            return None
        return f'callback_group_{list(dict.fromkeys(groups)).index(entity.group)}'

    def _measure(self, callback: DraftCallback, entity: Callback) -> bool:
        """Fill in the measured values of a callback; return whether there are any."""
        runs = self._runs.get(entity.number) or Runs()
        callback.runs = (callback.runs or 0) + runs.count
        if not runs.count:
            return False
        callback.publishes.extend(
            t for t in dict.fromkeys(each.topic for each in runs.publishers.values())
            if t not in callback.publishes and not is_background(t, callback.node)
            and TOPIC.check(t) is None)
        callback.maybe = [t for t in callback.maybe if t not in callback.publishes]
        if callback.kind == 'sync':
            callback.times = execution_time(self._whole.get(callback.key, ()))
        else:
            callback.interval_ns = runs.interval_ns
            callback.times = execution_time(runs.times)
        return True

    def measure(self, draft: Draft) -> int:
        """
        Fill measured values into a draft of the same system; return the number of callbacks.

        Callbacks are matched by node and trigger; of several with the same trigger by the order of
        creation.
        """
        waiting: dict[tuple[str, str, str], list[Callback]] = {}
        for entity in self._entities:
            start = str(entity.period) if entity.kind == 'timer' else entity.start
            waiting.setdefault((entity.node_name, entity.kind, start), []).append(entity)
        count = 0
        for callback in draft.callbacks():
            start = callback.starts[0] if callback.starts else str(callback.period_ns)
            fits = waiting.get((callback.node, callback.kind, start))
            if fits:
                count += self._measure(callback, fits.pop(0))
        return count


def execution_time(took: Iterable[int]) -> tuple[ExecutionTime, int] | None:
    """Return the execution time of a callback and the number of executions; None without any."""
    times = sorted(max(1, time) for time in took if time >= 0)
    if not times:
        return None
    quantiles = tuple(quantile(times, share / 100) for share in PERCENT)
    return ExecutionTime(quantiles, PERCENT), len(times)


def _is_shown(entity: Callback) -> bool:
    if NODE.check(entity.node_name) is not None:
        return False
    if entity.kind == 'timer':
        return entity.period >= 1_000
    name = TOPIC if entity.kind == 'subscription' else SERVICE
    return not is_background(entity.start, entity.node_name) and name.check(entity.start) is None


def _from_declared(declared: Declared) -> DraftCallback:
    starts = [declared.service] if declared.service else list(declared.topics)
    also = {key: str(value).lower() for key, value, usual in (
        ('on_late', declared.on_late, None),
        ('keep', declared.keep, 'all'),
        ('importance', declared.importance, 'normal'),
        ('tolerate', declared.tolerate, None),
        ('max_active_jobs', declared.max_active_jobs, None),
        ('holds_interpreter', declared.holds_interpreter, None)) if value != usual}
    return DraftCallback(
        declared.node, declared.name, declared.kind, starts, declared.period_ns, [], [],
        list(declared.reads), declared.group, declared.dag, declared.deadline_ns,
        declared.release_from, also=also)
