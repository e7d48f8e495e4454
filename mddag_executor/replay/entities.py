# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Who is who in a recording of CARET or ros2_tracing: nodes, publishers, callbacks, groups.

Theory of operation
-------------------
The events of the initialisation say which address is what.

1. Addresses belong to a process, and one may be used again after what it named is gone.  As CARET
   does it: an event at run time means what was registered last under the address before it (or,
   where nothing was, the first after it); an event of the initialisation that refers to another
   one means what was registered under the address nearest in time, and of the same kind.
2. CARET repeats what was initialised before the recording began, as `ros2_caret:<event>` with the
   original time on the monotonic clock (`init_timestamp`); `caret_init` has the offset to the
   recording's clock.  They stand for the `ros2:` events, wherever they are in the file; what is
   there twice counts once.
3. A subscription's callback is the one that was added to the rclcpp subscription of its handle;
   for communication within a process rclcpp adds a second one.  Both are the same callback here.
4. A callback is described by its node and what starts it: timer and period, subscription and
   topic, service and its name.  Several in one node that look the same are distinguished by the
   order in which they were made.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable
from itertools import count
from typing import Any, Generic, NamedTuple, TypeVar

from mddag_executor.trace import EVENTS
from msg_graph import format_duration

_T = TypeVar('_T')
_INIT = (
    'rcl_node_init', 'rcl_publisher_init', 'rcl_subscription_init', 'rclcpp_subscription_init',
    'rclcpp_subscription_callback_added', 'rcl_service_init', 'rclcpp_service_callback_added',
    'rcl_timer_init', 'rclcpp_timer_callback_added', 'rclcpp_timer_link_node',
    'rclcpp_callback_register')
_GROUPS = (
    'add_callback_group', 'add_callback_group_static_executor',
    'callback_group_to_executor_entity_collector', 'callback_group_add_timer',
    'callback_group_add_subscription', 'callback_group_add_service')
_CARET_INIT = 'ros2_caret:caret_init'
#: Full names of the events that say who is who.
INIT_EVENTS = frozenset([
    *(f'{provider}:{name}' for name in _INIT for provider in ('ros2', 'ros2_caret')),
    *(f'ros2_caret:{name}' for name in _GROUPS), _CARET_INIT, 'ros2_caret:rmw_implementation'])

Fields = dict[str, Any]


class Node(NamedTuple):
    """A node of a process."""

    pid: int
    name: str
    time: int


class Publisher(NamedTuple):
    """A publisher; `node` is None where its node is not in the recording."""

    number: int
    node: Node | None
    topic: str


class Callback:
    """
    A callback of a recording.

    :ivar number: its number among all, from 1.
    :ivar kind: ``timer``, ``subscription``, ``service`` or ``unknown``.
    :ivar start: topic or name of the service; empty for the others.
    :ivar period: of its timer, ns; 0 for the others.
    :ivar made: when its timer, subscription or service was made, ns.
    :ivar grid: from when on its timer's periods count, ns; None where that is not recorded.
    :ivar group: number of its mutually exclusive group; -1 for another one, None: not known.
    """

    __slots__ = ('number', 'node', 'kind', 'start', 'period', 'made', 'grid', 'group', 'symbol',
                 'label')

    def __init__(self, number: int, node: Node | None, kind: str, start: str = '',
                 period: int = 0, made: int = 0, grid: int | None = None) -> None:
        self.number = number
        self.node = node
        self.kind = kind
        self.start = start
        self.period = period
        self.made = made
        self.grid = grid
        self.group: int | None = None
        self.symbol = ''
        self.label = ''

    @property
    def description(self) -> str:
        """Return its node and what starts it."""
        node = self.node.name if self.node is not None else 'a node that is not recorded'
        if self.kind == 'timer':
            return f'{node} timer {format_duration(self.period)}'
        return f'{node} {self.kind} {self.start}'.rstrip()


class Addresses(Generic[_T]):
    """What is under the addresses of all processes, over time (rule 1)."""

    def __init__(self) -> None:
        self._times: dict[tuple[int, int], list[int]] = {}
        self._things: dict[tuple[int, int], list[_T]] = {}

    def add(self, pid: int, address: int, time: int, thing: _T) -> None:
        """Register a thing; times may come in any order."""
        times = self._times.setdefault((pid, address), [])
        place = bisect_right(times, time)
        times.insert(place, time)
        self._things.setdefault((pid, address), []).insert(place, thing)

    def latest(self, pid: int, address: int, time: int) -> _T | None:
        """Return what an event at run time means."""
        things = self._things.get((pid, address))
        if things is None:
            return None
        if len(things) == 1:
            return things[0]
        return things[max(0, bisect_right(self._times[(pid, address)], time) - 1)]

    def nearest(self, pid: int, address: int, time: int) -> _T | None:
        """Return what an event of the initialisation refers to."""
        things = self._things.get((pid, address))
        if things is None:
            return None
        times = self._times[(pid, address)]
        place = min(range(len(times)), key=lambda i: (abs(times[i] - time), i))
        return things[place]


