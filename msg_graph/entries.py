# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Entries of a declaration, and the kinds of values that stand in them.

Theory of operation
-------------------
An *entry* is a mapping of the declaration. A table says which keys it may have, and of what *kind*
the value of each is. A kind reads a value, with errors that name file, line and entry, and has its
part of the JSON Schema; so what a file may hold stands in one place, the tables of
``language``.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Mapping as Table
from dataclasses import dataclass
import math
import re
from typing import Any

from msg_graph.duration import DAY, DurationError, MICROSECOND, parse_duration
from msg_graph.errors import did_you_mean, GraphError, listed, shown
from msg_graph.names import Check, Name
from msg_graph.yamltext import Mapping, Scalar, Sequence, Tree

Schema = dict[str, Any]

ARGUMENT = re.compile(r'[A-Za-z_][A-Za-z0-9_]*')
ARGUMENT_USE = rf'\$\({ARGUMENT.pattern}\)'
"""How an argument of the file stands in a value; the JSON Schema allows it in any."""

_NUMBER = re.compile(r'[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?')
_INTEGER = re.compile(r'[+-]?[0-9]{1,18}')
_USE: Schema = {'type': 'string', 'pattern': ARGUMENT_USE}


@dataclass(frozen=True)
class Kind:
    """
    What a value can be.

    :ivar read: returns what a value at a key of an entry says, or raises a ``GraphError``.
    :ivar schema: its JSON Schema.
    :ivar missing: what stands for it where its key is missing.
    """

    read: Callable[[Entry, str, Tree], Any]
    schema: Schema
    missing: Any = None


@dataclass(frozen=True)
class Key:
    """A key that an entry may have: the kind of its value, and what editors show of it."""

    kind: Kind
    about: str
    needed: bool = False


class Entry:
    """
    One mapping of the declaration.

    :ivar file: the file's name.
    :ivar name: how errors call the mapping; may be set anew when that is known.
    """

    def __init__(self, tree: Tree, file: str, name: str, keys: Table[str, Key]) -> None:
        self.file = file
        self.name = name
        self._keys = keys
        if not isinstance(tree, Mapping):
            raise GraphError(
                file, tree.line, f'{name} is {kind_of(tree)}',
                f'write a mapping with the keys {", ".join(keys)}')
        self._tree = tree
        for key in tree.entries:
            if key not in keys:
                raise self.error(
                    key, f'unknown key {shown(key)}',
                    did_you_mean(key, keys, f'use {", ".join(keys)}'))

    @property
    def line(self) -> int:
        """Return the line that the mapping starts in."""
        return self._tree.line

    def has(self, key: str) -> bool:
        """Whether the key stands there."""
        return key in self._tree.entries

    def get(self, key: str) -> Any:
        """Return the value of a key; what the kind has for a missing one, where it is missing."""
        value = self._tree.entries.get(key)
        described = self._keys[key]
        if value is None:
            if described.needed:
                raise self.error(None, f'{shown(key)} is missing', f'add {shown(key + ":")}')
            return described.kind.missing
        if isinstance(value, Scalar) and value.is_null:
            raise self.error(key, f'{shown(key)} has no value', 'give it one or remove the key')
        return described.kind.read(self, key, value)

    def one_of(self, keys: Table[str, Any], what: str) -> str:
        """Return the one key of several that stands there."""
        found = [key for key in keys if self.has(key)]
        if not found:
            raise self.error(None, f'nothing says {what}', f'add one of {", ".join(keys)}')
        if len(found) > 1:
            raise self.error(
                found[1], f'{listed(found)} exclude each other', 'keep one, or make two callbacks')
        return found[0]

    def line_of(self, key: str, item: str | None = None) -> int:
        """Return the line of a key, or of an item of the list there; else the mapping's line."""
        value = self._tree.entries.get(key)
        if isinstance(value, Sequence):
            for each in value.items:
                if isinstance(each, Scalar) and each.text == item:
                    return each.line
        return self._tree.key_lines.get(key, self.line)

    def error(
        self, key: str | None, problem: str, remedy: str, item: str | None = None
    ) -> GraphError:
        """Return the error about a key, an item of the list there, or the whole mapping."""
        line = self.line if key is None else self.line_of(key, item)
        return GraphError(self.file, line, f'{self.name}: {problem}', remedy)

    def value_error(self, key: str, value: Tree, problem: str, remedy: str) -> GraphError:
        """Return the error about a value at a key."""
        return GraphError(
            self.file, value.line, f'{self.name}: {shown(key)}: {problem}', remedy)


def text(check: Check, form: Schema, missing: str | None = None) -> Kind:
    """Return the kind of a text that a check finds right."""
    def read(entry: Entry, key: str, value: Tree) -> str:
        if not isinstance(value, Scalar):
            raise entry.value_error(key, value, f'is {kind_of(value)}', 'write a text')
        if value.is_null:
            raise entry.value_error(key, value, 'has an empty entry', 'write a text')
        wrong = check(value.text)
        if wrong is not None:
            raise entry.value_error(key, value, *wrong)
        return value.text

    return Kind(read, form, missing)


def name(what: Name) -> Kind:
    """Return the kind of such a name."""
    return text(what.check, {
        # YAML reads some short names as numbers, and this program does not.
        'type': 'string' if what.is_global else ['string', 'integer'],
        'pattern': f'^(?:{what.pattern.pattern})$|{ARGUMENT_USE}', 'maxLength': what.longest})


