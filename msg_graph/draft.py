# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Drafts of declarations: a system as known from a file, a trace or the running system.

Theory of operation
-------------------
Drafts come from CARET architecture files (``caret``), from traces and from running systems. The
code that makes a draft checks the names in it. ``declaration_of`` writes it as a declaration to
fill in.

Known values become entries. An unknown value becomes a comment with ``FILL IN`` and a proposal,
which is an entry once its first ``# `` is removed. ``mddag graph check`` lists all open blanks
(``open_blanks``) instead of the errors that follow from them:

1. *deadline* of a sink: the shortest period of the sources that lead to it.
2. *period* of a service, and of a subscription whose topic no callback publishes: the measured
   time between two of its executions, if there is one.
3. *publishes*, if it is unknown which of a node's callbacks publishes a topic: on each that may.
4. *timers* that are only assumed, because no known callback publishes a topic of their node.

``accept`` uses the recording instead of asking: measured periods and proposed deadlines become
entries, only recorded publications count, and a source with an unknown rate is left out
(``leave_out_sources``).

A named path becomes an entry if each of its nodes has exactly one matching callback.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass, field
import re

from msg_graph.duration import DAY, exact_duration, format_duration, MICROSECOND
from msg_graph.errors import GraphError, printable, together
from msg_graph.language import PATH
from msg_graph.model import ExecutionTime, ReleaseFrom
from msg_graph.yamltext import plain_scalar

UNDEFINED = 'UNDEFINED'
"""CARET's word for the missing topic at the end of a path."""
MARK = 'FILL IN'
LEFT_OUT = '# Left out:'
_OPEN = re.compile(rf'\s*#\s+(?:(\w+:).*\s#\s+)?{MARK}: (.*)')
_ENTRY = re.compile(r'\s*- (?:name|node):|\s*-\s*\{')
_LITTLE = 1e-4  # fraction of a period


@dataclass
class DraftCallback:
    """
    A callback.

    :ivar kind: ``timer``, ``subscription``, ``sync`` or ``service``.
    :ivar starts: the topics that start it, or its service; empty for a timer.
    :ivar period_ns: its timer's period; of another source its period, if known.
    :ivar publishes: topics that it certainly publishes.
    :ivar maybe: topics of its node that it may publish.
    :ivar reads: topics and callbacks of its node that it reads by queue edges.
    :ivar runs: how many executions of it were recorded; None: there is no recording.
    :ivar interval_ns: measured mean time between two of its executions.
    :ivar times: its measured execution time, and the number of measured executions.
    :ivar guessed: whether the timer is only assumed.
    :ivar also: other declared keys, with their values.
    """

    node: str
    name: str
    kind: str
    starts: list[str] = field(default_factory=list)
    period_ns: int | None = None
    publishes: list[str] = field(default_factory=list)
    maybe: list[str] = field(default_factory=list)
    reads: list[str] = field(default_factory=list)
    group: str | None = None
    dag: str | None = None
    deadline_ns: int | None = None
    release_from: ReleaseFrom = 'arrival'
    runs: int | None = None
    interval_ns: int | None = None
    times: tuple[ExecutionTime, int] | None = None
    guessed: bool = False
    also: dict[str, str] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """Return the callback's key in a declaration."""
        return f'{self.node}:{self.name}'

    @property
    def source_period_ns(self) -> int | None:
        """Return the time between two releases if this is a source, if known."""
        return self.interval_ns if self.period_ns is None else self.period_ns


@dataclass
class DraftNode:
    """A node with its callbacks by name, and the topics it subscribes without a callback."""

    name: str
    callbacks: dict[str, DraftCallback] = field(default_factory=dict)
    taken: list[str] = field(default_factory=list)


@dataclass
class DraftPath:
    """A named path: node, subscribed and published topic of each step, or keys of callbacks."""

    name: str
    steps: list[tuple[str, str, str]]
    keys: list[str] = field(default_factory=list)


