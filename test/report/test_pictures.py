# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Pictures of task sets: what is in them, and that no name can break out of its label.

``test_golden`` has the DOT and Mermaid texts of ``GRAPH``.
"""

from __future__ import annotations

from dataclasses import replace
import json
from pathlib import Path
import re
import subprocess

from benchmarks import autoware_multi
from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.report import dot, mermaid
from mddag_executor.report.dot import to_dot
from mddag_executor.report.picture import Picture, picture
from mddag_executor.report.text import printable
import msg_graph
import pytest

ROOT = Path(__file__).resolve().parents[2]
GRAPH = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: t, timer: 10ms, publishes: [/a], dag: one, execution_time: 2ms}
      - {name: x, subscription: /a, publishes: [/b]}
      - {name: y, subscription: /a, publishes: [/c], reads: [x]}
  - node: /m
    callbacks:
      - {name: z, sync: [/b, /c], deadline: 50ms}
      - {name: q, subscription: /a, deadline: 5ms}
      - {name: s, service: /serve, period: 1s, deadline: 1s, dag: two, reads: [/c]}
"""
HOSTILE = ('a"b', 'back\\slash', 'n\\N\\G', '<b>bold</b>', 'line\nbreak', '"]; evil [label="',
           '%% comment', 'end', '--> x', '&quot;', '#35;', '\x1b[31m', '\u202e', '"', '\\')


def drawn(text: str = GRAPH) -> Picture:
    return picture(msg_graph.loads(text, name='g.yaml'))


def test_frames_boxes_and_arrows() -> None:
    result = drawn()
    assert [dag.title for dag in result.dags] == ['one, every 10 ms', 'two, every 1 s']
    assert [dag.depth for dag in result.dags] == [3, 1]
    assert [box.node for box in result.boxes] == ['/n', '/n', '/n', '/m', '/m', '/m']
    assert [(box.lines, box.kind, box.sink) for box in result.boxes] == [
        (('t', 'timer 10 ms'), 'timer', False), (('x',), 'subscription', False),
        (('y',), 'subscription', False), (('z', 'sync of 2', 'deadline 50 ms'), 'sync', True),
        (('q', 'deadline 5 ms'), 'subscription', True),
        (('s', 'service /serve', 'deadline 1 s'), 'service', True)]
    assert [(a.start, a.end, a.queue, a.note) for a in result.arrows] == [
        ('d0v0', 'd0v1', False, '/a'), ('d0v0', 'd0v2', False, '/a'),
        ('d0v0', 'd0v4', False, '/a'), ('d0v1', 'd0v3', False, '/b'),
        ('d0v2', 'd0v3', False, '/c'),
        ('d0v1', 'd0v2', True, 'member variable'), ('d0v2', 'd1v0', True, '/c')]


def test_colours_follow_the_rad_offset() -> None:
    result = drawn()
    colours = {box.mark: box.colour for box in result.boxes}
    assert colours['d0v0'] == colours['d0v4'] == result.legend[0][0]  # 5 ms: the most urgent
    assert colours['d0v1'] == colours['d0v2'] == colours['d0v3'] == result.legend[1][0]
    assert colours['d1v0'] == result.legend[2][0]
    assert [text for _, text in result.legend] == ['5 ms', '50 ms', '1 s']
    assert len(set(colours.values())) == 3


def test_a_long_legend_keeps_its_ends() -> None:
    nodes = ''.join(
        f'  - {{node: /n{i}, callbacks: [{{name: t, timer: {i}ms, deadline: {i}ms}}]}}\n'
        for i in range(1, 41))
    legend = drawn(f'mddag: 1\nnodes:\n{nodes}').legend
    assert (len(legend), legend[0][1], legend[-1][1]) == (12, '1 ms', '40 ms')


