# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The language of declarations: every key with the kind of its value, for parser and editors.

Theory of operation
-------------------
An *entry* is a mapping of the declaration. A table lists its keys, each with the *kind* of its
value. A kind reads a value, and has its part of the JSON Schema. So the tables below are the only
description of a file: the parser uses them, and the JSON Schema is made from them.

There are three kinds: a single value (``scalar``), a list (``list_of``) and a mapping with keys of
the user (``mapping_of``). A single value is text; a function turns it into a time, a name, … or
says what is wrong with it. Errors name the entry and the key (*where*), file and line.

The schema is of draft 7, the one best supported by language servers for YAML. It describes single
entries; only ``load`` checks the rules about several (publishers, cycles, sinks).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from collections.abc import Mapping as Table
from dataclasses import dataclass
import math
import os
import re
from typing import Any

from msg_graph.duration import DAY, MICROSECOND, parse_duration, UNITS
from msg_graph.errors import did_you_mean, GraphError, quoted, ValueProblem
from msg_graph.model import ExecutionTime, MOST_WORKERS, WeaklyHard
from msg_graph.yamltext import Mapping, Scalar, Sequence, Tree

Schema = dict[str, Any]

ARGUMENT_REFERENCE = r'\$\([A-Za-z_][A-Za-z0-9_]*\)'
"""An argument of the file in a value; the JSON Schema allows it in all values."""

_DRIVEN = "write it inside of the sync, as 'sync: {topics: [/a, /b], driven_by: /a}'"
ELSEWHERE = {
    'driven_by': _DRIVEN, 'topics': _DRIVEN,
    'deadline': "write it in a callback; a path has 'reaction:' and 'age:'"}
"""Keys in the wrong place, and where they belong; the keys of other entries are added below."""

_NUMBER = re.compile(r'[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?')
_TOLERANCE_PATTERN = re.compile(r'[ \t]*([0-9]{1,6})[ \t]+of[ \t]+([0-9]{1,6})[ \t]*')
_INTEGER = re.compile(r'[+-]?[0-9]{1,18}')
_REFERENCE_SCHEMA: Schema = {'type': 'string', 'pattern': ARGUMENT_REFERENCE}
_ROS_NAME = re.compile(r'(?:/[A-Za-z_][A-Za-z0-9_]*)+')
_WORD = re.compile(r'[A-Za-z0-9_][A-Za-z0-9_.-]*')


@dataclass(frozen=True)
class Name:
    """
    A kind of name.

    :ivar what: its description in errors.
    :ivar allowed: what a name that is not global consists of.
    """

    what: str
    pattern: re.Pattern[str] = _WORD
    longest: int = 255
    allowed: str = "letters, digits, '_', '-' and '.'"

    @property
    def is_global(self) -> bool:
        """Return whether it is a full name of the ROS graph, as of a node or topic."""
        return self.pattern is _ROS_NAME

    def check(self, text: str) -> str:
        """Return a name; raise ``ValueProblem`` if it is not valid."""
        problem, remedy = '', ''
        full = '/' + text.lstrip('~/')
        if self.is_global and not text.startswith('/') and self.pattern.fullmatch(full):
            problem = f'{quoted(text)} is not an absolute {self.what} name'
            remedy = f'write it in full, as {quoted(full)}'
        elif not self.pattern.fullmatch(text):
            problem = f'{quoted(text)} is not a valid {self.what} name'
            remedy = ("use '/' and words of letters, digits and '_' that start with no digit"
                      if self.is_global else f'use {self.allowed}')
        elif len(text) > self.longest:
            problem = f'the {self.what} name {quoted(text)} is too long'
            remedy = f'use at most {self.longest} characters'
        if problem:
            raise ValueProblem(problem, remedy)
        return text

    def fits(self, text: str) -> bool:
        """Return whether a text is a valid name."""
        return len(text) <= self.longest and self.pattern.fullmatch(text) is not None

    @property
    def schema(self) -> Schema:
        """Return the JSON Schema."""
        return {
            # YAML reads some short names as numbers, and this program does not.
            'type': 'string' if self.is_global else ['string', 'integer'],
            'pattern': f'^(?:{self.pattern.pattern})$|{ARGUMENT_REFERENCE}',
            'maxLength': self.longest}


