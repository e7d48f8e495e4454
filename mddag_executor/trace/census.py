# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Who is who in a trace, and what each callback did: for traces of this executor and of CARET.

Theory of operation
-------------------
The events of ros2_tracing name things by address, so everything is kept by process and address.
An address that is used again stands for the newer thing.

1. A node has timers, subscriptions and services, in the order in which they were made; each leads
   to a callback. rclcpp makes a subscription in two steps, so links are followed only when asked.
2. A callback runs in a thread from ``callback_start`` to ``callback_end``; the runs of a thread
   nest, as a callback may spin. What a thread publishes meanwhile, the innermost callback
   publishes.
3. Of each callback the number of runs, the first and the last start, and the times that runs took
   are kept; of the latter ``KEEP_TIMES`` at most, in ns.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from msg_graph.binding import entity_name
from msg_graph.duration import exact_duration

KEEP_TIMES = 100_000
ADDRESS = 2 ** 64 - 1
"""Columns have addresses with a sign; this mask takes it away."""

Event = tuple[Any, ...]
Address = tuple[int, int]
"""Process and address."""


@dataclass
class Entity:
    """
    A timer, subscription or service.

    :ivar kind: ``timer``, ``subscription`` or ``service``.
    :ivar start: the topic or service, as its name; empty for a timer.
    :ivar period_ns: the timer's period.
    :ivar callback: its callback's address; None where the trace does not say.
    :ivar group: its mutually exclusive callback group, or None.
    :ivar symbol: of its function; empty where the trace does not say.
    """

    kind: str
    node: str
    start: str
    period_ns: int | None
    callback: Address | None
    group: Address | None
    symbol: str


@dataclass
class Runs:
    """What a callback did."""

    count: int = 0
    first: int = 0
    last: int = 0
    times: array[int] = field(default_factory=lambda: array('q'))
    publishes: dict[str, None] = field(default_factory=dict)

    @property
    def interval_ns(self) -> int | None:
        """Return the mean time between two of its starts; None with fewer than two."""
        return (self.last - self.first) // (self.count - 1) if self.count > 1 else None


