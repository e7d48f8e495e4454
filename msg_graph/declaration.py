# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Declarations: from YAML to callbacks, paths and processes.

``include`` resolves a declaration of several files first. Entries do not depend on each other, so
the first error of each is collected and all are raised together. ``derive`` checks the rules about
several entries (publishers, cycles, sinks, …).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from msg_graph.duration import format_duration
from msg_graph.errors import Collector, did_you_mean, GraphError, shown
from msg_graph.include import as_text, read, resolve
from msg_graph.language import CALLBACK_KEYS, Entry, FILE, NODE_KEYS, PATH_KEYS, TRIGGERS
from msg_graph.model import Callback, Path, Process
from msg_graph.yamltext import Tree
import yaml

_WIDTH = 75


@dataclass(frozen=True, slots=True)
class Declaration:
    """
    A declaration as written in its files; callbacks in the order of the file.

    :ivar text: the text of the file, or of all files as one.
    :ivar entries: the entry of each callback, by its key, and of each path, by its name, with
        their lines.
    """

    file: str
    text: str
    workers: int | None
    callbacks: list[Callback]
    paths: list[Path]
    processes: tuple[Process, ...]
    entries: dict[str, Entry]


def parse_declaration(text: str, file: str, path: str | None = None) -> Declaration:
    """
    Return the declaration in a YAML text, with what it includes.

    :param path: its file; None: it cannot include any.
    """
    tree = read(text, file)
    resolved = resolve(tree, path)
    if resolved is not tree:
        text = as_text(resolved)
    top = Entry(resolved, 'the declaration', FILE)
    found = Collector()
    workers: int | None = None
    callbacks: list[Callback] = []
    paths: list[Path] = []
    entries: dict[str, Entry] = {}
    processes: tuple[Process, ...] = ()
    with found:
        workers = top.get('workers')
    with found:
        callbacks = _callbacks(top.get('nodes'), file, entries)
    with found:
        paths = _paths(top.get('paths') or [], entries)
    found.check()
    with found:
        processes = read_processes(top, (callback.node for callback in callbacks))
    found.check()
    return Declaration(file, text, workers, callbacks, paths, processes, entries)


def read_processes(entry: Entry, nodes: Iterable[str]) -> tuple[Process, ...]:
    """
    Return the processes that an entry declares.

    :param nodes: the declared ones, in file order.
    """
    said: dict[str, dict[str, int]] = entry.get('processes')
    nodes = list(dict.fromkeys(nodes))
    place: dict[str, str] = {}
    found = Collector()
    for process, lines in said.items():
        for node, line in lines.items():
            with found:
                other = place.setdefault(node, process)
                if node not in nodes:
                    raise _error(entry, line, f'there is no node {shown(node)}',
                                 did_you_mean(node, nodes, 'name a node of the declaration'))
                if other != process:
                    raise _error(
                        entry, line, f'node {shown(node)} is in process {shown(other)}, too',
                        'remove one of them: a node runs in one process')
    found.check()
    processes = []
    for i, process in enumerate(said):
        here = tuple(n for n in nodes if place.get(n, process if i == 0 else None) == process)
        if not here:
            raise entry.error('processes', f'no node runs in process {shown(process)}',
                              'name one, or remove the process')
        processes.append(Process(process, here))
    return tuple(processes)


def _error(entry: Entry, line: int, problem: str, remedy: str) -> GraphError:
    return GraphError(entry.file, line, f"{entry.name}: 'processes': {problem}", remedy)


def processes_text(processes: Iterable[Process]) -> str:
    """Return ``processes:`` of a declaration."""
    text: str = yaml.safe_dump(
        {'processes': {process.name: list(process.nodes) for process in processes}},
        default_flow_style=None, sort_keys=False, width=_WIDTH)
    return text


def _callbacks(nodes: list[Tree], file: str, entries: dict[str, Entry]) -> list[Callback]:
    callbacks: list[Callback] = []
    found = Collector()
    for place, tree in enumerate(nodes, 1):
        with found:
            entry = Entry(tree, f'node {place}', NODE_KEYS)
            node = entry.get('node')
            entry.name = f'node {shown(node)}'
            for number, callback_tree in enumerate(entry.get('callbacks'), 1):
                name = f'callback {number} of node {shown(node)}'
                with found:
                    each = Entry(callback_tree, name, CALLBACK_KEYS)
                    callback = _callback(each, node, file)
                    other = entries.setdefault(callback.key, each)
                    if other is not each:
                        where = 'line ' if other.file == each.file else f'{other.file}:'
                        raise each.error(
                            'name', f'this name is taken in {where}{other.line}',
                            'give each callback of a node a name of its own')
                    callbacks.append(callback)
    found.check()
    return callbacks


def _callback(entry: Entry, node: str, top: str) -> Callback:
    name = entry.get('name')
    key = f'{node}:{name}'
    entry.name = f'callback {shown(key)}'
    kind = entry.one_of(TRIGGERS, 'what starts the callback')
    timer_period = entry.get('timer')
    return Callback(
        node=node, name=name, key=key,
        kind=kind,  # type: ignore[arg-type]
        timer_period_ns=timer_period,
        topics=(entry.get(kind),) if kind == 'subscription' else entry.get('sync'),
        service=entry.get('service'),
        period_ns=_period(entry, timer_period),
        deadline_ns=entry.get('deadline'),
        **{same: entry.get(same) for same in (
            'publishes', 'reads', 'release_from', 'group', 'dag', 'execution_time', 'on_late',
            'max_active_jobs', 'holds_interpreter', 'keep', 'importance', 'tolerate')},
        line=entry.line,
        file=None if entry.file == top else entry.file)


def _period(entry: Entry, timer_period: int | None) -> int | None:
    """Return the declared period, or the timer's; both must agree."""
    period: int | None = entry.get('period')
    if timer_period is None or period is None:
        return timer_period if period is None else period
    if period != timer_period:
        raise entry.error(
            'period',
            f'its period of {format_duration(period)} is not that of its timer, '
            f'{format_duration(timer_period)}',
            "remove 'period:', a timer has its own")
    return period


def _paths(trees: list[Tree], entries: dict[str, Entry]) -> list[Path]:
    paths: list[Path] = []
    found = Collector()
    for place, tree in enumerate(trees, 1):
        with found:
            entry = Entry(tree, f'path {place}', PATH_KEYS)
            name = entry.get('name')
            entry.name = f'path {shown(name)}'
            path = Path(name, entry.get('callbacks'))
            if entries.setdefault(name, entry) is not entry:
                raise entry.error('name', 'this name is taken', 'give each path a name of its own')
            paths.append(path)
    found.check()
    return paths