NODE = Name('node', _ROS_NAME)  # after rmw_validate_node_name and its namespaces
TOPIC = Name('topic', _ROS_NAME, 247)  # RMW_TOPIC_MAX_NAME_LENGTH
SERVICE = Name('service', _ROS_NAME, 247)
CALLBACK = Name('callback')
GROUP = Name('callback group')
DAG = Name('DAG', re.compile(r'/?[A-Za-z0-9_.-]+(?:/[A-Za-z0-9_.-]+)*'))
PATH = Name('path')
PROCESS = Name('process')
ARGUMENT = Name('argument', re.compile(r'[A-Za-z_][A-Za-z0-9_]*'),
                allowed="letters, digits and '_', and no digit first")


def kind_of(tree: Tree) -> str:
    """Return a description of a tree."""
    if isinstance(tree, Scalar):
        return ('an empty value' if tree.is_null or not tree.text
                else f'the text {quoted(tree.text)}')
    return 'a list' if isinstance(tree, Sequence) else 'a mapping'


def error_at(value: Tree, where: str, problem: str, remedy: str) -> GraphError:
    """Return the error about a value."""
    return GraphError(value.file, value.line, f'{where}: {problem}', remedy)


@dataclass(frozen=True)
class Kind:
    """
    The kind of a value.

    :ivar read: returns a value, named *where* in errors, or raises a ``GraphError``.
    :ivar schema: its JSON Schema.
    :ivar missing: its value if the key is missing.
    """

    read: Callable[[Tree, str], Any]
    schema: Schema
    missing: Any = None


@dataclass(frozen=True)
class Key:
    """
    A key that an entry may have.

    :ivar about: its description in editors.
    :ivar of: the callbacks that may have it, if only these: sources, sinks or both.
    """

    kind: Kind
    about: str
    needed: bool = False
    of: tuple[str, ...] = ()


class Entry:
    """
    One mapping of the declaration.

    :ivar file: the file's name.
    :ivar name: the mapping's name in errors; it may be set later.
    """

    def __init__(self, tree: Tree, name: str, keys: Table[str, Key]) -> None:
        self.file = tree.file
        self.line = tree.line
        self.name = name
        self._keys = keys
        if not isinstance(tree, Mapping):
            raise error_at(tree, name, f'{kind_of(tree)} is not a mapping',
                           f'write one with the keys {", ".join(keys)}')
        self._tree = tree
        for key in tree.entries:
            if key not in keys:
                remedy = ELSEWHERE.get(key) or did_you_mean(key, keys, f'use {", ".join(keys)}')
                raise self.error(key, f'unknown key {quoted(key)}', remedy)

    def __contains__(self, key: str) -> bool:
        return key in self._tree.entries

    def __iter__(self) -> Iterator[str]:
        return iter(self._tree.entries)

    def get(self, key: str) -> Any:
        """Return the value of a key, or the kind's value for a missing key."""
        value = self._tree.entries.get(key)
        described = self._keys[key]
        if value is None:
            if described.needed:
                raise self.error(None, f'{quoted(key)} is missing', f'add {quoted(key + ":")}')
            return described.kind.missing
        if isinstance(value, Scalar) and value.is_null:
            raise self.error(key, f'{quoted(key)} has no value', 'give it one or remove the key')
        return described.kind.read(value, f'{self.name}: {quoted(key)}')

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


# --- the three kinds -----------------------------------------------------------------------------

def scalar(
    parse: Callable[[str], Any], form: Schema, missing: Any = None, what: str = 'a text',
) -> Kind:
    """
    Return the kind of a single value.

    :param parse: turns its text into the value, or raises a ``ValueProblem``.
    :param what: what to write.
    """
    def read(value: Tree, where: str) -> Any:
        if not isinstance(value, Scalar) or value.is_null:
            raise error_at(
                value, where, f'{kind_of(value)} is not a single value', f'write {what}')
        try:
            return parse(value.text)
        except ValueProblem as error:
            raise error_at(value, where, error.problem, error.remedy) from None

    return Kind(read, form, missing)


