# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Typed access to the mappings of a declaration, with errors that name file, line and entry."""

from __future__ import annotations

from collections.abc import Callable
import math
import re

from msg_graph.duration import DAY, DurationError, MICROSECOND, parse_duration
from msg_graph.errors import did_you_mean, GraphError, listed, shown
from msg_graph.yamltext import Mapping, Scalar, Sequence, Tree

LONGEST_TOPIC = 247  # RMW_TOPIC_MAX_NAME_LENGTH of rmw
LONGEST_NODE = 255  # RMW_NODE_NAME_MAX_NAME_LENGTH of rmw
LONGEST_WORD = 255
ROS_NAME = re.compile(r'(?:/[A-Za-z_][A-Za-z0-9_]*)+')
WORD = re.compile(r'[A-Za-z0-9_][A-Za-z0-9_.-]*')
DAG_NAME = re.compile(r'/?[A-Za-z0-9_.-]+(?:/[A-Za-z0-9_.-]+)*')
_NUMBER = re.compile(r'[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?')
_INTEGER = re.compile(r'[+-]?[0-9]{1,18}')
_TRUTHS = {'true': True, 'false': False}

Check = Callable[[str], 'tuple[str, str] | None']
"""Looks at a text; returns what is wrong with it and what to do, or None."""


def _check_ros_name(text: str, what: str, longest: int) -> tuple[str, str] | None:
    if not text.startswith('/'):
        return (
            f'{shown(text)} is not an absolute {what} name',
            f'write it in full, as {shown("/" + text.lstrip("~/"))}')
    if not ROS_NAME.fullmatch(text):
        return (
            f'{shown(text)} is not a valid {what} name',
            "use '/' and words of letters, digits and '_' that start with no digit")
    if len(text) > longest:
        return (f'the {what} name {shown(text)} is too long', f'use at most {longest} characters')
    return None


def check_node(text: str) -> tuple[str, str] | None:
    """Check a fully qualified node name (as rmw_validate_node_name and namespaces ask)."""
    return _check_ros_name(text, 'node', LONGEST_NODE)


def check_topic(text: str) -> tuple[str, str] | None:
    """Check a fully qualified topic name (as rmw_validate_full_topic_name asks)."""
    return _check_ros_name(text, 'topic', LONGEST_TOPIC)


def check_service(text: str) -> tuple[str, str] | None:
    """Check a fully qualified service name."""
    return _check_ros_name(text, 'service', LONGEST_TOPIC)


def _check_word(text: str, what: str, pattern: re.Pattern[str]) -> tuple[str, str] | None:
    if not pattern.fullmatch(text):
        return (f'{shown(text)} is no name for a {what}', "use letters, digits, '_', '-' and '.'")
    if len(text) > LONGEST_WORD:
        return (f'the name {shown(text)} is too long', f'use at most {LONGEST_WORD} characters')
    return None


def check_callback(text: str) -> tuple[str, str] | None:
    """Check the name of a callback within its node."""
    return _check_word(text, 'callback', WORD)


def check_group(text: str) -> tuple[str, str] | None:
    """Check the name of a callback group within its node."""
    return _check_word(text, 'callback group', WORD)


def check_dag(text: str) -> tuple[str, str] | None:
    """Check the name of a DAG; like a node's it may have '/'."""
    return _check_word(text, 'DAG', DAG_NAME)


def check_path(text: str) -> tuple[str, str] | None:
    """Check the name of an end-to-end path."""
    return _check_word(text, 'path', WORD)


def check_read(text: str) -> tuple[str, str] | None:
    """Check an entry of ``reads``: a topic, or the name of a callback of the same node."""
    if ':' in text:
        return (
            f'{shown(text)} names a callback with its node',
            'name the topic that is taken, or just the name of a callback of the same node')
    return check_topic(text) if text.startswith('/') else check_callback(text)


