# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The language of declarations: every key with the kind of its value, for parser and editors.

Theory of operation
-------------------
An *entry* is a mapping of the declaration. A table lists its keys, each with the *kind* of its
value. A kind reads a value, with errors that name file, line and entry, and has its part of the
JSON Schema. So the tables below are the only description of a file: the parser uses them, and the
JSON Schema is made from them.

A *name* of a node, topic, callback, … is a text that is valid as such.

The schema is of draft 7, the one best supported by language servers for YAML. It describes single
entries; only ``load`` checks the rules about several (publishers, cycles, sinks).
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Mapping as Table
from dataclasses import dataclass
import math
import os
import re
from typing import Any

from msg_graph.duration import DAY, DurationError, MICROSECOND, parse_duration, UNITS
from msg_graph.errors import did_you_mean, GraphError, listed, shown
from msg_graph.model import ExecutionTime, MOST_WORKERS, WeaklyHard
from msg_graph.yamltext import Mapping, Scalar, Sequence, Tree

Schema = dict[str, Any]

ARGUMENT = re.compile(r'[A-Za-z_][A-Za-z0-9_]*')
ARGUMENT_USE = rf'\$\({ARGUMENT.pattern}\)'
"""An argument of the file in a value; the JSON Schema allows it in all values."""

_NUMBER = re.compile(r'[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?')
_OF = re.compile(r'[ \t]*([0-9]{1,6})[ \t]+of[ \t]+([0-9]{1,6})[ \t]*')
_INTEGER = re.compile(r'[+-]?[0-9]{1,18}')
_USE: Schema = {'type': 'string', 'pattern': ARGUMENT_USE}
_ROS_NAME = re.compile(r'(?:/[A-Za-z_][A-Za-z0-9_]*)+')
_WORD = re.compile(r'[A-Za-z0-9_][A-Za-z0-9_.-]*')

Check = Callable[[str], 'tuple[str, str] | None']
"""Checks a text; returns the problem and its remedy, or None."""


@dataclass(frozen=True)
class Name:
    """
    A kind of name.

    :ivar what: its description in errors.
    """

    what: str
    pattern: re.Pattern[str] = _WORD
    longest: int = 255

    @property
    def is_global(self) -> bool:
        """Return whether it is a full name of the ROS graph, as of a node or topic."""
        return self.pattern is _ROS_NAME

    def check(self, text: str) -> tuple[str, str] | None:
        """Return the problem of a name and its remedy, or None."""
        what = f'{self.what} name'
        if self.is_global and not text.startswith('/'):
            return (f'{shown(text)} is not an absolute {what}',
                    f'write it in full, as {shown("/" + text.lstrip("~/"))}')
        if not self.pattern.fullmatch(text):
            if self.is_global:
                return (f'{shown(text)} is not a valid {what}',
                        "use '/' and words of letters, digits and '_' that start with no digit")
            return (f'{shown(text)} is no name for a {self.what}',
                    "use letters, digits, '_', '-' and '.'")
        if len(text) > self.longest:
            return (f'the {what if self.is_global else "name"} {shown(text)} is too long',
                    f'use at most {self.longest} characters')
        return None


NODE = Name('node', _ROS_NAME)  # after rmw_validate_node_name and its namespaces
TOPIC = Name('topic', _ROS_NAME, 247)  # RMW_TOPIC_MAX_NAME_LENGTH
SERVICE = Name('service', _ROS_NAME, 247)
CALLBACK = Name('callback')
GROUP = Name('callback group')
DAG = Name('DAG', re.compile(r'/?[A-Za-z0-9_.-]+(?:/[A-Za-z0-9_.-]+)*'))
PATH = Name('path')
PROCESS = Name('process')


def check_read(text: str) -> tuple[str, str] | None:
    """Check an entry of ``reads``: a topic, or the name of a callback of the same node."""
    if ':' in text:
        return (
            f'{shown(text)} names a callback with its node',
            'name the topic that is taken, or just the name of a callback of the same node')
    return (TOPIC if text.startswith('/') else CALLBACK).check(text)


