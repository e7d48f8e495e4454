# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Which node runs in which process: read, refused, and written anew."""

from __future__ import annotations

from msg_graph import GraphError, loads, Process
from msg_graph.edit import load_processes, with_processes
import pytest

from .helpers import error, MARK

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


def test_nodes_that_no_process_names_run_in_the_first() -> None:
    tasks = loads(HEAD + 'processes:\n  one: [/c]\n  two: [/b]\n')
    assert tasks.processes == (Process('one', ('/a', '/c')), Process('two', ('/b',)))
    assert [tasks.process_of(n) for n in ('/a', '/b', '/unknown')] == ['one', 'two', 'one']
    assert loads(HEAD).processes == () and loads(HEAD).process_of('/a') is None


@pytest.mark.parametrize(('lines', 'says'), [
    ([f'  one: [/a, /d] {MARK}'], "there is no node '/d'"),
    (['  one: [/a, /b]', f'  two: [/a] {MARK}'], "'/a' is in process 'one', too"),
    (['  one:', f'    - /a {MARK}'.replace('/a', '/aa')], "'/a'"),
    ([f'  one/two: [/a] {MARK}'], 'no name for a process'),
    ([f'  one: [/a, /a] {MARK}'], 'is listed twice'),
    ([f'  one: /a {MARK}'], 'write a list'),
])
def test_errors(lines: list[str], says: str) -> None:
    found = error(HEAD + 'processes:\n' + '\n'.join(lines))
    assert says in str(found)


def test_a_process_has_a_node() -> None:
    found = error(HEAD + f'processes: {MARK}\n  one: [/a, /b, /c]\n  two: []')
    assert "no node runs in process 'two'" in str(found)


@pytest.mark.parametrize('before', ['', 'processes: {old: [/a]}\n', 'processes:\n  old: [/b]\n'])
@pytest.mark.parametrize('after', ['', 'workers: 3\n'])
def test_processes_are_written_anew(before: str, after: str) -> None:
    tasks = loads(HEAD + before + after)
    placed = with_processes(tasks, (Process('x', ('/c', '/b')), Process('1', ('/a',))))
    assert placed.text == HEAD + after + "processes:\n  x: [/b, /c]\n  '1': [/a]\n"
    again = loads(placed.text)
    assert again.processes == placed.processes == (
        Process('x', ('/b', '/c')), Process('1', ('/a',)))
    assert again.dags == placed.dags


def test_a_text_in_which_processes_cannot_stand_is_refused() -> None:
    flow = '{mddag: 1, nodes: [{node: /a, callbacks: [{name: a, timer: 1ms, deadline: 1ms}]}]}'
    with pytest.raises(GraphError, match='cannot be changed'):
        with_processes(loads(flow), (Process('x', ('/a',)),))


def test_a_file_of_its_own() -> None:
    tasks = loads(HEAD)
    for head in ('', HEAD):
        assert load_processes(head + 'processes: {x: [/b]}', 'p.yaml', tasks) == (
            Process('x', ('/a', '/b', '/c')),)
    for text, says in (('', "there is no 'processes:'"), ('mddag: 1', "there is no 'processes:'"),
                       ('processes: {x: [/d]}', "p.yaml:1: the file: 'processes': there is no"),
                       ('[1]', 'p.yaml:1: the file is a list')):
        with pytest.raises(GraphError) as caught:
            load_processes(text, 'p.yaml', tasks)
        assert says in str(caught.value)
