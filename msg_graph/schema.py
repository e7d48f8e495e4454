# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
JSON Schema of the declaration, for editors that complete and check what is typed.

Theory of operation
-------------------
The keys are those of the parser's own tables (``declaration``), the names and times match the
parser's own patterns (``fields``, ``duration``); what stands here is their types and their help.
A key that the parser learns and this module does not know is a ``KeyError`` in ``schema``, so that
the first test shows it.

The schema is that of draft 7, which the language servers for YAML know best. It says what one
entry may look like; what takes more than one entry to judge (publishers, cycles, sinks) only
``load`` can tell.
"""

from __future__ import annotations

import re
from typing import Any

from msg_graph import declaration as language
from msg_graph import fields
from msg_graph.arguments import ARGUMENT
from msg_graph.duration import UNITS
from msg_graph.include import INCLUDE_KEYS

_Schema = dict[str, Any]

_ARGUMENT = rf'\$\({ARGUMENT.pattern}\)'  # an argument may stand in any value


def schema() -> _Schema:
    """Return the JSON Schema of the declaration."""
    return {
        '$schema': 'http://json-schema.org/draft-07/schema#',
        'title': 'mddag declaration',
        'description': 'Nodes, their callbacks and what starts them, with periods and deadlines.',
        **_mapping(language.FILE_KEYS, _FILE, required=('mddag',)),
        'anyOf': [{'required': ['nodes']}, {'required': ['include']}],
        'definitions': {
            'include': {'oneOf': [
                {'type': 'string', 'description': 'A file, as seen from this one.'},
                _mapping(INCLUDE_KEYS, _INCLUDE, required=('file',))]},
            'node': _mapping(language.NODE_KEYS, _NODE, required=language.NODE_KEYS),
            'callback': {
                **_mapping(language.CALLBACK_KEYS, _CALLBACK, required=('name',)),
                'oneOf': [{'required': [key]} for key in language.TRIGGERS],
            },
            'path': _mapping(language.PATH_KEYS, _PATH, required=language.PATH_KEYS),
            'time': {
                'type': 'string',
                'pattern': rf'^[ \t]*\+?([0-9]+(\.[0-9]*)?|\.[0-9]+)[ \t]*({"|".join(UNITS)})'
                           rf'[ \t]*$|{_ARGUMENT}',
                'examples': ['100ms', '20us', '1.5s'],
            },
            'execution_time': {
                'oneOf': [
                    {'$ref': '#/definitions/time'},
                    _mapping(language.TIME_KEYS, _TIME, required=('quantiles_us',)),
                ],
            },
        },
    }


def _mapping(keys: tuple[str, ...], meaning: dict[str, _Schema], required: tuple[str, ...]
             ) -> _Schema:
    return {
        'type': 'object', 'additionalProperties': False, 'required': list(required),
        'properties': {key: meaning[key] for key in keys}}


def _named(pattern: re.Pattern[str], longest: int, text: str) -> _Schema:
    return {'type': 'string', 'pattern': f'^(?:{pattern.pattern})$|{_ARGUMENT}',
            'maxLength': longest,
            'description': text}


def _word(pattern: re.Pattern[str], text: str) -> _Schema:
    """Return the schema of a short name; YAML reads some as numbers, and the parser does not."""
    return {**_named(pattern, fields.LONGEST_WORD, text), 'type': ['string', 'integer']}


def _topic(text: str) -> _Schema:
    return _named(fields.ROS_NAME, fields.LONGEST_TOPIC, text)


def _time(text: str) -> _Schema:
    return {'allOf': [{'$ref': '#/definitions/time'}], 'description': text}


def _list(items: _Schema, text: str, least: int = 0, unique: bool = False) -> _Schema:
    return {'type': 'array', 'items': items, 'minItems': least, 'uniqueItems': unique,
            'description': text}


def _integer(least: int, most: int) -> _Schema:
    return {'anyOf': [{'type': 'integer', 'minimum': least, 'maximum': most}, _VALUE]}


def _texts(text: str) -> _Schema:
    return {'type': 'object', 'description': text,
            'additionalProperties': {'type': ['string', 'number', 'boolean', 'null']}}


_VALUE: _Schema = {'type': 'string', 'pattern': _ARGUMENT}
_INCLUDE: dict[str, _Schema] = {
    'file': {'type': 'string', 'description': 'The file, as seen from this one.'},
    'namespace': _named(fields.ROS_NAME, fields.LONGEST_NODE,
                        'Put before all names of the included file.'),
    'remap': {'type': 'object', 'description': 'Names of the included file and what they become.',
              'additionalProperties': _topic('The name that this file knows.')},
    'set': _texts('Values of the arguments of the included file.'),
}
_FILE: dict[str, _Schema] = {
    'arguments': _texts('Arguments of this file, $(name) in its values, with their defaults.'),
    'include': _list({'$ref': '#/definitions/include'},
                     'Files whose nodes and paths come before those of this one.', least=1),
    'mddag': {'enum': [int(language.FORMAT), language.FORMAT],
              'description': 'Version of the format.'},
    'workers': {**_integer(1, language.MOST_WORKERS),
                'description': 'Number of workers that the system is made for.'},
    'nodes': _list({'$ref': '#/definitions/node'},
                   'The nodes; a node may have several entries, and their order counts for ties.',
                   least=1),
    'paths': _list({'$ref': '#/definitions/path'},
                   'End-to-end paths over trigger and queue edges.', least=1),
}
_NODE: dict[str, _Schema] = {
    'node': _named(fields.ROS_NAME, fields.LONGEST_NODE, 'Fully qualified name of the node.'),
    'callbacks': _list({'$ref': '#/definitions/callback'}, 'Its callbacks.', least=1),
}
_CALLBACK: dict[str, _Schema] = {
    'name': _word(fields.WORD, 'Name of the callback, unique in its node.'),
    'timer': _time('A timer of this period starts it.'),
    'subscription': _topic('A message on this topic starts it.'),
    'sync': _list(_topic('A topic that is joined.'),
                  'Messages on all of these topics together start it.', least=2, unique=True),
    'service': _topic('A request of this service starts it.'),
    'period': _time('Time between two releases of a source that is no timer.'),
    'publishes': _list(_topic('A topic that it publishes.'), 'The topics that it publishes.',
                       unique=True),
    'reads': _list(
        {'anyOf': [_topic('A topic that it takes messages from.'),
                   _word(fields.WORD, 'A callback of its node whose variable it reads.')]},
        'Queue edges: data that it reads later and that never starts it.', unique=True),
    'deadline': _time('Relative deadline of a sink, counted from the release of its DAG.'),
    'release_from': {'anyOf': [{'enum': list(language.RELEASE_FROM)}, _VALUE],
                     'description': 'Where the release time of a source comes from.'},
    'execution_time': {'allOf': [{'$ref': '#/definitions/execution_time'}],
                       'description': 'Its execution time: constant, or quantiles.'},
    'holds_interpreter': {
        'anyOf': [{'type': 'boolean'}, _VALUE],
        'description': 'Whether it computes in Python (true), or waits, or computes with the lock '
                       'of the interpreter released (false).'},
    'group': _word(fields.WORD, 'Its mutually exclusive callback group in the node.'),
    'dag': _word(fields.DAG_NAME, 'Name of the DAG that it is the source of.'),
    'on_miss': {'anyOf': [{'enum': list(language.ON_MISS)}, _VALUE],
                'description': 'What is done with a late job of its DAG, if it is a source.'},
    'max_active_jobs': {**_integer(1, language.MOST_ACTIVE_JOBS),
                        'description': 'Bound on the open jobs of its DAG, if it is a source.'},
}
_PATH: dict[str, _Schema] = {
    'name': _word(fields.WORD, 'Name of the path.'),
    'callbacks': _list(
        {'type': 'string', 'pattern': f'^(?:{fields.ROS_NAME.pattern}):'
                                      f'(?:{fields.WORD.pattern})$|{_ARGUMENT}'},
        "The callbacks along it, each as '/node:callback'.", least=2, unique=True),
}
_TIME: dict[str, _Schema] = {
    'quantiles_us': _list({'anyOf': [{'type': 'number', 'minimum': 0}, _VALUE]},
                          'Quantiles in us, rising.', least=1),
    'percent': _list({'anyOf': [{'type': 'number', 'minimum': 0, 'maximum': 100}, _VALUE]},
                     'The shares that they belong to, rising.', least=1),
}
