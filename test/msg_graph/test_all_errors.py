# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""All independent errors of a declaration are found at once."""

from __future__ import annotations

from collections.abc import Callable
import pickle
import subprocess

from msg_graph import GraphError, GraphErrors, loads
from msg_graph.errors import MOST_ERRORS
import pytest

Mddag = Callable[..., subprocess.CompletedProcess[str]]

ENTRIES = """\
mddag: 1
workers: none
nodes:
  - node: /n
    callbacks:
      - {name: t, timer: 10, publishes: [/a]}
      - {name: x, subscription: /a, deadine: 5ms}
      - {name: y, subscription: /a, deadline: 5ms}
      - {name: y, subscription: /a, deadline: 5ms}
  - node: n
    callbacks: []
paths:
  - {name: p, callbacks: ['/n:y']}
  - {name: q, callbacks: ['/n:y', y]}
"""
LINKS = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: t, timer: 10ms, publishes: [/a, /b], deadline: 5ms}
      - {name: x, subscription: /c, deadline: 5ms}
      - {name: y, subscription: /d}
      - {name: z, subscription: /a, reads: [w, /e], deadline: 5ms}
      - {name: v, subscription: /a, dag: d}
"""
GRAPH = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: t, timer: 10ms, publishes: [/a, /b], deadline: 5ms}
      - {name: x, subscription: /a, publishes: [/c]}
      - {name: y, sync: [/a, /z], publishes: [/y]}
      - {name: z, subscription: /y, publishes: [/z]}
      - {name: w, subscription: /a}
paths:
  - {name: p, callbacks: ['/n:t', '/n:z']}
"""


def found(text: str) -> GraphErrors:
    with pytest.raises(GraphErrors) as caught:
        loads(text, 'g.yaml')
    assert all(type(error) is GraphError for error in caught.value.errors)
    return caught.value


@pytest.mark.parametrize(('text', 'expected'), [
    (ENTRIES, [(2, "'workers' is 'none'"), (6, "'10' has no unit"), (7, "unknown key 'deadine'"),
               (9, 'taken in line 8'), (10, 'not an absolute node name'),
               (13, 'a path of one callback'), (14, "'y' names no callback")]),
    (LINKS, [(6, "no callback publishes '/c'"), (7, "no callback publishes '/d'"),
             (9, "'dag:' is for the source"), (8, "unknown callback 'w'"),
             (8, "it reads '/e', which no callback")]),
    (GRAPH, [(7, 'in a cycle'), (5, 'deadline but is no sink'), (6, 'has no deadline'),
             (9, 'has no deadline'), (11, 'no trigger or queue edge leads')]),
])
def test_every_error_of_a_stage(text: str, expected: list[tuple[int, str]]) -> None:
    errors = found(text).errors
    assert [error.line for error in errors] == [line for line, _ in expected]
    for error, (_, problem) in zip(errors, expected):
        assert problem in error.problem


def test_the_group_is_its_first_error_and_one_line() -> None:
    group = found(ENTRIES)
    first = group.errors[0]
    assert (group.file, group.line, group.problem, group.remedy) == (
        first.file, first.line, first.problem, first.remedy)
    assert str(group) == f'{first} (and 6 more)'
    again = pickle.loads(pickle.dumps(group))
    assert type(again) is GraphErrors
    assert str(again) == str(group)
    assert list(map(str, again.errors)) == list(map(str, group.errors))


def test_one_error_stays_one() -> None:
    with pytest.raises(GraphError) as caught:
        loads(ENTRIES[:ENTRIES.index('workers')], 'g.yaml')
    assert type(caught.value) is GraphError
    assert caught.value.errors == (caught.value,)


def test_a_file_full_of_errors() -> None:
    lines = [f'      - {{nme: c{i}, subscription: /topic_{i}, publishes: [/t{i}]}}'
             for i in range(1_000)]
    text = '\n'.join(['mddag: 1', 'nodes:', '  - node: /n', '    callbacks:', *lines])
    assert len(found(text).errors) == len(found(text.replace('nme', 'name')).errors) == MOST_ERRORS


def test_the_program_says_where_it_stops(call: Mddag) -> None:
    lines = [f'      - {{name: c{i}, timer: 10}}' for i in range(200)]
    text = '\n'.join(['mddag: 1', 'nodes:', '  - node: /n', '    callbacks:', *lines])
    done = call('graph', 'check', '-', stdin=text)
    assert done.returncode == 2
    shown = done.stderr.splitlines()
    assert len(shown) == MOST_ERRORS + 1
    assert shown[-1] == (
        'error: <stdin>: there may be more errors: correct these first')
