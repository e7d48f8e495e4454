# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Declarations: from YAML, of one file or several, to callbacks, paths and processes.

Theory of operation
-------------------
Entries do not depend on each other, so the first error of each is collected and all are raised
together. ``derive`` checks the rules about several entries (publishers, cycles, sinks, …).

A declaration may consist of several files:

1. ``include:`` lists files. Their nodes and paths come before those of the including file, in that
   order, each time that the file is listed. ``workers:`` and ``processes:`` of an included file
   are ignored: they concern the whole system.
2. ``arguments:`` names the arguments of a file, with default values (none: required). ``set:`` of
   an include gives a value, which replaces ``$(name)`` in all values of the file.
3. Names in an included file (nodes, topics, services, DAGs and, with dots, paths) are prefixed
   with the ``namespace:`` of the include. A name that ``remap:`` lists becomes the other name, as
   used in the including file.
4. An included file is processed from the inside out: its own includes, its arguments, then its
   names. The result is a tree like that of one file; every part of it keeps its file and line.
5. The path of a file is relative to the including file. It must be in the folder of the first file
   or below, also after resolving symbolic links. Include cycles are an error, as are too many
   files, levels or entries.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
import os
import re
import stat

from msg_graph.duration import format_duration
from msg_graph.errors import Collector, did_you_mean, GraphError, listed, printable, shown
from msg_graph.language import (
    ARGUMENT,
    CALLBACK_KEYS,
    Entry,
    FILE,
    INCLUDE,
    NODE_KEYS,
    PATH_KEYS,
    TRIGGERS,
)
from msg_graph.model import Callback, Path, Process
from msg_graph.yamltext import (
    decode,
    Mapping,
    MAX_BYTES,
    MAX_SIZE,
    parse_yaml,
    Scalar,
    Sequence,
    Tree,
    yaml_lines,
)
import yaml

_WIDTH = 75
MOST_FILES = 2_000
MOST_DEPTH = 16
LONGEST_VALUE = 4_096
_ARGUMENT_USE = re.compile(r'\$\(([^()]*)\)')

Part = tuple[Tree, str]
"""An entry of ``nodes:`` or ``paths:``, and the name of its file."""


@dataclass(frozen=True, slots=True)
class Declaration:
    """
    A declaration as written in its files; callbacks in the order of the file.

    :ivar text: the whole declaration as one text without includes.
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
    Return the declaration in a YAML text, with all its includes.

    :param path: its file; None: it cannot include any.
    """
    tree, top = top_of(text, file)
    found = Collector()
    workers: int | None = None
    nodes: list[Part] = []
    paths: list[Part] = []
    composed = is_composed(top)
    if composed:
        top, nodes, paths = Assembler(path).assemble(tree, file)
    with found:
        workers = top.get('workers')
    callbacks: list[Callback] = []
    declared_paths: list[Path] = []
    entries: dict[str, Entry] = {}
    processes: tuple[Process, ...] = ()
    with found:
        nodes = nodes or [(each, file) for each in top.get('nodes')]
        callbacks = _callbacks(nodes, file, entries)
    with found:
        paths = paths if composed else [(each, file) for each in top.get('paths') or ()]
        declared_paths = _paths(paths, entries)
    found.check()
    with found:
        processes = read_processes(top, (callback.node for callback in callbacks))
    found.check()
    if composed:
        text = _one_text(file, workers, nodes, paths)
        text += processes_text(processes) if processes else ''
    return Declaration(file, text, workers, callbacks, declared_paths, processes, entries)


def _one_text(file: str, workers: int | None, nodes: list[Part], paths: list[Part]) -> str:
    """Return the text of an assembled declaration; only its lines differ."""
    lines = [f'# put together from {printable(file)} and what it includes', 'mddag: 1']
    if workers is not None:
        lines.append(f'workers: {workers}')
    for key, parts in (('nodes', nodes), ('paths', paths)):
        if parts:
            lines.append(f'{key}:')
        for tree, _ in parts:
            first, *rest = yaml_lines(tree)
            lines += [f'  - {first}', *(f'    {line}' for line in rest)]
    return '\n'.join(lines) + '\n'


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


