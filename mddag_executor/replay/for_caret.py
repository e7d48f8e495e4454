# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A trace's events as CARET's analysis takes them: `caret_analyze.Lttng(list(caret_events(path)))`.

Theory of operation
-------------------
1. CARET's analysis stops on events that it does not know: they are left out.
2. An imported recording has all that CARET needs.  A trace of this executor lacks what only its
   tracer sees, below rclpy; that is filled in from what the executor knows:

   * `dds_write` and `dds_bind_addr_to_stamp` of a publication: its source timestamp is the first
     that a message of its topic was taken with from the publication on, before the topic's next
     publication.  They stand right behind `rcl_publish`.
   * `dispatch_subscription_callback`: what an execution in a job ran for is what the vertex before
     it published in that job.  It stands right before `callback_start`, in place of `rmw_take`:
     the executor takes in another thread, which CARET holds for a callback's own taking.

   * From Jazzy on callback groups belong to an executor through its entities collector: the
     executor stands for its own.

   Messages of which neither is known are not filled in: CARET shows them as lost.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import OrderedDict
from collections.abc import Iterator
import os
from typing import Any

from mddag_executor.replay.entities import Entities, OWN_INIT_EVENTS
from mddag_executor.replay.own import OwnRun
from mddag_executor.replay.run import open_run
from mddag_executor.trace import read_events

_ROS2 = (
    'rcl_init', 'rcl_node_init', 'rcl_publisher_init', 'rcl_subscription_init',
    'rclcpp_subscription_init', 'rclcpp_subscription_callback_added', 'rcl_service_init',
    'rclcpp_service_callback_added', 'rcl_client_init', 'rcl_timer_init',
    'rclcpp_timer_callback_added', 'rclcpp_timer_link_node', 'rclcpp_callback_register',
    'rcl_lifecycle_state_machine_init', 'rclcpp_buffer_to_ipb', 'rclcpp_ipb_to_subscription',
    'rclcpp_construct_ring_buffer')
_RUN_TIME = (
    'callback_start', 'callback_end', 'rcl_lifecycle_transition', 'rclcpp_publish',
    'message_construct', 'rclcpp_intra_publish', 'rclcpp_ring_buffer_enqueue',
    'rclcpp_ring_buffer_dequeue', 'dispatch_subscription_callback', 'rmw_take',
    'dispatch_intra_process_subscription_callback', 'rcl_publish')
_CARET = (
    'on_data_available', 'caret_init', 'dds_write', 'dds_bind_addr_to_stamp',
    'dds_bind_addr_to_addr', 'rmw_implementation', 'add_callback_group',
    'add_callback_group_static_executor', 'callback_group_to_executor_entity_collector',
    'executor_entity_collector_to_executor', 'construct_executor', 'construct_static_executor',
    'callback_group_add_timer', 'callback_group_add_subscription', 'callback_group_add_service',
    'callback_group_add_client', 'tilde_subscription_init', 'tilde_publisher_init',
    'tilde_subscribe', 'tilde_publish', 'tilde_subscribe_added', 'sim_time')
#: Full names of the events that CARET's analysis knows.
CARET_EVENTS = frozenset([
    *(f'ros2:{name}' for name in (*_ROS2, *_RUN_TIME)),
    *(f'ros2_caret:{name}' for name in (*_CARET, *_ROS2))])

_DISPATCH, _PUBLISH, _TAKE = 'mddag:dispatch', 'ros2:rcl_publish', 'ros2:rmw_take'
_LAG_NS = 1_000_000_000
_KEEP_JOBS = 4096

Event = dict[str, Any]
Stamps = dict[str, list[tuple[int, int]]]
"""By topic the publications' times and source timestamps (0: none is known)."""


def caret_events(path: str | os.PathLike[str]) -> Iterator[Event]:
    """
    Yield the events of a trace in the order of time as CARET's analysis takes them.

    They are dicts as ``trace.read_events`` has them.

    :raises mddag_executor.trace.TraceError: when it is no trace.
    :raises mddag_executor.replay.ReplayError: when no run is recorded in it.
    """
    run = open_run(path)
    if not isinstance(run, OwnRun):
        yield from read_events(path, CARET_EVENTS)
        return
    filler = _Filler(run, *_read(path))
    for event in read_events(path, (CARET_EVENTS | {_DISPATCH}) - {_TAKE}):
        yield from filler.take(event)


