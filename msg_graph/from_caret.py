# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
A declaration to fill in, from a CARET architecture file.

Theory of operation
-------------------
What the file says becomes entries. What it cannot know stands as a comment that is an entry once
its first ``# `` is gone, with ``FILL IN`` and a proposal, so that ``mddag graph check`` names what
is still open:

1. *deadline* of a sink: the shortest period of the timers that lead to it.
2. *period* of a subscription whose topic nobody publishes, and of a service: no proposal, as the
   file knows no rates.
3. *publishes*, where the file does not know which of a node's callbacks publishes a topic: on each
   that may.
4. *cycles*: at the top of the file, each with the queue edges that would cut it.

A named path becomes an entry where each of its nodes has just one callback that fits.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
import re

from msg_graph.caret import Architecture, CaretCallback, CaretPath, read_architecture, UNDEFINED
from msg_graph.duration import format_duration
from msg_graph.errors import printable
from msg_graph.fields import check_path

MARK = 'FILL IN'
_MOST_EDGES = 60
_PLAIN = re.compile(r'[/A-Za-z_][/A-Za-z0-9_.-]*')
_WORDS = {'true', 'false', 'yes', 'no', 'on', 'off', 'null', 'y', 'n'}


def declaration_from_caret(text: str, file: str) -> str:
    """
    Return the text of a declaration with marked blanks.

    :param text: the architecture file's.
    :param file: its name, for errors and for the first line.
    :raises GraphError: it is not YAML, or no architecture file.
    """
    architecture = read_architecture(text, file)
    return '\n'.join(_Writer(architecture).lines(file)) + '\n'


class _Writer:

    def __init__(self, architecture: Architecture) -> None:
        self._architecture = architecture
        self._callbacks = list(architecture.callbacks())
        self._publishers: dict[str, list[CaretCallback]] = {}
        self._started: dict[str, list[CaretCallback]] = {}
        for callback in self._callbacks:
            for topic in callback.publishes:
                self._publishers.setdefault(topic, []).append(callback)
            if callback.kind == 'subscription':
                self._started.setdefault(callback.start, []).append(callback)
        self._maybe = {topic for callback in self._callbacks for topic in callback.maybe}
        self._sources = Counter(c.node for c in self._callbacks if self._is_source(c))
        self._next = {callback.key: self._successors(callback) for callback in self._callbacks}
        self._period = self._shortest_periods()

    def _is_source(self, callback: CaretCallback) -> bool:
        return callback.kind != 'subscription' or not (
            callback.start in self._publishers or callback.start in self._maybe)

    def _successors(self, callback: CaretCallback) -> list[tuple[str, CaretCallback]]:
        return [(topic, after) for topic in callback.publishes
                for after in self._started.get(topic, ())]

    def _shortest_periods(self) -> dict[str, int]:
        """Return for each callback that timers lead to the shortest of their periods, in ns."""
        periods: dict[str, int] = {}
        timers = [c for c in self._callbacks if c.period_ns is not None]
        for timer in sorted(timers, key=lambda c: c.period_ns or 0):
            stack = [timer]
            while stack:
                callback = stack.pop()
                if callback.key not in periods:
                    periods[callback.key] = timer.period_ns or 0
                    stack.extend(after for _, after in self._next[callback.key])
        return periods

    def lines(self, file: str) -> Iterator[str]:
        yield f'# From the CARET architecture file {printable(file)}.'
        yield f"# Lines with '{MARK}' are blanks: correct the value, then take the '# ' away."
        yield "# 'mddag graph check' tells what is still open."
        yield from self._cycles()
        yield 'mddag: 1'
        yield 'nodes:'
        for node in self._architecture.nodes:
            yield f'  - node: {_scalar(node.name)}'
            yield '    callbacks:'
            for callback in node.callbacks.values():
                yield from self._callback(callback)
        yield from self._paths()

    def _callback(self, callback: CaretCallback) -> Iterator[str]:
        yield f'      - name: {_scalar(callback.name)}'
        start = callback.start
        if callback.period_ns is not None:
            start = _duration(callback.period_ns)
        yield f'        {callback.kind}: {start}'
        if self._is_source(callback) and self._sources[callback.node] > 1:
            dag = f'dag: {_scalar(callback.node + "/" + callback.name)}'
            outside = callback.kind == 'subscription'
            yield f'        # {dag}  # {MARK}: with the period' if outside else f'        {dag}'
        if callback.kind == 'service':
            yield f'        # period: 1s  # {MARK}: the time between two requests'
        elif callback.kind == 'subscription' and callback.start not in self._publishers:
            if not self._is_source(callback):
                yield f'        # {callback.start} has no known publisher yet: see its blanks'
            else:
                yield (f'        # period: 100ms  # {MARK}: nobody here publishes the topic; '
                       'the time between two messages')
        if callback.group is not None:
            yield f'        group: {_scalar(callback.group)}'
        yield from self._publishes(callback)
        if callback.reads:
            yield f'        reads: [{", ".join(map(_scalar, callback.reads))}]'
        if not self._next[callback.key]:
            yield self._deadline(callback)

    def _publishes(self, callback: CaretCallback) -> Iterator[str]:
        every = ', '.join(callback.publishes + callback.maybe)
        if callback.maybe:
            names = ', '.join(callback.maybe)
            yield f'        # publishes: [{every}]  # {MARK}: which callback publishes {names}?'
            if callback.publishes:
                yield '        # (instead of the next line)'
        if callback.publishes:
            yield f'        publishes: [{", ".join(callback.publishes)}]'

    def _deadline(self, callback: CaretCallback) -> str:
        what = 'if it is a sink' if callback.maybe else 'a sink'
        period = self._period.get(callback.key)
        if period is None:
            return f'        # deadline: 100ms  # {MARK}: {what}; no timer is known to lead here'
        return (f'        # deadline: {_duration(period)}  # {MARK}: {what}; proposed: the period '
                'of the timer that leads here')

    def _paths(self) -> Iterator[str]:
        found = [(path, self._path_keys(path)) for path in self._architecture.paths]
        if any(keys for _, keys in found):
            yield 'paths:'
        for path, keys in found:
            if keys:
                yield f'  - name: {_scalar(path.name)}'
                yield '    callbacks:'
                yield from (f"      - '{key}'" for key in keys)
            else:
                chain = ' -> '.join(node for node, _, _ in path.steps)
                yield printable(f'# {MARK}: path {path.name}: which callbacks? {chain}')

    def _path_keys(self, path: CaretPath) -> list[str]:
        keys = []
        for node, taken, published in path.steps:
            fits = [c for c in self._callbacks if c.node == node
                    and (taken == UNDEFINED or c.start == taken or taken in c.reads)
                    and (published == UNDEFINED or published in c.publishes)]
            if len(fits) != 1:
                return []
            keys.append(fits[0].key)
        return keys if len(keys) > 1 and check_path(path.name) is None else []

    def _cycles(self) -> Iterator[str]:
        for members in _components(self._next):
            edges = [(before, topic, after) for before in members
                     for topic, after in self._next[before] if after.key in members]
            names = ', '.join(members)
            yield f'# {MARK}: these callbacks start each other in a cycle: {names}.'
            cuts = [edge for edge in edges[:_MOST_EDGES]
                    if _is_cut(members, self._next, (edge[0], edge[2].key))]
            how = 'Each of these queue edges cuts it' if cuts else 'Several of these cut it'
            yield f"# {how} (write it under 'reads:', start the callback by something else):"
            for before, topic, after in cuts or edges[:_MOST_EDGES]:
                yield f'#   {after.key} reads {topic} (published by {before})'


