# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Pictures of task sets: what is in them, and that no name can break out of its label.

``cli/test_golden.py`` has the DOT and Mermaid texts of ``GRAPH``.
"""

from dataclasses import replace
import json
from pathlib import Path
import re
import subprocess

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.report import dot, mermaid
from mddag_executor.report.dot import to_dot
from mddag_executor.report.picture import picture
from mddag_executor.report.text import printable
import msg_graph
import pytest

from .drawn import GRAPH

ROOT = Path(__file__).resolve().parents[2]
HOSTILE = ('a"b', 'back\\slash', 'n\\N\\G', '<b>bold</b>', 'line\nbreak', '"]; evil [label="',
           '%% comment', 'end', '--> x', '&quot;', '#35;', '\x1b[31m', '\u202e', '"', '\\')


def laid_out(text, form='json0'):
    """Return by name what Graphviz makes of a text."""
    done = subprocess.run(['dot', f'-T{form}'], input=text, text=True, check=True,
                          stdout=subprocess.PIPE, timeout=60)
    return {item['name']: item for item in json.loads(done.stdout)['objects']}


@pytest.mark.needs('graphviz')
@pytest.mark.parametrize('name', ['config/autoware.yaml', 'examples/robot/graph.yaml'])
def test_dags_are_in_the_order_of_the_file(name):
    result = picture(msg_graph.load(ROOT / name))
    assert result.title == Path(name).name
    frames = laid_out(to_dot(result))
    tops = [float(frames[f'cluster_{dag.mark}']['bb'].split(',')[3]) for dag in result.dags]
    assert tops == sorted(tops, reverse=True) and len(set(tops)) == len(tops)


@given(st.one_of(st.sampled_from(HOSTILE), st.text()))
def test_labels_hold_any_text(text):
    label = dot.quoted(text)
    assert re.fullmatch(r'"(?:[^"\\\n]|\\["\\])*"', label)
    assert re.sub(r'\\(["\\])', r'\1', label[1:-1]) == printable(text)
    label = mermaid.quoted(text)
    assert re.fullmatch(r'"(?:[A-Za-z0-9_/:,. -]|#[0-9]+;)*"', label)
    back = re.sub(r'#([0-9]+);', lambda found: chr(int(found[1])), label[1:-1])
    assert back == printable(text)


@pytest.mark.needs('graphviz')
def test_graphviz_reads_hostile_names_as_they_are():
    result = picture(msg_graph.loads(GRAPH, name='g.yaml'))
    first = result.dags[0]
    boxes = tuple(replace(first.boxes[0], mark=f'd0v{place}', node=name, lines=(name,))
                  for place, name in enumerate(HOSTILE))
    hostile = replace(result, title='\\N"<b>&', arrows=(),
                      dags=(replace(first, title='"<\\', boxes=boxes),))
    objects = laid_out(to_dot(hostile), 'dot_json')
    for place, name in enumerate(HOSTILE):
        # Graphviz gives its strings back with the escapes for labels still in them.
        label = objects[f'd0v{place}']['label'].replace('\\\\', '\\')
        assert label.endswith(f'\\n{printable(name)}\\n')
