# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The declaration language: YAML to callbacks, each entry checked by itself.

Entries do not depend on each other, so the first error of each is collected and all are raised
together. What needs more than one entry to judge (publishers, cycles, sinks, sources, …) is
``derive``'s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

from msg_graph.duration import DAY, format_duration
from msg_graph.errors import Collector, GraphError, shown
from msg_graph.fields import (
    check_callback,
    check_dag,
    check_group,
    check_key,
    check_node,
    check_path,
    check_read,
    check_service,
    check_topic,
    Fields,
)
from msg_graph.include import Assembler, is_composed, Part
from msg_graph.model import Callback, ExecutionTime, Kind, OnMiss, Path, ReleaseFrom
from msg_graph.yamltext import Mapping, parse_yaml, Scalar, Tree

FORMAT = '1'
MOST_WORKERS = 1024
MOST_ACTIVE_JOBS = 1_000_000

FILE_KEYS = ('mddag', 'arguments', 'include', 'workers', 'nodes', 'paths')
NODE_KEYS = ('node', 'callbacks')
TRIGGERS = ('timer', 'subscription', 'sync', 'service')
CALLBACK_KEYS = (
    'name', *TRIGGERS, 'period', 'publishes', 'reads', 'deadline', 'release_from',
    'execution_time', 'holds_interpreter', 'group', 'dag', 'on_miss', 'max_active_jobs')
PATH_KEYS = ('name', 'callbacks')
TIME_KEYS = ('quantiles_us', 'percent')
RELEASE_FROM = ('arrival', 'source_timestamp', 'header_stamp')
ON_MISS = ('continue', 'abort')

# The quantiles that the published figures of the Autoware workload come with.
_PERCENT_29 = (
    0.0, 0.1, 0.5, 1.0, 2.0, *(float(percent) for percent in range(5, 100, 5)),
    98.0, 99.0, 99.5, 99.9, 100.0)


@dataclass(frozen=True, slots=True)
class Entry:
    """A callback and the mapping that declares it, which knows the lines."""

    callback: Callback
    fields: Fields


@dataclass(frozen=True, slots=True)
class PathEntry:
    """A path and the mapping that declares it."""

    path: Path
    fields: Fields


@dataclass(frozen=True, slots=True)
class Declaration:
    """
    A declaration as it stands in its files; callbacks in the order of the file.

    :ivar composed: whether it is put together, so that its text is not that of one file.
    """

    file: str
    workers: int | None
    entries: tuple[Entry, ...]
    paths: tuple[PathEntry, ...]
    composed: bool = False


def parse_declaration(text: str, file: str, path: str | None = None) -> Declaration:
    """
    Return the declaration that a YAML text holds, with all that it includes.

    :param path: the file that it was read from, if it was; beside it others are looked for.
    :raises GraphError: it is not YAML, or an entry is wrong by itself.
    """
    tree = parse_yaml(text, file)
    if tree is None or (isinstance(tree, Scalar) and tree.is_null):
        raise GraphError(
            file, None, 'the file is empty', "write a declaration that starts with 'mddag: 1'")
    if not isinstance(tree, Mapping):
        raise GraphError(
            file, tree.line, 'this is not a declaration', "write one that starts with 'mddag: 1'")
    fields = Fields(tree, file, 'the declaration', FILE_KEYS)
    fields.text('mddag', _check_format)
    parts = None
    if is_composed(tree):
        tree, parts = Assembler(path, FILE_KEYS, _check_format).assemble(tree, file)
        fields = Fields(tree, file, 'the declaration', FILE_KEYS)
    found = Collector()
    workers: int | None = None
    entries: tuple[Entry, ...] = ()
    paths: tuple[PathEntry, ...] = ()
    with found:
        workers = fields.integer_or_none('workers', 1, MOST_WORKERS)
    with found:
        nodes = [] if parts is None else parts.nodes
        entries = _entries(
            nodes or [(each, file) for each in fields.sequence('nodes')], file)
    with found:
        if parts is not None:
            paths = _paths(parts.paths)
        elif fields.has('paths'):
            paths = _paths([(each, file) for each in fields.sequence('paths')])
    found.check()
    return Declaration(file, workers, entries, paths, parts is not None)


def _check_format(text: str) -> tuple[str, str] | None:
    if text == FORMAT:
        return None
    return f'{shown(text)} is no known version of the format', f"write 'mddag: {FORMAT}'"


def _entries(nodes: list[Part], top: str) -> tuple[Entry, ...]:
    entries: dict[str, Entry] = {}
    found = Collector()
    for place, (tree, file) in enumerate(nodes, 1):
        with found:
            fields = Fields(tree, file, f'node {place}', NODE_KEYS)
            node = fields.text('node', check_node)
            fields.entry = f'node {shown(node)}'
            for number, callback_tree in enumerate(fields.sequence('callbacks'), 1):
                with found:
                    _add_entry(entries, callback_tree, file, node, number, top)
    found.check()
    return tuple(entries.values())


def _add_entry(
    entries: dict[str, Entry], tree: Tree, file: str, node: str, number: int, top: str
) -> None:
    entry = _callback(
        Fields(tree, file, f'callback {number} of node {shown(node)}', CALLBACK_KEYS), node,
        None if file == top else file)
    key = entry.callback.key
    if key in entries:
        first = entries[key].fields
        where = f'line {first.line}' if first.file == file else f'{first.file}:{first.line}'
        raise entry.fields.error(
            'name', f'this name is taken in {where}',
            'give each callback of a node a name of its own')
    entries[key] = entry


