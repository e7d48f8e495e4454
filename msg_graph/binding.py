# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Binding of running or recorded timers, subscriptions and services to declared callbacks.

Theory of operation
-------------------
A declaration names callbacks as their authors count them; a running or recorded system has timers
with periods, subscriptions with topics and services with names.

1. They are matched by node and by what starts them.
2. Several callbacks of one node that are started alike (two subscriptions of one topic) are handed
   out in the order of their declaration: nodes make their entities in the order in which tools
   count the callbacks.
3. A sync callback has one entity for each of its topics, its *legs*.
4. What no declared callback is left for is not declared. It is called by its node, its function
   and what it is, as in `/camera: on_image (subscription /image)`.
"""

from __future__ import annotations

from collections.abc import Iterable
from heapq import heappop, heappush
import re
from typing import NamedTuple

from msg_graph.duration import format_duration
from msg_graph.errors import shown
from msg_graph.model import Callback, TaskSet

# A timer made from a float of seconds is off by rounding (rclpy cuts off fractions of a ns), and
# declared periods like 33.3ms or 16.7ms are rounded themselves.
_PERIOD_TOLERANCE = 2e-3

_WORDS = {'subscription': 'topic', 'service': 'service'}
_PYTHON = re.compile(r'(?:[\w<>]+\.)*(\w+|<lambda>)')
_CPP = re.compile(r'[\w:<>*& ]*?\b(\w+)\([^()]*\)')


class Binder:
    """
    Hands out the declared callbacks of a task set to the entities that start them.

    Every ``bind_...`` returns None where nothing (more) is declared that fits, so the entity's
    callback is an undeclared one.
    """

    def __init__(self, task_set: TaskSet) -> None:
        self._callbacks = task_set.callbacks
        self._free: dict[tuple[str, str, str], list[int]] = {}
        self._periods: dict[str, set[int]] = {}
        self._place: dict[str, int] = {}
        self._bound: list[set[str]] = []
        for place, callback in enumerate(task_set.callbacks):
            self._place[callback.key] = place
            self._bound.append(set())
            for leg in _legs(callback):
                self._free.setdefault((callback.node, *leg), []).append(place)
            if callback.timer_period_ns is not None:
                self._periods.setdefault(callback.node, set()).add(callback.timer_period_ns)

    def bind_timer(self, node: str, period_ns: int) -> Callback | None:
        """
        Return the callback of a timer.

        The declared period may differ by 0.2 %; of several the nearest one is meant.

        :param node: fully qualified name of the timer's node.
        """
        declared = [
            period for period in self._periods.get(node, ())
            if is_period(period_ns, period) and self._free[node, 'timer', str(period)]]
        if not declared:
            return None
        nearest = min(declared, key=lambda period: (abs(period - period_ns), period))
        return self._take(node, 'timer', str(nearest))

    def bind_subscription(self, node: str, topic: str) -> Callback | None:
        """
        Return the callback of a subscription; of a sync callback's leg, the sync callback.

        :param node: fully qualified name of the subscription's node.
        :param topic: fully qualified name of its topic.
        """
        return self._take(node, 'topic', topic)

    def bind_service(self, node: str, service: str) -> Callback | None:
        """
        Return the callback of a service.

        :param node: fully qualified name of the service's node.
        :param service: fully qualified name of the service.
        """
        return self._take(node, 'service', service)

    def release(self, callback: Callback, topic: str | None = None) -> None:
        """
        Take a binding back, as its entity is gone; the callback can be bound anew.

        :param topic: the leg of a sync callback; None for all that are bound.
        :raises KeyError: the callback, or that leg of it, is not bound.
        """
        place = self._place[callback.key]
        bound = self._bound[place]
        starts = sorted(bound) if topic is None else [topic]
        if not bound or not bound.issuperset(starts):
            raise KeyError(callback.key if topic is None else topic)
        kinds = {start: kind for kind, start in _legs(callback)}
        for start in starts:
            bound.remove(start)
            heappush(self._free[callback.node, kinds[start], start], place)

    def _take(self, node: str, kind: str, start: str) -> Callback | None:
        free = self._free.get((node, kind, start))
        if not free:
            return None
        place = heappop(free)
        self._bound[place].add(start)
        return self._callbacks[place]


def is_period(period_ns: int, declared_ns: int) -> bool:
    """Tell whether a timer's period is the declared one."""
    return abs(declared_ns - period_ns) <= _PERIOD_TOLERANCE * declared_ns


class Entity(NamedTuple):
    """A timer, subscription or service that ran: its node, and what starts it."""

    node: str
    kind: str
    start: str = ''
    period_ns: int | None = None


def entities_of(callback: Callback) -> list[Entity]:
    """Return the entities that a declared callback stands for."""
    return [Entity(callback.node, 'subscription' if kind == 'topic' else kind,
                   '' if kind == 'timer' else start, callback.timer_period_ns)
            for kind, start in _legs(callback)]


def meant(callback: Callback, undeclared: Iterable[Entity]) -> str | None:
    """
    Return which entity a declared callback that nothing stands for probably means, as a question.

    That is one of another node or topic whose name has a namespace more or less, or a timer of its
    node with another period.
    """
    timers = []
    for wanted in entities_of(callback):
        for other in undeclared:
            if other.kind != wanted.kind or not _same_below(other.node, wanted.node):
                continue
            if wanted.kind == 'timer':
                timers.append(other)
            elif other.node != wanted.node and _same_below(other.start, wanted.start):
                return f'did you mean the node {shown(other.node)}?'
            elif other.start != wanted.start and _same_below(other.start, wanted.start):
                return f'did you mean the {_WORDS[other.kind]} {shown(other.start)}?'
    period = callback.timer_period_ns or 0
    for other in sorted(timers, key=lambda each: abs((each.period_ns or 0) - period)):
        if other.node == callback.node:
            return f'did you mean its timer of {format_duration(other.period_ns or 0)}?'
        if is_period(other.period_ns or 0, period):
            return f'did you mean the node {shown(other.node)}?'
    return None


def _same_below(name: str, other: str) -> bool:
    """Tell whether two names are the same, but for namespaces before one of them."""
    return name.endswith(other) or other.endswith(name)


def function_of(symbol: str) -> str | None:
    """
    Return the name of the function that a recorded symbol stands for, None where it has none.

    :param symbol: `package.module.Class.function`, or what rclcpp records.
    """
    found = _PYTHON.fullmatch(symbol) or _CPP.fullmatch(symbol)
    return None if found is None else found[1]


def entity_name(node: str, symbol: str, what: str) -> str:
    """
    Return what a callback is called that is not declared.

    :param symbol: that of its function; empty where there is none.
    :param what: its kind and what starts it, as `timer 100ms`.
    """
    function = function_of(symbol)
    if not node:
        return f'{function or "callback"} ({what})'
    return f'{node}: {what}' if function is None else f'{node}: {function} ({what})'


def _legs(callback: Callback) -> list[tuple[str, str]]:
    """Return what starts a callback, as pairs of kind and name."""
    if callback.kind == 'timer':
        return [('timer', str(callback.timer_period_ns))]
    if callback.kind == 'service':
        return [('service', str(callback.service))]
    return [('topic', topic) for topic in callback.topics]
