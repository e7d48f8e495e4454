# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Declarations that are put together from several files.

Theory of operation
-------------------
1. ``include:`` lists files. Their nodes and paths come before those of the file itself, in that
   order, each time that the file is listed. A ``workers:`` of an included file does not count.
2. ``arguments:`` names what a file can be told, and ``set:`` of an include tells it (see
   ``arguments``).
3. Names in an included file are put below the ``namespace:`` of the include, or become others by
   its ``remap:`` (see ``renaming``).
4. So an included file is worked from the inside out: its own includes, its arguments, then the
   names, as the file that includes it wants them. The result is a tree like that of one file, and
   every part of it knows its file and line.
5. A file is looked for beside the one that includes it, and nowhere outside of the folder of the
   first file, not by way of symbolic links either. Files that include each other in a cycle are
   an error, and so is too much of anything: files, depth, entries.
"""

from __future__ import annotations

from dataclasses import dataclass, field
import os
import stat

from msg_graph.arguments import argument_values, pairs, substituted
from msg_graph.errors import GraphError, shown
from msg_graph.fields import Check, Fields
from msg_graph.renaming import Names
from msg_graph.yamltext import decode, Mapping, MAX_BYTES, MAX_SIZE, parse_yaml, Scalar, Tree

MOST_FILES = 2_000
MOST_DEPTH = 16

INCLUDE_KEYS = ('file', 'namespace', 'remap', 'set')

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
        values = argument_values(fields, tree, given)
        own = substituted(tree, file, values)
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
        values = {key: text for key, text, _ in pairs(fields, 'set')}
        _, parts = self._file(included, name, values, [*chain, (path, name)])
        names = Names(fields)
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