def check_key(text: str) -> tuple[str, str] | None:
    """Check the key of a callback, ``/node:callback``."""
    node, colon, name = text.rpartition(':')
    if not colon:
        return (f'{shown(text)} names no callback', "write '/node:callback'")
    return check_node(node) or check_callback(name)


class Fields:
    """
    One mapping of the declaration.

    Every method takes a key. Those named ``..._or_none`` return None where the key is missing; the
    others raise the error that says so.

    :ivar file: the file's name.
    :ivar entry: how errors call the mapping; may be set anew when its name is known.
    """

    def __init__(self, tree: Tree, file: str, entry: str, known: tuple[str, ...]) -> None:
        self.file = file
        self.entry = entry
        if not isinstance(tree, Mapping):
            raise GraphError(
                file, tree.line, f'{entry} is {_kind_of(tree)}',
                f'write a mapping with the keys {", ".join(known)}')
        self._tree = tree
        for key in tree.entries:
            if key not in known:
                raise self.error(
                    key, f'unknown key {shown(key)}',
                    did_you_mean(key, known, f'use {", ".join(known)}'))

    @property
    def line(self) -> int:
        """Return the line that the mapping starts in."""
        return self._tree.line

    def has(self, key: str) -> bool:
        """Whether the key stands there."""
        return key in self._tree.entries

    def line_of(self, key: str, item: str | None = None) -> int:
        """Return the line of a key, or of an item of the list there; else the mapping's line."""
        value = self._tree.entries.get(key)
        if isinstance(value, Sequence):
            for each in value.items:
                if isinstance(each, Scalar) and each.text == item:
                    return each.line
        return self._tree.key_lines.get(key, self.line)

    def error(self, key: str | None, problem: str, remedy: str) -> GraphError:
        """Return the error about a key, or about the whole mapping."""
        line = self.line if key is None else self.line_of(key)
        return GraphError(self.file, line, f'{self.entry}: {problem}', remedy)

    def tree(self, key: str) -> Tree:
        """Return what stands at a key."""
        value = self.tree_or_none(key)
        if value is None:
            raise self.error(None, f'{shown(key)} is missing', f'add {shown(key + ":")}')
        return value

    def tree_or_none(self, key: str) -> Tree | None:
        """Return what stands at a key."""
        value = self._tree.entries.get(key)
        if isinstance(value, Scalar) and value.is_null:
            raise self.error(key, f'{shown(key)} has no value', 'give it one or remove the key')
        return value

    def sequence(self, key: str) -> list[Tree]:
        """Return the items of a list that must not be empty."""
        value = self.tree(key)
        if not isinstance(value, Sequence):
            raise self.error(
                key, f'{shown(key)} is {_kind_of(value)}', 'write a list, as [a, b] or as - a')
        if not value.items:
            raise self.error(key, f'{shown(key)} is empty', 'add an entry')
        return value.items

    def _text_of(self, key: str, value: Tree, check: Check) -> str:
        if not isinstance(value, Scalar):
            raise self._value_error(key, value, f'is {_kind_of(value)}', 'write a text')
        if value.is_null:
            raise self._value_error(key, value, 'has an empty entry', 'write a text')
        wrong = check(value.text)
        if wrong is not None:
            raise self._value_error(key, value, wrong[0], wrong[1])
        return value.text

    def _value_error(self, key: str, value: Tree, problem: str, remedy: str) -> GraphError:
        return GraphError(
            self.file, value.line, f'{self.entry}: {shown(key)}: {problem}', remedy)

    def text(self, key: str, check: Check) -> str:
        """Return a text."""
        return self._text_of(key, self.tree(key), check)

    def text_or_none(self, key: str, check: Check) -> str | None:
        """Return a text."""
        value = self.tree_or_none(key)
        return None if value is None else self._text_of(key, value, check)

    def texts(self, key: str, check: Check) -> tuple[str, ...]:
        """Return a list of different texts; none where the key is missing."""
        value = self.tree_or_none(key)
        if value is None:
            return ()
        if not isinstance(value, Sequence):
            raise self.error(
                key, f'{shown(key)} is {_kind_of(value)}', f'write a list, as {key}: [a, b]')
        result: dict[str, None] = {}
        for item in value.items:
            text = self._text_of(key, item, check)
            if text in result:
                raise self._value_error(
                    key, item, f'{shown(text)} stands there twice', 'remove one of them')
            result[text] = None
        return tuple(result)

    def choice(self, key: str, choices: tuple[str, ...]) -> str:
        """Return one of the choices; the first where the key is missing."""

        def check(text: str) -> tuple[str, str] | None:
            if text in choices:
                return None
            return (
                f'{shown(text)} is not known',
                did_you_mean(text, choices, f'use {", ".join(choices)}'))

        return self.text_or_none(key, check) or choices[0]

    def truth_or_none(self, key: str) -> bool | None:
        """Return true or false."""
        value = self.tree_or_none(key)
        if value is None:
            return None
        if not (isinstance(value, Scalar) and value.plain and value.text in _TRUTHS):
            what = shown(value.text) if isinstance(value, Scalar) else _kind_of(value)
            raise self.error(key, f'{shown(key)} is {what}', 'write true or false')
        return _TRUTHS[value.text]

    def duration_or_none(self, key: str, minimum_ns: int = MICROSECOND) -> int | None:
        """Return a time of at most a day, in ns."""
        value = self.tree_or_none(key)
        if value is None:
            return None
        if not isinstance(value, Scalar):
            raise self.error(
                key, f'{shown(key)} is {_kind_of(value)}', "write a time, as '100ms'")
        try:
            return parse_duration(value.text, minimum_ns=minimum_ns, maximum_ns=DAY)
        except DurationError as error:
            raise self._value_error(key, value, error.problem, error.remedy) from None

    def integer_or_none(self, key: str, minimum: int, maximum: int) -> int | None:
        """Return a whole number within bounds."""
        value = self.tree_or_none(key)
        if value is None:
            return None
        if not (isinstance(value, Scalar) and value.plain and _INTEGER.fullmatch(value.text)):
            what = shown(value.text) if isinstance(value, Scalar) else _kind_of(value)
            raise self.error(key, f'{shown(key)} is {what}', 'write a whole number')
        if not minimum <= int(value.text) <= maximum:
            raise self.error(
                key, f'{shown(key)} is {value.text}',
                f'write a number from {minimum} to {maximum}')
        return int(value.text)

    def numbers(self, key: str) -> list[float]:
        """Return a list of finite numbers that must not be empty."""
        numbers = []
        for item in self.sequence(key):
            number = _number(item)
            if number is None:
                what = shown(item.text) if isinstance(item, Scalar) else _kind_of(item)
                raise self._value_error(
                    key, item, f'{what} is not a number', 'write a finite number')
            numbers.append(number)
        return numbers

    def one_of(self, keys: tuple[str, ...], what: str) -> str:
        """Return the one key of several that stands there."""
        found = [key for key in keys if self.has(key)]
        if not found:
            raise self.error(None, f'nothing says {what}', f'add one of {", ".join(keys)}')
        if len(found) > 1:
            raise self.error(
                found[1], f'{listed(found)} exclude each other', 'keep one, or make two callbacks')
        return found[0]


def _kind_of(tree: Tree) -> str:
    if isinstance(tree, Scalar):
        return 'empty' if tree.is_null else f'the text {shown(tree.text)}'
    return 'a list' if isinstance(tree, Sequence) else 'a mapping'


def _number(tree: Tree) -> float | None:
    """Return a finite number, or None for anything else."""
    if not (isinstance(tree, Scalar) and tree.plain and _NUMBER.fullmatch(tree.text)):
        return None
    number = float(tree.text)
    return number if math.isfinite(number) else None
