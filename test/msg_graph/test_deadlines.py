# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Deadlines given anew: in the text, where all else stays, and in the task set."""

from __future__ import annotations

from msg_graph import GraphError, loads
from msg_graph.edit import (
    deadlines_in_text,
    load_with_or_without_deadlines,
    with_deadlines,
    without_lines,
)
import pytest

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


def test_only_the_values_change() -> None:
    task_set = loads(TEXT)
    new = {'/n:x': 1_234_000, '/n:y': 2_000_000_000, '/n:z': 3_141}
    result = deadlines_in_text(task_set, TEXT, new)
    assert result == TEXT.replace('5 ms', '1.234ms').replace('"50ms"', '2s').replace(
        '7ms', '3.141us')
    after = loads(result)
    assert {c.key: c.deadline_ns for c in after.callbacks if c.deadline_ns} == new
    assert without_lines(after) == without_lines(with_deadlines(task_set, new))


def test_some_may_stay() -> None:
    result = deadlines_in_text(loads(TEXT), TEXT, {'/n:z': 8_000_000})
    assert result == TEXT.replace('7ms', '8ms')


def test_missing_deadlines() -> None:
    text = TEXT.replace(', deadline: 5 ms', '').replace('      deadline: "50ms"   # quoted\n', '')
    text = text.replace('      deadline: 7ms\n', '')
    with pytest.raises(GraphError, match='no deadline'):
        loads(text)
    task_set, missing = load_with_or_without_deadlines(text, 'g.yaml')
    assert (task_set.file, missing) == ('g.yaml', ['/n:x', '/n:y', '/n:z'])
    result = deadlines_in_text(
        task_set, text, {'/n:x': 5_000_000, '/n:y': 50_000_000, '/n:z': 7_000_000})
    assert without_lines(loads(result)) == without_lines(loads(TEXT))
    # What was there stays as it was.
    left = iter(result.splitlines())
    assert all(any(line == other or 'deadline' in other for other in left)
               for line in text.splitlines())


def test_with_all_deadlines_none_is_missing() -> None:
    assert load_with_or_without_deadlines(TEXT, 'g.yaml') == (loads(TEXT, 'g.yaml'), [])


@pytest.mark.parametrize('text', [
    '', 'mddag: 1\n', 'nodes: 3\n', '[1, 2]\n', '{', 'mddag: 1\nnodes: [{}]\n',
    'mddag: 1\nnodes:\n  - node: /n\n    callbacks:\n      - name: a\n',
    'mddag: 1\nnodes:\n  - node: /n\n    callbacks:\n      - [a]\n',
    TEXT.replace('timer: 20ms', 'timer: 20').replace('      deadline: 7ms\n', ''),
    TEXT.replace('subscription: /a, deadline: 5 ms', 'subscription: /q'),
    'a: &a [*a]\n',
])
def test_other_errors_are_told_as_they_are(text: str) -> None:
    with pytest.raises(GraphError) as first:
        loads(text, 'g.yaml')
    with pytest.raises(GraphError) as caught:
        load_with_or_without_deadlines(text, 'g.yaml')
    assert str(caught.value) == str(first.value)


def test_shared_values_are_refused() -> None:
    """Two deadlines that are one in the text cannot differ."""
    text = TEXT.replace('"50ms"', '&d 50ms').replace('7ms', '*d')
    with pytest.raises(GraphError, match='without a change of its meaning'):
        deadlines_in_text(loads(text), text, {'/n:y': 9_000_000, '/n:z': 8_000_000})