_Next = dict[str, list[tuple[str, CaretCallback]]]


def _components(successors: _Next) -> list[list[str]]:
    """Return the sets of callbacks that lead back to themselves (Tarjan), in file order."""
    order = {key: place for place, key in enumerate(successors)}
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    open_keys: list[str] = []
    is_open: set[str] = set()
    found: list[list[str]] = []
    for root in successors:
        stack = [] if root in index else [(root, iter(successors[root]))]
        while stack:
            key, rest = stack[-1]
            if key not in index:
                index[key] = low[key] = len(index)
                open_keys.append(key)
                is_open.add(key)
            for _, after in rest:
                if after.key not in index:
                    stack.append((after.key, iter(successors[after.key])))
                    break
                if after.key in is_open:
                    low[key] = min(low[key], low[after.key])
            else:
                stack.pop()
                if stack:
                    low[stack[-1][0]] = min(low[stack[-1][0]], low[key])
                if low[key] == index[key]:
                    members: list[str] = []
                    while not members or members[-1] != key:
                        members.append(open_keys.pop())
                        is_open.discard(members[-1])
                    if len(members) > 1 or any(a.key == key for _, a in successors[key]):
                        found.append(sorted(members, key=order.__getitem__))
    return sorted(found, key=lambda members: order[members[0]])


def _is_cut(members: list[str], successors: _Next, edge: tuple[str, str]) -> bool:
    """Whether no cycle is left among the members without an edge."""
    inside = set(members)
    rest = {key: [(topic, after) for topic, after in successors[key]
                  if after.key in inside and (key, after.key) != edge] for key in members}
    return not _components(rest)


def _duration(nanoseconds: int) -> str:
    text = format_duration(nanoseconds)
    from msg_graph.duration import parse_duration
    return text if parse_duration(text, minimum_ns=1) == nanoseconds else f'{nanoseconds}ns'


def _scalar(text: str) -> str:
    """Return a name that stands for itself in YAML, in quotes where it would not."""
    return text if _PLAIN.fullmatch(text) and text.lower() not in _WORDS else f"'{text}'"
