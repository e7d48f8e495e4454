# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
r"""
A picture in DOT, Graphviz's language.

Theory of operation
-------------------
1. Every name is in a quoted string. In it only the quotation mark and the backslash (`\n`, `\N`,
   `\G`, …) are special to Graphviz; control characters are written as escapes. Only the title with
   the legend is an HTML-like label, whose texts are escaped for HTML.
2. A box has the name of its node above that of its callback. Graphviz routes arrows around boxes,
   but not around the titles of frames.
3. A queue edge begins at a text next to the reader, which names the topic and the writer. So no
   line joins two DAGs.
4. A small graph has topics on the trigger edges, and its DAGs in one column. In a larger graph
   topics are tool tips. Graphviz lays out each DAG separately and packs them into a grid, in the
   order of the file, with as many columns as give about the proportions of a screen. (Version 2.43
   drops the labels of edges when it packs.)
5. ``dot`` takes minutes for thousands of boxes, or for long arrows that cross many others. In a
   large or dense graph it spends less time on the order of boxes, and lines are straight.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from html import escape
import math
import re

from mddag_executor.report.picture import Arrow, Box, DagFrame, MOST_LABELLED, Picture
from mddag_executor.report.text import printable

_SHAPES = {
    'timer': ('shape=ellipse, style="filled", margin="0,0"', 'ellipse: timer'),
    'subscription': ('shape=box, style="filled,rounded"', 'rounded box: subscription'),
    'sync': ('shape=hexagon, style="filled", margin="0,0"', 'hexagon: sync (joins topics)'),
    'service': ('shape=parallelogram, style="filled"', 'parallelogram: service'),
}
_WIDTH, _WIDE = 22, 32
_MOST_WRITERS = 3
_QUEUE = 'style=dotted, color="#2244bb", penwidth=1.6, arrowhead=open'
_STUB = 'shape=plaintext, fontsize=9, fontcolor="#2244bb", margin="0.02,0.02"'
_PIECES = re.compile(r'[^/_]*[/_]?')
_MANY, _DENSE = 1_000, 10
"""Boxes, and arrows for each, above which a graph is large or dense."""
_QUICK = 'splines=line, nslimit=0.1, nslimit1=0.1, mclimit=0.1, size="166,166",'
"""166 inches are 16,000 dots, the maximum width of PNG viewers."""
_BOX_WIDTH, _BOX_HEIGHT = 150, 70
"""Approximate size of a box with the gap to the next one, points."""
_PROPORTION = 1.5


def to_dot(picture: Picture) -> str:
    """Return the DOT text of a picture."""
    return '\n'.join(_lines(picture)) + '\n'


def quoted(text: str) -> str:
    """Return a text as a literal quoted string of DOT."""
    return '"' + printable(text).replace('\\', '\\\\').replace('"', '\\"') + '"'


def _label(lines: Iterable[str]) -> str:
    r"""Return lines as one label, centred: ``\n`` ends each."""
    return '"' + ''.join(quoted(line)[1:-1] + '\\n' for line in lines) + '"'


def _wrapped(name: str, width: int = _WIDTH) -> list[str]:
    """Return a long name in lines, broken at its slashes and underscores."""
    lines = ['']
    for piece in _PIECES.findall(name):
        if lines[-1] and len(lines[-1]) + len(piece) > width:
            lines.append('')
        lines[-1] += piece
    return lines


def _lines(picture: Picture) -> Iterator[str]:
    labelled = len(picture.boxes) <= MOST_LABELLED
    yield 'digraph mddag {'
    yield '  graph [rankdir=LR, compound=true, ranksep=0.35, nodesep=0.1,'
    columns = 1 if labelled else _columns(picture)
    if not labelled:
        yield f'    pack=36, packmode="array_cutr{columns}",'
    if len(picture.boxes) > _MANY or len(picture.arrows) > _DENSE * len(picture.boxes):
        yield f'    {_QUICK}'
    yield '    fontname="Helvetica", labelloc=t, labeljust=l, fontsize=12,'
    yield f'    label={_legend(picture)}]'
    yield '  node [fontname="Helvetica", fontsize=11, margin="0.08,0.04", height=0.3]'
    yield '  edge [arrowsize=0.7, fontname="Helvetica", fontsize=9]'
    stubs = _stubs(picture)
    for dag in _upwards(picture.dags, columns):
        yield from _dag(dag, stubs)
    for arrow in picture.arrows:
        if not arrow.queue:
            yield f'  {_edge(arrow, labelled)}'
    yield '}'


def _columns(picture: Picture) -> int:
    """Return the number of columns of DAGs that gives about the proportions of a screen."""
    width = max(dag.depth for dag in picture.dags) * _BOX_WIDTH
    height = sum(_BOX_HEIGHT * (1 + len(dag.boxes) / dag.depth) for dag in picture.dags)
    return max(1, min(len(picture.dags), round(math.sqrt(_PROPORTION * height / width))))


def _upwards(dags: Sequence[DagFrame], columns: int) -> Iterator[DagFrame]:
    """Yield the DAGs row by row from the lowest row up, the order in which Graphviz packs."""
    for end in range(len(dags), 0, -columns):
        yield from dags[max(0, end - columns):end]


def _edge(arrow: Arrow, labelled: bool) -> str:
    label = f', label={_label(arrow.note.split(", "))}' if labelled else ''
    return f'{quoted(arrow.start)} -> {quoted(arrow.end)} [tooltip={quoted(arrow.note)}{label}]'


def _stubs(picture: Picture) -> dict[str, list[list[str]]]:
    """Return by reader the texts at which its queue edges begin."""
    names = {box.mark: f'{box.node.rpartition("/")[2]}:{box.lines[0]}' for box in picture.boxes}
    writers: dict[tuple[str, str], dict[str, None]] = {}
    for arrow in picture.arrows:
        if arrow.queue:
            writers.setdefault((arrow.end, arrow.note), {})[names[arrow.start]] = None
    stubs: dict[str, list[list[str]]] = {}
    for (reader, what), found in writers.items():
        shown = [line for name in list(found)[:_MOST_WRITERS]
                 for line in _wrapped(f'from {name}', _WIDE)]
        if len(found) > _MOST_WRITERS:
            shown.append(f'… ({len(found) - _MOST_WRITERS} more)')
        stubs.setdefault(reader, []).append([*_wrapped(what, _WIDE), *shown])
    return stubs


def _dag(dag: DagFrame, stubs: dict[str, list[list[str]]]) -> Iterator[str]:
    yield f'  subgraph {quoted("cluster_" + dag.mark)} {{'
    yield (f'    label={quoted(dag.title)} labeljust=l fontsize=16 style="rounded,bold" '
           'color="#444444"')
    for box in dag.boxes:
        yield f'    {_box(box)}'
        for number, text in enumerate(stubs.get(box.mark, ())):
            mark = quoted(f'{box.mark}q{number}')
            yield f'    {mark} [label={_label(text)}, {_STUB}]'
            yield f'    {mark} -> {quoted(box.mark)} [{_QUEUE}]'
    yield '  }'


def _box(box: Box) -> str:
    sink = ', peripheries=2' if box.sink else ''
    label = _label((*_wrapped(box.node), *box.lines))
    return (f'{quoted(box.mark)} [label={label}, {_SHAPES[box.kind][0]}, '
            f'fillcolor={quoted(box.colour)}{sink}]')


def _legend(picture: Picture) -> str:
    """Return title and legend as an HTML-like label; the legend has only what is drawn."""
    kinds = {box.kind for box in picture.boxes}
    shapes = [text for kind, (_, text) in _SHAPES.items() if kind in kinds]
    colours = ''.join(f'<td bgcolor="{colour}">{escape(text)}</td>'
                      for colour, text in picture.legend)
    lines = [', '.join((*shapes, 'double border: sink')), 'solid arrow: starts the next callback']
    if any(arrow.queue for arrow in picture.arrows):
        lines[1] += '; dotted: is read later (queue edge)'
    lines.append('colour: RAD offset, from the release to the earliest deadline ahead')
    rows = ''.join(f'<tr><td align="left"><font point-size="10">{line}</font></td></tr>'
                   for line in lines)
    return (f'<<table border="0" cellspacing="0" cellpadding="2"><tr><td align="left">'
            f'<font point-size="20">{escape(printable(picture.title)) or " "}</font></td></tr>'
            f'{rows}<tr><td align="left"><table border="0" cellspacing="3" cellpadding="3">'
            f'<tr>{colours}</tr></table></td></tr></table>>')