def list_of(item: Kind, least: int = 1, different: bool = False, too_few: str = '') -> Kind:
    """
    Return the kind of a list, read as a tuple.

    :param different: no two items may be equal.
    :param too_few: what to do about too few items.
    """
    def read(value: Tree, where: str) -> tuple[Any, ...]:
        if not isinstance(value, Sequence):
            raise error_at(value, where, f'{kind_of(value)} is not a list',
                           'write a list, as [a, b] or as - a')
        if len(value.items) < least:
            raise error_at(value, where, f'the list is {"too short" if value.items else "empty"}',
                           too_few if value.items else 'add an entry')
        found = [item.read(each, where) for each in value.items]
        if different and len(set(found)) < len(found):
            place = next(i for i, each in enumerate(found) if each in found[:i])
            raise error_at(value.items[place], where,
                           f'{quoted(found[place])} is listed twice', 'remove one of them')
        return tuple(found)

    form = {'type': 'array', 'items': item.schema, 'minItems': least}
    return Kind(read, {**form, 'uniqueItems': True} if different else form, ())


def mapping_of(values: Kind, names: Name | None = None) -> Kind:
    """Return the kind of a mapping with keys of the user, read as an ``Entry``."""
    key = Key(values, '')

    def read(value: Tree, where: str) -> Entry:
        given = value.entries if isinstance(value, Mapping) else ('NAME',)
        entry = Entry(value, where, dict.fromkeys(given, key))
        for each in given:
            if names is not None:
                scalar(names.check, {}).read(Scalar(entry.file, entry.line_of(each), each), where)
        return entry

    form = {'type': 'object', 'additionalProperties': values.schema}
    if names is not None:
        form['propertyNames'] = {'pattern': f'^(?:{names.pattern.pattern})$'}
    return Kind(read, form, Entry(Mapping('', 0), '', {}))


# --- single values -------------------------------------------------------------------------------

def name_kind(what: Name) -> Kind:
    """Return the kind of a name."""
    return scalar(what.check, what.schema, what=f'a {what.what} name')


def choice(
    *words: str, missing: str | None = None, gone: Table[str, str] | None = None
) -> Kind:
    """
    Return the kind of a choice of words.

    :param gone: words of earlier versions, and what to do instead.
    """
    def parse(word: str) -> str:
        if gone is not None and word in gone:
            raise ValueProblem(f'{quoted(word)} is gone', gone[word])
        if word not in words:
            raise ValueProblem(f'{quoted(word)} is not known',
                               did_you_mean(word, words, f'use {", ".join(words)}'))
        return word

    return scalar(parse, {'anyOf': [{'enum': list(words)}, _REFERENCE_SCHEMA]}, missing,
                  what=f'one of {", ".join(words)}')


def duration_kind(least_ns: int = MICROSECOND) -> Kind:
    """Return the kind of a time of at most a day, ns."""
    return scalar(lambda text: parse_duration(text, minimum_ns=least_ns),
                  {'allOf': [{'$ref': '#/definitions/time'}]}, what="a time, as '100ms'")


def whole(least: int, most: int) -> Kind:
    """Return the kind of an integer within bounds."""
    def parse(text: str) -> int:
        if not (_INTEGER.fullmatch(text) and least <= int(text) <= most):
            raise ValueProblem(
                f'{quoted(text)} is not an integer from {least} to {most}', 'write one')
        return int(text)

    return scalar(parse, {'anyOf': [
        {'type': 'integer', 'minimum': least, 'maximum': most}, _REFERENCE_SCHEMA]},
        what=f'an integer from {least} to {most}')


def number(**bounds: int) -> Kind:
    """Return the kind of a finite number; only the JSON Schema has the bounds."""
    def parse(text: str) -> float:
        found = float(text) if _NUMBER.fullmatch(text) else math.nan
        if not math.isfinite(found):
            raise ValueProblem(f'{quoted(text)} is not a number', 'write a finite number')
        return found

    return scalar(parse, {'anyOf': [{'type': 'number', **bounds}, _REFERENCE_SCHEMA]},
                  what='a finite number')


def _truth(text: str) -> bool:
    if text not in ('true', 'false'):
        raise ValueProblem(f'{quoted(text)} is neither true nor false', 'write one of them')
    return text == 'true'


NO_DEADLINE = 'none'


