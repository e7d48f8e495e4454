# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Declarations to fill in: what a sketch knows, and marked blanks for what it cannot know.

Theory of operation
-------------------
What is known becomes entries. What is not stands as a comment that is an entry once its first
``# `` is gone, with ``FILL IN`` and a proposal, so that ``mddag graph check`` names what is still
open (``open_blanks``), all of it at once, instead of the errors that come of it:

1. *deadline* of a sink: the shortest period of the sources that lead to it.
2. *period* of a subscription whose topic nobody publishes, and of a service: the measured time
   between two of its executions, where there is one.
3. *publishes*, where it is not known which of a node's callbacks publishes a topic: on each that
   may.
4. *timers* that are only supposed, as nothing else seems to start what their node publishes.
5. *cycles*: at the top of the file, each with the queue edges that would cut it.

A named path becomes an entry where each of its nodes has just one callback that fits.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
import re

from msg_graph.duration import DAY, exact_duration, format_duration, MICROSECOND
from msg_graph.errors import GraphError, GraphErrors, printable
from msg_graph.fields import check_path
from msg_graph.flat import quantiles_text
from msg_graph.model import ExecutionTime
from msg_graph.sketch import Sketch, SketchCallback, SketchPath, UNDEFINED
from msg_graph.yamltext import plain_scalar

MARK = 'FILL IN'
_OPEN = re.compile(rf'\s*#\s+(?:(\w+:).*\s#\s+)?{MARK}: (.*)')
_ENTRY = re.compile(r'\s*- (?:name|node):|\s*-\s*\{')
_MOST_EDGES = 60
_LITTLE = 1e-4      # of a period


def declaration_with_blanks(sketch: Sketch) -> str:
    """Return the text of a declaration with marked blanks."""
    return '\n'.join(_Writer(sketch).lines()) + '\n'


def open_blanks(text: str, file: str) -> list[GraphError]:
    """Return an error for each blank that is left in a declaration."""
    return [GraphError(
        file, number,
        f"{match[1] or 'this'} is a blank to fill in ({match[2]})",
        "correct the value and take the '# ' away" if match[1] else 'do so, then remove the line')
        for number, line in enumerate(text.splitlines(), 1)
        if MARK in line and (match := _OPEN.fullmatch(line)) is not None]


def with_blanks(error: GraphError, text: str, file: str) -> GraphError:
    """Return an error with the blanks of its file, and without what is wrong because of them."""
    blanks = open_blanks(text, file)
    if not blanks:
        return error
    starts = [number for number, line in enumerate(text.splitlines(), 1) if _ENTRY.match(line)]
    unfinished = {bisect_right(starts, blank.line or 0) for blank in blanks}
    others = [each for each in error.errors if each.file != file or each.line is None
              or bisect_right(starts, each.line) not in unfinished]
    found = (*blanks, *others)
    return found[0] if len(found) == 1 else GraphErrors(found)


