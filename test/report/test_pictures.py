# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Pictures of task sets: what is in them, and that no name can break out of its label."""

from __future__ import annotations

from dataclasses import replace
import json
from pathlib import Path
import re
import subprocess

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.report import dot, mermaid
from mddag_executor.report.dot import to_dot
from mddag_executor.report.mermaid import to_mermaid
from mddag_executor.report.picture import Picture, picture
from mddag_executor.report.text import printable
import msg_graph
import pytest

CONFIG = Path(__file__).resolve().parents[2] / 'config'
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
    assert [node.title for node in result.dags[0].nodes] == ['/n', '/m']
    boxes = [box for dag in result.dags for node in dag.nodes for box in node.boxes]
    assert [(box.lines, box.kind, box.sink) for box in boxes] == [
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
    colours = {box.mark: box.colour for dag in result.dags for node in dag.nodes
               for box in node.boxes}
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


def test_dot() -> None:
    text = to_dot(drawn())
    assert text.count('subgraph "cluster_d0n') == 2
    assert re.search(r'"d0v0" \[label="t\\ntimer 10 ms\\n", shape=ellipse', text)
    assert re.search(r'"d0v3" \[label="z\\nsync of 2\\ndeadline 50 ms\\n", shape=hexagon', text)
    assert re.search(r'"d0v3" .*peripheries=2', text)
    assert not re.search(r'"d0v1" .*peripheries', text)
    dotted = [line.split(' [')[0].strip() for line in text.splitlines() if 'dotted' in line]
    assert dotted[0].startswith('"k')     # in the legend
    assert dotted[1:] == ['"d1v0q0" -> "d1v0"', '"d0v2q0" -> "d0v2"']
    assert '"d1v0q0" [label="/c\\nfrom n:y\\n"' in text
    assert '"d0v2q0" [label="member variable\\nfrom n:x\\n"' in text


@pytest.mark.needs('graphviz')
@pytest.mark.parametrize('name', ['autoware.yaml', 'autoware_multi.yaml'])
def test_dags_stand_in_the_order_of_the_file_and_the_legend_below(name: str) -> None:
    result = picture(msg_graph.load(CONFIG / name))
    done = subprocess.run(['dot', '-Tjson'], input=to_dot(result), text=True, check=True,
                          stdout=subprocess.PIPE, timeout=60)
    objects = json.loads(done.stdout)['objects']
    frames = {item['name']: [float(number) for number in item['bb'].split(',')]
              for item in objects if item['name'].startswith('cluster_')}
    order = [f'cluster_{dag.mark}' for dag in result.dags] + ['cluster_legend']
    tops = [frames[mark][3] for mark in order]
    assert tops == sorted(tops, reverse=True)


@pytest.mark.needs('graphviz')
def test_dags_of_a_large_picture_stand_in_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    text = 'mddag: 1\nnodes:\n' + '\n'.join(
        f'- {{node: /n{i}, callbacks: [{{name: t, timer: 10ms, dag: d{i}, publishes: [/t{i}]}}, '
        f'{{name: s, subscription: /t{i}, deadline: 9ms, reads: [/t{(i + 1) % 9}]}}]}}'
        for i in range(9))
    small = to_dot(drawn(text))
    monkeypatch.setattr(dot, '_MANY', 10)
    large = to_dot(drawn(text))
    assert 'pack=' not in small and 'packmode=array_c3' in large
    laid = json.loads(subprocess.run(
        ['dot', '-Tjson0'], input=large.encode(), capture_output=True, check=True).stdout)
    boxes = {each['label'].partition(',')[0]: each['bb'].split(',') for each in laid['objects']
             if each['name'].startswith('cluster_d') and 'every' in each['label']}
    left, low = ([float(boxes[f'd{i}'][k]) for i in range(9)] for k in (0, 1))
    rows = [[0], [1, 2, 3], [4, 5, 6], [7, 8]]
    for row in rows:
        assert [left[i] for i in row] == sorted(left[i] for i in row)
    for above, below in zip(rows, rows[1:]):
        assert min(low[i] for i in above) > max(low[i] for i in below)
    assert len(laid['edges']) == large.count(' -> ')


def test_mermaid() -> None:
    lines = [line.strip() for line in to_mermaid(drawn()).splitlines()]
    assert lines[0] == 'flowchart LR'
    assert 'd0v0(["t<br>timer 10 ms"])' in lines
    assert 'd0v3{{"z<br>sync of 2<br>deadline 50 ms"}}' in lines
    assert 'd1v0[/"s<br>service /serve<br>deadline 1 s"/]' in lines
    assert 'd0v1 --> d0v3' in lines and 'd0v2 -.-> d1v0' in lines
    assert 'class d0v3,d0v4,d1v0 sink' in lines
    assert lines.count('end') == sum(line.startswith('subgraph') for line in lines) == 5


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
    node = first.nodes[0]
    boxes = tuple(replace(node.boxes[0], mark=f'd0v{place}', lines=(name,), note=name)
                  for place, name in enumerate(HOSTILE))
    titles = tuple(replace(node, mark=f'd0n{place}', title=name, boxes=(boxes[place],))
                   for place, name in enumerate(HOSTILE))
    hostile = replace(result, title='\\N"', arrows=(),
                      dags=(replace(first, title='"<\\', nodes=titles),))
    done = subprocess.run(['dot', '-Tdot_json'], input=to_dot(hostile), text=True, check=True,
                          stdout=subprocess.PIPE, timeout=60)
    objects = {item['name']: item for item in json.loads(done.stdout)['objects']}
    for place, name in enumerate(HOSTILE):
        # Graphviz gives its strings back with the escapes for labels still in them.
        label = objects[f'd0v{place}']['label'].removesuffix('\\n')
        assert label.replace('\\\\', '\\') == printable(name)


def test_the_workload() -> None:
    result = picture(msg_graph.load(CONFIG / 'autoware_multi.yaml'))
    boxes = [box for dag in result.dags for node in dag.nodes for box in node.boxes]
    assert (len(result.dags), len(boxes), len({box.mark for box in boxes})) == (11, 86, 86)
    assert {arrow.start for arrow in result.arrows} <= {box.mark for box in boxes}
    assert sum(arrow.queue for arrow in result.arrows) >= 32
