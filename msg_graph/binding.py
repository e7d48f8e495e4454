# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Binding of running or recorded timers, subscriptions and services to declared callbacks.

Theory of operation
-------------------
A declaration names callbacks; a running or recorded system has timers with periods, subscriptions
with topics and services with names.

1. Both are matched by node and start: the timer's period, the topic or the service.
2. Several callbacks of one node with the same start (two subscriptions of one topic) are bound in
   the order of their declaration: nodes make their entities in the order in which tools count the
   callbacks.
3. A sync callback has one entity for each of its topics, its *legs*.
4. A sporadic timer may be made again and again: each further timer of its node with its period is
   bound to it; of several sporadic ones to the one with the name of the timer's function.
5. An entity without a remaining declared callback is undeclared. Its name consists of its node,
   its function and its kind, as in `/camera: on_image (subscription /image)`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable
import re
from typing import NamedTuple

from msg_graph.duration import format_duration
from msg_graph.errors import quoted
from msg_graph.model import Callback, TaskSet

# A timer made from a float of seconds has a rounding error (rclpy cuts off fractions of a ns), and
# declared periods such as 33.3ms or 16.7ms are rounded themselves.
_PERIOD_TOLERANCE = 2e-3

_WORDS = {'subscription': 'topic', 'service': 'service'}
_PYTHON = re.compile(r'(?:[\w<>]+\.)*(\w+|<lambda>)')
_CPP = re.compile(r'[\w:<>*& ]*?\b(\w+)\([^()]*\)')
_BACKGROUND_TOPICS = {'/rosout', '/parameter_events', '/clock'}
_MONITORING_TOPIC = '/diagnostics'
_ANNOUNCEMENTS = '/mddag/jobs_'  # with them the processes of a run find each other's jobs
_BACKGROUND_SERVICES = {
    'describe_parameters', 'get_parameter_types', 'get_parameters', 'list_parameters',
    'set_parameters', 'set_parameters_atomically', 'get_type_description',
    'get_logger_levels', 'set_logger_levels'}
_LIFECYCLE = {
    'change_state', 'get_state', 'get_available_states', 'get_available_transitions',
    'get_transition_graph', 'transition_event'}


class Entity(NamedTuple):
    """A timer, subscription or service: its node and its start."""

    node: str
    kind: str
    start: str = ''
    period_ns: int | None = None


def entities_of(callback: Callback) -> list[Entity]:
    """Return the entities of a declared callback."""
    if callback.kind == 'timer':
        return [Entity(callback.node, 'timer', '', callback.timer_period_ns)]
    if callback.service is not None:
        return [Entity(callback.node, 'service', callback.service)]
    return [Entity(callback.node, 'subscription', topic) for topic in callback.topics]


class Binder:
    """Binds the declared callbacks of a task set to the entities that start them."""

    def __init__(self, task_set: TaskSet) -> None:
        self._callbacks = task_set.callbacks
        self._place = task_set.callback_indices()
        self._free: dict[Entity, list[int]] = {}
        self._timers: dict[str, set[Entity]] = {}
        self._bound: Counter[tuple[int, Entity]] = Counter()
        for place, callback in enumerate(task_set.callbacks):
            for entity in entities_of(callback):
                self._free.setdefault(entity, []).append(place)
                if entity.kind == 'timer':
                    self._timers.setdefault(entity.node, set()).add(entity)

    def bind(self, entity: Entity, function: str | None = None) -> Callback | None:
        """
        Return the callback of an entity; of a sync callback's leg, the sync callback.

        None: no (further) declared callback fits, so the entity's callback is undeclared. The
        period of a timer may differ by 0.2 %; of several timers the nearest one is bound.

        :param entity: with the full names of its node and of its topic or service.
        :param function: the name of its function, if known.
        """
        if entity.kind == 'timer':
            period = entity.period_ns or 0
            entity = min(
                (timer for timer in self._timers.get(entity.node, ())
                 if self._free[timer] and is_period(period, timer.period_ns or 0)),
                key=lambda timer: (abs((timer.period_ns or 0) - period), timer), default=entity)
        free = self._free.get(entity)
        if not free:
            return None
        place = self._next(free, function)
        self._bound[place, entity] += 1
        return self._callbacks[place]

    def _next(self, free: list[int], function: str | None) -> int:
        """Return the callback to bind next; a sporadic timer stays free."""
        again = [place for place in free if self._is_made_again(place)]
        if len(again) == len(free):
            return next(
                (each for each in again if self._callbacks[each].name == function), min(again))
        place = min(set(free).difference(again))
        free.remove(place)
        return place

    def _is_made_again(self, place: int) -> bool:
        callback = self._callbacks[place]
        return callback.kind == 'timer' and callback.sporadic

    def unbound(self) -> list[Callback]:
        """Return the callbacks without an entity, or syncs without one for each leg."""
        places = {place for entity, free in list(self._free.items()) for place in free
                  if not self._bound[place, entity]}
        return [self._callbacks[place] for place in sorted(places)]

    def release(self, callback: Callback, topic: str | None = None) -> None:
        """
        Undo a binding after the entity was removed; the callback can be bound again.

        :param topic: the leg of a sync callback; None: all that are bound.
        :raises KeyError: the callback, or that leg of it, is not bound.
        """
        place = self._place[callback.key]
        bound = [entity for entity in entities_of(callback)
                 if topic in (None, entity.start) and self._bound[place, entity]]
        if not bound:
            raise KeyError(callback.key if topic is None else topic)
        for entity in bound:
            self._bound[place, entity] -= 1
            if not self._is_made_again(place):
                self._free[entity].append(place)