def _callbacks(nodes: list[Part], top: str, entries: dict[str, Entry]) -> list[Callback]:
    callbacks: list[Callback] = []
    found = Collector()
    for place, (tree, file) in enumerate(nodes, 1):
        with found:
            entry = Entry(tree, file, f'node {place}', NODE_KEYS)
            node = entry.get('node')
            entry.name = f'node {shown(node)}'
            for number, callback_tree in enumerate(entry.get('callbacks'), 1):
                name = f'callback {number} of node {shown(node)}'
                with found:
                    each = Entry(callback_tree, file, name, CALLBACK_KEYS)
                    callback = _callback(each, node, top)
                    other = entries.setdefault(callback.key, each)
                    if other is not each:
                        where = '' if other.file == file else f'{other.file}:'
                        raise each.error(
                            'name', f'this name is taken in {where or "line "}{other.line}',
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


def _paths(parts: list[Part], entries: dict[str, Entry]) -> list[Path]:
    paths: list[Path] = []
    found = Collector()
    for place, (tree, file) in enumerate(parts, 1):
        with found:
            entry = Entry(tree, file, f'path {place}', PATH_KEYS)
            name = entry.get('name')
            entry.name = f'path {shown(name)}'
            path = Path(name, entry.get('callbacks'))
            if entries.setdefault(name, entry) is not entry:
                raise entry.error('name', 'this name is taken', 'give each path a name of its own')
            paths.append(path)
    found.check()
    return paths


def top_of(text: str, file: str) -> tuple[Mapping, Entry]:
    """Return the outermost mapping of a file, as a tree and as an entry."""
    tree = parse_yaml(text, file)
    if tree is None or (isinstance(tree, Scalar) and tree.is_null):
        raise GraphError(
            file, None, 'the file is empty', "write a declaration that starts with 'mddag: 1'")
    if not isinstance(tree, Mapping):
        raise GraphError(
            file, tree.line, 'this is not a declaration', "write one that starts with 'mddag: 1'")
    entry = _top(tree, file)
    entry.get('mddag')
    return tree, entry


def _top(tree: Tree, file: str) -> Entry:
    return Entry(tree, file, 'the declaration', FILE)


def is_composed(entry: Entry) -> bool:
    """Return whether a declaration has includes or arguments."""
    return entry.has('include') or entry.has('arguments')


@dataclass
class Assembler:
    """
    Assembles a declaration from its files.

    :ivar path: of the first file; None: it was not read from a file, and cannot include any.
    """

    path: str | None
    _read_trees: dict[str, Mapping] = field(default_factory=dict)
    _files: int = 0
    _size: int = 0

    def assemble(self, tree: Mapping, file: str) -> tuple[Entry, list[Part], list[Part]]:
        """Return the first file with its arguments filled in, and all nodes and paths."""
        chain = [] if self.path is None else [(os.path.realpath(self.path), file)]
        return self._file(tree, file, {}, chain)

    def _file(
        self, tree: Mapping, file: str, given: dict[str, str], chain: list[tuple[str, str]]
    ) -> tuple[Entry, list[Part], list[Part]]:
        values = _argument_values(_top(tree, file), tree, given)
        entry = _top(_substituted(tree, file, values), file)
        self._size += tree.size
        if self._size > MAX_SIZE:
            raise entry.error(
                None, f'with all includes there are more than {MAX_SIZE} entries',
                'include less, or split it into several graphs')
        nodes: list[Part] = []
        paths: list[Part] = []
        for place, each in enumerate(entry.get('include') or (), 1):
            more_nodes, more_paths = self._include(each, file, place, chain)
            nodes += more_nodes
            paths += more_paths
        if entry.has('nodes'):
            nodes += [(each, file) for each in entry.get('nodes')]
        paths += [(each, file) for each in entry.get('paths') or ()]
        return entry, nodes, paths

    def _include(
        self, tree: Tree, file: str, place: int, chain: list[tuple[str, str]]
    ) -> tuple[list[Part], list[Part]]:
        if isinstance(tree, Scalar):
            short, tree = tree, Mapping(tree.line)
            tree.entries['file'] = short
            tree.key_lines['file'] = short.line
        entry = Entry(tree, file, f'include {place}', INCLUDE)
        path, name = self._locate(entry, file, chain)
        values = {key: text for key, text, _ in entry.get('set')}
        _, nodes, paths = self._file(
            self._read(entry, path, name), name, values, [*chain, (path, name)])
        renaming = _Renaming(entry)
        nodes = [(renaming.node(each), source) for each, source in nodes]
        paths = [(renaming.path(each), source) for each, source in paths]
        renaming.check()
        return nodes, paths

    def _locate(
        self, entry: Entry, file: str, chain: list[tuple[str, str]]
    ) -> tuple[str, str]:
        """Return the real path of an included file, and its name in errors."""
        text = entry.get('file')
        if self.path is None:
            raise entry.error(
                'file', 'a declaration that is not read from a file includes nothing',
                'give the path of the declaration')
        real = os.path.realpath(os.path.join(os.path.dirname(chain[-1][0]), text))
        root = os.path.realpath(os.path.dirname(self.path) or '.')
        if os.path.commonpath([real, root]) != root:
            raise entry.error(
                'file', f'{shown(text)} lies outside of the folder of the first file',
                'keep all files of a declaration below one folder')
        if real in [path for path, _ in chain]:
            names = ' -> '.join(name for _, name in chain)
            raise entry.error(
                'file', f'files include each other in a cycle: {names} -> {text}',
                'remove one of the includes')
        self._files += 1
        if len(chain) > MOST_DEPTH or self._files > MOST_FILES:
            raise entry.error(
                'file', f'more than {MOST_DEPTH} levels or {MOST_FILES} files are included',
                'include less, or split it into several graphs')
        return real, os.path.normpath(os.path.join(os.path.dirname(file), text))

    def _read(self, entry: Entry, path: str, name: str) -> Mapping:
        if path not in self._read_trees:
            try:
                if not stat.S_ISREG(os.stat(path).st_mode):
                    raise OSError(0, 'it is no regular file')
                with open(path, 'rb') as stream:
                    data = stream.read(MAX_BYTES + 1)
            except (OSError, ValueError) as error:
                reason = error.strerror if isinstance(error, OSError) else str(error)
                raise entry.error('file', f'{shown(name)} cannot be read ({reason})',
                                  'correct the path') from None
            self._read_trees[path], _ = top_of(decode(data, name), name)
        return self._read_trees[path]


def _argument_values(entry: Entry, tree: Mapping, given: dict[str, str]) -> dict[str, str]:
    """
    Return the values of a file's arguments.

    :param given: those set by an include; the others have their defaults.
    """
    declared = tree.entries.get('arguments', Mapping(tree.line))
    if not isinstance(declared, Mapping):
        raise entry.error('arguments', "'arguments' is no mapping",
                          'write arguments: {name: default value}')
    values: dict[str, str] = {}
    for name, value in declared.entries.items():
        line = declared.key_lines[name]
        if not ARGUMENT.fullmatch(name):
            raise GraphError(entry.file, line, f'{shown(name)} is no name for an argument',
                             "use letters, digits and '_', and no digit first")
        if not isinstance(value, Scalar):
            raise GraphError(entry.file, value.line,
                             f'the default value of the argument {shown(name)} is no text',
                             'write a text, a number or a time')
        if value.is_null and name not in given:
            raise GraphError(entry.file, line, f'the argument {shown(name)} has no value',
                             "set it with 'set:' of the include, or give it a default here")
        values[name] = given.get(name, value.text)
    for name in given:
        if name not in values:
            raise entry.error(
                'arguments', f'an include sets {shown(name)}, which is no argument of this file',
                did_you_mean(name, values, "add it to 'arguments:'"))
    return values


def _substituted(tree: Tree, file: str, values: dict[str, str]) -> Tree:
    """Return a tree with arguments replaced by their values."""
    def change(old: Scalar) -> str:
        def value(found: re.Match[str]) -> str:
            if found[1] not in values:
                raise GraphError(
                    file, old.line, f'{shown(found[0])} is no argument of this file',
                    did_you_mean(found[1], values, f"add it to 'arguments:' ({listed(values)})"
                                 if values else "add it to 'arguments:'"))
            return values[found[1]]

        text = _ARGUMENT_USE.sub(value, old.text)
        if len(text) > LONGEST_VALUE and text != old.text:
            raise GraphError(file, old.line, 'with its arguments this value is too long',
                             f'use at most {LONGEST_VALUE} characters')
        return text

    return _changed(tree, change)


def _changed(tree: Tree, change: Callable[[Scalar], str]) -> Tree:
    """Return a tree with every text changed; its nesting is bounded."""
    if isinstance(tree, Scalar):
        text = change(tree)
        return tree if text == tree.text else Scalar(tree.line, text, tree.plain)
    if isinstance(tree, Sequence):
        return tree.with_items([_changed(item, change) for item in tree.items])
    return tree.with_entries(
        {key: _changed(value, change) for key, value in tree.entries.items()})


class _Renaming:
    """
    Changes names of an included file to those used in the including one (rule 3).

    :param entry: of ``include:``.
    """

    def __init__(self, entry: Entry) -> None:
        self._entry = entry
        self._space: str = entry.get('namespace') or ''
        self._remap: dict[str, str] = {old: new for old, new, _ in entry.get('remap')}
        self._lines = {old: line for old, _, line in entry.get('remap')}
        self._seen: set[str] = set()

    def check(self) -> None:
        """Raise if a remapped name does not occur in the included file."""
        for name, line in self._lines.items():
            if name not in self._seen:
                raise GraphError(
                    self._entry.file, line, f'{self._entry.name}: it remaps {shown(name)}, '
                    'which the included file does not name',
                    did_you_mean(name, self._seen, "remove it from 'remap:'"))

    def node(self, tree: Tree) -> Tree:
        """Return an entry of ``nodes`` with its names changed."""
        tree = _with_changes(tree, ('node',), self._name)
        callbacks = tree.entries.get('callbacks') if isinstance(tree, Mapping) else None
        if not isinstance(tree, Mapping) or not isinstance(callbacks, Sequence):
            return tree
        return tree.with_entries({**tree.entries, 'callbacks': callbacks.with_items(
            [_with_changes(_with_changes(each, _NAMED, self._name), ('dag',), self._dag)
             for each in callbacks.items])})

    def path(self, tree: Tree) -> Tree:
        """Return an entry of ``paths`` with its names changed."""
        before = self._space.strip('/').replace('/', '.')
        tree = _with_changes(tree, ('callbacks',), self._key)
        return _with_changes(tree, ('name',), lambda text: f'{before}.{text}') if before else tree

    def _name(self, text: str) -> str:
        if not text.startswith('/'):
            return text
        self._seen.add(text)
        return self._remap.get(text, self._space + text)

    def _key(self, text: str) -> str:
        node, colon, name = text.rpartition(':')
        return f'{self._name(node)}{colon}{name}'

    def _dag(self, text: str) -> str:
        return f'{self._space}/{text.lstrip("/")}' if self._space else text


_NAMED = ('subscription', 'service', 'sync', 'publishes', 'reads')


def _with_changes(tree: Tree, keys: tuple[str, ...], change: Callable[[str], str]) -> Tree:
    """Return an entry with the texts at some keys changed."""
    if not isinstance(tree, Mapping):
        return tree
    return tree.with_entries({
        key: value if key not in keys else _changed(
            value, lambda old: old.text if old.is_null else change(old.text))
        for key, value in tree.entries.items()})