def _deadline(text: str) -> int | str:
    if text == NO_DEADLINE:
        return NO_DEADLINE
    try:
        return parse_duration(text, minimum_ns=MICROSECOND)
    except ValueProblem as error:
        raise ValueProblem(error.problem, f"{error.remedy}, or 'none'") from None


def _weakly_hard(text: str) -> WeaklyHard:
    found = _TOLERANCE_PATTERN.fullmatch(text)
    if found is None or not 0 < int(found[1]) < int(found[2]):
        raise ValueProblem(f'{quoted(text)} is not a tolerance',
                           "write how many of how many, as '1 of 100', but not all")
    return WeaklyHard(int(found[1]), int(found[2]))


FORMAT = '1'


def _format(given: str) -> str:
    if given != FORMAT:
        raise ValueProblem(
            f'{quoted(given)} is not a known version of the format', f"write 'mddag: {FORMAT}'")
    return given


def _file(path: str) -> str:
    if os.path.isabs(path) or path.startswith('~') or '\0' in path or not path:
        raise ValueProblem(f'{quoted(path)} is not a relative path',
                           'write it as seen from the file that includes it')
    return path


def _read(text: str) -> str:
    """Check an entry of ``reads``: a topic, or the name of a callback of the same node."""
    if ':' in text:
        raise ValueProblem(
            f'{quoted(text)} names a callback with its node',
            'name the topic that is taken, or just the name of a callback of the same node')
    return (TOPIC if text.startswith('/') else CALLBACK).check(text)


def _key(text: str) -> str:
    """Check the key of a callback, ``/node:callback``."""
    node, colon, name = text.rpartition(':')
    if not colon:
        raise ValueProblem(f'{quoted(text)} does not name a callback', "write '/node:callback'")
    NODE.check(node)
    CALLBACK.check(name)
    return text


# --- execution times -----------------------------------------------------------------------------

def _read_execution_time(value: Tree, where: str) -> ExecutionTime:
    if isinstance(value, Scalar):
        return ExecutionTime((duration_kind(least_ns=1).read(value, where),), (50.0,))
    if not isinstance(value, Mapping):
        raise error_at(value, where, f'{kind_of(value)} is neither a time nor a mapping',
                       "write a time, as '4ms', or 'quantiles_us:' with a list")
    entry = Entry(value, where, QUANTILES)
    quantiles_us, percent = entry.get('quantiles_us'), entry.get('percent')
    count = len(quantiles_us)
    if not percent:     # evenly spaced
        percent = tuple(100.0 * i / (count - 1) for i in range(count)) if count > 1 else (50.0,)
    if list(quantiles_us) != sorted(quantiles_us) or quantiles_us[0] < 0 or not (
            1 <= quantiles_us[-1] * 1000 <= DAY):
        raise entry.error('quantiles_us', 'the quantiles are not from 0 to a day and rising',
                          'write times in us, the largest one at least 0.001')
    if list(percent) != sorted({*percent}) or percent[0] < 0 or percent[-1] > 100 or (
            len(percent) != count):
        raise entry.error('percent', 'the shares are not from 0 to 100 and rising, one for each '
                          'quantile', f'write {count} percentages')
    return ExecutionTime(tuple(round(us * 1000) for us in quantiles_us), percent)


# --- syncs ---------------------------------------------------------------------------------------

def _read_sync(value: Tree, where: str) -> tuple[tuple[str, ...], str | None]:
    """Return the topics of a sync, the one that drives it first, and that one, if any does."""
    if not isinstance(value, Mapping):
        return _SYNCED.read(value, where), None
    entry = Entry(value, where, SYNC_KEYS)
    topics, driven_by = entry.get('topics'), entry.get('driven_by')
    if driven_by not in topics:
        raise entry.error('driven_by', f'{quoted(driven_by)} is none of its topics',
                          did_you_mean(driven_by, topics, "add it to 'topics:'"))
    return (driven_by, *(topic for topic in topics if topic != driven_by)), driven_by


# --- the keys ------------------------------------------------------------------------------------

def _entries(what: str) -> Kind:
    """Return the kind of a list whose items are read as entries later."""
    return list_of(Kind(lambda value, where: value, {'$ref': f'#/definitions/{what}'}))


