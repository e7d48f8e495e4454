# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Declarations that are put together from several files."""

from dataclasses import replace
from pathlib import Path
import re

from hypothesis import given
from hypothesis import strategies as st
from msg_graph import GraphError, load, loads, Process
from msg_graph.edit import without_lines
import pytest

from ..conftest import examples
from .test_language import EVERYTHING, schema_errors

TWO = """\
mddag: 1
nodes:
  - node: /a
    callbacks: [{name: a, timer: 1ms, publishes: [/x]}]
  - node: /b
    callbacks: [{name: b, subscription: /x, deadline: 1ms}]
  - node: /c
    callbacks: [{name: c, subscription: /x, deadline: 1ms}]
"""
SENSOR = """\
mddag: 1
workers: 99
arguments:
  period: 100ms
  late:
nodes:
  - node: /driver
    callbacks:
      - {name: read, timer: $(period), publishes: [/points, /raw], dag: lidar}
  - node: /filter
    callbacks:
      - {name: crop, subscription: /points, publishes: [/cropped], reads: [/shared]}
      - {name: log, subscription: /raw, deadline: $(late)}
paths:
  - {name: way, callbacks: ['/driver:read', '/filter:crop']}
"""
TOP = """\
mddag: 1
workers: 3
include:
  - file: parts/sensor.yaml
    namespace: /front/left
    remap: {/cropped: /left, /shared: /twist}
    set: {late: 80ms}
  - file: parts/sensor.yaml
    namespace: /rear
    remap: {/cropped: /behind, /shared: /twist}
    set: {late: 70ms, period: 50ms}
nodes:
  - node: /vehicle
    callbacks:
      - {name: speed, timer: 20ms, publishes: [/twist], deadline: 20ms}
  - node: /fuse
    callbacks:
      - {name: a, subscription: /left, deadline: 90ms}
      - {name: b, subscription: /behind, deadline: 40ms}
"""
ONE_FILE = """\
mddag: 1
workers: 3
nodes:
  - node: /front/left/driver
    callbacks:
      - {name: read, timer: 100ms, publishes: [/front/left/points, /front/left/raw],
         dag: /front/left/lidar}
  - node: /front/left/filter
    callbacks:
      - {name: crop, subscription: /front/left/points, publishes: [/left], reads: [/twist]}
      - {name: log, subscription: /front/left/raw, deadline: 80ms}
  - node: /rear/driver
    callbacks:
      - {name: read, timer: 50ms, publishes: [/rear/points, /rear/raw], dag: /rear/lidar}
  - node: /rear/filter
    callbacks:
      - {name: crop, subscription: /rear/points, publishes: [/behind], reads: [/twist]}
      - {name: log, subscription: /rear/raw, deadline: 70ms}
  - node: /vehicle
    callbacks:
      - {name: speed, timer: 20ms, publishes: [/twist], deadline: 20ms}
  - node: /fuse
    callbacks:
      - {name: a, subscription: /left, deadline: 90ms}
      - {name: b, subscription: /behind, deadline: 40ms}
paths:
  - {name: front.left.way, callbacks: ['/front/left/driver:read', '/front/left/filter:crop']}
  - {name: rear.way, callbacks: ['/rear/driver:read', '/rear/filter:crop']}
"""


def write(folder, **files):
    """Write files, named by their stems with `__` for a folder; return the path of `top`."""
    for name, text in files.items():
        path = folder / (name.replace('__', '/') + '.yaml')
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    return folder / 'top.yaml'


def plain(task_set):
    """Return the task set without what tells of files and lines."""
    return replace(without_lines(task_set), file='')


def test_it_is_what_one_file_would_be(tmp_path):
    task_set = load(write(tmp_path, top=TOP, parts__sensor=SENSOR))
    assert plain(task_set) == plain(loads(ONE_FILE)) == plain(loads(task_set.text))
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