def is_period(period_ns: int, declared_ns: int) -> bool:
    """Return whether a timer's period is the declared one."""
    return abs(declared_ns - period_ns) <= _PERIOD_TOLERANCE * declared_ns


def suggest_entity(callback: Callback, undeclared: Collection[Entity]) -> str | None:
    """
    Return the entity that an unbound declared callback probably means, as a question.

    That is the timer of its node with the nearest period, or an entity of its kind of which
    either the node or the start has another name: a similar one, or one with other namespaces.
    """
    for wanted in entities_of(callback):
        alike = [other for other in undeclared if other.kind == wanted.kind]
        here = [other for other in alike if other.node == wanted.node]
        if wanted.kind == 'timer' and here:
            period = min((other.period_ns or 0 for other in here),
                         key=lambda ns: abs(ns - (wanted.period_ns or 0)))
            return f'did you mean its timer of {format_duration(period)}?'
        if found := _closest(wanted.start, (other.start for other in here)):
            return f'did you mean the {_WORDS[wanted.kind]} {quoted(found)}?'
        if found := _closest(wanted.node, (
                other.node for other in alike if _same_below(other.start, wanted.start)
                and is_period(other.period_ns or 0, wanted.period_ns or 0))):
            return f'did you mean the node {quoted(found)}?'
    return None


def _closest(name: str, others: Iterable[str]) -> str | None:
    """Return the name that differs only by namespaces, or a similar one."""
    different = sorted({*others} - {name})
    same = next((each for each in different if _same_below(each, name)), None)
    if same is not None:
        return same
    from difflib import get_close_matches  # rarely needed
    return next(iter(get_close_matches(name, different, 1)), None)


def _same_below(name: str, other: str) -> bool:
    """Return whether two names are equal except for namespaces before one of them."""
    return name.endswith(other) or other.endswith(name)


def function_of(symbol: str) -> str | None:
    """Return the function's name in a symbol of Python or rclcpp; None: it has none."""
    found = _PYTHON.fullmatch(symbol) or _CPP.fullmatch(symbol)
    return None if found is None else found[1]


OF_RATE = 'threading.Event.set'
"""The function of the timer of a ``Rate``, which ends a thread's sleep."""


def entity_name(node: str, symbol: str, what: str) -> str:
    """
    Return the name of an undeclared callback.

    :param symbol: of its function; empty if there is none.
    :param what: its kind and start, as `timer 100ms`.
    """
    function = 'Rate' if symbol == OF_RATE else function_of(symbol)
    if not node:
        return f'{function or "callback"} ({what})'
    return f'{node}: {what}' if function is None else f'{node}: {function} ({what})'


def is_background(name: str, node: str) -> bool:
    """
    Return whether a topic or service belongs to the client library, the executor or an action.

    Every node or lifecycle node has some of these; declarations do not contain them.
    """
    before, _, word = name.rpartition('/')
    return (name in _BACKGROUND_TOPICS or name.startswith(_ANNOUNCEMENTS)
            or '/_action/' in name or word in _BACKGROUND_SERVICES
            or (word in _LIFECYCLE and before == node))


def is_side_output(topic: str, node: str) -> bool:
    """
    Return whether a topic says nothing about what a callback publishes for others.

    Those are background topics, and ``/diagnostics``, on which nearly every node and the executor
    itself report their states.  A subscription of it is an ordinary callback.
    """
    return topic == _MONITORING_TOPIC or is_background(topic, node)
