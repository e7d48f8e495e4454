# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The executor's trace apart from its hot path: nodes and entities."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import nullcontext, suppress
from itertools import count
import socket
import threading
from typing import Any
import weakref

from mddag_executor import defaults
from mddag_executor.clocks import boot, TraceClock
from mddag_executor.core.tables import ON_LATE
from mddag_executor.executor.attribution import PublisherState
from mddag_executor.executor.compat import distribution
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.publishing import state_of
from mddag_executor.trace.errors import TraceError
from msg_graph import TaskSet
from rclpy.exceptions import InvalidHandle
from rclpy.logging import get_logger
from rclpy.utilities import get_rmw_implementation_identifier

_numbers = count(1)


def _log(error: TraceError) -> None:
    get_logger('mddag_executor').error(f'the trace is incomplete: {error}')


class Recorder:
    """
    The trace of one executor.

    Addresses are those of Python objects: the node, the rclpy entity, and for callbacks the
    ``Entity``.

    :param writer: writes the file, as a ``TraceWriter``; None: one that does not block.
    :param overwrite: whether an existing file may be replaced.
    :param cpus: their number, 0: unknown; None: the machine's.
    :ivar number: its own, from 1 up.
    :raises mddag_executor.trace.TraceError: when the file cannot be written.
    """

    def __init__(
        self, path: str, task_set: TaskSet | None, policy: str, workers: int,
        default_deadline: int, max_active_jobs: int, clock: TraceClock, writer: Any = None,
        cpus: int | None = None, overwrite: bool = False, on_late: str = 'continue',
    ) -> None:
        self._is_live = writer is None
        if writer is None:
            from mddag_executor.trace.writer import TraceWriter  # late: it loads the compression
            writer = TraceWriter(path, clock_offset=clock.offset_ns, overwrite=overwrite)
            writer.on_error = _log
        self.writer = writer
        self.record = self.writer.record
        self.path = path
        self._clock = clock
        # the objects themselves: an address may be used again
        self._known: weakref.WeakSet[Any] = weakref.WeakSet()
        self._nodes: weakref.WeakValueDictionary[int, Any] = weakref.WeakValueDictionary()
        self.number = next(_numbers)
        self._say(
            'task_set', task_set.text if task_set else '', task_set.file if task_set else '',
            policy, workers, default_deadline, max_active_jobs, False,
            defaults.processors() if cpus is None else cpus, ON_LATE[on_late])
        self._say('caret_init', clock.offset_ns, distribution())
        self._say('host', socket.gethostname(), boot())
        self._say('rmw_implementation', get_rmw_implementation_identifier())
        self._say('construct_executor', id(self), 'multi_deadline_executor')

    def _say(self, event: str, *fields: Any) -> None:
        self.record(event, self._clock.now(), threading.get_native_id(), *fields)

    def entities(self, nodes: Iterable[Any], added: Iterable[Entity]) -> None:
        """Record new nodes, publishers and entities, with the tracepoints CARET expects."""
        by_name: dict[str, int] = {}
        for node in nodes:
            try:
                by_name[node.get_fully_qualified_name()] = id(node)
                self._node(node)
            except InvalidHandle:
                continue  # it was destroyed meanwhile
        for entity in added:
            if entity.is_own:
                continue
            try:
                self._entity(entity, by_name.get(entity.node, 0))
            except InvalidHandle:
                continue

    def programs(self, entities: Iterable[Entity]) -> None:
        """Record entities of programs that run their callbacks one at a time."""
        for entity in entities:
            if entity.address:
                self._say('program', entity.address, entity.outer)

    def gone(self, entities: Iterable[Entity]) -> None:
        """Record that entities have disappeared."""
        for entity in entities:
            if entity.address and not entity.is_own:
                self._say('gone', entity.address)

    def _node(self, node: Any) -> None:
        address = id(node)
        if node not in self._known:
            self._known.add(node)
            self._nodes[address] = node
            self._say('rcl_node_init', address, address, node.get_name(), node.get_namespace())
        for publisher in list(node.publishers):
            self._publisher(publisher, state_of(publisher), address)

    def publisher(self, publisher: Any, state: PublisherState) -> None:
        """
        Record a publisher that is used before its node was found to have it.

        A callback may make it, use it and destroy it; or its node belongs to no executor.
        """
        nodes = (ref() for ref in self._nodes.valuerefs())
        node = next((each for each in nodes
                     if each is not None and publisher in list(each.publishers)), None)
        if node is not None:
            self._publisher(publisher, state, id(node))
        else:  # once more when its node is recorded
            self._say_publisher(publisher, state, 0)

    def _publisher(self, publisher: Any, state: PublisherState, node: int) -> None:
        if publisher not in self._known:
            self._known.add(publisher)
            self._say_publisher(publisher, state, node)

    def _say_publisher(self, publisher: Any, state: PublisherState, node: int) -> None:
        state.recorded_by = self.number
        self._say('rcl_publisher_init', state.address, node, state.address,
                  publisher.topic_name, publisher.qos_profile.depth)

    def _entity(self, entity: Entity, node: int) -> None:
        entity.record(self._say, node)
        if not entity.is_known_to_caret:
            return
        group = getattr(entity.rclpy_object, 'callback_group', None)
        if group is not None and group not in self._known:
            self._known.add(group)
            exclusive = entity.group >= 0 and entity.gate is None
            kind = 'mutually_exclusive' if exclusive else 'reentrant'
            self._say('add_callback_group', id(self), id(group), kind)
        if group is not None:
            self._say(f'callback_group_add_{entity.kind}', id(group), id(entity.rclpy_object))

    def close(self, now: int, end: int | None = None) -> None:
        """
        Record the run's end and complete the file.

        If the file of a live run could not be written, the run has continued without it.

        :param end: until when deadlines are judged, if that is before now; on the trace's clock.
        """
        self.record(
            'shutdown', now, threading.get_native_id(), now if end is None else end)
        # a live run has logged the error when it happened, and goes on
        with suppress(TraceError) if self._is_live else nullcontext():
            self.writer.close()
