# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The JSON Schema of declarations says what the parser says about one entry."""

from __future__ import annotations

from pathlib import Path

import jsonschema
import msg_graph
from msg_graph import GraphError, language
from msg_graph.language import schema
import pytest
import yaml

CONFIG = Path(__file__).resolve().parents[2] / 'config'
GRAPH = """\
mddag: 1
workers: 3
nodes:
  - node: /n
    callbacks:
      - {name: t, timer: 10ms, publishes: [/a], dag: one, on_late: abort, max_active_jobs: 3,
         keep: newest, execution_time: 2 ms}
      - {name: x, subscription: /a, deadline: 1.5s, group: g, holds_interpreter: true,
         execution_time: {quantiles_us: [1, 2.5], percent: [0, 100]}}
      - {name: y, subscription: /o, period: 1min, reads: [x, /a], publishes: [/b],
         release_from: header_stamp}
      - {name: w, subscription: /b, publishes: [/c]}
      - {name: v, subscription: /b, publishes: [/d]}
      - {name: 7, sync: [/c, /d], deadline: 50ms, importance: high, tolerate: 1 of 100}
      - {name: s, service: /s, period: 1s, deadline: 1s, dag: service}
paths:
  - {name: p, callbacks: ['/n:t', '/n:x']}
processes: {all: [/n]}
"""


def errors(text: str) -> list[str]:
    validator = jsonschema.Draft7Validator(schema())
    return [error.message for error in validator.iter_errors(yaml.safe_load(text))]


def test_it_is_a_schema():
    jsonschema.Draft7Validator.check_schema(schema())


@pytest.mark.parametrize('name', ['autoware.yaml', 'autoware_multi.yaml'])
def test_what_ships_is_valid(name):
    assert errors((CONFIG / name).read_text(encoding='utf-8')) == []


def test_a_declaration_with_every_key_is_valid():
    msg_graph.loads(GRAPH)
    assert errors(GRAPH) == []
    words = GRAPH.replace('{', ' ').replace(',', ' ').split()
    keys = {*language.FILE, *language.NODE_KEYS, *language.CALLBACK_KEYS,
            *language.PATH_KEYS, *language.QUANTILES}
    assert {f'{key}:' for key in keys} - {'arguments:', 'include:'} <= set(words)


def test_a_declaration_of_several_files_is_valid():
    text = """\
mddag: 1
arguments: {period: 10ms, workers: }
include:
  - other.yaml
  - {file: one.yaml, namespace: /front, remap: {/a: /b}, set: {period: $(period), on: 3}}
workers: $(workers)
nodes:
  - node: /$(period)
    callbacks: [{name: $(period)_x, timer: $(period), deadline: 1ms, on_late: $(period)}]
"""
    assert errors(text) == []
    assert errors(text.replace('namespace', 'name_space')) != []
    assert errors(text.replace('remap: {/a: /b}', 'remap: {/a: b}')) != []


@pytest.mark.parametrize(('right', 'wrong'), [
    ('mddag: 1', 'mddag: 2'),
    ('workers: 3', 'workers: 0'),
    ('workers: 3', 'wokers: 3'),
    ('- node: /n', '- node: n'),
    ('- node: /n', '- name: /n'),
    ('timer: 10ms', 'timer: 10'),
    ('timer: 10ms', 'timer: 10 parsec'),
    ('timer: 10ms', 'timer: -10ms'),
    ('timer: 10ms', 'timer: 10ms, subscription: /q'),
    ('timer: 10ms, ', ''),
    ('name: x', 'name: x y'),
    ('name: x, ', ''),
    ('subscription: /a', 'subscription: a'),
    ('sync: [/c, /d]', 'sync: [/c]'),
    ('sync: [/c, /d]', 'sync: /c'),
    ('publishes: [/b]', 'publishes: [/b, /b]'),
    ('on_late: abort', 'on_late: stop'),
    ('keep: newest', 'keep: old'),
    ('importance: high', 'importance: vital'),
    ('1 of 100', '1 in 100'),
    ('max_active_jobs: 3', 'max_active_jobs: many'),
    ('release_from: header_stamp', 'release_from: stamp'),
    ('quantiles_us: [1, 2.5]', 'quantiles_us: []'),
    ('percent: [0, 100]', 'percent: [0, 101]'),
    ('quantiles_us: [1, 2.5], ', ''),
    ("'/n:x'", "'/n'"),
    (", '/n:x'", ''),
])
def test_both_refuse(right, wrong):
    text = GRAPH.replace(right, wrong, 1)
    assert text != GRAPH
    with pytest.raises(GraphError):
        msg_graph.loads(text)
    assert errors(text)