def check_key(text: str) -> tuple[str, str] | None:
    """Check the key of a callback, ``/node:callback``."""
    node, colon, name = text.rpartition(':')
    if not colon:
        return (f'{shown(text)} names no callback', "write '/node:callback'")
    return NODE.check(node) or CALLBACK.check(name)


@dataclass(frozen=True)
class Kind:
    """
    The kind of a value.

    :ivar read: returns the value at a key of an entry, or raises a ``GraphError``.
    :ivar schema: its JSON Schema.
    :ivar missing: its value if the key is missing.
    """

    read: Callable[[Entry, str, Tree], Any]
    schema: Schema
    missing: Any = None


@dataclass(frozen=True)
class Key:
    """A key that an entry may have: the kind of its value, and its description in editors."""

    kind: Kind
    about: str
    needed: bool = False


RENAMED = {'on_miss': 'on_late'}
"""Keys of earlier versions, and their present names."""


class Entry:
    """
    One mapping of the declaration.

    :ivar file: the file's name.
    :ivar name: the mapping's name in errors; it may be set later.
    """

    def __init__(self, tree: Tree, name: str, keys: Table[str, Key]) -> None:
        self.file = tree.file
        self.name = name
        self._keys = keys
        if not isinstance(tree, Mapping):
            raise GraphError(
                tree.file, tree.line, f'{name} is {kind_of(tree)}',
                f'write a mapping with the keys {", ".join(keys)}')
        self._tree = tree
        for key in tree.entries:
            if key not in keys:
                if RENAMED.get(key) in keys:
                    raise self.error(
                        key, f'unknown key {shown(key)}', f"write '{RENAMED[key]}:' instead")
                raise self.error(
                    key, f'unknown key {shown(key)}',
                    did_you_mean(key, keys, f'use {", ".join(keys)}'))

    @property
    def line(self) -> int:
        """Return the line that the mapping starts in."""
        return self._tree.line

    def has(self, key: str) -> bool:
        """Return whether the mapping has the key."""
        return key in self._tree.entries

    def get(self, key: str) -> Any:
        """Return the value of a key, or the kind's value for a missing key."""
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
        """Return the key that the mapping has, of several alternatives."""
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
    """Return the kind of a text that passes a check."""
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
    """Return the kind of a name."""
    return text(what.check, {
        # YAML reads some short names as numbers, and this program does not.
        'type': 'string' if what.is_global else ['string', 'integer'],
        'pattern': f'^(?:{what.pattern.pattern})$|{ARGUMENT_USE}', 'maxLength': what.longest})


def choice(*words: str, missing: str | None = '') -> Kind:
    """Return the kind of a choice of words; a missing key gives the first, or ``missing``."""
    def check(word: str) -> tuple[str, str] | None:
        if word in words:
            return None
        return (f'{shown(word)} is not known',
                did_you_mean(word, words, f'use {", ".join(words)}'))

    return text(
        check, {'anyOf': [{'enum': list(words)}, _USE]}, words[0] if missing == '' else missing)


def items(form: Schema) -> Kind:
    """Return the kind of a non-empty list whose items are read later."""
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

    :param least: the minimum number of texts.
    :param too_few: the problem of fewer texts, and its remedy.
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
                    key, each, f'{shown(found)} is listed twice', 'remove one of them')
            result[found] = None
        if least and not result:
            raise entry.error(key, f'{shown(key)} is empty', 'add an entry')
        if len(result) < least:
            raise entry.error(key, too_few[0].format(len(result)), too_few[1])
        return tuple(result)

    return Kind(read, {'type': 'array', 'items': item.schema, 'minItems': least,
                       'uniqueItems': True}, ())


def numbers(**bounds: int) -> Kind:
    """Return the kind of a non-empty list of finite numbers."""
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
    """Return the kind of an integer within bounds."""
    def read(entry: Entry, key: str, value: Tree) -> int:
        if not (isinstance(value, Scalar) and value.plain and _INTEGER.fullmatch(value.text)):
            raise entry.error(key, f'{shown(key)} is {_described(value)}', 'write an integer')
        if not least <= int(value.text) <= most:
            raise entry.error(key, f'{shown(key)} is {value.text}',
                              f'write a number from {least} to {most}')
        return int(value.text)

    return Kind(read, {'anyOf': [
        {'type': 'integer', 'minimum': least, 'maximum': most}, _USE]})


