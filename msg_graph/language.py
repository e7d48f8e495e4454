# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The language of declarations: every key with the kind of its value, for the parser and for editors.

Theory of operation
-------------------
The tables here are what the parser goes by, and what the JSON Schema is made from. The schema is
that of draft 7, which the language servers for YAML know best. It says what one entry may look
like; what takes more than one entry to judge (publishers, cycles, sinks) only ``load`` can say.
"""

from __future__ import annotations

import os

from msg_graph.duration import DAY, UNITS
from msg_graph.entries import (
    ARGUMENT_USE,
    choice,
    Entry,
    items,
    Key,
    Kind,
    name,
    numbers,
    pairs,
    Schema,
    text,
    texts,
    time,
    truth,
    whole,
)
from msg_graph.errors import GraphError, shown
from msg_graph.model import ExecutionTime
from msg_graph.names import (
    CALLBACK,
    check_key,
    check_read,
    DAG,
    GROUP,
    NODE,
    PATH,
    PROCESS,
    SERVICE,
    TOPIC,
)
from msg_graph.yamltext import Mapping, Scalar, Sequence, Tree

FORMAT = '1'

# The quantiles that the published figures of the Autoware workload come with.
_PERCENT_29 = (
    0.0, 0.1, 0.5, 1.0, 2.0, *(float(percent) for percent in range(5, 100, 5)),
    98.0, 99.0, 99.5, 99.9, 100.0)


def _check_format(given: str) -> tuple[str, str] | None:
    if given == FORMAT:
        return None
    return f'{shown(given)} is no known version of the format', f"write 'mddag: {FORMAT}'"


def _check_file(path: str) -> tuple[str, str] | None:
    if os.path.isabs(path) or path.startswith('~') or '\0' in path or not path:
        return (f'{shown(path)} is no relative path',
                'write it as seen from the file that includes it')
    return None


def _read_execution_time(entry: Entry, key: str, value: Tree) -> ExecutionTime:
    if isinstance(value, Scalar):
        return ExecutionTime((time(least_ns=1).read(entry, key, value),), (50.0,))
    inner = Entry(value, entry.file, f'execution time of {entry.name}', QUANTILES)
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
    """Return of each process its nodes, and of each of these its line."""
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
    """Return the shares that the quantiles belong to, declared or the default for their number."""
    percent = entry.get('percent')
    if percent is None:
        if count == len(_PERCENT_29):
            return _PERCENT_29
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
    'workers': Key(whole(1, 1024), 'Number of workers that the system is made for.'),
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
    'on_miss': Key(choice('continue', 'abort'),
                   'What is done with a late job of its DAG, if it is a source.'),
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
