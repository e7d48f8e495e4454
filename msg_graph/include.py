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
Declarations that are put together from several files.

Theory of operation
-------------------
1. ``include:`` lists files. Their nodes and paths come before those of the file itself, in that
   order, each time that the file is listed. A ``workers:`` of an included file does not count.
2. ``arguments:`` names what a file can be told, with default values (none: it must be told), and
   ``$(name)`` in any value of the file stands for it. ``set:`` of an include tells it.
3. Names in an included file are put below the ``namespace:`` of the include: nodes, topics,
   services, names of DAGs and (with dots) of paths. A name that ``remap:`` lists, as it stands in
   the included file, becomes the other name instead, which the including file knows.
4. So an included file is worked from the inside out: its own includes, its arguments, then the
   names, as the file that includes it wants them. The result is a tree like that of one file, and
   every part of it knows its file and line.
5. A file is looked for beside the one that includes it, and nowhere outside of the folder of the
   first file, not by way of symbolic links either. Files that include each other in a cycle are
   an error, and so is too much of anything: files, depth, entries.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
import os
import re
import stat

from msg_graph.errors import did_you_mean, GraphError, listed, shown
from msg_graph.fields import Check, check_node, check_topic, Fields
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

MOST_FILES = 2_000
MOST_DEPTH = 16
LONGEST_VALUE = 4_096

INCLUDE_KEYS = ('file', 'namespace', 'remap', 'set')
ARGUMENT = re.compile(r'[A-Za-z_][A-Za-z0-9_]*')
_SUBSTITUTION = re.compile(r'\$\(([^()]*)\)')
_NAMES = ('subscription', 'service')
_LISTS = ('sync', 'publishes', 'reads')

Part = tuple[Tree, str]
"""A tree and the name of its file."""


@dataclass
class Parts:
    """The nodes and paths of a declaration, from all of its files."""

    nodes: list[Part] = field(default_factory=list)
    paths: list[Part] = field(default_factory=list)


def is_composed(tree: Mapping) -> bool:
    """Tell whether a declaration is put together, or has arguments."""
    return 'include' in tree.entries or 'arguments' in tree.entries


class Assembler:
    """
    Puts a declaration together.

    :param top: path of the first file; None where it was read from elsewhere, so that there is
        nothing to include from.
    :param known: the keys of a file.
    :param check_format: looks at the version of the format.
    """

    def __init__(self, top: str | None, known: tuple[str, ...], check_format: Check) -> None:
        self._root = None if top is None else os.path.realpath(os.path.dirname(top) or '.')
        self._top = None if top is None else os.path.realpath(top)
        self._known = known
        self._check_format = check_format
        self._trees: dict[str, Mapping] = {}
        self._files = 0
        self._size = 0

    def assemble(self, tree: Mapping, file: str) -> tuple[Mapping, Parts]:
        """
        Return the first file with its arguments filled in, and all parts.

        :raises GraphError: a file cannot be included, or an argument is missing.
        """
        chain = [] if self._top is None else [(self._top, file)]
        return self._file(tree, file, {}, chain)

    def _file(
        self, tree: Mapping, file: str, given: dict[str, str], chain: list[tuple[str, str]]
    ) -> tuple[Mapping, Parts]:
        fields = Fields(tree, file, 'the declaration', self._known)
        values = _arguments(fields, tree, given)
        own = _substituted(tree, file, values)
        assert isinstance(own, Mapping)
        self._size += own.size
        fields = Fields(own, file, 'the declaration', self._known)
        if self._size > MAX_SIZE:
            raise fields.error(
                None, f'with all includes there are more than {MAX_SIZE} entries',
                'include less, or split it into several graphs')
        parts = Parts()
        if fields.has('include'):
            for place, each in enumerate(fields.sequence('include'), 1):
                more = self._include(each, file, place, chain)
                parts.nodes += more.nodes
                parts.paths += more.paths
        for key, found in (('nodes', parts.nodes), ('paths', parts.paths)):
            if fields.has(key):
                found += [(item, file) for item in fields.sequence(key)]
        return own, parts

    def _include(
        self, tree: Tree, file: str, place: int, chain: list[tuple[str, str]]
    ) -> Parts:
        if isinstance(tree, Scalar):
            wrapped = Mapping(tree.line)
            wrapped.entries['file'] = tree
            wrapped.key_lines['file'] = tree.line
            tree = wrapped
        fields = Fields(tree, file, f'include {place}', INCLUDE_KEYS)
        path, name = self._locate(fields, file, chain)
        included = self._read(fields, path, name)
        values = {key: text for key, text, _ in _pairs(fields, 'set', None)}
        _, parts = self._file(included, name, values, [*chain, (path, name)])
        names = _Names(fields)
        parts = Parts([(names.node(tree), source) for tree, source in parts.nodes],
                      [(names.path(tree), source) for tree, source in parts.paths])
        names.check()
        return parts

    def _locate(
        self, fields: Fields, file: str, chain: list[tuple[str, str]]
    ) -> tuple[str, str]:
        """Return the real path of an included file, and what errors call it."""
        text = fields.text('file', _check_path)
        if self._root is None:
            raise fields.error(
                'file', 'a declaration that is not read from a file includes nothing',
                'give the path of the declaration')
        real = os.path.realpath(os.path.join(os.path.dirname(chain[-1][0]), text))
        if os.path.commonpath([real, self._root]) != self._root:
            raise fields.error(
                'file', f'{shown(text)} lies outside of the folder of the first file',
                'keep all files of a declaration below one folder')
        if real in [path for path, _ in chain]:
            names = ' -> '.join(name for _, name in chain)
            raise fields.error(
                'file', f'files include each other in a cycle: {names} -> {text}',
                'remove one of the includes')
        self._files += 1
        if len(chain) > MOST_DEPTH or self._files > MOST_FILES:
            raise fields.error(
                'file', f'more than {MOST_DEPTH} levels or {MOST_FILES} files are included',
                'include less, or split it into several graphs')
        return real, os.path.normpath(os.path.join(os.path.dirname(file), text))

    def _read(self, fields: Fields, path: str, name: str) -> Mapping:
        tree = self._trees.get(path)
        if tree is not None:
            return tree
        try:
            if not stat.S_ISREG(os.stat(path).st_mode):
                raise OSError(0, 'it is no regular file')
            with open(path, 'rb') as stream:
                data = stream.read(MAX_BYTES + 1)
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else str(error)
            raise fields.error(
                'file', f'{shown(name)} cannot be read ({reason})', 'correct the path') from None
        found = parse_yaml(decode(data, name), name)
        if not isinstance(found, Mapping):
            raise GraphError(name, None if found is None else found.line,
                             'this is not a declaration', "write one that starts with 'mddag: 1'")
        Fields(found, name, 'the declaration', self._known).text('mddag', self._check_format)
        self._trees[path] = found
        return found


