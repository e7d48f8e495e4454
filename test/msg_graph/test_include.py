# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Declarations that are put together from several files."""

from dataclasses import replace
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st
from msg_graph import GraphError, load, loads, Process
from msg_graph.edit import without_lines
import pytest

from ..cli import golden
from ..conftest import examples
from .helpers import EVERYTHING, GOLDEN, write
from .schema import schema_errors

TOP, SENSOR = ((GOLDEN / f'{name}.yaml').read_text() for name in ('top', 'parts/sensor'))


def plain(task_set):
    """Return the task set without files and lines."""
    return replace(without_lines(task_set), file='')


def test_it_is_what_one_file_would_be(tmp_path):
    task_set = load(write(tmp_path, top=TOP, parts__sensor=SENSOR))
    golden.compare('top', task_set.text.replace(f'{tmp_path}/', ''), GOLDEN)
    assert plain(task_set) == plain(loads(task_set.text))
    read = task_set.callback('/front/left/driver:read')
    assert (read.file, read.line) == (str(tmp_path / 'parts/sensor.yaml'), 9)
    assert task_set.callback('/fuse:a').file is None


def test_the_flat_text_keeps_every_key(tmp_path):
    task_set = load(write(
        tmp_path, top=EVERYTHING.replace('workers: 7', 'workers: 7\narguments: {}')))
    assert 'arguments' not in task_set.text
    assert plain(loads(task_set.text)) == plain(loads(EVERYTHING)) == plain(task_set)
    assert schema_errors(task_set.text) == []


def test_the_flat_text_has_quotes_where_the_files_have_them(tmp_path):
    text = load(write(
        tmp_path, top='mddag: 1\ninclude: [{file: a.yaml, set: {n: "7", b: true}}]\nworkers: 2\n',
        a="""\
mddag: 1
arguments: {n: , b: , m: 0.5}
nodes:
  - node: /n
    callbacks:
      - {name: '5', timer: 1s, deadline: 1s, holds_interpreter: $(b)}
      - {name: b, timer: 2s, deadline: 1s, execution_time: {quantiles_us: [$(m), $(n)]}}
""")).text
    assert text.splitlines()[1:3] == ['mddag: 1', 'workers: 2']
    assert "{name: '5'" in text and 'holds_interpreter: true' in text and '[0.5, 7]' in text
    assert [c.name for c in loads(text).callbacks] == ['5', 'b']


def test_includes_within_includes(tmp_path):
    task_set = load(write(
        tmp_path, top='mddag: 1\ninclude: [{file: a/mid.yaml, namespace: /x, '
        'remap: {/in/inner: /far/inner}, set: {p: 30ms}}]\n',
        a__mid='mddag: 1\narguments: {p: }\ninclude: [{file: ../b/leaf.yaml, namespace: /in, '
        'set: {q: $(p)}}]\n',
        b__leaf='mddag: 1\narguments: {q: }\nnodes: [{node: /inner, callbacks: [{name: t, '
        'timer: $(q), deadline: $(q)}, {name: u, timer: 1s, deadline: $(q), dag: u}]}]\n'))
    assert [(c.key, c.period_ns) for c in task_set.callbacks] == [
        ('/far/inner:t', 30_000_000), ('/far/inner:u', 1_000_000_000)]


def refused(top, place, problem):
    with pytest.raises(GraphError, match=problem) as caught:
        load(top)
    assert f'{Path(caught.value.file).name}:{caught.value.line}' == place


def test_bounds(tmp_path):
    top = write(tmp_path, top='mddag: 1\ninclude: [a.yaml]\n', a='mddag: 1\ninclude: [b.yaml]\n',
                b='mddag: 1\n\ninclude: [a.yaml]\n')
    refused(top, 'b.yaml:3', 'include each other in a cycle')
    write(tmp_path, b='mddag: 1\ninclude: [./../' + tmp_path.name + '/top.yaml]\n')
    refused(top, 'b.yaml:2', 'include each other in a cycle')
    files = {f'f{i}': f'mddag: 1\ninclude: [{", ".join([f"f{i + 1}.yaml"] * 8)}]\n'
             for i in range(6)}
    top = write(tmp_path, top='mddag: 1\ninclude: [f0.yaml]\n', **files,
                f6='mddag: 1\narguments: {}\n')
    refused(top, 'f5.yaml:2', 'more than 16 levels or 2000 files are included')
    files = {f'f{i}': f'mddag: 1\narguments: {{a: }}\ninclude: [{{file: f{i + 1}.yaml, '
                      'set: {a: $(a)$(a)$(a)}}]\n' for i in range(14)}
    top = write(tmp_path, top='mddag: 1\ninclude: [{file: f0.yaml, set: {a: abc}}]\n', **files)
    refused(top, 'f6.yaml:3', 'this value is too long')


@examples(150)
@given(data=st.data())
def test_damaged_files_give_errors_and_nothing_else(tmp_path, data):
    texts = []
    for text in (TOP, SENSOR):
        for _ in range(data.draw(st.integers(0, 2))):
            at = data.draw(st.integers(0, len(text)))
            end = data.draw(st.integers(at, min(len(text), at + 12)))
            text = text[:at] + data.draw(st.sampled_from(
                ['', '\n', ': ', '$(', '$(late)', '[', '{}', '*x', '&x', '~', 'top.yaml', '  ',
                 '/', '\x1b', '- ', "'", 'parts/sensor.yaml', '..'])) + text[end:]
        texts.append(text)
    top = write(tmp_path, top=texts[0], parts__sensor=texts[1])
    try:
        task_set = load(top)
    except GraphError as error:
        assert all('\n' not in str(each) and '\x1b' not in str(each) for each in error.errors)
    else:
        assert plain(loads(task_set.text)) == plain(task_set)


def test_processes_of_an_included_file_do_not_count(tmp_path):
    inner = """\
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: a, timer: 1ms, publishes: [/x]}]}
  - {node: /b, callbacks: [{name: b, subscription: /x, deadline: 1ms}]}
  - {node: /c, callbacks: [{name: c, subscription: /x, deadline: 1ms}]}
processes: {inner: [/a], other: [/b]}
"""
    text = 'mddag: 1\ninclude: [inner.yaml]\n'
    assert load(write(tmp_path, top=text, inner=inner)).processes == ()
    tasks = load(write(tmp_path, top=text + 'processes: {x: [/b], y: [/c]}\n'))
    assert tasks.processes == (Process('x', ('/a', '/b')), Process('y', ('/c',)))
    assert loads(tasks.text).processes == tasks.processes