class Census:
    """
    Collects events (tuples as ``TraceReader.events`` yields them), in the order of time.

    ``handlers`` has the method for each event, by full name.

    :param keep_times: how many times of each callback's runs to keep.
    """

    def __init__(self, keep_times: int = KEEP_TIMES) -> None:
        self._keep_times = keep_times
        self.runs: dict[Address, Runs] = {}
        #: By process and thread: the callback that ended there last, and how long it ran.
        self.took: dict[tuple[int, int], tuple[Address, int]] = {}
        #: By node its publishers' topics; by topic whether some callback was seen to publish it.
        self.publishers: dict[str, dict[str, bool]] = {}
        self._nodes: dict[Address, str] = {}
        self._topic: dict[Address, tuple[str, str]] = {}
        self._made: dict[Address, tuple[str, Address | None, str, int | None]] = {}
        self._node_of_timer: dict[Address, Address] = {}
        self._links: dict[Address, list[Address]] = {}
        self._exclusive: set[Address] = set()
        self._group: dict[Address, Address] = {}
        self._symbols: dict[Address, str] = {}
        self._groups: dict[int, int] | None = None      # None: something new has come
        self._names: dict[int, str] | None = None
        self._running: dict[tuple[int, int], list[tuple[Address, int]]] = {}
        #: The methods for events that say who there is.
        self.who: dict[str, Callable[[Event], None]] = {
            'ros2:rcl_node_init': self._node,
            'ros2:rcl_publisher_init': self._publisher,
            'ros2:rcl_subscription_init': self._subscription,
            'ros2:rcl_service_init': self._service,
            'ros2:rcl_timer_init': self._timer,
            'ros2:rclcpp_timer_link_node': self._timer_node,
            'ros2:rclcpp_subscription_init': self._link,
            'ros2:rclcpp_subscription_callback_added': self._link,
            'ros2:rclcpp_timer_callback_added': self._link,
            'ros2:rclcpp_service_callback_added': self._link,
            'ros2_caret:add_callback_group': self._new_group,
            'ros2_caret:callback_group_add_timer': self._in_group,
            'ros2_caret:callback_group_add_subscription': self._in_group,
            'ros2_caret:callback_group_add_service': self._in_group,
            'ros2:rclcpp_callback_register': self._register,
        }
        self.handlers: dict[str, Callable[[Event], None]] = {
            **self.who,
            'ros2:callback_start': self._start,
            'ros2:callback_end': self._end,
            'ros2:rclcpp_publish': self._publish,
            'ros2:rcl_publish': self._publish,
        }

    def take(self, event: Event) -> None:
        """Note what an event says; one without some fields, or of another kind, is left out."""
        handler = self.handlers.get(event[0])
        if handler is not None and None not in event:
            if event[0] in self.who:
                self._groups = self._names = None
            handler(event)

    def _node(self, event: Event) -> None:
        name = f'{event[7].rstrip("/")}/{event[6]}'
        self._nodes[event[2], event[4]] = name
        self.publishers.setdefault(name, {})

    def _publisher(self, event: Event) -> None:
        node = self._nodes.get((event[2], event[5]), '')
        self._topic[event[2], event[4]] = (node, event[7])
        if node:
            self.publishers[node].setdefault(event[7], False)

    def _add(self, kind: str, event: Event, node: int | None, start: str, period: int | None
             ) -> None:
        address = (event[2], event[4])
        self._made.pop(address, None)  # a new thing has a new place
        self._made[address] = (kind, None if node is None else (event[2], node), start, period)

    def _subscription(self, event: Event) -> None:
        self._add('subscription', event, event[5], event[7], None)

    def _service(self, event: Event) -> None:
        self._add('service', event, event[5], event[7], None)

    def _timer(self, event: Event) -> None:
        self._add('timer', event, None, '', event[5])

    def _timer_node(self, event: Event) -> None:
        self._node_of_timer[event[2], event[4]] = (event[2], event[5])

    def _link(self, event: Event) -> None:
        self._links.setdefault((event[2], event[4]), []).append((event[2], event[5]))

    def _new_group(self, event: Event) -> None:
        if event[6] == 'mutually_exclusive':
            self._exclusive.add((event[2], event[5]))

    def _in_group(self, event: Event) -> None:
        self._group[event[2], event[5]] = (event[2], event[4])

    def _register(self, event: Event) -> None:
        self._symbols[event[2], event[4]] = event[5]

    def _start(self, event: Event) -> None:
        callback = (event[2], event[4])
        self._running.setdefault((event[2], event[3]), []).append((callback, event[1]))
        runs = self.runs.get(callback)
        if runs is None:
            runs = self.runs[callback] = Runs(first=event[1])
        runs.count += 1
        runs.last = event[1]

    def _end(self, event: Event) -> None:
        stack = self._running.get((event[2], event[3]), [])
        while stack:
            callback, start = stack.pop()
            if callback == (event[2], event[4]):
                self.took[event[2], event[3]] = callback, event[1] - start
                times = self.runs[callback].times
                if len(times) < self._keep_times:
                    times.append(event[1] - start)
                return

    def _publish(self, event: Event) -> None:
        stack = self._running.get((event[2], event[3]))
        if stack:
            self.published(stack[-1][0], (event[2], event[4]))

    def published(self, callback: Address, publisher: Address) -> None:
        """Note that a callback has published with a publisher."""
        node, topic = self._topic.get(publisher, ('', ''))
        if node:
            self.runs.setdefault(callback, Runs()).publishes[topic] = None
            self.publishers[node][topic] = True

    def entities(self) -> Iterator[Entity]:
        """Yield the timers, subscriptions and services, as they were made."""
        for address, (kind, node, start, period) in self._made.items():
            if node is None:
                node = self._node_of_timer.get(address)
            name = None if node is None else self._nodes.get(node)
            if name is None:
                continue
            group = self._group.get(address)
            callback = self._callback(address)
            yield Entity(kind, name, start, period, callback,
                         group if group in self._exclusive else None,
                         '' if callback is None else self._symbols.get(callback, ''))

    def groups(self) -> dict[int, int]:
        """Return by callback its mutually exclusive group, or -1 for a reentrant one."""
        if self._groups is None:
            self._groups = {
                signed(callback): signed(group[1]) if group in self._exclusive else -1
                for entity, group in self._group.items() for callback in self._reachable(entity)}
        return self._groups

    def topics(self) -> dict[int, str]:
        """Return by callback of a subscription its topic."""
        return {signed(callback): start for entity, (kind, _, start, _) in self._made.items()
                if kind == 'subscription' for callback in self._reachable(entity)}

    def published_by(self) -> dict[int, tuple[str, str]]:
        """Return by publisher its node (empty: not known) and topic."""
        return {signed(address): what for (_, address), what in self._topic.items()}

    def name(self, callback: int) -> str:
        """Return what a callback is called that no declaration names."""
        if self._names is None:
            self._names = self._all_names()
        return self._names.get(callback & ADDRESS, 'a callback whose start is not recorded')

    def _reachable(self, address: Address) -> Iterator[int]:
        """Yield what the links from a handle lead to, and itself."""
        seen = {address: None}
        todo = [address]
        for handle in todo:
            yield handle[1]
            for after in self._links.get(handle, ()):
                if after not in seen:
                    seen[after] = None
                    todo.append(after)

    def _all_names(self) -> dict[int, str]:
        found = {address: symbol for (_, address), symbol in self._symbols.items()}
        for entity in self.entities():
            if entity.callback is not None:
                what = exact_duration(entity.period_ns) if entity.period_ns else entity.start
                found[entity.callback[1]] = entity_name(
                    entity.node, entity.symbol, f'{entity.kind} {what}')
        return found

    def _callback(self, address: Address) -> Address | None:
        """Return what the links from a handle end in."""
        seen = {address}
        while address in self._links:
            after = self._links[address][-1]
            if after in seen:
                break
            seen.add(after)
            address = after
        return address if len(seen) > 1 else None


def signed(address: int) -> int:
    """Return an address as columns have it."""
    return address - 2 ** 64 if address >= 2 ** 63 else address