def _check_path(text: str) -> tuple[str, str] | None:
    if os.path.isabs(text) or text.startswith('~') or '\0' in text or not text:
        return (f'{shown(text)} is no relative path',
                'write it as seen from the file that includes it')
    return None


def _pairs(
    fields: Fields, key: str, check: Check | None
) -> list[tuple[str, str, int]]:
    """Return the entries of a mapping of texts, each with its line."""
    tree = fields.tree_or_none(key)
    if tree is None:
        return []
    if not isinstance(tree, Mapping):
        raise fields.error(key, f"'{key}' is no mapping", f'write {key}: {{name: value}}')
    inner = Fields(tree, fields.file, f"{fields.entry}: '{key}'", tuple(tree.entries))
    return [(name, inner.text(name, check or (lambda _: None)), inner.line_of(name))
            for name in tree.entries]


def _arguments(fields: Fields, tree: Mapping, given: dict[str, str]) -> dict[str, str]:
    """Return the values of a file's arguments."""
    declared = tree.entries.get('arguments', Mapping(tree.line))
    if not isinstance(declared, Mapping):
        raise fields.error('arguments', "'arguments' is no mapping",
                           'write arguments: {name: default value}')
    values: dict[str, str] = {}
    for name, value in declared.entries.items():
        if not ARGUMENT.fullmatch(name):
            raise GraphError(fields.file, declared.key_lines[name],
                             f'{shown(name)} is no name for an argument',
                             "use letters, digits and '_', and no digit first")
        if not isinstance(value, Scalar):
            raise GraphError(fields.file, value.line,
                             f'the default value of the argument {shown(name)} is no text',
                             'write a text, a number or a time')
        if name in given:
            values[name] = given[name]
        elif value.is_null:
            raise GraphError(fields.file, declared.key_lines[name],
                             f'the argument {shown(name)} has no value',
                             "tell it with 'set:' of the include, or give it a default here")
        else:
            values[name] = value.text
    for name in given:
        if name not in values:
            raise fields.error(
                'arguments', f'an include sets {shown(name)}, which is no argument of this file',
                did_you_mean(name, values, "add it to 'arguments:'"))
    return values


