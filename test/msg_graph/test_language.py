# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The declaration language: what entries mean, and text that is no YAML or meant to do harm."""

from dataclasses import replace
from pathlib import Path

import jsonschema
from msg_graph import GraphError, language, load, loads, yamltext
import pytest
import yaml

from ..cli import golden
from .helpers import EVERYTHING, GOLDEN, graph
from .schema import schema_errors

CONFIG = Path(__file__).resolve().parents[2] / 'config'
SMALL = """\
mddag: 1
nodes:
  - node: /a
    callbacks:
      - {name: t, timer: 10ms, deadline: 10ms}
"""


@pytest.fixture(params=['CSafeLoader', 'SafeLoader'])
def loader(request, monkeypatch):
    """Run a test with libyaml and without."""
    monkeypatch.setattr(yamltext, '_LOADER', getattr(yaml, request.param))


def test_every_key(loader):
    tasks = loads(EVERYTHING, 'all.yaml')
    dags = [replace(dag, vertices=()) for dag in tasks.dags]
    golden.compare('everything', '\n'.join(map(repr, (
        tasks.workers, *tasks.callbacks, *dags, *tasks.queue_edges, *tasks.paths,
        *tasks.processes))) + '\n', GOLDEN)
    assert str(tasks.callbacks[-1].tolerate) == '2 of 50' and tasks.concurrent == ('/sink',)
    words = EVERYTHING.replace('{', ' ').replace(',', ' ').split()
    keys = {*language.FILE, *language.NODE_KEYS, *language.CALLBACK_KEYS,
            *language.PATH_KEYS, *language.QUANTILES}
    assert {f'{key}:' for key in keys} - {'arguments:', 'include:'} <= set(words)


@pytest.mark.parametrize('count', [2, 28, 29, 30])
def test_quantiles_without_shares_are_evenly_spaced(count):
    evenly = [100 * i / (count - 1) for i in range(count)]
    tasks = graph('- {node: /a, callbacks: [{name: t, timer: 10ms, deadline: 10ms, '
                  f'execution_time: {{quantiles_us: {evenly}}}}}]}}')
    time = tasks.callbacks[0].execution_time
    assert time.percent == pytest.approx(evenly)
    assert (time.mean_ns, time.draw(0.99)) == (50_000, 99_000)


def test_the_schema_allows_what_is_right():
    jsonschema.Draft7Validator.check_schema(language.schema())
    for file in (CONFIG / 'autoware.yaml', CONFIG / 'autoware_multi.yaml', GOLDEN / 'top.yaml',
                 GOLDEN / 'parts/sensor.yaml', GOLDEN / 'everything.yaml'):
        assert schema_errors(file.read_text(encoding='utf-8')) == []
    text = """\
mddag: 1
include: [other.yaml, {file: one.yaml, namespace: /front, remap: {/a: /b}, set: {on: 3}}]
workers: $(workers)
nodes:
  - node: /$(period)
    callbacks: [{name: $(period)_x, timer: $(period), deadline: 1ms, on_late: $(period)}]
"""
    assert schema_errors(text) == []
    assert schema_errors(text.replace('namespace', 'name_space')) != []
    assert schema_errors(text.replace('remap: {/a: /b}', 'remap: {/a: b}')) != []


def test_scalars_are_as_written(loader):
    """Numbers may be quoted; words that YAML 1.1 takes for truth values or dates are names."""
    text = EVERYTHING.replace('7\n', '"7"\n').replace('true', "'true'").replace('2.5', '"2.5"')
    assert loads(text).callbacks == loads(EVERYTHING).callbacks and loads(text).workers == 7
    tasks = loads(SMALL.replace('/a', '/on').replace('name: t', (
        'name: yes, group: 1e3, dag: 2026-01-01')))
    assert (tasks.callbacks[0].key, tasks.callbacks[0].group) == ('/on:yes', '1e3')
    assert tasks.dags[0].name == '2026-01-01'


@pytest.mark.parametrize('text', [
    'mddag: 1\nnodes: [1', 'mddag: 1\n"nodes', 'mddag: 1\nnodes:\n\t- a', 'mddag: 1\na: b: c',
    '%YAML 7.0\n---\nmddag: 1'])
def test_not_yaml(loader, text):
    with pytest.raises(GraphError, match='not YAML') as caught:
        loads(text, 'g.yaml')
    assert 1 <= caught.value.line <= text.count('\n') + 2


def test_bytes(loader):
    for data in (SMALL.encode(), b'\xef\xbb\xbf' + SMALL.encode()):
        assert len(loads(data).dags) == 1
    for data, problem in (
            (b'mddag: 1\n\xff', 'g:2: byte 9 is not UTF-8'),
            (SMALL.encode('utf-16'), 'not UTF-8'), (b'', 'g: the file is empty')):
        with pytest.raises(GraphError, match=problem):
            loads(data, 'g')


@pytest.mark.parametrize('opening', ['[', '{a: ', '- ', '- - ? '])
def test_nesting_is_bounded(loader, opening):
    with pytest.raises(GraphError, match='nesting|a key is'):
        loads('mddag: 1\nnodes:\n  ' + opening * 100_000)


def test_size_is_bounded(tmp_path, monkeypatch):
    aliases = 'a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n'
    for i in range(1, 30):
        aliases += f'a{i}: &a{i} [{", ".join([f"*a{i - 1}"] * 10)}]\n'
    with pytest.raises(GraphError, match=r':7: more than 2000000 entries'):
        loads(aliases, 'g')
    path = tmp_path / 'big.yaml'
    path.write_text(SMALL + '#' * (16 * 1024 * 1024))
    for read, given in ((loads, path.read_text()), (loads, path.read_bytes()), (load, path)):
        with pytest.raises(GraphError, match='larger than 16 MiB'):
            read(given)
    monkeypatch.setattr(yamltext, 'MAX_SIZE', 40)
    with pytest.raises(GraphError, match='g:1: more than 40 entries'):
        loads(f'[{"a, " * 50}]', 'g')
    assert len(loads(SMALL).dags) == 1


def test_files_that_cannot_be_read(tmp_path):
    for path, problem in (
            (tmp_path / 'none.yaml', 'no such file or directory: check the path'),
            (tmp_path, 'the file cannot be read ('), ('nul\0byte', 'the file cannot be read (')):
        with pytest.raises(GraphError) as caught:
            load(path)
        assert problem in str(caught.value) and caught.value.line is None
