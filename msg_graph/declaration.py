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
from itertools import chain

from msg_graph.duration import format_duration
from msg_graph.errors import Collector, did_you_mean, for_each, listed, quoted
from msg_graph.include import as_text, read, resolve
from msg_graph.language import (
    CALLBACK_KEYS,
    Entry,
    FILE,
    NO_DEADLINE,
    NODE_KEYS,
    PATH_KEYS,
    TRIGGERS,
)
from msg_graph.model import Callback, Path, Process, TaskSet
from msg_graph.yamltext import Tree
import yaml

_WIDTH = 75


def parse_declaration(
    text: str, file: str, path: str | None = None
) -> tuple[TaskSet, dict[str, Entry]]:
    """
    Return the declaration in a YAML text, with what it includes: a task set without DAGs yet.

    :param path: its file; None: it cannot include any.
    :return: the task set, and the entries of each callback, by its key, and each path, by its
        name.
    """
    tree = read(text, file)
    resolved = resolve(tree, path)
    if resolved is not tree:
        text = as_text(resolved)
    top = Entry(resolved, 'the declaration', FILE)
    entries: dict[str, Entry] = {}
    errors = Collector()
    workers = errors.attempt(top.get, 'workers')
    concurrent: list[str] = []
    callbacks = errors.attempt(_callbacks, top, file, entries, concurrent)
    paths = errors.attempt(_paths, top, entries)
    errors.check()
    processes = read_processes(top, (callback.node for callback in callbacks))
    return TaskSet((), tuple(callbacks), (), tuple(paths), workers, file, text, processes,
                   tuple(concurrent)), entries


def read_processes(top: Entry, nodes: Iterable[str]) -> tuple[Process, ...]:
    """Return the processes that the entry of a file declares for its nodes."""
    declared: Entry = top.get('processes')
    nodes = list(dict.fromkeys(nodes))
    process_of: dict[str, str] = {}

    def place(process: str, node: str) -> None:
        other = process_of.setdefault(node, process)
        if node not in nodes:
            raise declared.error(
                process, f'there is no node {quoted(node)}',
                did_you_mean(node, nodes, 'name a node of the declaration'), item=node)
        if other != process:
            raise declared.error(
                process, f'node {quoted(node)} is also in process {quoted(other)}',
                'remove one of them: a node runs in one process', item=node)

    errors = Collector()
    for process in declared:
        for node in errors.attempt(declared.get, process) or ():
            errors.attempt(place, process, node)
    errors.check()
    processes: list[Process] = []
    for process in declared:
        rest = process if not processes else None
        here = tuple(node for node in nodes if process_of.get(node, rest) == process)
        if not here:
            raise top.error('processes', f'no node runs in process {quoted(process)}',
                            'name one, or remove the process')
        processes.append(Process(process, here))
    return tuple(processes)


def processes_text(processes: Iterable[Process]) -> str:
    """Return ``processes:`` of a declaration."""
    text: str = yaml.safe_dump(
        {'processes': {process.name: list(process.nodes) for process in processes}},
        default_flow_style=None, sort_keys=False, width=_WIDTH)
    return text


def _callbacks(
    top: Entry, file: str, entries: dict[str, Entry], concurrent: list[str]
) -> list[Callback]:
    def of_node(numbered: tuple[int, Tree]) -> list[Callback]:
        entry = Entry(numbered[1], f'node {numbered[0]}', NODE_KEYS)
        node = entry.get('node')
        entry.name = f'node {quoted(node)}'
        if entry.get('concurrent'):
            concurrent.append(node)
        return for_each(enumerate(entry.get('callbacks'), 1), lambda each: _callback(
            Entry(each[1], f'callback {each[0]} of {entry.name}', CALLBACK_KEYS), node, file,
            entries))

    return list(chain.from_iterable(for_each(enumerate(top.get('nodes'), 1), of_node)))


def _callback(entry: Entry, node: str, top: str, entries: dict[str, Entry]) -> Callback:
    name = entry.get('name')
    key = f'{node}:{name}'
    entry.name = f'callback {quoted(key)}'
    kinds = [kind for kind in TRIGGERS if kind in entry]
    if not kinds:
        raise entry.error(
            None, 'nothing says what starts the callback', f'add one of {", ".join(TRIGGERS)}')
    if len(kinds) > 1:
        raise entry.error(
            kinds[1], f'{listed(kinds)} exclude each other', 'keep one, or make two callbacks')
    kind = kinds[0]
    timer_period = entry.get('timer')
    topics, driven_by = entry.get('sync')
    callback = Callback(
        node=node, name=name, key=key,
        kind=kind,  # type: ignore[arg-type]
        timer_period_ns=timer_period,
        topics=(entry.get(kind),) if kind == 'subscription' else topics, driven_by=driven_by,
        service=entry.get('service'),
        period_ns=_period(entry, timer_period),
        deadline_ns=None if entry.get('deadline') == NO_DEADLINE else entry.get('deadline'),
        judged=entry.get('deadline') != NO_DEADLINE,
        publishes=_publishes(entry), may_publish=entry.get('may_publish'),
        **{same: entry.get(same) for same in (
            'reads', 'release_from', 'group', 'dag', 'execution_time', 'on_late',
            'max_active_jobs', 'holds_interpreter', 'keep', 'importance', 'tolerate', 'once',
            'sporadic')},
        line=entry.line,
        file=None if entry.file == top else entry.file)
    other = entries.setdefault(key, entry)
    if other is not entry:
        where = 'line ' if other.file == entry.file else f'{other.file}:'
        raise entry.error('name', f'this name is taken in {where}{other.line}',
                          'give each callback of a node a name of its own')
    return callback


def _publishes(entry: Entry) -> tuple[str, ...]:
    """Return all topics of a callback, those that it publishes only sometimes last."""
    always: tuple[str, ...] = entry.get('publishes')
    sometimes: tuple[str, ...] = entry.get('may_publish')
    for topic in sometimes:
        if topic in always:
            raise entry.error(
                'may_publish', f"{quoted(topic)} is under 'publishes:' as well",
                "keep it under 'publishes:' if each execution publishes it, else under "
                "'may_publish:'", item=topic)
    return always + sometimes


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


def _paths(top: Entry, entries: dict[str, Entry]) -> list[Path]:
    def read_path(numbered: tuple[int, Tree]) -> Path:
        entry = Entry(numbered[1], f'path {numbered[0]}', PATH_KEYS)
        name = entry.get('name')
        entry.name = f'path {quoted(name)}'
        path = Path(name, entry.get('callbacks'), entry.get('reaction'), entry.get('age'),
                    entry.get('tolerate'))
        if entries.setdefault(name, entry) is not entry:
            raise entry.error('name', 'this name is taken', 'give each path a name of its own')
        if path.tolerate is not None and not path.requirements:
            raise entry.error('tolerate', 'it has no requirement that could be missed',
                              "remove 'tolerate:', or add 'reaction:' or 'age:'")
        return path

    return for_each(enumerate(top.get('paths'), 1), read_path)
