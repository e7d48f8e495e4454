# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Changes of the text of a declaration: deadlines and processes, where all else stays."""

from dataclasses import replace
from pathlib import Path

from msg_graph import GraphError, load, loads, Process
from msg_graph.edit import (
    deadlines_in_text,
    load_processes,
    load_with_or_without_deadlines,
    with_deadlines,
    with_processes,
    without_lines,
)
import pytest

CONFIG = Path(__file__).resolve().parents[2] / 'config'

TEXT = """\
# At the top.
mddag:   1
nodes:
- node: "/n"     # oddly laid out
  callbacks:
    - {name: t, timer: 10ms, publishes: [/a, /b], dag: one}
    - {name: x, subscription: /a, deadline: 5 ms, execution_time: 1ms}  # flow, unquoted
    - name: y
      subscription: '/b'

      deadline: "50ms"   # quoted
      # between
      execution_time: {quantiles_us: [1000,
          3000]}
    - name: z
      deadline: 7ms
      timer: 20ms
"""


def test_only_the_values_change():
    task_set = loads(TEXT)
    new = {'/n:x': 1_234_000, '/n:y': 2_000_000_000, '/n:z': 3_141}
    result = deadlines_in_text(task_set, new)
    assert result == TEXT.replace('5 ms', '1.234ms').replace('"50ms"', '2s').replace(
        '7ms', '3.141us')
    assert without_lines(loads(result)) == without_lines(with_deadlines(task_set, new))
    # Two deadlines that are one in the text cannot differ.
    text = TEXT.replace('"50ms"', '&d 50ms').replace('7ms', '*d')
    with pytest.raises(GraphError, match='cannot be edited automatically'):
        deadlines_in_text(loads(text), {'/n:y': 9_000_000, '/n:z': 8_000_000})


def test_missing_deadlines():
    text = TEXT.replace(', deadline: 5 ms', '').replace('      deadline: "50ms"   # quoted\n', '')
    text = text.replace('      deadline: 7ms\n', '')
    task_set = load_with_or_without_deadlines(text, 'g.yaml')
    assert [callback.deadline_ns for callback in task_set.callbacks] == [None, *[10 ** 9] * 3]
    result = deadlines_in_text(
        task_set, {'/n:x': 5_000_000, '/n:y': 50_000_000, '/n:z': 7_000_000})
    assert without_lines(loads(result)) == without_lines(loads(TEXT))
    # What was there stays as it was.
    left = iter(result.splitlines())
    assert all(any(line == other or 'deadline' in other for other in left)
               for line in text.splitlines())
    for wrong, problem in (('', 'the file is empty'),
                           (text.replace('timer: 20ms', 'timer: 20'), "'20' has no unit")):
        with pytest.raises(GraphError, match=problem):
            load_with_or_without_deadlines(wrong, 'g.yaml')


def test_what_includes_others_becomes_one_file(tmp_path):
    (tmp_path / 'part.yaml').write_text(TEXT.replace(', deadline: 5 ms', ''))
    text = 'mddag: 1\ninclude: [{file: part.yaml, namespace: /a}]\n'
    task_set = load_with_or_without_deadlines(text, 'top', str(tmp_path / 'top.yaml'))
    again = loads(deadlines_in_text(task_set, {'/a/n:x': 5_000_000}))
    assert [c.deadline_ns for c in again.callbacks] == [
        None, 5_000_000, 50_000_000, 7_000_000]


def test_autoware_with_other_deadlines():
    """`golden/check_stdin.txt` and `draw_autoware.txt` of `test/cli` have what is in it."""
    autoware, multi = (load(CONFIG / f'{name}.yaml') for name in ('autoware', 'autoware_multi'))
    deadlines = {callback.key: callback.deadline_ns for callback in multi.callbacks
                 if callback.deadline_ns is not None}
    assert without_lines(multi) == replace(
        without_lines(with_deadlines(autoware, deadlines)), file=multi.file)
    assert {one.name for one, dag in zip(autoware.dags, multi.dags) if any(
        v.deadline_ns != w.deadline_ns for v, w in zip(one.vertices, dag.vertices))} == {
            'control', 'imu', 'perception', 'vehicle'}


HEAD = """\
mddag: 1
nodes:
  - node: /a
    callbacks: [{name: a, timer: 1ms, publishes: [/x]}]
  - node: /b
    callbacks: [{name: b, subscription: /x, deadline: 1ms}]  # the first
  - node: /c
    callbacks: [{name: c, subscription: /x, deadline: 1ms}]
"""


@pytest.mark.parametrize('before', ['', 'processes: {old: [/a]}\n', 'processes:\n  old: [/b]\n'])
@pytest.mark.parametrize('after', ['', '\n# the pool\nworkers: 3\n', '# the end\n'])
def test_processes_are_written_again(before, after):
    tasks = loads(HEAD + before + after)
    placed = with_processes(tasks, (Process('x', ('/c', '/b')), Process('1', ('/a',))))
    assert placed.text == HEAD + after + "processes:\n  x: [/b, /c]\n  '1': [/a]\n"
    again = loads(placed.text)
    assert again.processes == placed.processes == (
        Process('x', ('/b', '/c')), Process('1', ('/a',)))
    assert again.dags == placed.dags


def test_a_text_in_which_processes_cannot_stand_is_refused():
    flow = '{mddag: 1, nodes: [{node: /a, callbacks: [{name: a, timer: 1ms, deadline: 1ms}]}]}'
    with pytest.raises(GraphError, match='cannot be edited'):
        with_processes(loads(flow), (Process('x', ('/a',)),))


def test_nodes_that_no_process_names_run_in_the_first():
    tasks = loads(HEAD + 'processes:\n  one: [/c]\n  two: [/b]\n')
    assert tasks.processes == (Process('one', ('/a', '/c')), Process('two', ('/b',)))
    assert [tasks.process_of(n) for n in ('/a', '/b', '/unknown')] == ['one', 'two', 'one']
    tasks = loads(HEAD)
    assert tasks.processes == () and tasks.process_of('/a') is None
    for head in ('', HEAD):     # a file of its own
        assert load_processes(head + 'processes: {x: [/b]}', 'p.yaml', tasks) == (
            Process('x', ('/a', '/b', '/c')),)
    for text, says in (('', "there is no 'processes:'"), ('mddag: 1', "there is no 'processes:'"),
                       ('processes: {x: [/d]}', "p.yaml:1: the file: 'processes': there is no"),
                       ('[1]', 'p.yaml:1: the file: a list is not a mapping')):
        with pytest.raises(GraphError, match=says):
            load_processes(text, 'p.yaml', tasks)


def test_lines_end_as_they_did():
    text = HEAD.replace('\n', '\r\n')
    for placed in (with_processes(loads(each), (Process('x', ('/a', '/b', '/c')),))
                   for each in (text, text + 'workers: 3')):
        assert placed.text.count('\n') == placed.text.count('\r\n') > text.count('\n')
    text = TEXT.replace('      deadline: 7ms\n', '').replace('\n', '\r\n')
    task_set = load_with_or_without_deadlines(text, 'g.yaml')
    result = deadlines_in_text(task_set, {'/n:z': 8_000_000})
    assert result.count('\n') == result.count('\r\n') == text.count('\n') + 1
