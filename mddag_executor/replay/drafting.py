# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Drafts of systems from traces: nodes, callbacks, what each publishes, rates, execution times.

Theory of operation
-------------------
1. ``Entities`` knows what there is. What every node has anyway (parameter services and their like)
   is left out, and with it nodes that have nothing else.
2. A callback that the recorded declaration names keeps its name, and what was declared of it that
   a trace does not show: deadline, queue edges, period, sync, group, name of the DAG.  Others have
   the name of their function where the trace has it, else ``callback_0``, ``callback_1``, … by
   node, in the order in which they were made.
3. A topic of a node is published by the callbacks that were seen to publish it. Where none was,
   each callback of the node may; where the node has no callback, there is supposed to be a timer.
4. Execution times are the quantiles of ``PERCENT``. Those of a sync callback are of the executions
   that made it whole: the others only keep a message.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
import os

from mddag_executor.core import quantile
from mddag_executor.errors import InputError
from mddag_executor.replay.entities import (
    Address,
    as_table,
    Callback,
    Entities,
    Event,
    INIT_EVENTS,
    KINDS,
)
from mddag_executor.trace import TraceReader
from msg_graph import Callback as Declared
from msg_graph import ExecutionTime, GraphError, loads, TaskSet
from msg_graph.binding import function_of, is_background
from msg_graph.draft import Draft, DraftCallback, DraftNode
from msg_graph.language import CALLBACK, NODE, SERVICE, TOPIC

PERCENT = (0.0, 50.0, 90.0, 99.0, 100.0)
_STEP = 4096
_KEEP_TIMES = 100_000
_START, _END = 'ros2:callback_start', 'ros2:callback_end'
_PUBLISH = ('ros2:rclcpp_publish', 'ros2:rcl_publish')
_TASK_SET, _DISPATCH, _COMPLETE = 'mddag:task_set', 'mddag:dispatch', 'mddag:complete'


@dataclass
class Runs:
    """What a callback did; of the times that runs took, the first ``_KEEP_TIMES`` are kept, ns."""

    count: int = 0
    first: int = 0
    last: int = 0
    times: array[int] = field(default_factory=lambda: array('q'))
    publishers: dict[Address, None] = field(default_factory=dict)

    @property
    def interval_ns(self) -> int | None:
        """Return the mean time between two of its starts; None with fewer than two."""
        return (self.last - self.first) // (self.count - 1) if self.count > 1 else None


