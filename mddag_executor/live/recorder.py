# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the executor writes into a trace besides its hot path: who is who, and what was taken."""

from __future__ import annotations

from collections.abc import Iterable
import threading
import time
from typing import Any
import weakref

from mddag_executor.live.entries import Entry, SERVICE, SUBSCRIPTION, TIMER
from mddag_executor.trace.errors import TraceError
from msg_graph import TaskSet
from rclpy.exceptions import InvalidHandle
from rclpy.logging import get_logger
from rclpy.utilities import get_rmw_implementation_identifier


class Recorder:
    """
    The trace of one executor.

    Addresses are those of Python objects: the node, the entity, and, for callbacks, the entry.

    :raises mddag_executor.trace.TraceError: when the file cannot be written.
    """

    def __init__(
        self, path: str, task_set: TaskSet | None, policy: str, workers: int,
        default_deadline: int, max_active_jobs: int, clock_offset: int,
    ) -> None:
        from mddag_executor.trace.writer import TraceWriter  # late: it loads the compression
        self.writer = TraceWriter(path, clock_offset=clock_offset)
        self.record = self.writer.record
        self.path = path
        self._clock_offset = clock_offset
        # by themselves: another one may have the address of one that is gone
        self._known: weakref.WeakSet[Any] = weakref.WeakSet()
        self._say(
            'task_set', task_set.text if task_set else '', task_set.file if task_set else '',
            policy, workers, default_deadline, max_active_jobs, False)
        self._say('caret_init', clock_offset, 'jazzy')
        self._say('rmw_implementation', get_rmw_implementation_identifier())
        self._say('construct_executor', id(self), 'multi_deadline_executor')

    def _say(self, event: str, *fields: Any) -> None:
        now = time.monotonic_ns() + self._clock_offset
        self.record(event, now, threading.get_native_id(), *fields)

    def entities(self, nodes: Iterable[Any], added: list[Entry]) -> None:
        """Record new nodes, publishers and entities, with the tracepoints CARET expects."""
        by_name: dict[str, int] = {}
        for node in nodes:
            try:
                by_name[node.get_fully_qualified_name()] = id(node)
                self._node(node)
            except InvalidHandle:
                continue  # destroyed meanwhile
        for entry in added:
            try:
                self._entity(entry, by_name.get(entry.node, 0))
            except InvalidHandle:
                continue

    def _node(self, node: Any) -> None:
        address = id(node)
        if node not in self._known:
            self._known.add(node)
            self._say('rcl_node_init', address, address, node.get_name(), node.get_namespace())
        for publisher in list(node.publishers):
            if publisher not in self._known:
                self._known.add(publisher)
                self._say(
                    'rcl_publisher_init', id(publisher), address, id(publisher),
                    publisher.topic_name, publisher.qos_profile.depth)

    def _entity(self, entry: Entry, node: int) -> None:
        entity = id(entry.entity)
        if entry.kind == TIMER:
            self._say('rcl_timer_init', entity, entry.entity.timer_period_ns)
            self._say('rclcpp_timer_callback_added', entity, entry.address)
            self._say('rclcpp_timer_link_node', entity, node)
        elif entry.kind == SUBSCRIPTION:
            self._say('rcl_subscription_init', entity, node, entity, entry.label, entry.depth)
            self._say('rclcpp_subscription_init', entity, entity)
            self._say('rclcpp_subscription_callback_added', entity, entry.address)
        elif entry.kind == SERVICE:
            self._say('rcl_service_init', entity, node, entity, entry.label)
            self._say('rclcpp_service_callback_added', entity, entry.address)
        else:
            self._say('rclcpp_callback_register', entry.address, entry.name)
            return
        self._say('rclcpp_callback_register', entry.address, entry.symbol)
        group = getattr(entry.entity, 'callback_group', None)
        if group is not None and group not in self._known:
            self._known.add(group)
            exclusive = entry.group >= 0 and entry.gate is None
            kind = 'mutually_exclusive' if exclusive else 'reentrant'
            self._say('add_callback_group', id(self), id(group), kind)
        if group is not None:
            self._say(f'callback_group_add_{entry.kind}', id(group), entity)

    def taken(self, entry: Entry, message: Any, source_timestamp: int) -> None:
        """Record that a message was taken."""
        self._say('rmw_take', id(entry.entity), id(message), source_timestamp, True)

    def close(self, end: int) -> None:
        """
        Record the run's end (trace's clock) and complete the file.

        Where it could not be written, the run has gone on without it; this says so in the log.
        """
        self.record('shutdown', end, threading.get_native_id(), end)
        try:
            self.writer.close()
        except TraceError as error:
            get_logger('mddag_executor').error(f'the trace is incomplete: {error}')