def _substituted(tree: Tree, file: str, values: dict[str, str]) -> Tree:
    """Return a tree with arguments replaced by their values; what has none is shared."""
    def value(found: re.Match[str], line: int) -> str:
        if found[1] not in values:
            raise GraphError(
                file, line, f'{shown(found[0])} stands for no argument of this file',
                did_you_mean(found[1], values, f"add it to 'arguments:' ({listed(values)})"
                             if values else "add it to 'arguments:'"))
        return values[found[1]]

    def scalar(old: Scalar) -> Scalar:
        if '$(' not in old.text:
            return old
        text = _SUBSTITUTION.sub(lambda found: value(found, old.line), old.text)
        if len(text) > LONGEST_VALUE:
            raise GraphError(file, old.line, 'with its arguments this value is too long',
                             f'use at most {LONGEST_VALUE} characters')
        return Scalar(old.line, text, old.plain)

    return _mapped(tree, scalar)


def _mapped(tree: Tree, change: Callable[[Scalar], Scalar]) -> Tree:
    """Return a tree with every value changed; nesting is bounded, so this may recurse."""
    if isinstance(tree, Scalar):
        return change(tree)
    if isinstance(tree, Sequence):
        items = Sequence(tree.line)
        items.items = [_mapped(item, change) for item in tree.items]
        items.size = tree.size
        return items
    return _with(tree, {key: _mapped(value, change) for key, value in tree.entries.items()})


def _with(tree: Mapping, entries: dict[str, Tree]) -> Mapping:
    """Return a mapping with other values of the same keys."""
    result = Mapping(tree.line)
    result.entries, result.key_lines, result.size = entries, tree.key_lines, tree.size
    return result


class _Names:
    """Gives names of an included file those that the including one knows."""

    def __init__(self, fields: Fields) -> None:
        self._fields = fields
        self._space = fields.text_or_none('namespace', check_node) or ''
        self._remap = {old: (new, line) for old, new, line in _pairs(fields, 'remap', check_topic)}
        self._used: set[str] = set()
        self._seen: set[str] = set()

    def check(self) -> None:
        """Raise where a name is remapped that the included file does not have."""
        for name, (_, line) in self._remap.items():
            if name not in self._used:
                raise GraphError(
                    self._fields.file, line, f'{self._fields.entry}: it remaps {shown(name)}, '
                    'which the included file does not name',
                    did_you_mean(name, self._seen, "remove it from 'remap:'"))

    def _name(self, text: str) -> str:
        if not text.startswith('/'):
            return text
        self._seen.add(text)
        if text in self._remap:
            self._used.add(text)
            return self._remap[text][0]
        return self._space + text

    def _scalar(self, tree: Tree, change: Callable[[str], str]) -> Tree:
        if not isinstance(tree, Scalar) or tree.is_null:
            return tree
        return Scalar(tree.line, change(tree.text), tree.plain)

    def _list(self, tree: Tree, change: Callable[[str], str]) -> Tree:
        if not isinstance(tree, Sequence):
            return tree
        items = Sequence(tree.line)
        items.items = [self._scalar(item, change) for item in tree.items]
        items.size = tree.size
        return items

    def node(self, tree: Tree) -> Tree:
        """Return an entry of ``nodes`` with its names changed."""
        if not isinstance(tree, Mapping):
            return tree
        entries = dict(tree.entries)
        if 'node' in entries:
            entries['node'] = self._scalar(entries['node'], self._name)
        callbacks = entries.get('callbacks')
        if isinstance(callbacks, Sequence):
            items = Sequence(callbacks.line)
            items.items = [self._callback(item) for item in callbacks.items]
            items.size = callbacks.size
            entries['callbacks'] = items
        return _with(tree, entries)

    def _callback(self, tree: Tree) -> Tree:
        if not isinstance(tree, Mapping):
            return tree
        entries = dict(tree.entries)
        for key, value in tree.entries.items():
            if key in _NAMES:
                entries[key] = self._scalar(value, self._name)
            elif key in _LISTS:
                entries[key] = self._list(value, self._name)
            elif key == 'dag' and self._space:
                entries[key] = self._scalar(
                    value, lambda text: f'{self._space}/{text.lstrip("/")}')
        return _with(tree, entries)

    def path(self, tree: Tree) -> Tree:
        """Return an entry of ``paths`` with its names changed."""
        if not isinstance(tree, Mapping):
            return tree
        entries = dict(tree.entries)
        if 'name' in entries and self._space:
            before = self._space.strip('/').replace('/', '.')
            entries['name'] = self._scalar(entries['name'], lambda text: f'{before}.{text}')
        if 'callbacks' in entries:
            entries['callbacks'] = self._list(entries['callbacks'], self._key)
        return _with(tree, entries)

    def _key(self, text: str) -> str:
        node, colon, name = text.rpartition(':')
        return self._name(node) + colon + name
