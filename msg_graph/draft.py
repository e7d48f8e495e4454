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
which is an entry once its first ``# `` is removed. While blanks are open, they are the errors of
the declaration (``open_blanks``), since most others follow from them:

1. *deadline* of a sink: the shortest period of the sources that lead to it; none, if it only
   stores a message, and is not the only result of its DAG.
2. *period* of a service, and of a subscription whose topic no callback publishes: the measured
   time between two of its executions, if there is one.
3. *publishes*, if it is unknown which of a node's callbacks publishes a topic: on each that may.
4. *timers* that are only assumed, because no known callback publishes a topic of their node.

``accept`` uses the recording instead of asking: measured periods and proposed deadlines become
entries, only recorded publications count, and a source with an unknown rate is left out
(``leave_out_sources``).  So is a callback that a rule of the model refuses, such as one of a
cycle: an accepted draft is always a valid declaration.

A recording may begin late or end early.  A draft names nothing that is not in it: variables and
topics that are read, topics of a sync, callbacks of a path.

A named path becomes an entry if each of its nodes has exactly one matching callback.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from msg_graph.blanks import MARK
from msg_graph.derive import loads
from msg_graph.duration import exact_duration, format_duration, MICROSECOND, SECOND
from msg_graph.errors import GraphError, printable
from msg_graph.language import PATH
from msg_graph.model import ExecutionTime, ReleaseFrom
from msg_graph.yamltext import plain_scalar

UNDEFINED = 'UNDEFINED'
"""CARET's word for the missing topic at the end of a path."""
LEFT_OUT = '# Left out:'
_LITTLE = 1e-4  # fraction of a period


@dataclass
class DraftCallback:
    """
    A callback.

    :ivar kind: ``timer``, ``subscription``, ``sync`` or ``service``.
    :ivar started_by: the topics that start it, or its service; empty for a timer.
    :ivar period_ns: its timer's period, None if the timer is only assumed; of another source its
        period, if known.
    :ivar publishes: topics that it certainly publishes.
    :ivar possible_topics: topics of its node that it may publish.
    :ivar reads: topics and callbacks of its node that it reads by queue edges.
    :ivar runs: how many executions of it were recorded; None: there is no recording.
    :ivar interval_ns: measured usual time between two of its executions.
    :ivar times: its measured execution time, and the number of measured executions.
    :ivar other_keys: other declared keys, with their values.
    :ivar sometimes: topics of ``publishes`` that it publishes only sometimes: in how many of how
        many executions, None if they are declared.
    :ivar judged: of a sink: False if it has no deadline.
    :ivar driven_by: of a sync of different rates, the topic of ``started_by`` that drives it.
    :ivar why: of a proposed sync, a comment with the reason.
    :ivar is_irregular: whether the times between its executions are irregular, or it is a service.
        If they vary, ``interval_ns`` is the least mean of several.
    :ivar came_once: whether it ran only once in a long recording, as for a latched topic.
    :ivar stores: whether it seems to only store its message: it is short and publishes nothing.
    """

    node: str
    name: str
    kind: str
    started_by: list[str] = field(default_factory=list)
    period_ns: int | None = None
    publishes: list[str] = field(default_factory=list)
    possible_topics: list[str] = field(default_factory=list)
    reads: list[str] = field(default_factory=list)
    group: str | None = None
    dag: str | None = None
    deadline_ns: int | None = None
    release_from: ReleaseFrom = 'arrival'
    runs: int | None = None
    interval_ns: int | None = None
    times: tuple[ExecutionTime, int] | None = None
    other_keys: dict[str, str] = field(default_factory=dict)
    sometimes: dict[str, tuple[int, int] | None] = field(default_factory=dict)
    judged: bool = True
    driven_by: str | None = None
    why: str = ''
    is_irregular: bool = False
    came_once: bool = False
    stores: bool = False

    @property
    def triggers(self) -> list[str]:
        """Return the topics that start it in a DAG."""
        if self.kind not in ('subscription', 'sync'):
            return []
        return self.started_by if self.driven_by is None else [self.driven_by]

    @property
    def key(self) -> str:
        """Return the callback's key in a declaration."""
        return f'{self.node}:{self.name}'

    @property
    def source_period_ns(self) -> int | None:
        """Return the time between two releases if this is a source, if known."""
        if self.came_once and self.period_ns is None:
            return SECOND
        return self.period_ns or self.interval_ns


