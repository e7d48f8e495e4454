# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Identifies nodes, publishers, callbacks and callback groups of a recording by their addresses.

Theory of operation
-------------------
1. Addresses belong to a process and may be reused.  An event at run time means the last object
   registered under the address before it or, if there is none, the first one after it.  An event
   of the initialisation means the object of the right kind that was registered under the address
   at the nearest time.  CARET uses the same rules.
2. CARET repeats initialisation events from before the recording as `ros2_caret:<event>`, with the
   original time on the monotonic clock (`init_timestamp`); `caret_init` has the offset to the
   recording's clock.  They are treated as `ros2:` events, wherever they are in the file;
   duplicates count once.
3. The callback of a subscription is the one added to the rclcpp subscription of its handle.  For
   communication within a process rclcpp adds a second one; both are one callback here.
4. A callback is described by its node and its trigger: timer and period, subscription and topic,
   service and name.  Callbacks of a node with the same description are numbered in the order of
   creation.  A timer that was made again (``recording.timers``) has the label of the first one.
5. In an imported recording initialisation events may be anywhere, so they are all read first
   (``read``), and callbacks are numbered.  This executor records them before it refers to them, so
   they are processed one by one (``take``), and a callback's number is its address.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Generic, TypeVar

from mddag_executor.recording.names import Address, Callback, KINDS, Names, Node, Publisher
from mddag_executor.trace import EVENTS

_T = TypeVar('_T')
# In the order in which they refer to one another.
_INIT = (
    'rcl_node_init', 'rcl_publisher_init', 'rcl_subscription_init', 'rcl_service_init',
    'rcl_timer_init', 'rclcpp_timer_link_node', 'rclcpp_subscription_init',
    'rclcpp_subscription_callback_added', 'rclcpp_timer_callback_added',
    'rclcpp_service_callback_added', 'rclcpp_callback_register')
_GROUPS = (
    'add_callback_group', 'add_callback_group_static_executor',
    'callback_group_to_executor_entity_collector',
    *(f'callback_group_add_{kind}' for kind in KINDS))
_PROGRAM, _GONE = 'program', 'gone'
_CARET_INIT = 'ros2_caret:caret_init'
#: Full names of the initialisation events that this executor records, and of all of them.
OWN_INIT_EVENTS = frozenset([
    *(f'ros2:{name}' for name in _INIT), *(f'ros2_caret:{name}' for name in _GROUPS),
    f'mddag:{_PROGRAM}', f'mddag:{_GONE}'])
INIT_EVENTS = OWN_INIT_EVENTS | {
    *(f'ros2_caret:{name}' for name in _INIT), _CARET_INIT, 'ros2_caret:rmw_implementation'}

Event = tuple[Any, ...]
Fields = dict[str, Any]


class Addresses(Generic[_T]):
    """Objects by process, address and time (rule 1)."""

    def __init__(self) -> None:
        self._times: dict[Address, list[int]] = {}
        self._things: dict[Address, list[_T]] = {}

    def add(self, pid: int, address: int, time: int, thing: _T) -> None:
        """Register an object; times may come in any order."""
        times = self._times.setdefault((pid, address), [])
        place = bisect_right(times, time)
        times.insert(place, time)
        self._things.setdefault((pid, address), []).insert(place, thing)

    def times(self, pid: int, address: int) -> Sequence[int]:
        """Return when objects were registered under an address, ascending."""
        return self._times.get((pid, address), ())

    def latest(self, pid: int, address: int, time: int) -> _T | None:
        """Return the object that an event at run time means."""
        things = self._things.get((pid, address))
        if things is None:
            return None
        if len(things) == 1:
            return things[0]
        return things[max(0, bisect_right(self._times[(pid, address)], time) - 1)]

    def nearest(self, pid: int, address: int, time: int) -> _T | None:
        """Return the object that an event of the initialisation refers to."""
        things = self._things.get((pid, address))
        if things is None:
            return None
        times = self._times[(pid, address)]
        place = min(range(len(times)), key=lambda i: (abs(times[i] - time), i))
        return things[place]