class _Entity(NamedTuple):
    """A timer, subscription or service, by its handle."""

    kind: str
    node: Node | None
    start: str
    period: int
    time: int
    number: int     # no two are the same


class Entities:
    """
    Who is who.

    :param events: those of the initialisation, as pairs of full name and fields, with
        ``_timestamp`` and ``_vpid`` among the fields.
    """

    def __init__(self, events: Iterable[tuple[str, Fields]]) -> None:
        self.nodes: Addresses[Node] = Addresses()
        self.publishers: Addresses[Publisher] = Addresses()
        self.callbacks: Addresses[Callback] = Addresses()
        #: By the handle that `rmw_take` names: the subscription's callbacks.
        self.taken: Addresses[list[Callback]] = Addresses()
        self.every: list[Callback] = []
        #: When the first of the events was recorded, ns.
        self.begin = 0
        #: Events that lack what they should say, and are left out.
        self.incomplete = 0
        self._entities: dict[str, Addresses[_Entity]] = {
            kind: Addresses() for kind in ('timer', 'subscription', 'service')}
        self._holders: Addresses[_Entity] = Addresses()
        self._rmw: dict[_Entity, tuple[int, int]] = {}
        self._made: dict[tuple[str, int, _Entity], Callback] = {}
        self._groups: Addresses[tuple[int, bool]] = Addresses()
        self._numbers = count(1)
        self._read(events)
        self._label()

    # --- reading ---------------------------------------------------------------------------------

    def _read(self, events: Iterable[tuple[str, Fields]]) -> None:
        by_kind: dict[str, list[Fields]] = {}
        seen: set[tuple[Any, ...]] = set()
        waiting: list[tuple[str, Fields]] = []
        offsets: dict[int, int] = {}
        for name, fields in events:
            self.begin = min(self.begin or fields['_timestamp'], fields['_timestamp'])
            if name == _CARET_INIT:
                if fields.get('clock_offset'):
                    offsets.setdefault(
                        fields['_vpid'], fields['_timestamp'] - fields['clock_offset'])
                continue
            waiting.append((name.partition(':')[2], fields))
        waiting.sort(key=lambda item: 'init_timestamp' in item[1])
        for name, fields in waiting:
            if not _complete(name, fields):
                self.incomplete += 1
                continue
            pid = fields['_vpid']
            if fields.get('init_timestamp') and offsets:
                offset = offsets.get(pid, next(iter(offsets.values())))
                fields = {**fields, '_timestamp': fields['init_timestamp'] + offset}
            same = (name, *sorted((k, v) for k, v in fields.items()
                                  if k not in ('_timestamp', 'init_timestamp', '_vtid')))
            repeated = 'init_timestamp' in fields
            if same in seen and repeated:
                continue
            seen.add(same)
            by_kind.setdefault(name, []).append(fields)
        self._build(by_kind)

    def _build(self, by_kind: dict[str, list[Fields]]) -> None:
        """Register things in the order in which they refer to one another."""
        def each(name: str) -> list[Fields]:
            return sorted(by_kind.get(name, ()), key=lambda fields: fields['_timestamp'])

        for f in each('rcl_node_init'):
            name = f'{f["namespace"].rstrip("/")}/{f["node_name"]}'
            self.nodes.add(f['_vpid'], f['node_handle'], f['_timestamp'],
                           Node(f['_vpid'], name, f['_timestamp']))
        for f in each('rcl_publisher_init'):
            publisher = Publisher(next(self._numbers), self._node(f), f['topic_name'])
            self.publishers.add(f['_vpid'], f['publisher_handle'], f['_timestamp'], publisher)
        for f in each('rcl_subscription_init'):
            entity = self._entity('subscription', f, f['subscription_handle'], f['topic_name'])
            self._rmw[entity] = f['_vpid'], f['rmw_subscription_handle']
        for f in each('rcl_service_init'):
            self._entity('service', f, f['service_handle'], f['service_name'])
        self._timers(each('rcl_timer_init'), each('rclcpp_timer_link_node'))
        for f in each('rclcpp_subscription_init'):
            found = self._entities['subscription'].nearest(
                f['_vpid'], f['subscription_handle'], f['_timestamp'])
            if found is not None:
                self._holders.add(f['_vpid'], f['subscription'], f['_timestamp'], found)
        for f in each('rclcpp_subscription_callback_added'):
            self._callback('subscription', f, f['subscription'])
        for kind in ('timer', 'service'):
            for f in each(f'rclcpp_{kind}_callback_added'):
                self._callback(kind, f, f[f'{kind}_handle'])
        for f in each('rclcpp_callback_register'):
            callback = self.callbacks.nearest(f['_vpid'], f['callback'], f['_timestamp'])
            if callback is not None and not callback.symbol:
                callback.symbol = f['symbol']
        self._add_groups(each)

    def _node(self, f: Fields) -> Node | None:
        return self.nodes.nearest(f['_vpid'], f['node_handle'], f['_timestamp'])

    def _entity(self, kind: str, f: Fields, handle: int, start: str) -> _Entity:
        entity = _Entity(
            kind, self._node(f), start, 0, f['_timestamp'], next(self._numbers))
        self._entities[kind].add(f['_vpid'], handle, f['_timestamp'], entity)
        return entity

    def _timers(self, timers: list[Fields], links: list[Fields]) -> None:
        nodes: Addresses[Node | None] = Addresses()
        for f in links:
            nodes.add(f['_vpid'], f['timer_handle'], f['_timestamp'], self._node(f))
        for f in timers:
            node = nodes.nearest(f['_vpid'], f['timer_handle'], f['_timestamp'])
            entity = _Entity(
                'timer', node, '', f['period'], f['_timestamp'], next(self._numbers))
            self._entities['timer'].add(
                f['_vpid'], f['timer_handle'], f['_timestamp'], entity)

    def _callback(self, kind: str, f: Fields, holder: int) -> None:
        pid, time = f['_vpid'], f['_timestamp']
        entity = (self._holders if kind == 'subscription' else self._entities[kind]).nearest(
            pid, holder, time)
        if entity is None:
            callback = Callback(len(self.every) + 1, None, kind, made=time)
            self.every.append(callback)
        else:
            made = self._made.get((kind, pid, entity))
            if made is None:
                made = Callback(
                    len(self.every) + 1, entity.node, kind, entity.start, entity.period,
                    entity.time, entity.time if kind == 'timer' else None)
                self._made[(kind, pid, entity)] = made
                self.every.append(made)
                if entity in self._rmw:
                    self.taken.add(*self._rmw[entity], entity.time, [made])
            callback = made
        self.callbacks.add(pid, f['callback'], time, callback)

    # --- groups ----------------------------------------------------------------------------------

    def _add_groups(self, each: Any) -> None:
        number = 0
        for name in _GROUPS[:3]:
            for f in each(name):
                number += 1
                known = self._groups.nearest(f['_vpid'], f['callback_group_addr'], f['_timestamp'])
                if known is None:
                    exclusive = f.get('group_type_name') == 'mutually_exclusive'
                    self._groups.add(f['_vpid'], f['callback_group_addr'], f['_timestamp'],
                                     (number, exclusive))
        for kind in ('timer', 'subscription', 'service'):
            for f in each(f'callback_group_add_{kind}'):
                pid, time = f['_vpid'], f['_timestamp']
                entity = self._entities[kind].nearest(pid, f[f'{kind}_handle'], time)
                group = self._groups.nearest(pid, f['callback_group_addr'], time)
                callback = None if entity is None else self._made.get((kind, pid, entity))
                if callback is not None and group is not None:
                    callback.group = group[0] if group[1] else -1

    # --- looking up ------------------------------------------------------------------------------

    def _label(self) -> None:
        """Give callbacks labels that are different."""
        used: dict[str, int] = {}
        for callback in sorted(self.every, key=lambda c: (c.made, c.number)):
            description = callback.description
            number = used[description] = used.get(description, 0) + 1
            callback.label = description if number == 1 else f'{description} #{number}'

    def callback(self, pid: int, address: int, time: int) -> Callback:
        """Return the callback that an event at run time means, if need be a new, unknown one."""
        found = self.callbacks.latest(pid, address, time)
        if found is None:
            found = Callback(len(self.every) + 1, None, 'unknown', made=time)
            found.label = f'callback {found.number} of process {pid}, whose start is not recorded'
            self.every.append(found)
            self.callbacks.add(pid, address, time, found)
        return found


