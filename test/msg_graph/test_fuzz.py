# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Damaged declarations give an error of one line; the work grows with their contents."""

import sys

from hypothesis import example, given
from hypothesis import strategies as st
from msg_graph import GraphError, loads
import yaml

from ..conftest import examples
from .helpers import EVERYTHING, HEAD

FRAGMENTS = [
    '', '\n', ' ', '\t', ':', ': ', '-', '- ', '[', ']', '{', '}', ',', '#', '"', "'", '&a ',
    '*a', '<<: ', '? ', '! ', '!!int ', '!!python/object/apply:os.system ', '---\n', '...\n',
    '%YAML 1.1\n', '|\n', '>\n', '\x00', '\r', '\u2028', '\ufeff', '~', 'null', '0', '-1',
    '1e999', '.nan', '.inf', '9' * 5000, 'a' * 3000, '/', '//', '/a:b', 'ms', '0ms', '-1ms',
    'timer: 1ms\n', 'sync: [/a, /b]\n', 'period: 1s\n', 'deadline: 1ms\n', 'reads: [/boxes]\n',
    'dag: d\n', 'nodes:\n', 'mddag: 1\n',
]


def outcome(text):
    """Return the task set, or None after a look at the error."""
    try:
        return loads(text, 'f.yaml')
    except GraphError as error:
        line = str(error)
        assert line.startswith('f.yaml:') and line.isprintable() and len(line) < 2_000
        assert error.problem and error.remedy and (error.line is None or 1 <= error.line)
        return None


@st.composite
def damaged(draw):
    """Draw a declaration with a few cuts, insertions, and lines gone or moved."""
    text = EVERYTHING
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(text)))
        lines = text.split('\n')
        row = draw(st.integers(0, len(lines) - 1))
        how = draw(st.sampled_from(['insert', 'cut', 'drop', 'double', 'move', 'shift']))
        if how == 'insert':
            text = text[:at] + draw(st.sampled_from(FRAGMENTS)) + text[at:]
        elif how == 'cut':
            text = text[:at] + text[at + draw(st.integers(1, 40)):]
        elif how == 'shift':
            lines[row] = draw(st.sampled_from(['  ', ' '])) + lines[row]
            text = '\n'.join(lines)
        else:
            line = lines.pop(row)
            if how == 'double':
                lines[row:row] = [line, line]
            elif how == 'move':
                lines.insert(draw(st.integers(0, len(lines))), line)
            text = '\n'.join(lines)
    return text


@examples(300)
@given(damaged())
def test_damaged_declarations(text):
    outcome(text)


@examples(200)
@given(st.text() | st.binary())
@example('mddag: 1\nnodes: {a: &b {c: *b}}')
@example('? ? ? a')
@example('a: !<tag:x> b')
@example('- &a\n- *a')
@example('&a a: *a')
@example('\ud800')
def test_anything(text):
    assert outcome(text) is None


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9)
    | st.sampled_from(['/a', '1ms', '/a:t', 't']),
    lambda inner: st.lists(inner, max_size=3)
    | st.dictionaries(st.sampled_from([
        'node', 'callbacks', 'name', 'timer', 'sync', 'subscription', 'service', 'period',
        'publishes', 'reads', 'deadline', 'execution_time', 'quantiles_us', 'percent', 'dag']),
        inner, max_size=4),
    max_leaves=12)


@examples(150)
@given(
    st.sampled_from(['workers', 'nodes', 'paths', 'mddag']), VALUES,
    st.sampled_from(['name', 'timer', 'deadline', 'publishes', 'reads', 'execution_time', 'group',
                     'release_from', 'on_late', 'max_active_jobs', 'dag']), VALUES)
def test_any_value_at_any_key(top, value, key, inner):
    callback = {'name': 't', 'timer': '1ms', 'deadline': '1ms', key: inner}
    data = {
        'mddag': 1, 'nodes': [{'node': '/n', 'callbacks': [callback]}]}
    outcome(yaml.safe_dump(data))
    data[top] = value
    outcome(yaml.safe_dump(data))


def test_every_truncation():
    """A file that was cut off anywhere is never an accident."""
    for end in range(len(EVERYTHING)):
        outcome(EVERYTHING[:end])


def shape(size):
    """Many DAGs that share a callback; one topic with many publishers, sinks and queue edges."""
    text = HEAD + '  - {name: t, timer: 10ms, publishes: [/a]}\n'
    for i in range(size // 3):
        text += f'  - {{name: c{i}, timer: 10ms, publishes: [/d], dag: d{i}}}\n'
        text += f'  - {{name: p{i}, subscription: /a, publishes: [/b], reads: [p0]}}\n'
        text += f'  - {{name: r{i}, subscription: /a, deadline: 1s}}\n'
    return text + '  - {name: s, sync: [/a, /b], deadline: 1s}\n' \
        '  - {name: u, subscription: /d, deadline: 1s}\n'


def calls(work):
    """Return how many functions a piece of work calls, C functions included."""
    count = 0

    def profile(frame, event, argument):
        nonlocal count
        count += event in ('call', 'c_call')

    previous = sys.getprofile()
    sys.setprofile(profile)
    work()
    sys.setprofile(previous)
    return count


def test_work_is_linear():
    small, large = shape(400), shape(1_600)
    loads(small)
    assert 3 < calls(lambda: loads(large)) / calls(lambda: loads(small)) < 4.5