@dataclass
class Draft:
    """
    A system.

    :ivar origin: the source of the draft, for the first line of the declaration.
    :ivar left_out: callbacks missing from the declaration, with the reason.
    """

    origin: str
    nodes: list[DraftNode]
    paths: list[DraftPath] = field(default_factory=list)
    workers: int | None = None
    left_out: list[str] = field(default_factory=list)

    def callbacks(self) -> Iterator[DraftCallback]:
        """Yield the callbacks of all nodes."""
        for node in self.nodes:
            yield from node.callbacks.values()


def leave_out_sources(draft: Draft, reason: Callable[[DraftCallback], str]) -> None:
    """
    Leave out sources, and callbacks that become sources because their topics lose the publisher.

    :param reason: returns why a source is left out; an empty text keeps it.
    """
    while True:
        published = {topic for callback in draft.callbacks()
                     for topic in callback.publishes + callback.maybe}
        found = {callback.key: why for callback in draft.callbacks()
                 if _is_source(callback, published) and (why := reason(callback))}
        if not found:
            return
        for node in draft.nodes:
            for callback in list(node.callbacks.values()):
                if callback.key in found:
                    del node.callbacks[callback.name]
                    what = ' '.join((callback.kind, *callback.starts))
                    draft.left_out.append(f'{callback.key} ({what}): {found[callback.key]}')
        draft.nodes = [node for node in draft.nodes if node.callbacks]


def _is_source(callback: DraftCallback, published: Container[str]) -> bool:
    return callback.kind != 'sync' and (
        callback.kind != 'subscription' or callback.starts[0] not in published)


def accept(draft: Draft) -> None:
    """Replace unknown values by recorded ones, so that the periods of all sources are known."""
    for callback in draft.callbacks():
        callback.maybe.clear()
    leave_out_sources(draft, _without_rate)


def _without_rate(callback: DraftCallback) -> str:
    if callback.guessed:
        return 'nothing is recorded that starts it'
    if callback.kind == 'timer' and not _is_timer_period(callback.period_ns or 0):
        return f'its period is said to be {format_duration(callback.period_ns or 0)}'
    if callback.source_period_ns is not None:
        return ''
    return 'it ran once, which gives no rate' if callback.runs == 1 else 'it never ran'


def _is_timer_period(period_ns: int) -> bool:
    return MICROSECOND <= period_ns <= DAY


def declaration_of(draft: Draft, accepted: bool = False) -> str:
    """
    Return the text of a declaration.

    :param accepted: proposals for periods and deadlines become entries, else marked blanks.
    """
    return '\n'.join(_Writer(draft, accepted).lines()) + '\n'


def open_blanks(text: str, file: str) -> list[GraphError]:
    """Return an error for each open blank in a declaration."""
    return [GraphError(
        file, number,
        f"{match[1] or 'this'} is a blank to fill in ({match[2]})",
        "correct the value and take the '# ' away" if match[1] else 'do so, then remove the line')
        for number, line in enumerate(text.splitlines(), 1)
        if MARK in line and (match := _OPEN.fullmatch(line)) is not None]


def with_blanks(error: GraphError, text: str, file: str) -> GraphError:
    """Return an error with the blanks of its file, without the errors that these cause."""
    blanks = open_blanks(text, file)
    if not blanks:
        return error
    starts = [number for number, line in enumerate(text.splitlines(), 1) if _ENTRY.match(line)]
    unfinished = {bisect_right(starts, blank.line or 0) for blank in blanks}
    others = [each for each in error.errors if each.file != file or each.line is None
              or bisect_right(starts, each.line) not in unfinished]
    return together([*blanks, *others])


