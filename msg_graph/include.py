# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Declarations of several files, resolved to one tree before they are read.

Theory of operation
-------------------
1. ``include:`` lists files. Their nodes and paths come before those of the including file, in that
   order, each time that the file is listed. ``workers:`` and ``processes:`` of an included file
   are ignored: they concern the whole system.
2. ``arguments:`` names the arguments of a file, with default values (none: required). ``set:`` of
   an include gives a value, which replaces ``$(name)`` in all values of the file.
3. Names in an included file (nodes, topics, services, DAGs and, with dots, paths) are prefixed
   with the ``namespace:`` of the include. A name that ``remap:`` lists becomes the other name, as
   used in the including file.
4. An included file is processed from the inside out: its own includes, its arguments, then its
   names. Every part of the resulting tree keeps its file and line.
5. The path of a file is relative to the including file. It must be in the folder of the first file
   or below, also after resolving symbolic links. Include cycles are an error, as are too many
   files, levels or entries.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as Items
from copy import copy
import os
import re
import stat
from typing import Any

from msg_graph.errors import did_you_mean, GraphError, listed, quoted
from msg_graph.language import Entry, FILE, INCLUDE
from msg_graph.yamltext import (
    decode,
    Mapping,
    MAX_BYTES,
    MAX_SIZE,
    parse_yaml,
    Scalar,
    Sequence,
    Tree,
)
import yaml

MOST_FILES = 2_000
MOST_DEPTH = 16
LONGEST_VALUE = 4_096
_ARGUMENT_REFERENCE = re.compile(r'\$\(([^()]*)\)')
_NUMBER = re.compile(r'[+-]?[0-9.]+(?:[eE][+-]?[0-9]+)?|true|false')
_NAMED = ('node', 'subscription', 'service', 'sync', 'publishes', 'may_publish', 'reads')

Chain = list[tuple[str, str]]
"""The including files, the first one first: real path, and name in errors."""


def read(text: str, file: str) -> Mapping:
    """Return the outermost mapping of a file."""
    tree = parse_yaml(text, file)
    if tree is None or (isinstance(tree, Scalar) and tree.is_null):
        raise GraphError(
            file, None, 'the file is empty', "write a declaration that starts with 'mddag: 1'")
    if not isinstance(tree, Mapping):
        raise GraphError(
            file, tree.line, 'this is not a declaration', "write one that starts with 'mddag: 1'")
    Entry(tree, 'the declaration', FILE).get('mddag')
    return tree


def resolve(tree: Mapping, path: str | None) -> Mapping:
    """
    Return the outermost mapping of a declaration with all includes and arguments resolved.

    :param path: of its file; None: it was not read from a file, and cannot include any.
    """
    if tree.entries.keys().isdisjoint(('include', 'arguments')):
        return tree
    return _Resolver(path).file(tree, {}, [] if path is None else [
        (os.path.realpath(path), tree.file)])


def as_text(tree: Tree) -> str:
    """Return a resolved tree as YAML."""
    text: str = yaml.dump(tree, Dumper=_Dumper, sort_keys=False, default_flow_style=None,
                          width=99, allow_unicode=True)
    return f'# put together from {ascii(tree.file)[1:-1]} and what it includes\n{text}'


class _Dumper(getattr(yaml, 'CSafeDumper', yaml.SafeDumper)):  # type: ignore[misc]
    """Writes trees; numbers without quotes, unless they were read with quotes."""

    def ignore_aliases(self, data: Any) -> bool:
        """Write everything out."""
        return True

    def scalar(self, scalar: Scalar) -> Any:
        """Return the node of a scalar."""
        if scalar.is_null:
            return self.represent_none(None)
        if scalar.is_plain and _NUMBER.fullmatch(scalar.text):
            return self.represent_scalar(
                self.resolve(yaml.ScalarNode, scalar.text, (True, False)), scalar.text)
        return self.represent_str(scalar.text)


_Dumper.add_representer(Scalar, _Dumper.scalar)
_Dumper.add_representer(Sequence, lambda dumper, tree: dumper.represent_list(tree.items))
_Dumper.add_representer(Mapping, lambda dumper, tree: dumper.represent_dict(tree.entries))


