# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A layout of our own for pictures that are too large for Graphviz's ``dot``.

Theory of operation
-------------------
``dot`` takes minutes for some thousands of boxes, as it weighs each against all others. DAGs need
less, as no trigger edge leads from one to another:

1. Each DAG is laid out by itself, in layers from left to right: a box stands in the layer after
   the last of its predecessors.
2. Within a layer boxes are ordered by the mean place of their predecessors, then, going back, of
   their successors, and once more (the barycentre method of Sugiyama, Tagawa and Toda, 1981). The
   nodes' frames are not kept together: a node's name stands in its boxes instead.
3. A layer is as wide as its widest box, and its boxes are centred about the middle of the DAG.
4. The DAGs' frames stand in rows, in the order of the DAGs, so that the whole is about ``ASPECT``
   times as wide as high.

Lengths are points (1/72 inch); y grows upwards, as Graphviz has it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

from mddag_executor.report.picture import Box, DagFrame, Picture

ASPECT = 1.6
_CHARACTER, _LINE = 6.2, 14.0
_PADDING = 10.0
# How much larger than its text a shape has to be, for the text to stand inside.
_ROOM = {'timer': (1.4, 1.4), 'subscription': (1.0, 1.0), 'sync': (1.45, 1.1),
         'service': (1.6, 1.2)}
_GAP_X, _GAP_Y, _GAP_DAG = 46.0, 10.0, 24.0
_TITLE = 26.0


@dataclass(frozen=True, slots=True)
class Rectangle:
    """Centre and size."""

    x: float
    y: float
    width: float
    height: float


@dataclass(frozen=True, slots=True)
class Placed:
    """A DAG's frame, its boxes with their texts, and where each is."""

    frame: DagFrame
    at: Rectangle
    boxes: tuple[tuple[Box, tuple[str, ...], Rectangle], ...]


def place(picture: Picture) -> list[Placed]:
    """Return where everything stands."""
    after: dict[str, list[str]] = {}
    for arrow in picture.arrows:
        if not arrow.queue:
            after.setdefault(arrow.start, []).append(arrow.end)
    return _rows([_dag(dag, after) for dag in picture.dags])


def _dag(dag: DagFrame, after: dict[str, list[str]]) -> Placed:
    """Lay out one DAG, with its centre at 0, 0."""
    texts = {box.mark: (node.title.rpartition('/')[2], *box.lines)
             for node in dag.nodes for box in node.boxes}
    boxes = {box.mark: box for node in dag.nodes for box in node.boxes}
    layers = _layers(list(boxes), after)
    _order(layers, after)
    sizes = {}
    for mark, text in texts.items():
        wide, high = _ROOM[boxes[mark].kind]
        border = 10.0 * boxes[mark].sink
        sizes[mark] = ((max(map(len, text)) * _CHARACTER + 16) * wide + border,
                       (len(text) * _LINE + 6) * high + border)
    found = []
    left, top = 0.0, 0.0
    for layer in layers:
        width = max(sizes[mark][0] for mark in layer)
        height = sum(sizes[mark][1] + _GAP_Y for mark in layer) - _GAP_Y
        top = max(top, height / 2)
        y = height / 2
        for mark in layer:
            high = sizes[mark][1]
            found.append((boxes[mark], texts[mark],
                          Rectangle(left + width / 2, y - high / 2, *sizes[mark])))
            y -= high + _GAP_Y
        left += width + _GAP_X
    wide = max(left - _GAP_X, len(dag.title) * 9.0) + 2 * _PADDING
    middle = (left - _GAP_X) / 2
    moved = tuple((box, text, Rectangle(at.x - middle, at.y - _TITLE / 2, at.width, at.height))
                  for box, text, at in found)
    return Placed(dag, Rectangle(0, 0, wide, 2 * top + 2 * _PADDING + _TITLE), moved)


def _layers(marks: Sequence[str], after: dict[str, list[str]]) -> list[list[str]]:
    waiting = dict.fromkeys(marks, 0)
    for mark in marks:
        for successor in after.get(mark, ()):
            waiting[successor] += 1
    depth = {mark: 0 for mark, count in waiting.items() if count == 0}
    order = list(depth)
    for mark in order:
        for successor in after.get(mark, ()):
            depth[successor] = max(depth.get(successor, 0), depth[mark] + 1)
            waiting[successor] -= 1
            if waiting[successor] == 0:
                order.append(successor)
    layers: list[list[str]] = [[] for _ in range(max(depth.values(), default=0) + 1)]
    for mark in marks:
        layers[depth[mark]].append(mark)
    return layers


def _order(layers: list[list[str]], after: dict[str, list[str]]) -> None:
    """Order the boxes of each layer (rule 2)."""
    before: dict[str, list[str]] = {}
    for layer in layers:
        for mark in layer:
            for successor in after.get(mark, ()):
                before.setdefault(successor, []).append(mark)
    at: dict[str, float] = {}
    for links, sequence in ((before, layers), (after, layers[::-1])) * 2:
        for layer in sequence:
            own = {mark: place - len(layer) / 2 for place, mark in enumerate(layer)}
            layer.sort(key=lambda mark: _mean(
                [at[other] for other in links.get(mark, ()) if other in at], own[mark]))
            at.update((mark, place - len(layer) / 2) for place, mark in enumerate(layer))


def _mean(values: Sequence[float], otherwise: float) -> float:
    return sum(values) / len(values) if values else otherwise


def _rows(dags: Sequence[Placed]) -> list[Placed]:
    """Put the frames into rows, from the upper left on (rule 4)."""
    area = sum((d.at.width + _GAP_DAG) * (d.at.height + _GAP_DAG) for d in dags)
    most = max([math.sqrt(area * ASPECT), *(d.at.width for d in dags)])
    found = []
    x, y, high = 0.0, 0.0, 0.0
    for dag in dags:
        if x > 0 and x + dag.at.width > most:
            x, y, high = 0.0, y - high - _GAP_DAG, 0.0
        found.append(_moved(dag, x + dag.at.width / 2, y - dag.at.height / 2))
        x += dag.at.width + _GAP_DAG
        high = max(high, dag.at.height)
    return found


def _moved(dag: Placed, x: float, y: float) -> Placed:
    def move(at: Rectangle) -> Rectangle:
        return Rectangle(at.x + x, at.y + y, at.width, at.height)
    return Placed(dag.frame, move(dag.at),
                  tuple((box, text, move(at)) for box, text, at in dag.boxes))
