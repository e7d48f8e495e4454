# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Drafts of systems from traces: nodes, callbacks, what each publishes, rates, execution times.

Theory of operation
-------------------
1. ``Census`` lists what there is. What every node has anyway (parameter services and their like)
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
from collections.abc import Callable, Iterable
import os

from mddag_executor.core import quantile
from mddag_executor.errors import InputError
from mddag_executor.trace import TraceReader
from mddag_executor.trace.census import Address, Census, Entity, Event, KEEP_TIMES
from msg_graph import Callback, ExecutionTime, GraphError, loads, TaskSet
from msg_graph.binding import function_of
from msg_graph.draft import Draft, DraftCallback, DraftNode
from msg_graph.names import CALLBACK, is_background, NODE, SERVICE, TOPIC

PERCENT = (0.0, 50.0, 90.0, 99.0, 100.0)
_STEP = 4096
_TASK_SET, _DISPATCH, _COMPLETE = 'mddag:task_set', 'mddag:dispatch', 'mddag:complete'


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
        self.census = Census()
        self.task_set: TaskSet | None = None
        self.workers: int | None = None
        self._declared: dict[Address, Callback] = {}
        self._whole: dict[str, array[int]] = {}     # by sync callback: how long these took
        reader = TraceReader(path)
        wanted = {*self.census.handlers, _TASK_SET, _DISPATCH, _COMPLETE}
        for count, event in enumerate(reader.events(wanted, sorted=True)):
            if event[0] == _DISPATCH:
                self._dispatch(event)
            elif event[0] == _COMPLETE:
                self._complete(event)
            elif event[0] == _TASK_SET:
                self._recorded(event)
            else:
                self.census.take(event)
            if progress is not None and count % _STEP == 0:
                progress(count)
        self.warnings = list(reader.warnings)
        self._entities = [entity for entity in self.census.entities() if _is_shown(entity)]
        if not self._entities:
            raise InputError(
                self.name, 'no timer, subscription or service of a node is recorded in it',
                'record the start of the nodes, too')

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
        took = self.census.took.get((event[2], event[3]))
        if declared is None or declared.kind != 'sync' or not event[8] or took is None:
            return
        times = self._whole.setdefault(declared.key, array('q'))
        if took[0] == (event[2], event[4]) and len(times) < KEEP_TIMES:
            times.append(took[1])

    def draft(self) -> Draft:
        """Return the whole system."""
        nodes: dict[str, DraftNode] = {}
        for entity in self._entities:
            node = nodes.setdefault(entity.node, DraftNode(entity.node))
            callback = self._callback(entity, node)
            node.callbacks.setdefault(callback.name, callback)
        for name, topics in self.census.publishers.items():
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

    def _callback(self, entity: Entity, node: DraftNode) -> DraftCallback:
        declared = None if entity.callback is None else self._declared.get(entity.callback)
        if declared is not None and declared.node == entity.node:
            known = node.callbacks.get(declared.name)
            callback = known or _from_declared(declared)
        else:
            callback = DraftCallback(
                entity.node, self._free_name(entity, node), entity.kind,
                [entity.start] if entity.start else [], entity.period_ns)
            if entity.group is not None:
                callback.group = self._group_name(entity)
        self._measure(callback, [entity])
        return callback

    def _free_name(self, entity: Entity, node: DraftNode) -> str:
        """Return a name for a callback that nobody has named."""
        declared = () if self.task_set is None else self.task_set.callbacks
        taken = {*node.callbacks, *(c.name for c in declared if c.node == entity.node)}
        name = function_of(entity.symbol)
        if name is None or CALLBACK.check(name) is not None:
            names = [f'callback_{number}' for number in range(len(taken), 2 * len(taken) + 1)]
        else:
            names = [name, *(f'{name}_{number}' for number in range(2, len(taken) + 2))]
        return next(each for each in names if each not in taken)

    def _group_name(self, entity: Entity) -> str | None:
        """Return a name for a group that several callbacks of the node share."""
        groups = [e.group for e in self._entities if e.node == entity.node]
        if groups.count(entity.group) < 2:
            return None
        known = [group for group in dict.fromkeys(groups) if group is not None]
        return f'callback_group_{known.index(entity.group)}' if entity.group in known else None

    def _measure(self, callback: DraftCallback, entities: Iterable[Entity]) -> bool:
        """Fill in what was measured of a callback; return whether anything was."""
        found = [self.census.runs[e.callback] for e in entities
                 if e.callback is not None and e.callback in self.census.runs]
        if not found:
            return False
        runs = found[0]
        for each in found:
            callback.publishes.extend(
                t for t in each.publishes if t not in callback.publishes
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
        waiting: dict[tuple[str, str, str], list[Entity]] = {}
        for entity in self._entities:
            start = str(entity.period_ns) if entity.kind == 'timer' else entity.start
            waiting.setdefault((entity.node, entity.kind, start), []).append(entity)
        count = 0
        for callback in draft.callbacks():
            start = callback.starts[0] if callback.starts else str(callback.period_ns)
            fits = waiting.get((callback.node, callback.kind, start))
            if fits:
                count += self._measure(callback, [fits.pop(0)])
        return count


def execution_time(took: Iterable[int]) -> tuple[ExecutionTime, int] | None:
    """Return the execution time of a callback and of how many executions it is; None of none."""
    times = sorted(max(1, time) for time in took)
    if not times:
        return None
    quantiles = tuple(quantile(times, share / 100) for share in PERCENT)
    return ExecutionTime(quantiles, PERCENT), len(times)


def _is_shown(entity: Entity) -> bool:
    if NODE.check(entity.node) is not None:
        return False
    if entity.kind == 'timer':
        return entity.period_ns is not None and entity.period_ns >= 1_000
    name = TOPIC if entity.kind == 'subscription' else SERVICE
    return not is_background(entity.start, entity.node) and name.check(entity.start) is None


def _from_declared(declared: Callback) -> DraftCallback:
    starts = [declared.service] if declared.service else list(declared.topics)
    also = {key: str(value).lower() for key, value, usual in (
        ('on_miss', declared.on_miss, 'continue'),
        ('max_active_jobs', declared.max_active_jobs, None),
        ('holds_interpreter', declared.holds_interpreter, None)) if value != usual}
    return DraftCallback(
        declared.node, declared.name, declared.kind, starts, declared.period_ns, [], [],
        list(declared.reads), declared.group, declared.dag, declared.deadline_ns,
        declared.release_from, also=also)