class _Resolver:
    """Resolves one declaration; ``path`` as for ``resolve``."""

    def __init__(self, path: str | None) -> None:
        self._path = path
        self._trees: dict[str, Mapping] = {}
        self._files = self._size = 0

    def file(self, tree: Mapping, given: dict[str, str], chain: Chain) -> Mapping:
        """Return the mapping of a file; ``given`` are the values of its arguments."""
        values = _argument_values(tree, given)
        resolved: Any = _changed(tree, lambda old: _substituted(old, values))
        top = Entry(resolved, 'the declaration', FILE)
        self._size += tree.size
        if self._size > MAX_SIZE:
            raise top.error(
                None, f'with all includes there are more than {MAX_SIZE} entries',
                'include less, or split it into several graphs')
        inner = [self._included(each, place, chain)
                 for place, each in enumerate(top.get('include'), 1)]
        entries: dict[str, Tree] = {key: value for key, value in resolved.entries.items()
                                    if key not in ('include', 'arguments')}
        for key in ('nodes', 'paths'):
            items = [item for each in inner for item in _items(each, key)]
            items += top.get(key) if key in top else ()
            if items:
                entries[key] = Sequence(tree.file, tree.line, items)
        return Mapping(tree.file, tree.line, entries, tree.key_lines)

    def _included(self, tree: Tree, place: int, chain: Chain) -> Mapping:
        if isinstance(tree, Scalar):
            short, tree = tree, Mapping(tree.file, tree.line)
            tree.entries['file'], tree.key_lines['file'] = short, short.line
        entry = Entry(tree, f'include {place}', INCLUDE)
        path, name = self._locate(entry, chain)
        given: Entry = entry.get('set')
        values = {key: given.get(key) for key in given}
        return _renamed(
            entry, self.file(self._read(entry, path, name), values, [*chain, (path, name)]))

    def _locate(self, entry: Entry, chain: Chain) -> tuple[str, str]:
        """Return the real path of an included file, and its name in errors."""
        text = entry.get('file')
        if self._path is None:
            raise entry.error(
                'file', 'a declaration that is not read from a file includes nothing',
                'give the path of the declaration')
        real = os.path.realpath(os.path.join(os.path.dirname(chain[-1][0]), text))
        root = os.path.realpath(os.path.dirname(self._path) or '.')
        if os.path.commonpath([real, root]) != root:
            raise entry.error(
                'file', f'{quoted(text)} lies outside of the folder of the first file',
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
        return real, os.path.normpath(os.path.join(os.path.dirname(entry.file), text))

    def _read(self, entry: Entry, path: str, name: str) -> Mapping:
        if path not in self._trees:
            try:
                if not stat.S_ISREG(os.stat(path).st_mode):
                    raise OSError(0, 'it is not a regular file')
                with open(path, 'rb') as stream:
                    data = stream.read(MAX_BYTES + 1)
            except (OSError, ValueError) as error:
                reason = error.strerror if isinstance(error, OSError) else str(error)
                raise entry.error('file', f'{quoted(name)} cannot be read ({reason})',
                                  'correct the path') from None
            self._trees[path] = read(decode(data, name), name)
        return self._trees[path]


def _argument_values(tree: Mapping, given: dict[str, str]) -> dict[str, str]:
    """Return the values of a file's arguments: those that are set, or the defaults."""
    top = Entry(tree, 'the declaration', FILE)
    declared: Entry = top.get('arguments')
    values: dict[str, str] = {}
    for name in declared:
        try:
            values[name] = given[name] if name in given else declared.get(name)
        except GraphError as error:
            raise GraphError(
                error.file, error.line, error.problem,
                "set it with 'set:' of the include, or give it a default here") from None
    for name in [each for each in given if each not in values]:
        raise top.error(
            'arguments', f'an include sets {quoted(name)}, which is not an argument of this file',
            did_you_mean(name, values, "add it to 'arguments:'"))
    return values


def _substituted(old: Scalar, values: dict[str, str]) -> str:
    def value(found: re.Match[str]) -> str:
        if found[1] not in values:
            raise GraphError(
                old.file, old.line, f'{quoted(found[0])} is not an argument of this file',
                did_you_mean(found[1], values, f"add it to 'arguments:' ({listed(values)})"
                             if values else "add it to 'arguments:'"))
        return values[found[1]]

    text = _ARGUMENT_REFERENCE.sub(value, old.text)
    if len(text) > LONGEST_VALUE and text != old.text:
        raise GraphError(old.file, old.line, 'with its arguments this value is too long',
                         f'use at most {LONGEST_VALUE} characters')
    return text


def _changed(tree: Tree, change: Callable[[Scalar], str]) -> Tree:
    """Return a tree with every text changed; its nesting is bounded."""
    result = copy(tree)
    if isinstance(result, Scalar):
        result.text = change(result)
    elif isinstance(result, Sequence):
        result.items = [_changed(item, change) for item in result.items]
    else:
        result.entries = {key: _changed(each, change) for key, each in result.entries.items()}
    return result


def _renamed(entry: Entry, inner: Mapping) -> Mapping:
    """Return an included file with its names as an entry of ``include:`` has them (rule 3)."""
    space: str = entry.get('namespace') or ''
    remapped: Entry = entry.get('remap')
    remap: dict[str, str] = {old: remapped.get(old) for old in remapped}
    seen: set[str] = set()

    def name(text: str) -> str:
        if not text.startswith('/'):
            return text
        seen.add(text)
        return remap.get(text, space + text)

    def key(text: str) -> str:
        node, colon, callback = text.rpartition(':')
        return f'{name(node)}{colon}{callback}'

    def dag(text: str) -> str:
        return f'{space}/{text.lstrip("/")}' if space else text

    def path(text: str) -> str:
        before = space.strip('/').replace('/', '.')
        return f'{before}.{text}' if before else text

    for node in _items(inner, 'nodes'):
        _rename(node, _NAMED, name)
        for callback in _items(node, 'callbacks'):
            _rename(callback, _NAMED, name)
            _rename(callback, ('dag',), dag)
    for each in _items(inner, 'paths'):
        _rename(each, ('callbacks',), key)
        _rename(each, ('name',), path)
    for old in remap:
        if old not in seen:
            raise remapped.error(old, f'the included file does not name {quoted(old)}',
                                 did_you_mean(old, seen, "remove it from 'remap:'"))
    return inner


def _items(tree: Tree, key: str) -> Items[Tree]:
    items = tree.entries.get(key) if isinstance(tree, Mapping) else None
    return items.items if isinstance(items, Sequence) else ()


def _rename(tree: Tree, keys: tuple[str, ...], change: Callable[[str], str]) -> None:
    """Change the texts at some keys of a mapping, which is not shared with other trees."""
    for key in keys:
        if isinstance(tree, Mapping) and key in tree.entries:
            tree.entries[key] = _changed(
                tree.entries[key], lambda old: old.text if old.is_null else change(old.text))