class Entities:
    """
    The nodes, publishers, callbacks and groups of a recording.

    :param by_address: whether callbacks and publishers are numbered by their addresses.
    :ivar names: what was read, by numbers.
    """

    def __init__(self, by_address: bool = False) -> None:
        self._by_address = by_address
        self.nodes: Addresses[Node] = Addresses()
        self.publishers: Addresses[Publisher] = Addresses()
        self.callbacks: Addresses[Callback] = Addresses()
        #: By the handle in `rmw_take`: the subscription's callbacks.
        self.taken: Addresses[list[Callback]] = Addresses()
        self.names = Names()
        #: Time of the first of these events, ns.
        self.begin = 0
        #: Number of ignored events that lack a field.
        self.incomplete = 0
        self._entities: dict[str, Addresses[Callback]] = {kind: Addresses() for kind in KINDS}
        self._holders: Addresses[Callback] = Addresses()
        self._groups: Addresses[tuple[int, bool]] = Addresses()
        self._n_groups = 0
        self._programs: dict[tuple[int, int], int] = {}

    # --- reading ---------------------------------------------------------------------------------

    def take(self, event: Event) -> None:
        """Note an event of ``TraceReader.events``."""
        self.note(event[0], _as_dict([field for field, _ in EVENTS[event[0]].fields], event))

    def note(self, name: str, fields: Fields) -> None:
        """Note an event of ``read_events``."""
        name = name.partition(':')[2]
        if _complete(name, fields):
            self._one(name, fields)

    def read(self, events: Iterable[Event]) -> None:
        """Note all events of a recording, from ``TraceReader.layout_events``."""
        by_kind: dict[str, list[Fields]] = {}
        seen: set[tuple[Any, ...]] = set()
        waiting: list[tuple[str, Fields]] = []
        offsets: dict[int, int] = {}
        for event in events:
            fields = _as_dict(event[0].fields, event)
            self.begin = min(self.begin or fields['_timestamp'], fields['_timestamp'])
            if event[0].name != _CARET_INIT:
                waiting.append((event[0].name.partition(':')[2], fields))
            elif fields.get('clock_offset'):
                offsets.setdefault(fields['_vpid'], fields['_timestamp'] - fields['clock_offset'])
        waiting.sort(key=lambda item: 'init_timestamp' in item[1])
        for name, fields in waiting:
            if not _complete(name, fields):
                self.incomplete += 1
                continue
            if fields.get('init_timestamp') and offsets:
                offset = offsets.get(fields['_vpid'], next(iter(offsets.values())))
                fields = {**fields, '_timestamp': fields['init_timestamp'] + offset}
            same = (name, *sorted((k, v) for k, v in fields.items()
                                  if k not in ('_timestamp', 'init_timestamp', '_vtid')))
            if same not in seen or 'init_timestamp' not in fields:
                by_kind.setdefault(name, []).append(fields)
            seen.add(same)
        for name in (*_INIT, *_GROUPS, _PROGRAM, _GONE):
            for fields in sorted(by_kind.get(name, ()), key=lambda f: f['_timestamp']):
                self._one(name, fields)
        self.label({})

    def _one(self, name: str, f: Fields) -> None:
        """Note a complete event."""
        pid, time = f['_vpid'], f['_timestamp']
        if name == 'rcl_node_init':
            node = Node(pid, full_name(f['namespace'], f['node_name']), time)
            self.nodes.add(pid, f['node_handle'], time, node)
            self.names.nodes[node.name] = None
        elif name == 'rcl_publisher_init':
            handle = f['publisher_handle']
            number = signed(handle) if self._by_address else len(self.names.publishers) + 1
            publisher = Publisher(number, self._node(f), f['topic_name'])
            self.names.publishers[number] = publisher
            self.publishers.add(pid, handle, time, publisher)
        elif name == 'rcl_subscription_init':
            self._made('subscription', f, f['topic_name']).rmw = pid, f['rmw_subscription_handle']
        elif name == 'rcl_service_init':
            self._made('service', f, f['service_name'])
        elif name == 'rcl_timer_init':
            self._made('timer', f)
        elif name == 'rclcpp_timer_link_node':
            timer = self._entities['timer'].nearest(pid, f['timer_handle'], time)
            if timer is not None:
                timer.node = self._node(f)
        elif name == 'rclcpp_subscription_init':
            found = self._entities['subscription'].nearest(pid, f['subscription_handle'], time)
            if found is not None:
                self._holders.add(pid, f['subscription'], time, found)
        elif name == 'rclcpp_subscription_callback_added':
            self._callback('subscription', f, self._holders, f['subscription'])
        elif name == 'rclcpp_callback_register':
            callback = self.callbacks.nearest(pid, f['callback'], time)
            if callback is None:
                self.names.symbols[signed(f['callback'])] = f['symbol']
            elif not callback.symbol:
                callback.symbol = f['symbol']
        elif name.endswith('_callback_added'):
            kind = name.split('_')[1]
            self._callback(kind, f, self._entities[kind], f[f'{kind}_handle'])
        elif name.startswith('callback_group_add_'):
            self._add_to_group(f, name.rpartition('_')[2])
        elif name == _PROGRAM:
            callback = self.callbacks.nearest(pid, f['callback'], time)
            if callback is not None and callback.number:
                key = pid, f['program']
                self.names.programs[callback.number] = self._programs.setdefault(
                    key, len(self._programs))
        elif name == _GONE:
            callback = self.callbacks.latest(pid, f['callback'], time)
            if callback is not None:
                callback.gone = time
        elif name in _GROUPS and self._groups.nearest(
                pid, f['callback_group_addr'], time) is None:
            self._n_groups += 1
            self._groups.add(pid, f['callback_group_addr'], time, (
                self._n_groups, f['group_type_name'] == 'mutually_exclusive'))

    def _node(self, f: Fields) -> Node | None:
        return self.nodes.nearest(f['_vpid'], f['node_handle'], f['_timestamp'])

    def _made(self, kind: str, f: Fields, start: str = '') -> Callback:
        time, is_timer = f['_timestamp'], kind == 'timer'
        entity = Callback(
            None if is_timer else self._node(f), kind, start, f['period'] if is_timer else 0,
            time, time if is_timer else None)
        self._entities[kind].add(f['_vpid'], f[f'{kind}_handle'], time, entity)
        self.names.made.append(entity)
        return entity

    def _callback(self, kind: str, f: Fields, of: Addresses[Callback], holder: int) -> None:
        pid, time, address = f['_vpid'], f['_timestamp'], f['callback']
        callback = of.nearest(pid, holder, time) or Callback(None, kind, made=time)
        callback.address = pid, address
        self.callbacks.add(pid, address, time, callback)
        if not callback.number:
            self._number(callback, address)
            if callback.rmw is not None:
                self.taken.add(*callback.rmw, callback.made, [callback])

    def _number(self, callback: Callback, address: int) -> None:
        self.names.callbacks.append(callback)
        callback.number = signed(address) if self._by_address else len(self.names.callbacks)
        self.names.by_number[callback.number] = callback

    def _add_to_group(self, f: Fields, kind: str) -> None:
        pid, time = f['_vpid'], f['_timestamp']
        callback = self._entities[kind].nearest(pid, f[f'{kind}_handle'], time)
        group = self._groups.nearest(pid, f['callback_group_addr'], time)
        if callback is not None and callback.number and group is not None:
            callback.group = group[0] if group[1] else -1
            self.names.groups[callback.number] = callback.group

    def label(self, first: Mapping[int, Callback]) -> None:
        """
        Give the callbacks of timers, subscriptions and services unique labels.

        :param first: of each timer that was made again, by number, the first one: it has the same
            label.
        """
        used: dict[str, int] = {}
        for callback in sorted(self.names.callbacks, key=lambda c: (c.made, c.number)):
            if callback.kind not in KINDS:
                continue
            if callback.number in first:
                callback.label = first[callback.number].label
                continue
            description = callback.description
            number = used[description] = used.get(description, 0) + 1
            callback.label = description if number == 1 else f'{description} #{number}'

    # --- looking up ------------------------------------------------------------------------------

    def program(self, pid: int, number: int) -> int:
        """Return the number in tables of a program that a process numbers itself; -1: none."""
        return self._programs.get((pid, number), -1)

    def callback(self, pid: int, address: int, time: int) -> Callback:
        """Return the callback that an event at run time means; create an unknown one if needed."""
        found = self.callbacks.latest(pid, address, time)
        if found is None:
            # an action, a task or a guard condition has only a symbol
            symbol = self.names.symbols.get(signed(address), '')
            found = Callback(None, 'other' if symbol else 'unknown', made=time)
            found.symbol = symbol
            self._number(found, address)
            found.label = symbol or (
                f'callback {found.number} of process {pid}, whose start is not recorded')
            self.callbacks.add(pid, address, time, found)
        return found


def full_name(namespace: str, name: str) -> str:
    """Return the full name of a node."""
    return f'{namespace.rstrip("/")}/{name}'


def signed(address: int) -> int:
    """Return an address as a signed 64-bit number, as in columns."""
    return address - 2 ** 64 if address >= 2 ** 63 else address


_OPTIONAL = {'queue_depth', 'rmw_handle', 'rmw_publisher_handle', 'rmw_service_handle',
             'executor_addr'}


def _complete(name: str, fields: Fields) -> bool:
    """Return whether an event has all needed fields, with values of the right types."""
    # CARET's other events that add a group have the same fields
    event = next((EVENTS[key] for key in (f'ros2:{name}', f'ros2_caret:{name}', f'mddag:{name}')
                  if key in EVENTS), EVENTS['ros2_caret:add_callback_group'])
    return all(
        isinstance(fields.get(field), str if kind == 'string' else int)
        for field, kind in event.fields if field not in _OPTIONAL
    ) and isinstance(fields.get('init_timestamp', 0), int)


def _as_dict(fields: Iterable[str], event: Event) -> Fields:
    return {'_timestamp': event[1], '_vpid': event[2], '_vtid': event[3],
            **dict(zip(fields, event[4:]))}
