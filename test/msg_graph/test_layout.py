# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The normal form of declarations."""

from __future__ import annotations

from pathlib import Path
import re

from hypothesis import given
from hypothesis import strategies as st
import msg_graph
from msg_graph.layout import format_text
import pytest

CONFIG = Path(__file__).resolve().parents[2] / 'config'
UGLY = """\


# what this is

mddag:   1    # the format
nodes:
- node:   /n    # a node
  callbacks:
  # first
  - {name: t,   timer: 10ms,publishes: [ /a ]}       # why
  -   name:  "x"
      # on the topic
      subscription: /a
      deadline:    5ms
      execution_time: &e 0.50ms
      # of x

  # last
  - name: '0x10'
    subscription: /a
    deadline: 010ms
    execution_time: *e
# the end
"""
NORMAL = """\
# what this is

mddag: 1      # the format
nodes:
  - node: /n    # a node
    callbacks:
      # first
      - {name: t, timer: 10ms, publishes: [/a]}      # why
      - name: "x"
        # on the topic
        subscription: /a
        deadline: 5ms
        execution_time: &e 0.50ms
        # of x

      # last
      - name: '0x10'
        subscription: /a
        deadline: 010ms
        execution_time: *e
# the end
"""


def meaning(text: str) -> object:
    task_set = msg_graph.loads(text)
    dags = [(d.name, d.period_ns, d.edges, [v.name for v in d.vertices],
             [v.deadline_ns for v in d.vertices]) for d in task_set.dags]
    times = [c.execution_time for c in task_set.callbacks]
    return dags, times, task_set.queue_edges, task_set.paths, task_set.workers


def test_by_hand() -> None:
    assert format_text(UGLY) == NORMAL


@pytest.mark.parametrize('name', ['autoware.yaml', 'autoware_multi.yaml'])
def test_what_ships_keeps_its_meaning_and_its_comments(name: str) -> None:
    text = (CONFIG / name).read_text(encoding='utf-8')
    result = format_text(text, name)
    assert meaning(result) == meaning(text)
    assert re.findall('#.*', result) == re.findall('#.*', text)
    # Only what cannot be broken, a key with a long name, is longer than a line may be.
    assert [line for line in result.splitlines() if len(line) > 99 and ', ' in line] == []
    assert format_text(result, name) == result


def test_long_lists_break_ahead_of_what_would_not_fit() -> None:
    items = [f'/a/topic/with/the/number/n{number}' for number in range(9)]
    text = (f'mddag: 1\nnodes:\n  - node: /{"n" * 90}\n    callbacks:\n'
            f'      - {{name: t, timer: 10ms, publishes: [{", ".join(items)}]}}  # all\n'
            f'      - name: x\n        subscription: /a/topic/with/the/number/n1\n'
            '        deadline: 5ms\n'
            f'        publishes: [{", ".join(f"{item}b" for item in items)}]\n')
    result = format_text(text)
    assert meaning(result) == meaning(text)
    assert ' '.join(result.split()) == ' '.join(text.split())
    lines = result.splitlines()
    assert lines[2] == text.splitlines()[2], 'a name stays with its key'
    assert all(len(line) <= 87 for line in lines[3:])
    assert [line for line in lines if line.startswith(' ' * 10 + '/')] != []
    assert format_text(result) == result


@pytest.mark.parametrize('column', ['', '  '])
def test_no_comment_is_lost(column: str) -> None:
    text = f"""\
mddag: 1
nodes:
# 'one'
{column}- node: /n
{column}  callbacks:
{column}  # two
{column}  - {{name: "a", timer: 10ms, deadline: 5ms}}  #three #
"""
    result = format_text(text)
    assert re.findall('#.*', result) == ["# 'one'", '# two', '#three #']
    with pytest.raises(msg_graph.GraphError, match='without the loss of a comment: write'):
        format_text(text.replace('timer:', 'publishes: [/a,  # four\n        /b], timer:'))


def test_the_mark_of_a_document_stays() -> None:
    assert format_text('# a\n---   # b\n' + UGLY) == '# a\n---   # b\n\n\n' + NORMAL


def test_a_wrong_declaration_is_an_error() -> None:
    with pytest.raises(msg_graph.GraphError, match="g.yaml:1: .*'2' is no known version"):
        format_text('mddag: 2\nnodes: []\n', 'g.yaml')


WORDS = st.sampled_from(
    ['a', '1', '1.0', '007', '0x1F', '1e3', 'yes', 'on', 'null_', 'true', '2026-01-01', '1_0',
     '0o7', '-', '"q"', "'s'"]).filter(lambda word: word != '-')
SPACES = st.sampled_from(['', ' ', '  ', '   # note'])


@given(st.lists(WORDS, min_size=1, max_size=6, unique_by=lambda word: word.strip('\'"')),
       st.data(), st.booleans())
def test_any_names_and_spaces(names: list[str], data: st.DataObject, flow: bool) -> None:
    lines = ['mddag: 1', 'nodes:', '- node: /n', '  callbacks:']
    for name in names:
        if flow:
            lines.append(f'  - {{ name: {name}, timer: 10ms , deadline: "1s",dag: {name} }}')
        else:
            lines += [f'  -   name: {name}', '      timer: 10 ms', '      deadline: 1s',
                      f'      dag: {name}']
    text = ''.join(f'{line}{data.draw(SPACES)}\n' for line in lines)
    result = format_text(text)
    assert meaning(result) == meaning(text)
    assert format_text(result) == result
    assert re.findall('# .*', result) == re.findall('# .*', text)