def truth() -> Kind:
    """Return the kind of a boolean."""
    def read(entry: Entry, key: str, value: Tree) -> bool:
        if not (isinstance(value, Scalar) and value.plain and value.text in ('true', 'false')):
            raise entry.error(key, f'{shown(key)} is {_described(value)}', 'write true or false')
        return value.text == 'true'

    return Kind(read, {'anyOf': [{'type': 'boolean'}, _USE]})


def pairs(value_kind: Kind) -> Kind:
    """Return the kind of a mapping of texts: key, text and line of each."""
    def read(entry: Entry, key: str, value: Tree) -> list[tuple[str, str, int]]:
        if not isinstance(value, Mapping):
            raise entry.error(key, f"'{key}' is no mapping", f'write {key}: {{name: value}}')
        keys = dict.fromkeys(value.entries, Key(value_kind, ''))
        inner = Entry(value, f"{entry.name}: '{key}'", keys)
        return [(each, inner.get(each), inner.line_of(each)) for each in keys]

    return Kind(read, {'type': 'object', 'additionalProperties': value_kind.schema}, [])


def kind_of(tree: Tree) -> str:
    """Return a description of a tree."""
    if isinstance(tree, Scalar):
        return 'empty' if tree.is_null else f'the text {shown(tree.text)}'
    return 'a list' if isinstance(tree, Sequence) else 'a mapping'


def _described(tree: Tree) -> str:
    return shown(tree.text) if isinstance(tree, Scalar) else kind_of(tree)


FORMAT = '1'


def _check_format(given: str) -> tuple[str, str] | None:
    if given == FORMAT:
        return None
    return f'{shown(given)} is no known version of the format', f"write 'mddag: {FORMAT}'"


def _check_file(path: str) -> tuple[str, str] | None:
    if os.path.isabs(path) or path.startswith('~') or '\0' in path or not path:
        return (f'{shown(path)} is no relative path',
                'write it as seen from the file that includes it')
    return None


def weakly_hard() -> Kind:
    """Return the kind of 'N of M': at most N misses in any M results in a row."""
    def read(entry: Entry, key: str, value: Tree) -> WeaklyHard:
        found = _OF.fullmatch(value.text) if isinstance(value, Scalar) else None
        if found is None:
            raise entry.value_error(
                key, value, f'is {_described(value)}', "write how many of how many, as '1 of 100'")
        misses, of = int(found[1]), int(found[2])
        if not 0 < misses < of:
            raise entry.value_error(
                key, value, f'{misses} of {of} makes no sense',
                'tolerate at least 1 miss, and fewer than all')
        return WeaklyHard(misses, of)

    return Kind(read, {'type': 'string', 'pattern': f'^(?:{_OF.pattern})$|{ARGUMENT_USE}',
                       'examples': ['1 of 100']})


def _read_execution_time(entry: Entry, key: str, value: Tree) -> ExecutionTime:
    if isinstance(value, Scalar):
        return ExecutionTime((time(least_ns=1).read(entry, key, value),), (50.0,))
    inner = Entry(value, f'execution time of {entry.name}', QUANTILES)
    quantiles_us = inner.get('quantiles_us')
    if quantiles_us[0] < 0:
        raise inner.error('quantiles_us', f'the quantile {quantiles_us[0]} is negative',
                          'write times in us')
    for before, after in zip(quantiles_us, quantiles_us[1:]):
        if after < before:
            raise inner.error('quantiles_us', f'the quantile {after} comes after {before}',
                              'write them in rising order')
    if not 1 <= quantiles_us[-1] * 1000 <= DAY:
        raise inner.error(
            'quantiles_us', f'the largest quantile, {quantiles_us[-1]} us, makes no sense',
            'write times from 0.001 us to a day, in us')
    return ExecutionTime(tuple(round(us * 1000) for us in quantiles_us),
                         _percent(inner, len(quantiles_us)))