class System:
    """
    What a trace shows of the system that was recorded.

    :param path: a trace of this executor, or an imported recording of CARET or ros2_tracing.
    :ivar warnings: what is missing of the trace, one line each.
    """

    def __init__(
        self, path: str | os.PathLike[str], name: str | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> None:
        self.name = name or os.fspath(path)
        self.task_set: TaskSet | None = None
        self.workers: int | None = None
        self._declared: dict[Address | None, Declared] = {}
        self._whole: dict[str, array[int]] = {}     # by sync callback: how long these took
        self._runs: dict[Address | None, Runs] = {}
        # by process and thread what runs, and since when; what ended last, and how long it took
        self._running: dict[tuple[int, int], list[tuple[Address, int]]] = {}
        self._took: dict[tuple[int, int], tuple[Address, int]] = {}
        reader = TraceReader(path)
        who = Entities()
        who.read(self._others(reader, progress))
        self.warnings = list(reader.warnings)
        self._entities = [entity for entity in sorted(
            who.made, key=lambda e: (e.made, KINDS.index(e.kind))) if _is_shown(entity)]
        if not self._entities:
            raise InputError(
                self.name, 'no timer, subscription or service of a node is recorded in it',
                'record the start of the nodes, too')
        #: By node the topics that it publishes, and whether a callback was seen to do so.
        self._publishers: dict[str, dict[str, bool]] = {
            name: {} for name in who.names_of_nodes}
        for publisher in who.every_publisher.values():
            if publisher.node is not None:
                self._publishers[publisher.node.name][publisher.topic] = False
        #: By callback's address the topics that it was seen to publish.
        self._publishes: dict[Address | None, list[str]] = {}
        for callback, runs in self._runs.items():
            for address in runs.publishers:
                found = who.publishers.latest(*address, runs.last)
                if found is not None and found.node is not None:
                    self._publishes.setdefault(callback, []).append(found.topic)
                    self._publishers[found.node.name][found.topic] = True

    def _others(
        self, reader: TraceReader, progress: Callable[[int], None] | None
    ) -> Iterator[Event]:
        """Yield the events that say who is who; note what the others say."""
        handlers = {
            _DISPATCH: self._dispatch, _COMPLETE: self._complete, _TASK_SET: self._recorded,
            _START: self._start, _END: self._end, **dict.fromkeys(_PUBLISH, self._publish)}
        for count, event in enumerate(reader.layout_events({*INIT_EVENTS, *handlers})):
            handler = handlers.get(event[0].name)
            if handler is None:
                yield event
            else:
                handler(as_table(event))
            if progress is not None and count % _STEP == 0:
                progress(count)

    def _start(self, event: Event) -> None:
        callback = event[2], event[4]
        if event[4] is None:
            return
        self._running.setdefault(event[2:4], []).append((callback, event[1]))
        runs = self._runs.setdefault(callback, Runs(first=event[1]))
        runs.count += 1
        runs.last = event[1]

    def _end(self, event: Event) -> None:
        stack = self._running.get(event[2:4], [])
        while stack and event[4] is not None:
            callback, start = stack.pop()
            if callback == (event[2], event[4]):
                self._took[event[2:4]] = callback, event[1] - start
                times = self._runs[callback].times
                if len(times) < _KEEP_TIMES:
                    times.append(event[1] - start)
                return

    def _publish(self, event: Event) -> None:
        """Note what publishes: runs nest in a thread, as a callback may spin."""
        stack = self._running.get(event[2:4])
        if stack and event[4] is not None:
            self._runs[stack[-1][0]].publishers[event[2], event[4]] = None

    def _recorded(self, event: Event) -> None:
        if None in event or self.task_set is not None or not event[4].strip():
            return
        try:
            self.task_set = loads(event[4], event[5] or self.name)
        except GraphError:
            return  # what it declares is of no use, but who is who still is
        self.workers = event[7]

    def _dispatch(self, event: Event) -> None:
        if self.task_set is None or None in event:
            return
        dag, vertex = event[5], event[6]
        if (0 <= dag < len(self.task_set.dags)
                and 0 <= vertex < len(self.task_set.dags[dag].vertices)):
            callback = self.task_set.dags[dag].vertices[vertex].callback
            self._declared[event[2], event[4]] = callback

    def _complete(self, event: Event) -> None:
        declared = self._declared.get((event[2], event[4]))
        took = self._took.get(event[2:4])
        if declared is None or declared.kind != 'sync' or not event[8] or took is None:
            return
        times = self._whole.setdefault(declared.key, array('q'))
        if took[0] == (event[2], event[4]) and len(times) < _KEEP_TIMES:
            times.append(took[1])

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
        return Draft(f'the trace {self.name}', self._ordered(nodes), workers=self.workers)

    def _ordered(self, nodes: dict[str, DraftNode]) -> list[DraftNode]:
        """Return the nodes in the order of the recorded declaration, which counts for ties."""
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
        declared = self._declared.get(entity.address)
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
        """Return a name for a callback that nobody has named."""
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
        """Fill in what was measured of a callback; return whether anything was."""
        runs = self._runs.get(entity.address)
        if runs is None:
            return False
        callback.publishes.extend(
            t for t in self._publishes.get(entity.address, ()) if t not in callback.publishes
            and not is_background(t, callback.node) and TOPIC.check(t) is None)
        callback.maybe = [t for t in callback.maybe if t not in callback.publishes]
        if callback.kind == 'sync':
            callback.times = execution_time(self._whole.get(callback.key, ()))
        else:
            callback.interval_ns = runs.interval_ns
            callback.times = execution_time(runs.times)
        return True

    def measure(self, draft: Draft) -> int:
        """
        Fill what was measured into a draft of the same system; return of how many callbacks.

        Callbacks are the same if node and what starts them are; of several that are started
        alike the first is the one that was made first.
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
    """Return the execution time of a callback and of how many executions it is; None of none."""
    times = sorted(max(1, time) for time in took)
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
        ('on_miss', declared.on_miss, 'continue'),
        ('max_active_jobs', declared.max_active_jobs, None),
        ('holds_interpreter', declared.holds_interpreter, None)) if value != usual}
    return DraftCallback(
        declared.node, declared.name, declared.kind, starts, declared.period_ns, [], [],
        list(declared.reads), declared.group, declared.dag, declared.deadline_ns,
        declared.release_from, also=also)
