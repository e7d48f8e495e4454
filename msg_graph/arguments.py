# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Arguments of a declaration file: ``arguments:``, ``$(name)``, and ``set:`` of an include.

``arguments:`` names what a file can be told, with default values (none: it must be told), and
``$(name)`` in any value of the file stands for it.
"""

from __future__ import annotations

from collections.abc import Callable
import re

from msg_graph.errors import did_you_mean, GraphError, listed, shown
from msg_graph.fields import Check, Fields
from msg_graph.yamltext import Mapping, Scalar, Sequence, Tree

LONGEST_VALUE = 4_096
ARGUMENT = re.compile(r'[A-Za-z_][A-Za-z0-9_]*')
_SUBSTITUTION = re.compile(r'\$\(([^()]*)\)')


def pairs(
    fields: Fields, key: str, check: Check = lambda _: None
) -> list[tuple[str, str, int]]:
    """Return the entries of a mapping of texts, each with its line."""
    tree = fields.tree_or_none(key)
    if tree is None:
        return []
    if not isinstance(tree, Mapping):
        raise fields.error(key, f"'{key}' is no mapping", f'write {key}: {{name: value}}')
    inner = Fields(tree, fields.file, f"{fields.entry}: '{key}'", tuple(tree.entries))
    return [(name, inner.text(name, check), inner.line_of(name))
            for name in tree.entries]


def argument_values(fields: Fields, tree: Mapping, given: dict[str, str]) -> dict[str, str]:
    """
    Return the values of a file's arguments.

    :param given: those that an include tells; the others have their defaults.
    :raises GraphError: one has no value, or there is no such argument.
    """
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


def substituted(tree: Tree, file: str, values: dict[str, str]) -> Tree:
    """
    Return a tree with arguments replaced by their values; what has none is shared.

    :raises GraphError: something stands for no argument, or a value gets too long.
    """
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
        return tree.with_items([_mapped(item, change) for item in tree.items])
    return tree.with_entries(
        {key: _mapped(value, change) for key, value in tree.entries.items()})
