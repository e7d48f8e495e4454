# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The rules of the model, one by one, and all errors of a declaration at once."""

import textwrap

from msg_graph import GraphError, loads
from msg_graph.errors import MOST_ERRORS
import pytest

from .helpers import MARK, nodes_error

T = '{name: t, timer: 10ms, publishes: [/a]}'


@pytest.mark.parametrize(('callbacks', 'says'), [
    # what is subscribed to, and read
    (['{name: t, timer: 10ms, publishes: [/points]}',
      f'{{name: s, subscription: /point, deadline: 10ms}} {MARK}'],
     "callback '/n:s': no callback publishes '/point': did you mean '/points'?"),
    ([f'{{name: s, subscription: /point, deadline: 10ms}} {MARK}'],
     "no callback publishes '/point': add it to a 'publishes:', or add 'period:'"),
    ([T, 'name: s', '  sync:', '    - /a', f'    - /xyz {MARK}', '  deadline: 10ms'],
     "no callback publishes '/xyz': add it to a 'publishes:'"),
    (['{name: t, timer: 10ms, publishes: [/twist], deadline: 1ms}', 'name: callback_1',
      '  timer: 10ms', '  dag: d', '  deadline: 1ms', '  reads:', '    - /twist',
      f'    - /twits {MARK}'],
     "'/n:callback_1': it reads '/twits', which no callback publishes: did you mean '/twist'?"),
    ([f'{{name: callback_1, timer: 10ms, deadline: 1ms, reads: [callback_2]}} {MARK}'],
     "it reads the unknown callback 'callback_2': did you mean 'callback_1'?"),
    ([f'{{name: callback_1, timer: 10ms, deadline: 1ms, reads: [other]}} {MARK}'],
     "name a callback of its node: 'callback_1'"),
    # what only a source may have
    *(([T, 'name: s', '  subscription: /a', f'  {key} {MARK}', '  deadline: 10ms'],
       f"callback '/n:s': '{key.split()[0]}' is for a source")
      for key in ('dag: d', 'on_late: continue', 'max_active_jobs: 3',
                  'release_from: header_stamp')),
    ([T, 'name: s', '  subscription: /a', f'  period: 10ms {MARK}', '  deadline: 10ms'],
     "only a source has a period, but '/n:t' publishes '/a': remove 'period:'"),
    ([T, f'{{name: m, subscription: /a, publishes: [/b], keep: newest}} {MARK}',
      '{name: s, subscription: /b, deadline: 10ms}'], "'keep:' is for a source or a sink"),
    *(([f'{{name: t, timer: 10ms, publishes: [/a], {key}}} {MARK}',
        '{name: s, subscription: /a, deadline: 10ms}'],
       f"'{key.split()[0]}' is for a sink, and this callback starts '/n:s' by '/a': move it")
      for key in ('importance: high', 'tolerate: 1 of 10')),
    (['name: s', '  sync: [/a, /b]', f'  period: 10ms {MARK}', '  deadline: 10ms'],
     'a sync callback joins topics, so it cannot be a source'),
    (['name: s', '  timer: 10ms', f'  release_from: source_timestamp {MARK}', '  deadline: 10ms'],
     'a timer is released when it is due'),
    ([f'{{name: s, service: /ask, deadline: 10ms}} {MARK}'], "has no period: add 'period:'"),
    # cycles
    ([f'{{name: x, subscription: /c, publishes: [/a]}} {MARK}',
      '{name: y, subscription: /a, publishes: [/b]}',
      '{name: z, subscription: /b, publishes: [/c]}',
      '{name: after, subscription: /c, deadline: 10ms}'],
     'callbacks start each other in a cycle: /n:x -> /n:y -> /n:z -> /n:x: cut it with a '
     'queue edge'),
    (['{name: t, timer: 10ms, publishes: [/in]}',
      f'{{name: track, subscription: /objects, publishes: [/tracks]}} {MARK}',
      '{name: detect, sync: [/in, /tracks], publishes: [/objects]}'],
     'cycle: /n:track -> /n:detect -> /n:track: cut it'),
    # sources and sinks
    ([T, '{name: u, timer: 20ms, publishes: [/b], dag: u}',
      '{name: v, subscription: /b, publishes: [/c]}',
      'name: s', '  sync:', '    - /a', f'    - /c {MARK}', '  deadline: 10ms'],
     "callback '/n:s': it joins two sources, '/n:t' and '/n:u', but a DAG has one: read '/c' "
     "by a queue edge: take it out of 'sync:' and list it under 'reads:'"),
    ([T, f'{{name: s, subscription: /a, publishes: [/unheard]}} {MARK}'],
     "callback '/n:s': it is a sink (it starts no other callback) and has no deadline: add"),
    ([f'{{name: t, timer: 10ms, publishes: [/a], deadline: 10ms}} {MARK}',
      '{name: s, subscription: /a, deadline: 10ms}'],
     "callback '/n:t': 'deadline:' is for a sink, and this callback starts '/n:s' by '/a': move"),
    (['{name: t, timer: 10ms, deadline: 1ms, dag: /n/u}',
      '{name: v, timer: 10ms, deadline: 1ms}',
      f'{{name: u, timer: 10ms, deadline: 1ms}} {MARK}'],
     "callback '/n:u': its DAG has the name '/n/u', as that of '/n:t': give it another one"),
])
def test_each_rule(callbacks, says):
    lines = [line if line.startswith('  ') else f'- {line}' for line in callbacks]
    nodes_error('- node: /n\n  callbacks:\n' + textwrap.indent('\n'.join(lines), '  '), says)