def _mapping(keys: dict[str, Key]) -> Schema:
    return {'type': 'object', 'additionalProperties': False,
            'required': [word for word, key in keys.items() if key.needed],
            'properties': {word: {**key.kind.schema, 'description': key.about}
                           for word, key in keys.items()}}


_TRUTH = scalar(_truth, {'anyOf': [{'type': 'boolean'}, _REFERENCE_SCHEMA]}, what='true or false')
_FLAG = scalar(_truth, _TRUTH.schema, False, what='true or false')
_DEADLINE = scalar(_deadline, {'anyOf': [duration_kind().schema, {'enum': [NO_DEADLINE]}]},
                   what="a time, as '100ms', or none")
_WEAKLY_HARD = scalar(_weakly_hard, {
    'type': 'string', 'pattern': f'^(?:{_TOLERANCE_PATTERN.pattern})$|{ARGUMENT_REFERENCE}',
    'examples': ['1 of 100']}, what="how many of how many, as '1 of 100'")
_VALUES = mapping_of(scalar(str, {'type': ['string', 'number', 'boolean', 'null']}), ARGUMENT)
_TOPICS = list_of(name_kind(TOPIC), 0, different=True)

QUANTILES = {
    'quantiles_us': Key(list_of(number(minimum=0)), 'Quantiles in us, rising.', needed=True),
    'percent': Key(list_of(number(minimum=0, maximum=100)),
                   'The shares that they belong to, rising.'),
}
_EXECUTION_TIME = Kind(
    _read_execution_time, {'oneOf': [duration_kind().schema, _mapping(QUANTILES)]})

_SYNCED = list_of(name_kind(TOPIC), 2, different=True,
                  too_few="give at least 2, or write 'subscription:' for one topic")
SYNC_KEYS = {
    'topics': Key(_SYNCED, 'The topics.', needed=True),
    'driven_by': Key(name_kind(TOPIC),
                     'The one each message of which has a result. The others are '
                     'queue edges.', needed=True),
}
_SYNC = Kind(_read_sync, {'oneOf': [_SYNCED.schema, _mapping(SYNC_KEYS)]}, ((), None))