def _read_processes(entry: Entry, key: str, value: Tree) -> dict[str, dict[str, int]]:
    """Return the nodes of each process, with their lines."""
    found: dict[str, dict[str, int]] = {}
    for process, _, line in _NODES_BY_PROCESS.read(entry, key, value):
        wrong = PROCESS.check(process)
        if wrong is not None:
            problem, remedy = wrong
            raise GraphError(entry.file, line, f'{entry.name}: {shown(key)}: {problem}', remedy)
        nodes = value.entries[process] if isinstance(value, Mapping) else None
        assert isinstance(nodes, Sequence)
        found[process] = {each.text: each.line for each in nodes.items if isinstance(each, Scalar)}
    return found


def _percent(entry: Entry, count: int) -> tuple[float, ...]:
    """Return the percentages of the quantiles: declared, or evenly spaced."""
    percent = entry.get('percent')
    if percent is None:
        return tuple(100.0 * i / (count - 1) for i in range(count)) if count > 1 else (50.0,)
    if len(percent) != count:
        raise entry.error(
            'percent', f'the number of shares is {len(percent)}, that of quantiles {count}',
            'give one for each')
    if percent[0] < 0 or percent[-1] > 100:
        raise entry.error('percent', 'a share is not within 0 and 100', 'write percentages')
    if any(after <= before for before, after in zip(percent, percent[1:])):
        raise entry.error('percent', 'the shares do not rise', 'write them in rising order')
    return tuple(percent)


def _entries(what: str) -> Kind:
    return items({'$ref': f'#/definitions/{what}'})


def _mapping(keys: dict[str, Key]) -> Schema:
    return {'type': 'object', 'additionalProperties': False,
            'required': [word for word, key in keys.items() if key.needed],
            'properties': {word: {**key.kind.schema, 'description': key.about}
                           for word, key in keys.items()}}


_NODES_BY_PROCESS = pairs(texts(name(NODE)))
_PROCESSES = Kind(_read_processes, {
    **_NODES_BY_PROCESS.schema, 'propertyNames': {'pattern': f'^(?:{PROCESS.pattern.pattern})$'}},
    {})
_VALUES = pairs(text(lambda _: None, {'type': ['string', 'number', 'boolean', 'null']}))

QUANTILES = {
    'quantiles_us': Key(numbers(minimum=0), 'Quantiles in us, rising.', needed=True),
    'percent': Key(numbers(minimum=0, maximum=100), 'The shares that they belong to, rising.'),
}
_EXECUTION_TIME = Kind(_read_execution_time, {'oneOf': [time().schema, _mapping(QUANTILES)]})