class _Writer:

    def __init__(self, sketch: Sketch) -> None:
        self._sketch = sketch
        self._callbacks = list(sketch.callbacks())
        self._publishers: dict[str, list[SketchCallback]] = {}
        self._started: dict[str, list[SketchCallback]] = {}
        for callback in self._callbacks:
            for topic in callback.publishes:
                self._publishers.setdefault(topic, []).append(callback)
            if callback.kind in ('subscription', 'sync'):
                for topic in callback.starts:
                    self._started.setdefault(topic, []).append(callback)
        self._maybe = {topic for callback in self._callbacks for topic in callback.maybe}
        self._sources = Counter(c.node for c in self._callbacks if self._is_source(c))
        self._next = {callback.key: self._successors(callback) for callback in self._callbacks}
        self._period = self._shortest_periods()

    def _is_source(self, callback: SketchCallback) -> bool:
        if callback.kind == 'sync':
            return False
        return callback.kind != 'subscription' or not (
            callback.starts[0] in self._publishers or callback.starts[0] in self._maybe)

    def _successors(self, callback: SketchCallback) -> list[tuple[str, SketchCallback]]:
        return [(topic, after) for topic in callback.publishes
                for after in self._started.get(topic, ())]

    def _shortest_periods(self) -> dict[str, SketchCallback]:
        """Return by callback the source with the shortest period that leads to it, perhaps."""
        found: dict[str, SketchCallback] = {}
        sources = [c for c in self._callbacks if self._is_source(c) and c.source_period_ns]
        for source in sorted(sources, key=lambda c: c.source_period_ns or 0):
            stack = [source]
            while stack:
                callback = stack.pop()
                if callback.key not in found:
                    found[callback.key] = source
                    stack.extend(after for topic in callback.publishes + callback.maybe
                                 for after in self._started.get(topic, ()))
        return found

    def lines(self) -> Iterator[str]:
        yield f'# From {printable(self._sketch.origin)}.'
        yield f"# Lines with '{MARK}' are blanks: correct the value, then take the '# ' away."
        yield "# 'mddag graph check' tells what is still open."
        yield from self._cycles()
        yield 'mddag: 1'
        if self._sketch.workers is not None:
            yield f'workers: {self._sketch.workers}'
        yield 'nodes:'
        for node in self._sketch.nodes:
            yield f'  - node: {plain_scalar(node.name)}'
            yield '    callbacks:'
            for callback in node.callbacks.values():
                yield from self._callback(callback)
        yield from self._paths()

    def _callback(self, callback: SketchCallback) -> Iterator[str]:
        yield f'      - name: {plain_scalar(callback.name)}'
        yield self._trigger(callback)
        yield from self._source(callback)
        if callback.group is not None:
            yield f'        group: {plain_scalar(callback.group)}'
        yield from self._publishes(callback)
        if callback.reads:
            yield f'        reads: [{", ".join(map(plain_scalar, callback.reads))}]'
        if not self._next[callback.key]:
            yield self._deadline(callback)
        if callback.times is not None:
            yield from _execution_time(*callback.times)

    def _trigger(self, callback: SketchCallback) -> str:
        if callback.kind == 'timer':
            if callback.guessed and not (callback.publishes or callback.maybe):
                return (f'        # timer: 100ms  # {MARK}: what starts it? Nothing is seen of '
                        'the node but its name; remove it if it has no callbacks')
            if callback.guessed and callback.interval_ns is None:
                return (f'        # timer: 100ms  # {MARK}: what starts it? No message came while '
                        'it was looked at')
            if callback.guessed:
                return (f'        timer: {_rounded(callback.interval_ns or 0)}  # {MARK}: is this '
                        f'a timer? Proposed: the measured {_measured(callback)}')
            period_ns = callback.period_ns or 0
            if not MICROSECOND <= period_ns <= DAY:
                return (f'        # timer: 100ms  # {MARK}: its period is said to be '
                        f'{exact_duration(period_ns)}')
            return f'        timer: {_whole(period_ns)}'
        if callback.kind == 'sync':
            return f'        sync: [{", ".join(callback.starts)}]'
        return f'        {callback.kind}: {callback.starts[0]}'

    def _source(self, callback: SketchCallback) -> Iterator[str]:
        """Yield what concerns a source: the name of its DAG, and its period if it is no timer."""
        source = self._is_source(callback)
        known = callback.kind == 'timer' or callback.period_ns is not None
        if source and (callback.dag or self._sources[callback.node] > 1):
            dag = f'dag: {plain_scalar(callback.dag or callback.node + "/" + callback.name)}'
            blank = callback.kind == 'subscription' and not known
            yield f'        # {dag}  # {MARK}: with the period' if blank else f'        {dag}'
        if callback.kind in ('timer', 'sync'):
            return
        if source and known:
            yield f'        period: {exact_duration(callback.period_ns or 0)}'
            if callback.release_from != 'arrival':
                yield f'        release_from: {callback.release_from}'
        elif source:
            yield f'        # period: {self._period_blank(callback)}'
        elif callback.starts[0] not in self._publishers:
            yield f'        # {callback.starts[0]} has no known publisher yet: see its blanks'

    def _period_blank(self, callback: SketchCallback) -> str:
        what = ('the time between two requests' if callback.kind == 'service' else
                'nobody here publishes the topic; the time between two messages')
        if callback.interval_ns is not None:
            return (f'{_rounded(callback.interval_ns)}  # {MARK}: {what}; proposed: the measured '
                    f'{_measured(callback)}')
        return f'{"1s" if callback.kind == "service" else "100ms"}  # {MARK}: {what}'

    def _publishes(self, callback: SketchCallback) -> Iterator[str]:
        every = ', '.join(callback.publishes + callback.maybe)
        if callback.maybe:
            names = ', '.join(callback.maybe)
            yield f'        # publishes: [{every}]  # {MARK}: which callback publishes {names}?'
            if callback.publishes:
                yield '        # (instead of the next line)'
        if callback.publishes:
            yield f'        publishes: [{", ".join(callback.publishes)}]'

    def _deadline(self, callback: SketchCallback) -> str:
        if callback.deadline_ns is not None and not callback.maybe:
            return f'        deadline: {exact_duration(callback.deadline_ns)}'
        what = 'if it is a sink' if callback.maybe else 'a sink'
        if callback.key not in self._period:
            return (f'        # deadline: 100ms  # {MARK}: {what}; no source with a known period '
                    'leads here')
        source = self._period[callback.key]
        leads = 'timer' if source.kind == 'timer' else 'source'
        return (f'        # deadline: {_period(source)}  # {MARK}: {what}; proposed: the period '
                f'of the {leads} that leads here')

    def _paths(self) -> Iterator[str]:
        found = [(path, self._path_keys(path)) for path in self._sketch.paths]
        if any(keys for _, keys in found):
            yield 'paths:'
        for path, keys in found:
            if keys:
                yield f'  - name: {plain_scalar(path.name)}'
                yield '    callbacks:'
                yield from (f"      - '{key}'" for key in keys)
            else:
                chain = ' -> '.join(node for node, _, _ in path.steps)
                yield printable(f'# {MARK}: path {path.name}: which callbacks? {chain}')

    def _path_keys(self, path: SketchPath) -> list[str]:
        keys = []
        for node, taken, published in path.steps:
            fits = [c for c in self._callbacks if c.node == node
                    and (taken == UNDEFINED or taken in c.starts or taken in c.reads)
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


_Next = dict[str, list[tuple[str, SketchCallback]]]


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


def _period(source: SketchCallback) -> str:
    if source.period_ns is not None:
        return _whole(source.period_ns)
    return _rounded(source.interval_ns or 0)


def _whole(period_ns: int) -> str:
    """Return a timer's period as people write it: rounded to 1 us, where that changes little."""
    rounded = round(period_ns / MICROSECOND) * MICROSECOND
    close = abs(rounded - period_ns) <= _LITTLE * period_ns
    return exact_duration(rounded if close else period_ns)


def _rounded(nanoseconds: int) -> str:
    """Return a measured time with three digits."""
    digits = 10 ** max(0, len(str(nanoseconds)) - 3)
    return exact_duration(max(1_000, round(nanoseconds / digits) * digits))


def _measured(callback: SketchCallback) -> str:
    return f'time between two of its executions, {format_duration(callback.interval_ns or 0)}'


def _execution_time(time: ExecutionTime, count: int) -> Iterator[str]:
    yield f'        # measured in {count} execution{"s" * (count != 1)}'
    yield f'        execution_time: {quantiles_text(time)}'
