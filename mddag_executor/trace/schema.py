# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The events of a trace: the table that both writer and reader use.

Names and fields are those of ros2_tracing (provider `ros2`) and CARET (`ros2_caret`), so that
their tools understand them; provider `mddag` is this project's. Each event is a message `int64
timestamp`, `int32 vpid`, `int32 vtid`, then its fields: addresses are uint64, times are int64
nanoseconds.
"""

from __future__ import annotations

from dataclasses import dataclass
import re

from mddag_executor.trace.cdr import FieldType

GOES_ON = -2
"""Instead of a job, in ``dispatch`` of an undeclared execution that is suspended and goes on."""

DISCARDED, MISSING, DAMAGED = 1, 2, 3
"""
Why events of an imported recording are lost: the tracer discarded them; packets are not in
its files; or places in its files are damaged.  The event says how many events, packets or places.
"""

PREAMBLE = (('timestamp', 'int64'), ('vpid', 'int32'), ('vtid', 'int32'))

BEFORE_HUMBLE = ('ros2_hook:dds_write', 'ros2_hook:take_type_erased', 'dds:write_pre')
"""Events of CARET and of an instrumented Cyclone DDS that only recordings before Humble have."""
BEFORE_HUMBLE_PROBLEM = 'it was recorded before ROS 2 Humble, which is not read any more'
BEFORE_HUMBLE_REMEDY = 'record with CARET or ros2_tracing of Humble or later'

_NAME = re.compile(r'[A-Za-z][A-Za-z0-9_]*')


@dataclass(frozen=True)
class EventType:
    """
    One kind of event: its provider, its name, and its fields as pairs of name and ros2msg type.

    :ivar optional: defaults of the last fields, for writers and older files without them.
    :raises ValueError: for a name or type that a flat ROS message cannot have
    """

    provider: str
    name: str
    fields: tuple[tuple[str, str], ...]
    optional: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        names = [name for name, _ in PREAMBLE + self.fields]
        for name in (self.provider, self.name, *names):
            if not _NAME.fullmatch(name):
                raise ValueError(f'{name!r} in event {self.key} is not a ROS name')
        if len(set(names)) != len(names):
            raise ValueError(f'event {self.key} has a field twice')
        for _, kind in self.fields:
            FieldType.parse(kind)

    @property
    def key(self) -> str:
        """Return the full name, as in `ros2:callback_start`."""
        return f'{self.provider}:{self.name}'

    @property
    def topic(self) -> str:
        """Return the topic of the event's channel."""
        return f'/trace/{self.provider}/{self.name}'

    @property
    def types(self) -> tuple[FieldType, ...]:
        """Return the types of the whole message, with the preamble."""
        return tuple(FieldType.parse(kind) for _, kind in PREAMBLE + self.fields)

    @property
    def defaults(self) -> dict[str, int]:
        """Return the defaults of the optional fields."""
        first = len(self.fields) - len(self.optional)
        return {name: value for (name, _), value in zip(self.fields[first:], self.optional)}

    @property
    def text(self) -> str:
        """Return the message definition in ros2msg."""
        return ''.join(f'{kind} {name}\n' for name, kind in PREAMBLE + self.fields)


def camel_case(name: str) -> str:
    """Return an event's name as a message name: `callback_start` becomes `CallbackStart`."""
    return ''.join(part[:1].upper() + part[1:] for part in name.split('_'))


def _event(
    provider: str, name: str, optional: tuple[int, ...] = (), /, **fields: str
) -> EventType:
    return EventType(provider, name, tuple(fields.items()), optional)


_U64, _I64, _I32, _STR, _BOOL = 'uint64', 'int64', 'int32', 'string', 'bool'

_ALL = (
    # ros2_tracing: initialisation
    _event('ros2', 'rcl_node_init',
           node_handle=_U64, rmw_handle=_U64, node_name=_STR, namespace=_STR),
    _event('ros2', 'rcl_publisher_init', publisher_handle=_U64, node_handle=_U64,
           rmw_publisher_handle=_U64, topic_name=_STR, queue_depth=_U64),
    _event('ros2', 'rcl_subscription_init', subscription_handle=_U64, node_handle=_U64,
           rmw_subscription_handle=_U64, topic_name=_STR, queue_depth=_U64),
    _event('ros2', 'rclcpp_subscription_init', subscription_handle=_U64, subscription=_U64),
    _event('ros2', 'rclcpp_subscription_callback_added', subscription=_U64, callback=_U64),
    _event('ros2', 'rcl_service_init', service_handle=_U64, node_handle=_U64,
           rmw_service_handle=_U64, service_name=_STR),
    _event('ros2', 'rclcpp_service_callback_added', service_handle=_U64, callback=_U64),
    _event('ros2', 'rcl_timer_init', timer_handle=_U64, period=_I64),
    _event('ros2', 'rclcpp_timer_callback_added', timer_handle=_U64, callback=_U64),
    _event('ros2', 'rclcpp_timer_link_node', timer_handle=_U64, node_handle=_U64),
    _event('ros2', 'rclcpp_callback_register', callback=_U64, symbol=_STR),
    # ros2_tracing: run time
    _event('ros2', 'callback_start', callback=_U64, is_intra_process=_BOOL),
    _event('ros2', 'callback_end', callback=_U64),
    _event('ros2', 'rclcpp_publish',
           publisher_handle=_U64, message=_U64, message_timestamp=_U64),
    _event('ros2', 'rcl_publish', publisher_handle=_U64, message=_U64),
    # the number that the middleware gave the message among those of its publisher, 0: unknown
    _event('ros2', 'rmw_take', (0,), rmw_subscription_handle=_U64, message=_U64,
           source_timestamp=_I64, taken=_BOOL, sequence_number=_I64),
    # CARET
    _event('ros2_caret', 'caret_init', clock_offset=_I64, distribution=_STR),
    _event('ros2_caret', 'rmw_implementation', rmw_impl=_STR),
    _event('ros2_caret', 'construct_executor', executor_addr=_U64, executor_type_name=_STR),
    _event('ros2_caret', 'add_callback_group',
           executor_addr=_U64, callback_group_addr=_U64, group_type_name=_STR),
    _event('ros2_caret', 'callback_group_add_timer', callback_group_addr=_U64, timer_handle=_U64),
    _event('ros2_caret', 'callback_group_add_subscription',
           callback_group_addr=_U64, subscription_handle=_U64),
    _event('ros2_caret', 'callback_group_add_service',
           callback_group_addr=_U64, service_handle=_U64),
    _event('ros2_caret', 'callback_group_add_client',
           callback_group_addr=_U64, client_handle=_U64),
    _event('ros2_caret', 'dds_write', message=_U64),
    _event('ros2_caret', 'dds_bind_addr_to_stamp', addr=_U64, source_stamp=_I64),
    _event('ros2_caret', 'sim_time', stamp=_I64),
    # this project
    # the CPUs that the process could use, 0: unknown; what is done with late jobs (`ON_LATE`)
    _event('mddag', 'task_set', (0, 0), yaml=_STR, file=_STR, policy=_STR, workers=_I32,
           default_deadline=_I64, max_active_jobs=_I32, preemptive=_BOOL, cpus=_I32,
           on_late=_I32),
    # the boot of the machine that the steady clock counts from, '': unknown; `import ctf` writes
    # one for each process, and what turns the steady clock into its times (0: unknown), which
    # `caret_init` says of this executor
    _event('mddag', 'host', (0,), name=_STR, boot=_STR, clock_offset=_I64),
    _event('mddag', 'hosted', dag=_I32, vertices=_STR),
    # the callback is of a program that runs its callbacks one at a time; the number of the program
    _event('mddag', 'program', callback=_U64, program=_I64),
    # the program, or with -1 the executor, did not spin meanwhile, so no callback of it started
    _event('mddag', 'spin_gap', program=_I64, begin=_I64, end=_I64),
    # the timer, subscription or service of the callback was destroyed, or left the executor
    _event('mddag', 'gone', callback=_U64),
    _event('mddag', 'judge_from', release=_I64),
    _event('mddag', 'job_release', dag=_I32, job=_I64, release=_I64),
    # of an execution that belongs to no job: the deadline that it inherits, 0: none; the due time
    # of its timer, 0: unknown; its CPU time, -1: unknown; and whether its callback holds the GIL
    _event('mddag', 'dispatch', (0, -1, False), callback=_U64, dag=_I32, vertex=_I32, job=_I64,
           worker=_I32, ready=_I64, reference_deadline=_I64, due=_I64, cpu_time=_I64,
           held_interpreter=_BOOL),
    # an execution that has not ended: when it began, where it is and what it waits for, in words;
    # of a suspended coroutine without a thread, since when it waits
    _event('mddag', 'unfinished', callback=_U64, dag=_I32, vertex=_I32, job=_I64, worker=_I32,
           ready=_I64, start=_I64, where=_STR),
    # the CPU time of the execution, -1: unknown, and whether it held the GIL
    _event('mddag', 'complete', (-1, False),
           callback=_U64, dag=_I32, vertex=_I32, job=_I64, last_leg=_BOOL, completed=_I64,
           leg=_I32, cpu_time=_I64, held_interpreter=_BOOL),
    _event('mddag', 'deadline',
           dag=_I32, vertex=_I32, job=_I64, deadline=_I64, completed=_I64),
    _event('mddag', 'drop', callback=_U64, dag=_I32, vertex=_I32, job=_I64, reason=_STR),
    # the next publication of this thread, which has the same time, is on behalf of an execution of
    # another thread, given by its callback, job (-1: none) and ready time
    _event('mddag', 'on_behalf', callback=_U64, job=_I64, ready=_I64),
    # messages of a subscription that the middleware dropped before the one that is taken now
    _event('mddag', 'messages_lost', callback=_U64, count=_I64),
    _event('mddag', 'demote', dag=_I32, vertex=_I32, job=_I64),
    _event('mddag', 'fail', dag=_I32, vertex=_I32, job=_I64),
    _event('mddag', 'expire', dag=_I32, job=_I64),
    _event('mddag', 'abort', dag=_I32, job=_I64),
    _event('mddag', 'outdate', dag=_I32, job=_I64),
    # no thread of the process ran; a stop of length 0: from here on stops are recorded
    _event('mddag', 'stop', begin=_I64, end=_I64),
    # the system clock was set forward by so much, which moves timers and stamps
    _event('mddag', 'clock_step', step=_I64),
    # what was lost up to now, and since when, 0: unknown; why (`DISCARDED`, …; 0: not said)
    _event('mddag', 'lost', (0, 0), count=_I64, begin=_I64, cause=_I32),
    _event('mddag', 'shutdown', end=_I64),
    # imported recordings: the name of the event's thread from here on
    _event('mddag', 'process', procname=_STR),
)

#: Every event of the table by its full name.
EVENTS = {event.key: event for event in _ALL}

PROCESS = 'mddag:process'
HOST = 'mddag:host'