class _Writer:

    def __init__(self, draft: Draft, accepted: bool) -> None:
        self._draft = draft
        self._accepted = accepted
        self._callbacks = list(draft.callbacks())
        self._publishers: dict[str, list[DraftCallback]] = {}
        self._started: dict[str, list[DraftCallback]] = {}
        for callback in self._callbacks:
            for topic in callback.publishes:
                self._publishers.setdefault(topic, []).append(callback)
            if callback.kind in ('subscription', 'sync'):
                for topic in callback.starts:
                    self._started.setdefault(topic, []).append(callback)
        self._published = {*self._publishers, *(
            topic for callback in self._callbacks for topic in callback.maybe)}
        self._period = self._shortest_periods()

    def _is_source(self, callback: DraftCallback) -> bool:
        return _is_source(callback, self._published)

    def _shortest_periods(self) -> dict[str, DraftCallback]:
        """Return by callback the source with the shortest period that may lead to it."""
        found: dict[str, DraftCallback] = {}
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
        yield f'# From {printable(self._draft.origin)}.'
        if self._accepted:
            yield "# Values marked 'proposed' come from the recording, not from requirements."
        else:
            yield f"# Lines with '{MARK}' are blanks: correct the value, then take the '# ' away."
            yield "# 'mddag graph check' lists what is still open."
        yield from (f'{LEFT_OUT} {printable(text)}' for text in self._draft.left_out)
        yield 'mddag: 1'
        if self._draft.workers is not None:
            yield f'workers: {self._draft.workers}'
        yield 'nodes:'
        for node in self._draft.nodes:
            yield f'  - node: {plain_scalar(node.name)}'
            yield '    callbacks:'
            yield from self._possible_syncs(node)
            for callback in node.callbacks.values():
                yield from self._callback(callback)
        yield from self._paths()

    def _possible_syncs(self, node: DraftNode) -> Iterator[str]:
        """Yield a comment on the subscriptions of a node that one source leads to."""
        topics: dict[str, list[str]] = {}
        for callback in node.callbacks.values():
            if callback.kind == 'subscription' and not self._is_source(callback) and (
                    source := self._period.get(callback.key)):
                topics.setdefault(source.key, []).append(plain_scalar(callback.starts[0]))
        for each in topics.values():
            if len({*each}) > 1:
                yield ('      # If these are one sync, declare one callback: '
                       f'sync: [{", ".join(each)}]')

    def _callback(self, callback: DraftCallback) -> Iterator[str]:
        yield f'      - name: {plain_scalar(callback.name)}'
        yield self._trigger(callback)
        yield from self._source(callback)
        if callback.group is not None:
            yield f'        group: {plain_scalar(callback.group)}'
        yield from self._publishes(callback)
        if callback.reads:
            yield f'        reads: [{", ".join(map(plain_scalar, callback.reads))}]'
        if not any(topic in self._started for topic in callback.publishes):
            yield self._deadline(callback)
        yield from (f'        {key}: {value}' for key, value in callback.also.items())
        if callback.times is not None:
            yield from _execution_time(*callback.times)

    def _trigger(self, callback: DraftCallback) -> str:
        if callback.kind == 'timer':
            if callback.guessed and not (callback.publishes or callback.maybe):
                return (f'        # timer: 100ms  # {MARK}: what starts it? Nothing is seen of '
                        'the node but its name; remove it if it has no callbacks')
            if callback.guessed and callback.interval_ns is None:
                return (f'        # timer: 100ms  # {MARK}: what starts it? No message came while '
                        'the system was probed')
            if callback.guessed:
                return (f'        timer: {_rounded(callback.interval_ns or 0)}  # {MARK}: is this '
                        f'a timer? Proposed: the measured {_measured(callback)}')
            period_ns = callback.period_ns or 0
            if not _is_timer_period(period_ns):
                return (f'        # timer: 100ms  # {MARK}: its period is said to be '
                        f'{exact_duration(period_ns)}')
            return f'        timer: {_whole(period_ns)}'
        if callback.kind == 'sync':
            return f'        sync: [{", ".join(callback.starts)}]'
        return f'        {callback.kind}: {callback.starts[0]}'

    def _source(self, callback: DraftCallback) -> Iterator[str]:
        """Yield the entries of a source: the name of its DAG, and its period if it is no timer."""
        source = self._is_source(callback)
        if source and callback.dag:
            yield f'        dag: {plain_scalar(callback.dag)}'
        if callback.kind in ('timer', 'sync'):
            return
        if source and callback.period_ns is not None:
            yield f'        period: {exact_duration(callback.period_ns)}'
            if callback.release_from != 'arrival':
                yield f'        release_from: {callback.release_from}'
        elif source:
            yield self._period_line(callback)
        elif callback.starts[0] not in self._publishers:
            yield f'        # {callback.starts[0]} has no known publisher yet: see its blanks'

    def _proposal(self, entry: str, what: str, why: str) -> str:
        """Return the line of a proposed entry: a blank, or the entry if proposals are accepted."""
        if self._accepted:
            return f'        {entry}  # proposed: {why}'
        return f'        # {entry}  # {MARK}: {what}; proposed: {why}'

    def _period_line(self, callback: DraftCallback) -> str:
        what = ('the time between two requests' if callback.kind == 'service' else
                'no callback here publishes the topic; the time between two messages')
        if callback.interval_ns is not None:
            return self._proposal(f'period: {_rounded(callback.interval_ns)}', what,
                                  f'the measured {_measured(callback)}')
        default = '1s' if callback.kind == 'service' else '100ms'
        return f'        # period: {default}  # {MARK}: {what}'

    def _publishes(self, callback: DraftCallback) -> Iterator[str]:
        every = ', '.join(callback.publishes + callback.maybe)
        if callback.maybe:
            names = ', '.join(callback.maybe)
            yield f'        # publishes: [{every}]  # {MARK}: which callback publishes {names}?'
            if callback.publishes:
                yield '        # (instead of the next line)'
        if callback.publishes:
            yield f'        publishes: [{", ".join(callback.publishes)}]'

    def _deadline(self, callback: DraftCallback) -> str:
        if callback.deadline_ns is not None and not callback.maybe:
            return f'        deadline: {exact_duration(callback.deadline_ns)}'
        what = 'if it is a sink' if callback.maybe else 'a sink'
        if callback.key not in self._period:
            return (f'        # deadline: 100ms  # {MARK}: {what}; no source with a known period '
                    'leads here')
        source = self._period[callback.key]
        leads = 'timer' if source.kind == 'timer' else 'source'
        return self._proposal(f'deadline: {_period(source)}', what,
                              f'the period of the {leads} that leads here')

    def _paths(self) -> Iterator[str]:
        found = [(path, self._path_keys(path)) for path in self._draft.paths]
        if any(keys for _, keys in found):
            yield 'paths:'
        for path, keys in found:
            if keys:
                yield f'  - name: {plain_scalar(path.name)}'
                yield '    callbacks:'
                yield from (f"      - '{key}'" for key in keys)
            else:
                chain = ' -> '.join([*path.keys, *(node for node, _, _ in path.steps)])
                yield printable(f'# {MARK}: path {path.name}: which callbacks? {chain}')

    def _path_keys(self, path: DraftPath) -> list[str]:
        keys = [callback.key for key in path.keys for callback in self._callbacks
                if callback.key == key]
        if len(keys) < len(path.keys):
            return []
        for node, taken, published in path.steps:
            fits = [c for c in self._callbacks if c.node == node
                    and (taken == UNDEFINED or taken in c.starts or taken in c.reads)
                    and (published == UNDEFINED or published in c.publishes)]
            if len(fits) != 1:
                return []
            keys.append(fits[0].key)
        return keys if len(keys) > 1 and PATH.check(path.name) is None else []