@pytest.mark.parametrize(('wrong', 'right', 'place', 'problem'), [
    ('timer: $(period)', 'timer: $(perod)', 'parts/sensor.yaml:9',
     "'$(perod)' is not an argument of this file: did you mean 'period'?"),
    ('subscription: /raw', 'subscription: /rawe', 'parts/sensor.yaml:13',
     "no callback publishes '/front/left/rawe': did you mean '/front/left/raw'?"),
    ('set: {late: 80ms}', 'set: {}', 'parts/sensor.yaml:5',
     "'late' has no value: set it with 'set:' of the include"),
    ('set: {late: 80ms}', 'set: {lat: 80ms, late: 1s}', 'parts/sensor.yaml:3',
     "sets 'lat', which is not an argument of this file: did you mean 'late'?"),
    ('/shared: /twist}\n    set: {late: 80', '/share: /twist}\n    set: {late: 80', 'top.yaml:6',
     "'remap': the included file does not name '/share': did you mean '/shared'?"),
    ('remap: {/cropped: /left,', 'remap: {/cropped: left,', 'top.yaml:6', 'not an absolute topic'),
    ('namespace: /rear', 'namespace: rear', 'top.yaml:9', 'is not an absolute node name'),
    ('parts/sensor.yaml\n    namespace: /rear', 'parts/none.yaml\n    namespace: /rear',
     'top.yaml:8', 'cannot be read (No such file or directory)'),
    ('namespace: /rear', 'namespace: /front/left', 'parts/sensor.yaml:9',
     'this name is taken in line 9'),
    ('  period: 100ms', '  1period: 100ms', 'parts/sensor.yaml:4',
     "argument name: use letters, digits and '_',"),
    ('    remap: {/cropped: /behind, /shared: /twist}', '    remap: [1]', 'top.yaml:10',
     "'remap': a list is not a mapping: write one with"),
])
def test_errors_name_their_file(tmp_path, wrong, right, place, problem):
    assert wrong in TOP + SENSOR
    top = write(tmp_path, top=TOP.replace(wrong, right),
                parts__sensor=SENSOR.replace(wrong, right))
    with pytest.raises(GraphError) as caught:
        load(top)
    texts = [str(error) for error in caught.value.errors]
    assert any(text.startswith(f'{tmp_path / place}: ') and problem in text for text in texts), (
        texts)
    assert all('\n' not in text for text in texts)


def test_errors_of_several_files_come_together(tmp_path):
    top = write(tmp_path, top=TOP.replace('deadline: 90ms', 'deadline: 90'),
                parts__sensor=SENSOR.replace('subscription: /raw', 'subscription: raw'))
    with pytest.raises(GraphError) as caught:
        load(top)
    assert [(Path(error.file).name, error.line) for error in caught.value.errors] == [
        ('sensor.yaml', 13), ('sensor.yaml', 13), ('top.yaml', 18)]


def test_cycles(tmp_path):
    top = write(tmp_path, top='mddag: 1\ninclude: [a.yaml]\n', a='mddag: 1\ninclude: [b.yaml]\n',
                b='mddag: 1\n\ninclude: [a.yaml]\n')
    with pytest.raises(GraphError, match=re.escape('include each other in a cycle')) as caught:
        load(top)
    assert (Path(caught.value.file).name, caught.value.line) == ('b.yaml', 3)
    write(tmp_path, b='mddag: 1\ninclude: [./../' + tmp_path.name + '/top.yaml]\n')
    with pytest.raises(GraphError, match='include each other in a cycle'):
        load(top)


def test_too_many(tmp_path):
    files = {f'f{i}': f'mddag: 1\ninclude: [{", ".join([f"f{i + 1}.yaml"] * 8)}]\n'
             for i in range(6)}
    with pytest.raises(GraphError, match='are included'):
        load(write(tmp_path, top='mddag: 1\ninclude: [f0.yaml]\n', **files,
                   f6='mddag: 1\narguments: {}\n'))


def test_values_do_not_explode(tmp_path):
    files = {f'f{i}': f'mddag: 1\narguments: {{a: }}\ninclude: [{{file: f{i + 1}.yaml, '
                      'set: {a: $(a)$(a)$(a)}}]\n' for i in range(14)}
    with pytest.raises(GraphError, match='this value is too long'):
        load(write(tmp_path, top='mddag: 1\ninclude: [{file: f0.yaml, set: {a: abc}}]\n', **files))


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


def test_those_of_an_included_file_do_not_count(tmp_path):
    (tmp_path / 'inner.yaml').write_text(TWO + 'processes: {inner: [/a], other: [/b]}\n')
    top = tmp_path / 'top.yaml'
    top.write_text('mddag: 1\ninclude: [inner.yaml]\n')
    assert load(top).processes == ()
    top.write_text('mddag: 1\ninclude: [inner.yaml]\nprocesses: {x: [/b], y: [/c]}\n')
    tasks = load(top)
    assert tasks.processes == (Process('x', ('/a', '/b')), Process('y', ('/c',)))
    assert loads(tasks.text).processes == tasks.processes