FILE = {
    'mddag': Key(text(_check_format, {'enum': [int(FORMAT), FORMAT]}),
                 'Version of the format.', needed=True),
    'arguments': Key(_VALUES,
                     'Arguments of this file, $(name) in its values, with their defaults.'),
    'include': Key(_entries('include'),
                   'Files whose nodes and paths come before those of this one.'),
    'workers': Key(whole(1, MOST_WORKERS), 'Number of workers that the system is made for.'),
    'nodes': Key(_entries('node'),
                 'The nodes; a node may have several entries, and their order counts for ties.',
                 needed=True),
    'processes': Key(_PROCESSES, 'The processes that the nodes run in, each with its nodes; those '
                     'that are not named run in the first.'),
    'paths': Key(_entries('path'), 'End-to-end paths over trigger and queue edges.'),
}
INCLUDE = {
    'file': Key(text(_check_file, {'type': 'string'}), 'The file, as seen from this one.',
                needed=True),
    'namespace': Key(name(NODE), 'Put before all names of the included file.'),
    'remap': Key(pairs(name(TOPIC)), 'Names of the included file and what they become.'),
    'set': Key(_VALUES, 'Values of the arguments of the included file.'),
}
NODE_KEYS = {
    'node': Key(name(NODE), 'Fully qualified name of the node.', needed=True),
    'callbacks': Key(_entries('callback'), 'Its callbacks.', needed=True),
}
TRIGGERS = {
    'timer': Key(time(), 'A timer of this period starts it.'),
    'subscription': Key(name(TOPIC), 'A message on this topic starts it.'),
    'sync': Key(texts(name(TOPIC), 2, 'a sync callback joins topics, and here is {}',
                      "give at least 2, or write 'subscription:' for one topic"),
                'Messages on all of these topics together start it.'),
    'service': Key(name(SERVICE), 'A request of this service starts it.'),
}
CALLBACK_KEYS = {
    'name': Key(name(CALLBACK), 'Name of the callback, unique in its node.', needed=True),
    **TRIGGERS,
    'period': Key(time(), 'Time between two releases of a source that is no timer.'),
    'publishes': Key(texts(name(TOPIC)), 'The topics that it publishes.'),
    'reads': Key(texts(text(check_read, {'anyOf': [name(TOPIC).schema, name(CALLBACK).schema]})),
                 'Queue edges: topics that it takes messages from, and callbacks of its node '
                 'whose variables it reads. They never start it.'),
    'deadline': Key(time(), 'Relative deadline of a sink, counted from the release of its DAG.'),
    'release_from': Key(choice('arrival', 'source_timestamp', 'header_stamp'),
                        'Where the release time of a source comes from.'),
    'execution_time': Key(_EXECUTION_TIME, 'Its execution time: constant, or quantiles.'),
    'holds_interpreter': Key(truth(), 'Whether it computes in Python (true), or waits, or '
                             'computes with the lock of the interpreter released (false).'),
    'group': Key(name(GROUP), 'Its mutually exclusive callback group in the node.'),
    'dag': Key(name(DAG), 'Name of the DAG that it is the source of.'),
    'on_late': Key(choice('continue', 'demote', 'abort', missing=None),
                   'What is done with a late job of its DAG, if it is a source.'),
    'keep': Key(choice('all', 'newest'),
                'Of a source or sink: newest drops what has not started when the next is ready.'),
    'importance': Key(choice('high', 'normal', 'low', missing='normal'),
                      'Of a sink: in an overload the least important is late first.'),
    'tolerate': Key(weakly_hard(), "Of a sink: how many misses are tolerated, as '1 of 100'."),
    'max_active_jobs': Key(whole(1, 1_000_000),
                           'Bound on the open jobs of its DAG, if it is a source.'),
}
PATH_KEYS = {
    'name': Key(name(PATH), 'Name of the path.', needed=True),
    'callbacks': Key(texts(text(check_key, {'type': 'string', 'pattern': (
        f'^(?:{NODE.pattern.pattern}):(?:{CALLBACK.pattern.pattern})$|{ARGUMENT_USE}')}),
        2, 'a path of one callback', 'give at least 2'),
        "The callbacks along it, each as '/node:callback'.", needed=True),
}


def schema() -> Schema:
    """Return the JSON Schema of the declaration."""
    return {
        '$schema': 'http://json-schema.org/draft-07/schema#',
        'title': 'mddag declaration',
        'description': 'Nodes, their callbacks and what starts them, with periods and deadlines.',
        **_mapping(FILE),
        'required': ['mddag'],
        'anyOf': [{'required': ['nodes']}, {'required': ['include']}],
        'definitions': {
            'include': {'oneOf': [INCLUDE['file'].kind.schema, _mapping(INCLUDE)]},
            'node': _mapping(NODE_KEYS),
            'callback': {**_mapping(CALLBACK_KEYS),
                         'oneOf': [{'required': [key]} for key in TRIGGERS]},
            'path': _mapping(PATH_KEYS),
            'time': {
                'type': 'string',
                'pattern': rf'^[ \t]*\+?([0-9]+(\.[0-9]*)?|\.[0-9]+)[ \t]*({"|".join(UNITS)})'
                           rf'[ \t]*$|{ARGUMENT_USE}',
                'examples': ['100ms', '20us', '1.5s'],
            },
        },
    }