def test_long_cycle_is_not_spelt_out():
    text = '- node: /n\n  callbacks:\n'
    for i in range(500):
        mark = MARK if i == 0 else ''
        text += f'  - name: c{i}\n    subscription: /t{i} {mark}\n'
        text += f'    publishes: [/t{(i + 1) % 500}]\n'
    found = nodes_error(text, '/n:c0 -> /n:c1', '… (492 more) -> /n:c0')
    assert len(str(found)) < 400


def doubling(levels):
    """Return a graph in which each level has twice the vertices of the one before."""
    text = 'mddag: 1\nnodes:\n- node: /n\n  callbacks:\n'
    text += '  - {name: t, timer: 10ms, publishes: [/t0]}\n'
    for i in range(levels):
        for side in 'ab':
            text += (
                f'  - {{name: {side}{i}, subscription: /t{i}, publishes: [/t{i + 1}]}}\n')
    return text + f'  - {{name: end, subscription: /t{levels}, deadline: 1s}}\n'


def test_or_must_not_explode():
    assert len(loads(doubling(5)).vertices) == 1 + 2 + 4 + 8 + 16 + 32 + 32
    for levels in (16, 60, 2_000):
        with pytest.raises(GraphError) as caught:
            loads(doubling(levels))
        assert 'more than 200000 vertices and edges' in caught.value.problem
        assert "'reads:'" in caught.value.remedy
        assert caught.value.line is not None


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


def found(text):
    with pytest.raises(GraphError) as caught:
        loads(text, 'g.yaml')
    assert all(error.errors == (error,) for error in caught.value.errors)
    return caught.value


@pytest.mark.parametrize(('text', 'expected'), [
    (ENTRIES, [(2, "'none' is not an integer"), (6, "'10' has no unit"),
               (7, "unknown key 'deadine'"),
               (9, 'taken in line 8'), (10, 'not an absolute node name'),
               (13, 'the list is too short'), (14, "'y' does not name a callback")]),
    (LINKS, [(6, "no callback publishes '/c'"), (7, "no callback publishes '/d'"),
             (9, "'dag:' is for a source"), (8, "unknown callback 'w'"),
             (8, "it reads '/e', which no callback")]),
    (GRAPH, [(7, 'in a cycle'), (5, "'deadline:' is for a sink"), (6, 'has no deadline'),
             (9, 'has no deadline'), (11, 'no trigger or queue edge leads')]),
])
def test_every_error_of_a_stage(text, expected):
    errors = found(text).errors
    assert [error.line for error in errors] == [line for line, _ in expected]
    for error, (_, problem) in zip(errors, expected):
        assert problem in error.problem


def test_a_file_full_of_errors():
    lines = [f'      - {{nme: c{i}, subscription: /topic_{i}, publishes: [/t{i}]}}'
             for i in range(1_000)]
    text = '\n'.join(['mddag: 1', 'nodes:', '  - node: /n', '    callbacks:', *lines])
    assert len(found(text).errors) == len(found(text.replace('nme', 'name')).errors) == MOST_ERRORS


def test_the_program_says_where_it_stops(call):
    lines = [f'      - {{name: c{i}, timer: 10}}' for i in range(200)]
    text = '\n'.join(['mddag: 1', 'nodes:', '  - node: /n', '    callbacks:', *lines])
    done = call('graph', 'check', '-', stdin=text)
    assert done.returncode == 2
    shown = done.stderr.splitlines()
    assert len(shown) == MOST_ERRORS + 1
    assert shown[-1] == (
        'error: <stdin>: there may be more errors: correct these first')