@dataclass
class DraftNode:
    """A node with its callbacks by name, and the topics it subscribes without a callback."""

    name: str
    callbacks: dict[str, DraftCallback] = field(default_factory=dict)
    polled_topics: list[str] = field(default_factory=list)


@dataclass
class DraftPath:
    """
    A named path: node, subscribed and published topic of each step, or keys of callbacks.

    ``also`` has further entries of a path that is declared already.
    """

    name: str
    steps: list[tuple[str, str, str]]
    keys: list[str] = field(default_factory=list)
    other_keys: dict[str, str] = field(default_factory=dict)


@dataclass
class Draft:
    """
    A system.

    :ivar origin: the source of the draft, for the first line of the declaration.
    :ivar processes: the nodes of each process; empty: one process.
    :ivar left_out: callbacks missing from the declaration, with the reason.
    """

    origin: str
    nodes: list[DraftNode]
    paths: list[DraftPath] = field(default_factory=list)
    workers: int | None = None
    processes: dict[str, list[str]] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)

    def callbacks(self) -> Iterator[DraftCallback]:
        """Yield the callbacks of all nodes."""
        for node in self.nodes:
            yield from node.callbacks.values()


def leave_out_sources(
    draft: Draft, which: Callable[[DraftCallback], bool], reason: str
) -> None:
    """Leave out some sources, and callbacks whose topics lose all publishers by that."""
    while True:
        published = {topic for callback in draft.callbacks()
                     for topic in callback.publishes + callback.possible_topics}
        found = {callback.key: reason for callback in draft.callbacks()
                 if _is_source(callback, published) and which(callback)}
        for callback in draft.callbacks():
            missing = [topic for topic in callback.triggers if topic not in published]
            if callback.kind == 'sync' and callback.driven_by is None and missing:
                found[callback.key] = f'no callback publishes {missing[0]}'
        if not found:
            return
        _leave_out(draft, found)


def _leave_out(draft: Draft, reasons: Mapping[str, str]) -> None:
    """Leave out callbacks, each with a reason."""
    for node in draft.nodes:
        for callback in list(node.callbacks.values()):
            if callback.key in reasons:
                del node.callbacks[callback.name]
                what = ' '.join((callback.kind, *callback.started_by))
                draft.left_out.append(f'{callback.key} ({what}): {reasons[callback.key]}')
    draft.nodes = [node for node in draft.nodes if node.callbacks]
    leave_out_paths(draft)


def leave_out_paths(draft: Draft) -> None:
    """Leave out declared paths of which a callback is not in the draft."""
    keys = {callback.key for callback in draft.callbacks()}
    for path in list(draft.paths):
        missing = next((key for key in path.keys if key not in keys), None)
        if missing is not None:
            draft.paths.remove(path)
            draft.left_out.append(f'path {path.name}: {missing} is not in it')


def _is_source(callback: DraftCallback, published: Container[str]) -> bool:
    if callback.kind == 'sync' and callback.driven_by is None:
        return False
    return not callback.triggers or callback.triggers[0] not in published


def accept(draft: Draft) -> None:
    """Replace unknown values by recorded ones, so that the periods of all sources are known."""
    for callback in draft.callbacks():
        callback.possible_topics.clear()
    while True:
        leave_out_sources(draft, lambda callback: callback.source_period_ns is None,
                          'its rate is unknown')
        if not draft.nodes:
            return
        writer = _Writer(draft, accepted=True)
        try:
            loads('\n'.join(writer.lines()))
            return
        except GraphError as error:
            _leave_out_refused(draft, writer, error)


def _leave_out_refused(draft: Draft, writer: _Writer, error: GraphError) -> None:
    """Leave out the callback, or the path, that an error of the drafted declaration is about."""
    entry = writer.entry_at(error.line or 0)
    reason = error.problem.partition(': ')[2] or error.problem    # without the entry's name
    if isinstance(entry, DraftCallback):
        _leave_out(draft, {entry.key: reason})
    elif isinstance(entry, DraftPath):
        draft.paths.remove(entry)
        draft.left_out.append(f'path {entry.name}: {reason}')
    else:
        raise error


