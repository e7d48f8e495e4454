# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Names of nodes, topics, callbacks, …: which are valid, and which every node has anyway."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import re

from msg_graph.errors import shown

Check = Callable[[str], 'tuple[str, str] | None']
"""Looks at a text; returns what is wrong with it and what to do, or None."""

_ROS_NAME = re.compile(r'(?:/[A-Za-z_][A-Za-z0-9_]*)+')
_WORD = re.compile(r'[A-Za-z0-9_][A-Za-z0-9_.-]*')


@dataclass(frozen=True)
class Name:
    """
    A kind of name.

    :ivar what: what errors call it.
    """

    what: str
    pattern: re.Pattern[str] = _WORD
    longest: int = 255

    @property
    def is_global(self) -> bool:
        """Whether it is a full name of the ROS graph, as a node's or topic's."""
        return self.pattern is _ROS_NAME

    def check(self, text: str) -> tuple[str, str] | None:
        """Return what is wrong with a name and what to do, or None."""
        what = f'{self.what} name'
        if self.is_global and not text.startswith('/'):
            return (f'{shown(text)} is not an absolute {what}',
                    f'write it in full, as {shown("/" + text.lstrip("~/"))}')
        if not self.pattern.fullmatch(text):
            if self.is_global:
                return (f'{shown(text)} is not a valid {what}',
                        "use '/' and words of letters, digits and '_' that start with no digit")
            return (f'{shown(text)} is no name for a {self.what}',
                    "use letters, digits, '_', '-' and '.'")
        if len(text) > self.longest:
            return (f'the {what if self.is_global else "name"} {shown(text)} is too long',
                    f'use at most {self.longest} characters')
        return None


NODE = Name('node', _ROS_NAME)  # as rmw_validate_node_name and its namespaces ask
TOPIC = Name('topic', _ROS_NAME, 247)  # RMW_TOPIC_MAX_NAME_LENGTH
SERVICE = Name('service', _ROS_NAME, 247)
CALLBACK = Name('callback')
GROUP = Name('callback group')
DAG = Name('DAG', re.compile(r'/?[A-Za-z0-9_.-]+(?:/[A-Za-z0-9_.-]+)*'))
PATH = Name('path')
PROCESS = Name('process')


def check_read(text: str) -> tuple[str, str] | None:
    """Check an entry of ``reads``: a topic, or the name of a callback of the same node."""
    if ':' in text:
        return (
            f'{shown(text)} names a callback with its node',
            'name the topic that is taken, or just the name of a callback of the same node')
    return (TOPIC if text.startswith('/') else CALLBACK).check(text)


def check_key(text: str) -> tuple[str, str] | None:
    """Check the key of a callback, ``/node:callback``."""
    node, colon, name = text.rpartition(':')
    if not colon:
        return (f'{shown(text)} names no callback', "write '/node:callback'")
    return NODE.check(node) or CALLBACK.check(name)


_BACKGROUND_TOPICS = {'/rosout', '/parameter_events', '/clock', '/diagnostics'}
_BACKGROUND_SERVICES = {
    'describe_parameters', 'get_parameter_types', 'get_parameters', 'list_parameters',
    'set_parameters', 'set_parameters_atomically', 'get_type_description',
    'get_logger_levels', 'set_logger_levels'}
_LIFECYCLE = {
    'change_state', 'get_state', 'get_available_states', 'get_available_transitions',
    'get_transition_graph', 'transition_event'}


def is_background(name: str, node: str) -> bool:
    """
    Return whether a node has a topic or service as every node has, or is an action's inner one.

    So it is with what every lifecycle node has. A declaration is about what a system is there for,
    not about what the client library adds.
    """
    before, _, word = name.rpartition('/')
    return (name in _BACKGROUND_TOPICS or '/_action/' in name or word in _BACKGROUND_SERVICES
            or (word in _LIFECYCLE and before == node))
