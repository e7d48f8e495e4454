# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The layout of large pictures: nothing overlaps, arrows lead to the right, Graphviz takes it."""

from __future__ import annotations

import random
import subprocess

from hypothesis import given, settings
from hypothesis import strategies as st
from mddag_executor.report import dot
from mddag_executor.report.dot import to_dot
from mddag_executor.report.layered import ASPECT, place, Placed, Rectangle
from mddag_executor.report.picture import picture
import msg_graph
import pytest


def text_of(seed: int, dags: int, size: int) -> str:
    """Return a declaration of random DAGs, with joins and queue edges from one to the next."""
    rng = random.Random(seed)
    lines = ['mddag: 1', 'nodes:']
    for dag in range(dags):
        parents = [[]] + [sorted(rng.sample(range(i), min(i, rng.choice([1, 1, 2]))))
                          for i in range(1, size)]
        used = {p for each in parents for p in each}
        for i in range(size):
            name = f'/d{dag}/n{i // 4}_{"x" * rng.randint(0, 30)}'
            start = 'timer: 10ms' if i == 0 else f'subscription: /d{dag}t{parents[i][0]}'
            if len(parents[i]) > 1:
                start = f'sync: [/d{dag}t{parents[i][0]}, /d{dag}t{parents[i][1]}]'
            end = f'publishes: [/d{dag}t{i}]' if i in used or i == 0 else 'deadline: 20ms'
            if i == 0 and i not in used:
                end += ', deadline: 20ms'
            reads = f', reads: [/d{(dag + 1) % dags}t0]' if i % 7 == 3 else ''
            lines.append(f'  - {{node: {name}, callbacks: [{{name: c{i}, {start}, {end}{reads}'
                         '}]}')
    return '\n'.join(lines)


def placed(text: str) -> list[Placed]:
    return place(picture(msg_graph.loads(text)))


def overlap(a: Rectangle, b: Rectangle) -> bool:
    return (abs(a.x - b.x) < (a.width + b.width) / 2 - 1e-6
            and abs(a.y - b.y) < (a.height + b.height) / 2 - 1e-6)


def inside(a: Rectangle, b: Rectangle) -> bool:
    return (abs(a.x - b.x) <= (b.width - a.width) / 2 + 1e-6
            and abs(a.y - b.y) <= (b.height - a.height) / 2 + 1e-6)


@settings(max_examples=40)
@given(seed=st.integers(0, 2 ** 32), dags=st.integers(1, 8), size=st.integers(1, 40))
def test_nothing_overlaps(seed: int, dags: int, size: int) -> None:
    text = text_of(seed, dags, size)
    drawn = picture(msg_graph.loads(text))
    found = place(drawn)
    assert [dag.frame.title for dag in found] == [dag.title for dag in drawn.dags]
    at = {}
    for i, dag in enumerate(found):
        assert all(not overlap(dag.at, other.at) for other in found[:i])
        rectangles = [where for _, _, where in dag.boxes]
        assert len(rectangles) == size
        for j, where in enumerate(rectangles):
            assert inside(where, dag.at)
            assert all(not overlap(where, other) for other in rectangles[:j])
        at.update((box.mark, where) for box, _, where in dag.boxes)
    for arrow in drawn.arrows:
        if not arrow.queue:
            assert at[arrow.start].x < at[arrow.end].x


def test_it_is_the_same_every_time() -> None:
    text = text_of(3, 5, 20)
    assert placed(text) == placed(text)


def test_the_whole_has_about_the_wanted_shape() -> None:
    found = placed(text_of(1, 60, 20))
    width = max(d.at.x + d.at.width / 2 for d in found)
    height = -min(d.at.y - d.at.height / 2 for d in found)
    assert ASPECT / 2 < width / height < ASPECT * 2


def test_fewer_lines_cross_than_in_the_order_of_the_file() -> None:
    def crossings(text: str, order: bool) -> int:
        drawn = picture(msg_graph.loads(text))
        at = {box.mark: where for dag in place(drawn) for box, _, where in dag.boxes}
        columns: dict[float, list[str]] = {}
        for dag in drawn.dags:
            for node in dag.nodes:
                for box in node.boxes:
                    columns.setdefault(at[box.mark].x, []).append(box.mark)
        y = {mark: (at[mark].y if order else -float(place_))
             for marks in columns.values() for place_, mark in enumerate(marks)}
        edges = [(a.start, a.end) for a in drawn.arrows if not a.queue]
        return sum(
            1 for i, (a, b) in enumerate(edges) for c, d in edges[:i]
            if at[a].x == at[c].x and at[b].x == at[d].x and (y[a] - y[c]) * (y[b] - y[d]) < 0)

    texts = [text_of(seed, 1, 40) for seed in range(12)]
    assert sum(crossings(t, True) for t in texts) < 0.7 * sum(crossings(t, False) for t in texts)


@pytest.mark.needs('graphviz')
def test_large_pictures_come_with_positions(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = picture(msg_graph.loads(text_of(2, 4, 10)))
    assert 'layout=nop2' not in to_dot(drawn)
    monkeypatch.setattr(dot, '_MANY', 30)
    text = to_dot(drawn)
    assert 'layout=nop2' in text
    assert text.count(' pos="') >= 40 + 4 + 1
    assert text.count('style=dotted') == sum(arrow.queue for arrow in drawn.arrows) > 0
    done = subprocess.run(['dot', '-Tsvg'], input=text, capture_output=True, text=True,
                          check=True, timeout=60)
    assert done.stderr == ''
    assert done.stdout.count('class="edge"') == len(drawn.arrows)
