# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Names of an included declaration, as the file that includes it wants them.

They are put below the ``namespace:`` of the include: nodes, topics, services, names of DAGs and
(with dots) of paths. A name that ``remap:`` lists, as it stands in the included file, becomes the
other name instead, which the including file knows.
"""

from __future__ import annotations

from collections.abc import Callable

from msg_graph.arguments import pairs
from msg_graph.errors import did_you_mean, GraphError, shown
from msg_graph.fields import check_node, check_topic, Fields
from msg_graph.yamltext import Mapping, Scalar, Sequence, Tree

_NAMES = ('subscription', 'service')
_LISTS = ('sync', 'publishes', 'reads')


class Names:
    """
    Gives names of an included file those that the including one knows.

    :param fields: the entry of ``include:``.
    """

    def __init__(self, fields: Fields) -> None:
        self._fields = fields
        self._space = fields.text_or_none('namespace', check_node) or ''
        self._remap = {old: (new, line) for old, new, line in pairs(fields, 'remap', check_topic)}
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
        return tree.with_items([self._scalar(item, change) for item in tree.items])

    def node(self, tree: Tree) -> Tree:
        """Return an entry of ``nodes`` with its names changed."""
        if not isinstance(tree, Mapping):
            return tree
        entries = dict(tree.entries)
        if 'node' in entries:
            entries['node'] = self._scalar(entries['node'], self._name)
        callbacks = entries.get('callbacks')
        if isinstance(callbacks, Sequence):
            entries['callbacks'] = callbacks.with_items(
                [self._callback(item) for item in callbacks.items])
        return tree.with_entries(entries)

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
        return tree.with_entries(entries)

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
        return tree.with_entries(entries)

    def _key(self, text: str) -> str:
        node, colon, name = text.rpartition(':')
        return self._name(node) + colon + name