def choice(*words: str) -> Kind:
    """Return the kind of some words; where the key is missing it is the first."""
    def check(word: str) -> tuple[str, str] | None:
        if word in words:
            return None
        return (f'{shown(word)} is not known',
                did_you_mean(word, words, f'use {", ".join(words)}'))

    return text(check, {'anyOf': [{'enum': list(words)}, _USE]}, words[0])


def items(form: Schema) -> Kind:
    """Return the kind of a list that is not empty, whose items are read later."""
    def read(entry: Entry, key: str, value: Tree) -> list[Tree]:
        if not isinstance(value, Sequence):
            raise entry.error(
                key, f'{shown(key)} is {kind_of(value)}', 'write a list, as [a, b] or as - a')
        if not value.items:
            raise entry.error(key, f'{shown(key)} is empty', 'add an entry')
        return value.items

    return Kind(read, {'type': 'array', 'items': form, 'minItems': 1})


def texts(item: Kind, least: int = 0, *too_few: str) -> Kind:
    """
    Return the kind of a list of different texts.

    :param least: so many there are at least.
    :param too_few: what is wrong with fewer, and what to do.
    """
    def read(entry: Entry, key: str, value: Tree) -> tuple[str, ...]:
        if not isinstance(value, Sequence):
            raise entry.error(
                key, f'{shown(key)} is {kind_of(value)}', f'write a list, as {key}: [a, b]')
        result: dict[str, None] = {}
        for each in value.items:
            found = item.read(entry, key, each)
            if found in result:
                raise entry.value_error(
                    key, each, f'{shown(found)} stands there twice', 'remove one of them')
            result[found] = None
        if least and not result:
            raise entry.error(key, f'{shown(key)} is empty', 'add an entry')
        if len(result) < least:
            raise entry.error(key, too_few[0].format(len(result)), too_few[1])
        return tuple(result)

    return Kind(read, {'type': 'array', 'items': item.schema, 'minItems': least,
                       'uniqueItems': True}, ())


def numbers(**bounds: int) -> Kind:
    """Return the kind of a list of finite numbers that is not empty."""
    trees = items({'anyOf': [{'type': 'number', **bounds}, _USE]})

    def read(entry: Entry, key: str, value: Tree) -> list[float]:
        found = []
        for each in trees.read(entry, key, value):
            is_number = isinstance(each, Scalar) and each.plain and _NUMBER.fullmatch(each.text)
            number = float(each.text) if is_number else math.nan
            if not math.isfinite(number):
                raise entry.value_error(
                    key, each, f'{_described(each)} is not a number', 'write a finite number')
            found.append(number)
        return found

    return Kind(read, trees.schema)


def time(least_ns: int = MICROSECOND) -> Kind:
    """Return the kind of a time of at most a day, ns."""
    def read(entry: Entry, key: str, value: Tree) -> int:
        if not isinstance(value, Scalar):
            raise entry.error(
                key, f'{shown(key)} is {kind_of(value)}', "write a time, as '100ms'")
        try:
            return parse_duration(value.text, minimum_ns=least_ns, maximum_ns=DAY)
        except DurationError as error:
            raise entry.value_error(key, value, error.problem, error.remedy) from None

    return Kind(read, {'allOf': [{'$ref': '#/definitions/time'}]})


def whole(least: int, most: int) -> Kind:
    """Return the kind of a whole number within bounds."""
    def read(entry: Entry, key: str, value: Tree) -> int:
        if not (isinstance(value, Scalar) and value.plain and _INTEGER.fullmatch(value.text)):
            raise entry.error(key, f'{shown(key)} is {_described(value)}', 'write a whole number')
        if not least <= int(value.text) <= most:
            raise entry.error(key, f'{shown(key)} is {value.text}',
                              f'write a number from {least} to {most}')
        return int(value.text)

    return Kind(read, {'anyOf': [
        {'type': 'integer', 'minimum': least, 'maximum': most}, _USE]})


def truth() -> Kind:
    """Return the kind of true and false."""
    def read(entry: Entry, key: str, value: Tree) -> bool:
        if not (isinstance(value, Scalar) and value.plain and value.text in ('true', 'false')):
            raise entry.error(key, f'{shown(key)} is {_described(value)}', 'write true or false')
        return value.text == 'true'

    return Kind(read, {'anyOf': [{'type': 'boolean'}, _USE]})


def pairs(value_kind: Kind) -> Kind:
    """Return the kind of a mapping of texts; of each its key, text and line."""
    def read(entry: Entry, key: str, value: Tree) -> list[tuple[str, str, int]]:
        if not isinstance(value, Mapping):
            raise entry.error(key, f"'{key}' is no mapping", f'write {key}: {{name: value}}')
        keys = dict.fromkeys(value.entries, Key(value_kind, ''))
        inner = Entry(value, entry.file, f"{entry.name}: '{key}'", keys)
        return [(each, inner.get(each), inner.line_of(each)) for each in keys]

    return Kind(read, {'type': 'object', 'additionalProperties': value_kind.schema}, [])


def kind_of(tree: Tree) -> str:
    """Return what a tree is, in words."""
    if isinstance(tree, Scalar):
        return 'empty' if tree.is_null else f'the text {shown(tree.text)}'
    return 'a list' if isinstance(tree, Sequence) else 'a mapping'


def _described(tree: Tree) -> str:
    return shown(tree.text) if isinstance(tree, Scalar) else kind_of(tree)