def _callback(fields: Fields, node: str, file: str | None) -> Entry:
    name = fields.text('name', check_callback)
    key = f'{node}:{name}'
    fields.entry = f'callback {shown(key)}'
    kind = fields.one_of(TRIGGERS, 'what starts the callback')
    timer_period = fields.duration_or_none('timer')
    topics: tuple[str, ...] = ()
    if kind == 'subscription':
        topics = (fields.text('subscription', check_topic),)
    elif kind == 'sync':
        topics = fields.texts('sync', check_topic)
        if len(topics) < 2:
            raise fields.error(
                'sync', f'a sync callback joins topics, and here is {len(topics)}',
                "give at least 2, or write 'subscription:' for one topic")
    callback = Callback(
        node=node,
        name=name,
        key=key,
        kind=cast(Kind, kind),
        timer_period_ns=timer_period,
        topics=topics,
        service=fields.text_or_none('service', check_service),
        period_ns=_period(fields, timer_period),
        publishes=fields.texts('publishes', check_topic),
        reads=fields.texts('reads', check_read),
        deadline_ns=fields.duration_or_none('deadline'),
        release_from=cast(ReleaseFrom, fields.choice('release_from', RELEASE_FROM)),
        group=fields.text_or_none('group', check_group),
        dag=fields.text_or_none('dag', check_dag),
        execution_time=_execution_time(fields),
        line=fields.line,
        on_miss=cast(OnMiss, fields.choice('on_miss', ON_MISS)),
        max_active_jobs=fields.integer_or_none('max_active_jobs', 1, MOST_ACTIVE_JOBS),
        holds_interpreter=fields.truth_or_none('holds_interpreter'),
        file=file,
    )
    return Entry(callback, fields)


def _period(fields: Fields, timer_period: int | None) -> int | None:
    """Return the declared period, or the timer's; where both stand they must agree."""
    period = fields.duration_or_none('period')
    if timer_period is None or period is None:
        return timer_period if period is None else period
    if period != timer_period:
        raise fields.error(
            'period',
            f'its period of {format_duration(period)} is not that of its timer, '
            f'{format_duration(timer_period)}',
            "remove 'period:', a timer has its own")
    return period


def _execution_time(fields: Fields) -> ExecutionTime | None:
    value = fields.tree_or_none('execution_time')
    if value is None:
        return None
    if isinstance(value, Scalar):
        constant = fields.duration_or_none('execution_time', minimum_ns=1)
        assert constant is not None
        return ExecutionTime((constant,), (50.0,))
    inner = Fields(value, fields.file, f'execution time of {fields.entry}', TIME_KEYS)
    quantiles_us = inner.numbers('quantiles_us')
    _check_quantiles(inner, quantiles_us)
    percent = _percent(inner, len(quantiles_us))
    return ExecutionTime(tuple(round(us * 1000) for us in quantiles_us), percent)


def _check_quantiles(fields: Fields, quantiles_us: list[float]) -> None:
    key = 'quantiles_us'
    if quantiles_us[0] < 0:
        raise fields.error(key, f'the quantile {quantiles_us[0]} is negative', 'write times in us')
    for before, after in zip(quantiles_us, quantiles_us[1:]):
        if after < before:
            raise fields.error(
                key, f'the quantile {after} comes after {before}', 'write them in rising order')
    if not 1 <= quantiles_us[-1] * 1000 <= DAY:
        raise fields.error(
            key, f'the largest quantile, {quantiles_us[-1]} us, makes no sense',
            'write times from 0.001 us to a day, in us')


def _percent(fields: Fields, count: int) -> tuple[float, ...]:
    """Return the shares that the quantiles belong to, declared or the default for their number."""
    if not fields.has('percent'):
        if count == len(_PERCENT_29):
            return _PERCENT_29
        return tuple(100.0 * i / (count - 1) for i in range(count)) if count > 1 else (50.0,)
    percent = fields.numbers('percent')
    if len(percent) != count:
        raise fields.error(
            'percent', f'{len(percent)} shares for {count} quantiles', 'give one for each')
    if percent[0] < 0 or percent[-1] > 100:
        raise fields.error('percent', 'a share is not within 0 and 100', 'write percentages')
    if any(after <= before for before, after in zip(percent, percent[1:])):
        raise fields.error('percent', 'the shares do not rise', 'write them in rising order')
    return tuple(percent)


def _paths(trees: list[Part]) -> tuple[PathEntry, ...]:
    paths: dict[str, PathEntry] = {}
    found = Collector()
    for place, (tree, file) in enumerate(trees, 1):
        with found:
            entry = _path(Fields(tree, file, f'path {place}', PATH_KEYS))
            name = entry.path.name
            if name in paths:
                raise entry.fields.error(
                    'name', 'this name is taken', 'give each path a name of its own')
            paths[name] = entry
    found.check()
    return tuple(paths.values())


def _path(fields: Fields) -> PathEntry:
    name = fields.text('name', check_path)
    fields.entry = f'path {shown(name)}'
    fields.sequence('callbacks')
    callbacks = fields.texts('callbacks', check_key)
    if len(callbacks) < 2:
        raise fields.error('callbacks', 'a path of one callback', 'give at least 2')
    return PathEntry(Path(name, callbacks), fields)