def laid_out(text: str) -> dict[str, list[float]]:
    """Return where Graphviz puts each DAG: left, low, right and high."""
    done = subprocess.run(['dot', '-Tjson0'], input=text, text=True, check=True,
                          stdout=subprocess.PIPE, timeout=60)
    return {item['name']: [float(number) for number in item['bb'].split(',')]
            for item in json.loads(done.stdout)['objects']
            if item['name'].startswith('cluster_')}


@pytest.mark.needs('graphviz')
@pytest.mark.parametrize('name', ['config/autoware.yaml', 'examples/robot/graph.yaml'])
def test_dags_are_in_the_order_of_the_file(name: str) -> None:
    result = picture(msg_graph.load(ROOT / name))
    assert result.title == Path(name).name
    frames = laid_out(to_dot(result))
    tops = [frames[f'cluster_{dag.mark}'][3] for dag in result.dags]
    assert tops == sorted(tops, reverse=True) and len(set(tops)) == len(tops)


@pytest.mark.needs('graphviz')
def test_many_small_dags_are_in_a_grid() -> None:
    count = 32
    text = to_dot(drawn('mddag: 1\nnodes:\n' + '\n'.join(
        f'- {{node: /n{i}, callbacks: [{{name: t, timer: 10ms, dag: d{i}, publishes: [/t{i}]}}, '
        f'{{name: s, subscription: /t{i}, deadline: 9ms, reads: [/t{(i + 1) % 9}]}}]}}'
        for i in range(count))))
    assert '[tooltip="/t0"]' in text
    frames = [laid_out(text)[f'cluster_d{i}'] for i in range(count)]
    columns = len({round(frame[0]) for frame in frames})
    assert 3 <= columns <= 8
    first = count % columns or columns
    rows = [frames[:first], *(frames[i:i + columns] for i in range(first, count, columns))]
    for row in rows:
        assert row == sorted(row)
    for above, below in zip(rows, rows[1:]):
        assert min(frame[1] for frame in above) > max(frame[3] for frame in below)


@given(st.one_of(st.sampled_from(HOSTILE), st.text()))
def test_labels_hold_any_text(text: str) -> None:
    label = dot.quoted(text)
    assert re.fullmatch(r'"(?:[^"\\\n]|\\["\\])*"', label)
    assert re.sub(r'\\(["\\])', r'\1', label[1:-1]) == printable(text)
    label = mermaid.quoted(text)
    assert re.fullmatch(r'"(?:[A-Za-z0-9_/:,. -]|#[0-9]+;)*"', label)
    back = re.sub(r'#([0-9]+);', lambda found: chr(int(found[1])), label[1:-1])
    assert back == printable(text)


@pytest.mark.needs('graphviz')
def test_graphviz_reads_hostile_names_as_they_are() -> None:
    result = drawn()
    first = result.dags[0]
    boxes = tuple(replace(first.boxes[0], mark=f'd0v{place}', node=name, lines=(name,), note=name)
                  for place, name in enumerate(HOSTILE))
    hostile = replace(result, title='\\N"<b>&', arrows=(),
                      dags=(replace(first, title='"<\\', boxes=boxes),))
    done = subprocess.run(['dot', '-Tdot_json'], input=to_dot(hostile), text=True, check=True,
                          stdout=subprocess.PIPE, timeout=60)
    objects = {item['name']: item for item in json.loads(done.stdout)['objects']}
    for place, name in enumerate(HOSTILE):
        # Graphviz gives its strings back with the escapes for labels still in them.
        label = objects[f'd0v{place}']['label'].replace('\\\\', '\\')
        assert label.endswith(f'\\n{printable(name)}\\n')


def test_the_workload() -> None:
    result = picture(autoware_multi.task_set())
    boxes = result.boxes
    assert (len(result.dags), len(boxes), len({box.mark for box in boxes})) == (11, 86, 86)
    assert {arrow.start for arrow in result.arrows} <= {box.mark for box in boxes}
    assert sum(arrow.queue for arrow in result.arrows) >= 32