def _period(source: DraftCallback) -> str:
    if source.period_ns is not None:
        return _whole(source.period_ns)
    return _rounded(source.interval_ns or 0)


def _whole(period_ns: int) -> str:
    """Return a timer's period rounded to 1 us, if that changes little."""
    rounded = round(period_ns / MICROSECOND) * MICROSECOND
    close = abs(rounded - period_ns) <= _LITTLE * period_ns
    return exact_duration(rounded if close else period_ns)


def _rounded(nanoseconds: int) -> str:
    """Return a measured time with three significant digits."""
    digits = 10 ** max(0, len(str(nanoseconds)) - 3)
    return exact_duration(max(1_000, round(nanoseconds / digits) * digits))


def _measured(callback: DraftCallback) -> str:
    return f'time between two of its executions, {format_duration(callback.interval_ns or 0)}'


def _execution_time(time: ExecutionTime, count: int) -> Iterator[str]:
    quantiles = ', '.join(f'{ns / 1000:.3f}'.rstrip('0').rstrip('.') for ns in time.quantiles_ns)
    percent = ', '.join(repr(share).removesuffix('.0') for share in time.percent)
    yield f'        # measured in {count} execution{"s" * (count != 1)}'
    yield f'        execution_time: {{quantiles_us: [{quantiles}], percent: [{percent}]}}'
