# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What is wrong with declarations: golden/errors.txt has cases, each with all of its errors.

A case is a text, or what replaces what in files of golden/. UPDATE_GOLDEN: see `test/cli`.
"""

import json
import textwrap

from msg_graph import GraphError, load, loads, yamltext
from msg_graph.caret import read_architecture
from msg_graph.errors import MOST_ERRORS
import pytest
import yaml

from ..cli import golden
from .helpers import EVERYTHING, GOLDEN, HEAD, write
from .schema import schema_errors


def errors_of(work, *arguments):
    """Return the errors of a declaration as lines, none if there is none."""
    try:
        work(*arguments)
    except GraphError as error:
        for each in error.errors:
            assert each.errors == (each,) and each.problem and each.remedy
            assert str(each).isprintable() and len(str(each)) < 400
        return [f'> {each}' for each in error.errors]
    return []


def of_everything(case):
    right, wrong = json.loads(case)
    assert right in EVERYTHING
    text = EVERYTHING.replace(right, wrong, 1)
    refused = ['> the schema refuses it as well'] if schema_errors(text) else []
    return errors_of(loads, text, 'g.yaml') + refused


def of_several_files(case, folder):
    files = {name.replace('/', '__'): (GOLDEN / f'{name}.yaml').read_text().replace(
        *json.loads(case)) for name in ('top', 'parts/sensor')}
    return [line.replace(f'{folder}/', '')
            for line in errors_of(load, write(folder, **files))]


@pytest.mark.parametrize('loader', ['CSafeLoader', 'SafeLoader'])     # with libyaml, and without
def test_each_error(loader, monkeypatch, tmp_path):
    monkeypatch.setattr(yamltext, '_LOADER', getattr(yaml, loader))
    sections = {
        'everything.yaml with other words': of_everything,
        'top.yaml and parts/sensor.yaml with other words':
            lambda case: of_several_files(case, tmp_path),
        'callbacks of one node': lambda case: errors_of(
            loads, HEAD + textwrap.indent(case, '  '), 'g.yaml'),
        'declarations': lambda case: errors_of(loads, case, 'g.yaml'),
        'architecture files of CARET':
            lambda case: errors_of(read_architecture, case, 'arch.yaml')}
    found, case, work = [], [], None
    for line in (GOLDEN / 'errors.txt').read_text().splitlines():
        if line.startswith('=== '):
            work = sections.pop(line[4:])
        elif line.startswith('> '):
            found += work('\n'.join(case)) if case else []
            case = []
            continue
        elif line:
            case.append(line)
        found.append(line)
    assert not sections
    golden.compare('errors', '\n'.join(found) + '\n', GOLDEN)


def test_a_long_cycle_is_not_spelt_out():
    text = HEAD + ''.join(
        f'  - {{name: c{i}, subscription: /t{i}, publishes: [/t{(i + 1) % 500}]}}\n'
        for i in range(500))
    line, = errors_of(loads, text)
    assert '/n:c0 -> /n:c1' in line and '… (492 more) -> /n:c0' in line


def test_or_must_not_explode():
    def doubling(levels):
        """Return a graph in which each level has twice the vertices of the one before."""
        text = HEAD + '  - {name: t, timer: 10ms, publishes: [/t0]}\n'
        for i in range(levels):
            for side in 'ab':
                text += f'  - {{name: {side}{i}, subscription: /t{i}, publishes: [/t{i + 1}]}}\n'
        return text + f'  - {{name: end, subscription: /t{levels}, deadline: 1s}}\n'

    assert len(loads(doubling(5)).vertices) == 1 + 2 + 4 + 8 + 16 + 32 + 32
    for levels in (16, 60, 2_000):
        line, = errors_of(loads, doubling(levels), 'g.yaml')
        assert line.startswith('> g.yaml:') and 'more than 200000 vertices and edges' in line


def test_a_file_full_of_errors(call):
    text = HEAD + ''.join(f'  - {{nme: c{i}, subscription: /x{i}, publishes: [/t{i}]}}\n'
                          for i in range(1_000))
    for wrong in (text, text.replace('nme', 'name')):
        done = call('graph', 'check', '-', stdin=wrong)
        shown = done.stderr.splitlines()
        assert (done.returncode, len(shown)) == (2, MOST_ERRORS + 1)
        assert shown[-1] == 'error: <stdin>: there may be more errors: correct these first'


STARTS = {
    'timer': 'timer: 10ms', 'source': 'subscription: /out, period: 10ms',
    'subscription': 'subscription: /a', 'sync': 'sync: [/a, /b]',
    'driven': 'sync: {topics: [/a, /b], driven_by: /a}', 'service': 'service: /srv, period: 1s'}
VALUES = {
    'once': ('true', 'false', 'yes', '1', '[true]', '{a: b}', "''", ''),
    'sporadic': ('true', 'yes', '1', '[true]', ''),
    'may_publish': ('[/x]', '/x', '[x]', '[/x, /x]', '[/c]', '[/a]', '{/x: 1}', '[]', '[[/x]]',
                    ''),
    'deadline': ('none', 'None', 'never', 'no', '0', '-1ms', '[none]', 'none, tolerate: 1 of 9',
                 'none, importance: high', 'none, keep: newest', ''),
    'driven_by': ('/a', '[/a]')}
PATH_VALUES = {
    'callbacks': ("['/n:t']", "['/n:t', '/n:v']", "['/n:t', '/n:x']", "['/n:u', '/n:t']",
                  "['/n:t', '/n:t']", '/n:t', "['t', 'u']", '[]', ''),
    'reaction': ('9', '-1ms', '0', 'none', '[9s]', '9 hours', ''),
    'age': ('9ms', '9', '0ms', 'fast', '{max: 9ms}', ''),
    'tolerate': ('1 of 100', '1', '2 of 1', '0 of 0', '1%', '-1 of 9', '[1, 9]', ''),
    'deadline': ('9ms',), 'reation': ('9ms',)}


def test_wrong_uses_of_the_keys_of_ordinary_robots():
    """One line each, which says where, what and what to do; golden/wrong_uses.txt has them all."""
    found = []
    for what, start in STARTS.items():
        for key, values in VALUES.items():
            for value in values:
                keys = f'{start}, publishes: [/c], {key}: {value}'
                text = (HEAD + '  - {name: t, timer: 9ms, publishes: [/a, /b]}\n'
                        '  - {name: u, subscription: /a, deadline: 9ms}\n'
                        f'  - {{name: s, {keys}' + ', deadline: 9ms' * (key != 'deadline') + '}\n')
                errors = errors_of(loads, text, 'g.yaml')
                assert len(errors) <= 1 + (value == '[/a]')     # a cycle, and no sink
                line = errors[0].split('callback ', 1)[1] if errors else 'accepted'
                found.append(f'{what}, {key}: {value} -> {line}')
    for key, values in PATH_VALUES.items():
        for value in values:
            entry = {'name': 'p', 'callbacks': "['/n:t', '/n:u']", 'reaction': '9s'} | {key: value}
            text = (HEAD + '  - {name: t, timer: 9ms, publishes: [/a]}\n'
                    '  - {name: u, subscription: /a, deadline: 9ms}\n'
                    '  - {name: v, timer: 9ms, deadline: 9ms, dag: v}\n'
                    f'paths: [{{{", ".join(f"{k}: {v}" for k, v in entry.items())}}}]\n')
            errors = errors_of(loads, text, 'g.yaml')
            assert len(errors) <= 1
            line = errors[0].removeprefix('> g.yaml:') if errors else 'accepted'
            found.append(f'path, {key}: {value} -> {line}')
    golden.compare('wrong_uses', '\n'.join(found) + '\n', GOLDEN)