_OPTIONAL = {'queue_depth', 'rmw_handle', 'rmw_publisher_handle', 'rmw_service_handle',
             'executor_addr'}
_NEEDED = {
    'callback_group_to_executor_entity_collector': {
        'callback_group_addr': 'uint64', 'group_type_name': 'string'},
    'add_callback_group_static_executor': {
        'callback_group_addr': 'uint64', 'group_type_name': 'string'}}


def _complete(name: str, fields: Fields) -> bool:
    """Return whether an event has all fields that are needed of it, with values of their kind."""
    needed = _NEEDED.get(name)
    if needed is None:
        event = EVENTS.get(f'ros2:{name}') or EVENTS.get(f'ros2_caret:{name}')
        needed = dict(event.fields) if event is not None else {}
    return all(
        isinstance(fields.get(field), str if kind == 'string' else int)
        for field, kind in needed.items() if field not in _OPTIONAL
    ) and isinstance(fields.get('init_timestamp', 0), int)


def fields_of(event: tuple[Any, ...]) -> Fields:
    """Return an event of ``TraceReader.layout_events`` as a dict, as ``read_events`` has it."""
    return {'_timestamp': event[1], '_vpid': event[2], '_vtid': event[3],
            **dict(zip(event[0].fields, event[4:]))}


def as_table(event: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return an event of ``layout_events`` with the table's fields; None is one that it lacks."""
    values = dict(zip(event[0].fields, event[4:]))
    wanted = EVENTS[event[0].name].fields if event[0].name in EVENTS else ()
    return (event[0].name, *event[1:4], *(values.get(field) for field, _ in wanted))