FILE = {
    'mddag': Key(scalar(_format, {'enum': [int(FORMAT), FORMAT]}, what=FORMAT),
                 'Version of the format.', needed=True),
    'arguments': Key(_VALUES,
                     'Arguments of this file, $(name) in its values, with their defaults.'),
    'include': Key(_entries('include'),
                   'Files whose nodes and paths come before those of this one.'),
    'workers': Key(whole(1, MOST_WORKERS), 'Number of workers that the system is made for.'),
    'nodes': Key(_entries('node'),
                 'The nodes; a node may have several entries, and their order counts for ties.',
                 needed=True),
    'processes': Key(mapping_of(list_of(name_kind(NODE), 0, different=True), PROCESS),
                     'The processes that the nodes run in, each with its nodes; those '
                     'that are not named run in the first.'),
    'paths': Key(_entries('path'), 'End-to-end paths over trigger and queue edges.'),
}
INCLUDE = {
    'file': Key(scalar(_file, {'type': 'string'}), 'The file, as seen from this one.',
                needed=True),
    'namespace': Key(name_kind(NODE), 'Put before all names of the included file.'),
    'remap': Key(mapping_of(name_kind(TOPIC)), 'Names of the included file and what they become.'),
    'set': Key(_VALUES, 'Values of the arguments of the included file.'),
}
NODE_KEYS = {
    'node': Key(name_kind(NODE), 'Fully qualified name of the node.', needed=True),
    'callbacks': Key(_entries('callback'), 'Its callbacks.', needed=True),
    'concurrent': Key(_FLAG, 'Whether its callbacks may overlap with others of its program, even '
                      'if the program spins in a single thread.'),
}
TRIGGERS = {
    'timer': Key(duration_kind(), 'A timer of this period starts it.'),
    'subscription': Key(name_kind(TOPIC), 'A message on this topic starts it.'),
    'sync': Key(_SYNC, 'Messages on all of these topics together start it; of topics with '
                'different rates, one drives it.'),
    'service': Key(name_kind(SERVICE), 'A request of this service starts it.'),
}
CALLBACK_KEYS = {
    'name': Key(name_kind(CALLBACK), 'Name of the callback, unique in its node.', needed=True),
    **TRIGGERS,
    'period': Key(duration_kind(), 'Time between two releases of a source that is not a timer.'),
    'publishes': Key(_TOPICS, 'The topics that it publishes in each execution.'),
    'may_publish': Key(_TOPICS, 'Further topics, which it publishes only in some executions.'),
    'reads': Key(list_of(scalar(_read, {'anyOf': [TOPIC.schema, CALLBACK.schema]},
                                what='a topic, or the name of a callback of the node'), 0,
                         different=True),
                 'Queue edges: topics that it takes messages from, and callbacks of its node '
                 'whose variables it reads. They never start it.'),
    'deadline': Key(_DEADLINE, 'Relative deadline of a sink, counted from the release of its DAG; '
                    'none: it is not judged.', of=('sink',)),
    'once': Key(_FLAG, 'Whether a timer fires only once, as it is cancelled in its callback.',
                of=('source',)),
    'sporadic': Key(_FLAG, 'Whether the period of a source is only the least time between two '
                    'releases; of a timer, whether it is made, reset or cancelled when needed.',
                    of=('source',)),
    'release_from': Key(choice('arrival', 'source_timestamp', 'header_stamp', missing='arrival'),
                        'Where the release time of a source comes from.', of=('source',)),
    'execution_time': Key(_EXECUTION_TIME, 'Its execution time: constant, or quantiles.'),
    'holds_interpreter': Key(_TRUTH, 'Whether it computes in Python (true), or waits, or '
                             'computes with the lock of the interpreter released (false).'),
    'group': Key(name_kind(GROUP), 'Its mutually exclusive callback group in the node.'),
    'dag': Key(name_kind(DAG), 'Name of the DAG that it is the source of.', of=('source',)),
    'on_late': Key(choice('continue', 'demote', gone={
        'abort': "use 'demote', or 'keep: newest' to drop what a newer message replaces"}),
                   'What is done with a late job of its DAG, if it is a source.', of=('source',)),
    'keep': Key(choice('all', 'newest', missing='all'),
                'Newest drops an execution that has not started when the next is ready.',
                of=('source', 'sink')),
    'importance': Key(choice('high', 'normal', 'low', missing='normal'),
                      'In an overload, the least important sinks are late first.',
                      of=('sink',)),
    'tolerate': Key(_WEAKLY_HARD, "How many misses of a sink are tolerated, as '1 of 100'.",
                    of=('sink',)),
    'max_active_jobs': Key(whole(1, 1_000_000),
                           'Bound on the open jobs of its DAG, if it is a source.',
                           of=('source',)),
}
PATH_KEYS = {
    'name': Key(name_kind(PATH), 'Name of the path.', needed=True),
    'callbacks': Key(list_of(scalar(_key, {'type': 'string', 'pattern': (
        f'^(?:{NODE.pattern.pattern}):(?:{CALLBACK.pattern.pattern})$|{ARGUMENT_REFERENCE}')},
        what="'/node:callback'"), 2, different=True, too_few='give at least 2'),
        "The callbacks along it, each as '/node:callback'.", needed=True),
    'reaction': Key(duration_kind(),
                    'Maximum reaction time: from a change right after an input of the '
                    'first callback to the end of the first output that has seen it.'),
    'age': Key(duration_kind(), 'Maximum data age: from the input to the end of each output.'),
    'tolerate': Key(_WEAKLY_HARD, 'How many inputs or outputs in a row may be late, as '
                    "'1 of 100'."),
}
for _keys, _place in ((CALLBACK_KEYS, 'in a callback'), (PATH_KEYS, "in an entry of 'paths:'"),
                      (FILE, 'at the top of the file, not indented')):
    for _word in _keys:
        if _word not in ('name', 'callbacks', 'tolerate'):  # several entries have these
            ELSEWHERE.setdefault(_word, f'write it {_place}')


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
                'pattern': rf'^[ \t]*([0-9]+(\.[0-9]*)?|\.[0-9]+)[ \t]*({"|".join(UNITS)})'
                           rf'[ \t]*$|{ARGUMENT_REFERENCE}',
                'examples': ['100ms', '20us', '1.5s'],
            },
        },
    }