def declaration_of(draft: Draft, accepted: bool = False) -> str:
    """Return the text of a declaration; proposals are entries if accepted, else blanks."""
    return '\n'.join(_Writer(draft, accepted).lines()) + '\n'


class _Writer:

    def __init__(self, draft: Draft, accepted: bool) -> None:
        self._draft = draft
        self._accepted = accepted
        self._callbacks = list(draft.callbacks())
        self._published = {topic for each in self._callbacks for topic in each.publishes}
        self._perhaps_published = self._published.union(
            topic for each in self._callbacks for topic in each.possible_topics)
        self._started: dict[str, list[DraftCallback]] = {}
        for callback in self._callbacks:
            for topic in callback.triggers:
                self._started.setdefault(topic, []).append(callback)
        self._fastest = self._fastest_sources()
        self._only_results = self._find_only_results()
        # the entry that begins with the next line, and the entries by their first line, from 1
        self._next: DraftCallback | DraftPath | None = None
        self._entries_at: dict[int, DraftCallback | DraftPath] = {}

    def entry_at(self, line: int) -> DraftCallback | DraftPath | None:
        """Return the callback or path that a line belongs to, once all lines have been made."""
        first = max((number for number in self._entries_at if number <= line), default=None)
        return None if first is None else self._entries_at[first]

    def _is_source(self, callback: DraftCallback) -> bool:
        return _is_source(callback, self._perhaps_published)

    def _fastest_sources(self) -> dict[str, DraftCallback]:
        """Return by callback the source with the shortest period that may lead to it."""
        found: dict[str, DraftCallback] = {}
        sources = [c for c in self._callbacks if self._is_source(c) and c.source_period_ns]
        for source in sorted(sources, key=lambda c: c.source_period_ns or 0):
            stack = [source]
            while stack:
                callback = stack.pop()
                if callback.key not in found:
                    found[callback.key] = source
                    stack.extend(after for topic in callback.publishes + callback.possible_topics
                                 for after in self._started.get(topic, ()))
        return found

    def _find_only_results(self) -> set[str]:
        """
        Return the callbacks that only store messages of a DAG without other sinks.

        What they store is the result of that DAG: without a deadline for it nothing of the DAG
        would be judged, and its source would be less urgent than its period.
        """
        found: set[str] = set()
        for source in filter(self._is_source, self._callbacks):
            seen, stack = {source.key: source}, [source]
            while stack:
                callback = stack.pop()
                for topic in callback.publishes + callback.possible_topics:
                    for after in self._started.get(topic, ()):
                        if after.key not in seen:
                            seen[after.key] = after
                            stack.append(after)
            sinks = [each for each in seen.values()
                     if self._started.keys().isdisjoint(each.publishes)]
            if source not in sinks and all(each.stores for each in sinks):
                found.update(each.key for each in sinks)
        return found

    def lines(self) -> Iterator[str]:
        """Yield the lines of the declaration."""
        for number, line in enumerate(self._lines(), 1):
            if self._next is not None:
                self._entries_at[number], self._next = self._next, None
            yield line

    def _lines(self) -> Iterator[str]:
        yield f'# From {printable(self._draft.origin)}.'
        if self._accepted:
            yield "# Values marked 'proposed' come from the recording, not from requirements."
        else:
            yield f"# Lines with '{MARK}' are blanks: correct the value, then remove the '# '."
            yield "# 'mddag graph check' lists what is still open."
        yield from (f'{LEFT_OUT} {printable(text)}' for text in self._draft.left_out)
        yield 'mddag: 1'
        if self._draft.workers is not None:
            yield f'workers: {self._draft.workers}'
        if self._draft.processes:
            yield 'processes:'
            yield from (f'  {plain_scalar(name)}: {_listed(nodes)}'
                        for name, nodes in self._draft.processes.items())
        yield 'nodes:'
        for node in self._draft.nodes:
            yield f'  - node: {plain_scalar(node.name)}'
            yield '    callbacks:'
            yield from self._possible_syncs(node)
            for callback in node.callbacks.values():
                self._next = callback
                yield f'      - name: {plain_scalar(callback.name)}'
                yield from (f'        {line}' for line in self._entries(callback))
        yield from self._paths()

    def _possible_syncs(self, node: DraftNode) -> Iterator[str]:
        """Yield a comment on the subscriptions of a node that one source leads to."""
        topics: dict[str, list[str]] = {}
        for callback in node.callbacks.values():
            source = self._fastest.get(callback.key)
            if callback.kind == 'subscription' and source and not self._is_source(callback):
                topics.setdefault(source.key, []).append(plain_scalar(callback.started_by[0]))
        for each in topics.values():
            if len({*each}) > 1:
                yield ('      # If these are one sync, declare one callback: '
                       f'sync: [{", ".join(each)}]')

    def _entries(self, callback: DraftCallback) -> Iterator[str]:
        if callback.kind == 'timer':
            yield _timer(callback)
        elif callback.driven_by is not None:
            yield (f'sync: {{topics: {_listed(callback.started_by)}, '
                   f'driven_by: {callback.driven_by}}}{callback.why}')
        elif callback.kind == 'sync':
            yield f'sync: {_listed(callback.started_by)}{callback.why}'
        else:
            yield f'{callback.kind}: {callback.started_by[0]}'
        if callback.dag and self._is_source(callback):
            yield f'dag: {plain_scalar(callback.dag)}'
        if callback.kind in ('subscription', 'service') or callback.driven_by is not None:
            yield from self._period(callback)
        if callback.group is not None:
            yield f'group: {plain_scalar(callback.group)}'
        if callback.possible_topics:
            yield _blank(f'publishes: {_listed(callback.publishes + callback.possible_topics)}',
                         f'which callback publishes {", ".join(callback.possible_topics)}?')
            if callback.publishes:
                yield '# (instead of the next line)'
        if always := [t for t in callback.publishes if t not in callback.sometimes]:
            yield f'publishes: {_listed(always)}'
        yield from self._sometimes(callback)
        if reads := [read for read in callback.reads if self._is_known(callback.node, read)]:
            yield f'reads: {_listed(map(plain_scalar, reads))}'
        if self._started.keys().isdisjoint(callback.publishes):
            yield self._deadline(callback)
        yield from (f'{key}: {value}' for key, value in callback.other_keys.items())
        if callback.times is not None:
            yield from _execution_time(*callback.times)

    def _is_known(self, node: str, read: str) -> bool:
        """Return whether a topic, or a variable of a node, that is read is in the draft."""
        return read in self._perhaps_published if read.startswith('/') else any(
            callback.key == f'{node}:{read}' for callback in self._callbacks)

    @staticmethod
    def _sometimes(callback: DraftCallback) -> Iterator[str]:
        """Yield the topics that a callback publishes only in some executions."""
        if callback.sometimes:
            seen = [f'{topic} in {counts[0]} of {counts[1]} executions'
                    for topic, counts in callback.sometimes.items() if counts is not None]
            yield (f'may_publish: {_listed(callback.sometimes)}'
                   + (f'  # published {", ".join(seen)}' if seen else ''))

    def _period(self, callback: DraftCallback) -> Iterator[str]:
        """Yield the period of a subscription or service that is a source."""
        is_service = callback.kind == 'service'
        what = ('the time between two requests' if is_service else
                'no callback here publishes the topic; the time between two messages')
        if not self._is_source(callback):
            if callback.started_by[0] not in self._published:
                yield f'# {callback.started_by[0]} has no known publisher yet: see its blanks'
        elif callback.period_ns is not None:
            yield f'period: {exact_duration(callback.period_ns)}'
            if callback.release_from != 'arrival':
                yield f'release_from: {callback.release_from}'
        elif callback.is_irregular:
            yield self._proposal(
                f'period: {_rounded(callback.interval_ns or 0)}', what,
                'the usual measured time between two of its executions; if that varies, the least '
                'mean of several')
            yield self._proposal(
                'sporadic: true', 'whether it has no fixed rate',
                'requests come when they are needed' if is_service else 'its rate is irregular')
        elif callback.came_once:
            yield self._proposal('period: 1s', what, 'it ran only once')
            yield self._proposal('sporadic: true', 'whether it has no fixed rate',
                                 'it ran only once')
        elif callback.interval_ns is not None:
            yield self._proposal(
                f'period: {_rounded(callback.interval_ns)}', what, _measured(callback))
        else:
            yield _blank(f'period: {"1s" if is_service else "100ms"}', what)

    def _proposal(self, entry: str, what: str, why: str) -> str:
        """Return the line of a proposed entry: a blank, or the entry if proposals are accepted."""
        if self._accepted:
            return f'{entry}  # proposed: {why}'
        return _blank(entry, f'{what}; proposed: {why}')

    def _deadline(self, callback: DraftCallback) -> str:
        if not callback.judged:
            return 'deadline: none'
        if callback.deadline_ns is not None and not callback.possible_topics:
            return f'deadline: {exact_duration(callback.deadline_ns)}'
        what = 'if it is a sink' if callback.possible_topics else 'a sink'
        if (callback.stores and not callback.possible_topics
                and callback.key not in self._only_results):
            return self._proposal('deadline: none', what, 'it seems to only store its message')
        source = self._fastest.get(callback.key)
        if source is None:
            return _blank('deadline: 100ms', f'{what}; no source with a known period leads here')
        usual = (_rounded(source.source_period_ns or 0) if source.period_ns is None
                 else _whole(source.period_ns))
        kind = 'timer' if source.kind == 'timer' else 'source'
        return self._proposal(
            f'deadline: {usual}', what, f'the period of the {kind} that leads here')

    def _paths(self) -> Iterator[str]:
        found = [(path, self._path_keys(path)) for path in self._draft.paths]
        if any(keys for _, keys in found):
            yield 'paths:'
        for path, keys in found:
            if keys:
                self._next = path
                yield f'  - name: {plain_scalar(path.name)}'
                yield '    callbacks:'
                yield from (f"      - '{key}'" for key in keys)
                yield from (f'    {key}: {value}' for key, value in path.other_keys.items())
            else:
                chain = ' -> '.join([*path.keys, *(node for node, _, _ in path.steps)])
                yield printable(f'# {MARK}: path {path.name}: which callbacks? {chain}')

    def _path_keys(self, path: DraftPath) -> list[str]:
        """Return the callbacks of a path if each of its steps has exactly one, else none."""
        choices = [[c for c in self._callbacks if c.key == key][:1] for key in path.keys]
        choices += [[c for c in self._callbacks if c.node == node
                     and (taken == UNDEFINED or taken in c.started_by or taken in c.reads)
                     and (published == UNDEFINED or published in c.publishes)]
                    for node, taken, published in path.steps]
        if (len(choices) < 2 or any(len(fits) != 1 for fits in choices)
                or not PATH.fits(path.name)):
            return []
        return [fits[0].key for fits in choices]


def _blank(entry: str, what: str) -> str:
    return f'# {entry}  # {MARK}: {what}'


def _listed(texts: Iterable[str]) -> str:
    return f'[{", ".join(texts)}]'


def _timer(callback: DraftCallback) -> str:
    if callback.period_ns is not None:
        return f'timer: {_whole(callback.period_ns)}'
    if callback.interval_ns is None:
        return _blank('timer: 100ms', 'what starts it? Remove it if the node has no callbacks')
    return (f'timer: {_rounded(callback.interval_ns)}  # {MARK}: is this a timer? '
            f'Proposed: {_measured(callback)}')


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
    return ('the measured time between two of its executions, '
            f'{format_duration(callback.interval_ns or 0)}')


def _execution_time(time: ExecutionTime, count: int) -> Iterator[str]:
    quantiles = [f'{ns / 1000:.3f}'.rstrip('0').rstrip('.') for ns in time.quantiles_ns]
    percent = [repr(share).removesuffix('.0') for share in time.percent]
    yield f'# measured in {count} execution{"s" * (count != 1)}'
    yield f'execution_time: {{quantiles_us: {_listed(quantiles)}, percent: {_listed(percent)}}}'