def _read(path: str | os.PathLike[str]) -> tuple[Entities, Stamps]:
    """Return who is who, and the stamps."""
    who = Entities(by_address=True)
    sent: dict[str, list[int]] = {}
    taken: dict[str, set[int]] = {}
    for event in read_events(path, {*OWN_INIT_EVENTS, _PUBLISH, _TAKE}):
        if event['_name'] == _PUBLISH:
            sent.setdefault(_topic(who, event), []).append(event['_timestamp'])
        elif event['_name'] == _TAKE:
            callbacks = who.taken.latest(
                event['_vpid'], event['rmw_subscription_handle'], event['_timestamp'])
            taken.setdefault(callbacks[0].start if callbacks else '', set()).add(
                event['source_timestamp'])
        else:
            who.note(event['_name'], event)
    found: Stamps = {}
    for topic, times in sent.items():
        stamps = sorted(taken.get(topic, ()))
        for time, after in zip(times, [*times[1:], times[-1] + _LAG_NS]):
            place = bisect_left(stamps, time)
            known = place < len(stamps) and stamps[place] < min(after, time + _LAG_NS)
            found.setdefault(topic, []).append((time, stamps[place] if known else 0))
    return who, found


def _topic(who: Entities, event: Event) -> str:
    """Return the topic of a publication, empty where that is not known."""
    publisher = who.publishers.latest(
        event['_vpid'], event['publisher_handle'], event['_timestamp'])
    return '' if publisher is None else publisher.topic


def _head(event: Event) -> Event:
    """Return who an event is of, and when it was."""
    return {key: value for key, value in event.items() if key.startswith('_')}


class _Filler:
    """Adds what CARET's tracer would have seen."""

    def __init__(self, run: OwnRun, who: Entities, stamps: Stamps) -> None:
        self._who, self._stamps = who, stamps
        self._dags = run.recorded_set.dags
        self._running: dict[int, tuple[int, int, int]] = {}     # by thread: DAG, vertex, job
        # by job, of what was published: source timestamp and address, by vertex and topic
        self._jobs: OrderedDict[tuple[int, int], dict[tuple[int, str], tuple[int, int]]] = \
            OrderedDict()

    def take(self, event: Event) -> Iterator[Event]:
        """Yield an event and what belongs to it."""
        name, thread = event['_name'], event['_vtid']
        if name == _DISPATCH:
            self._running[thread] = event['dag'], event['vertex'], event['job']
            return
        if name == 'ros2:callback_start':
            yield from self._dispatched(event)
        elif name == 'ros2_caret:construct_executor':
            yield {**_head(event), '_name': 'ros2_caret:executor_entity_collector_to_executor',
                   'executor_addr': event['executor_addr'],
                   'entities_collector_addr': event['executor_addr']}
        elif name == 'ros2_caret:add_callback_group':
            event = {
                **_head(event), '_name': 'ros2_caret:callback_group_to_executor_entity_collector',
                'entities_collector_addr': event['executor_addr'],
                'callback_group_addr': event['callback_group_addr'],
                'group_type_name': event['group_type_name']}
        yield event
        if name == _PUBLISH:
            yield from self._written(event)
        elif name == 'ros2:callback_end':
            self._running.pop(thread, None)

    def _written(self, event: Event) -> Iterator[Event]:
        topic = _topic(self._who, event)
        publications = self._stamps.get(topic, [])
        place = bisect_left(publications, (event['_timestamp'], 0))
        if place == len(publications) or publications[place][0] != event['_timestamp']:
            return
        stamp, address = publications[place][1], event['message']
        if not stamp:
            return
        running = self._running.get(event['_vtid'])
        if running is not None and running[0] >= 0:
            dag, vertex, job = running
            self._jobs.setdefault((dag, job), {})[(vertex, topic)] = stamp, address
            if len(self._jobs) > _KEEP_JOBS:
                self._jobs.popitem(last=False)
        head = _head(event)
        yield {**head, '_name': 'ros2_caret:dds_write', 'message': address}
        yield {**head, '_name': 'ros2_caret:dds_bind_addr_to_stamp', 'addr': address,
               'source_stamp': stamp}

    def _dispatched(self, event: Event) -> Iterator[Event]:
        running = self._running.get(event['_vtid'])
        callback = self._who.callbacks.latest(
            event['_vpid'], event['callback'], event['_timestamp'])
        if running is None or running[0] < 0 or callback is None:
            return
        dag, vertex, job = running
        if not dag < len(self._dags) or not 0 <= vertex < len(self._dags[dag].vertices):
            return
        messages = self._jobs.get((dag, job), {})
        for before in self._dags[dag].vertices[vertex].predecessors:
            if (before, callback.start) in messages:
                stamp, address = messages[(before, callback.start)]
                yield {
                    **_head(event),
                    '_name': 'ros2:dispatch_subscription_callback', 'message': address,
                    'callback': event['callback'], 'source_stamp': stamp, 'message_timestamp': 0}
                return
