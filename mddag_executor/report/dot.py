# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
r"""
A picture in DOT, Graphviz's language.

Every name stands in a quoted string. In those Graphviz gives a meaning to the quotation mark and
to the backslash (`\n`, `\N`, `\G`, …), to nothing else, and an HTML-like label only begins with
`<` outside of quotes; control characters are written as escapes, so that no name can break a line.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
import re

from mddag_executor.report.layered import place, Rectangle
from mddag_executor.report.picture import Arrow, Box, DagFrame, Picture
from mddag_executor.report.text import printable

_SHAPES = {
    'timer': 'shape=ellipse, style="filled"',
    'subscription': 'shape=box, style="filled,rounded"',
    'sync': 'shape=hexagon, style="filled"',
    'service': 'shape=cds, style="filled"',
}
_CENTRED = '\\n'
_LEFT = '\\l'
_WIDTH = 22
_PIECES = re.compile(r'[^/_]*[/_]?')
_MOST_PIXELS = 16_000
_MANY = 1_000
"""With more boxes than this the layout is our own, and Graphviz only draws."""


def to_dot(picture: Picture) -> str:
    """Return the DOT text of a picture."""
    boxes = sum(len(node.boxes) for dag in picture.dags for node in dag.nodes)
    return '\n'.join(_placed_lines(picture) if boxes > _MANY else _lines(picture)) + '\n'


def quoted(text: str) -> str:
    """Return a text as a quoted string of DOT that stands for just this text."""
    return '"' + printable(text).replace('\\', '\\\\').replace('"', '\\"') + '"'


def _label(lines: Iterable[str], end: str = _CENTRED) -> str:
    r"""Return lines as one label, centred (``\n`` ends each) or from the left on (``\l``)."""
    return '"' + ''.join(quoted(line)[1:-1] + end for line in lines) + '"'


def _wrapped(name: str) -> list[str]:
    """Return a long name in lines, broken at its slashes and underscores."""
    lines = ['']
    for piece in _PIECES.findall(name):
        if lines[-1] and len(lines[-1]) + len(piece) > _WIDTH:
            lines.append('')
        lines[-1] += piece
    return lines


def _lines(picture: Picture) -> Iterator[str]:
    yield 'digraph mddag {'
    yield '  graph [rankdir=LR, compound=true, newrank=false, ranksep=0.35, nodesep=0.1,'
    yield '    fontname="Helvetica", labelloc=t, labeljust=l, fontsize=20,'
    yield f'    label={quoted(picture.title)}]'
    yield '  node [fontname="Helvetica", fontsize=12, margin="0.08,0.04", height=0.3]'
    yield '  edge [arrowsize=0.7]'
    yield from _legend(picture)
    for dag in picture.dags:
        yield from _dag(dag)
    for arrow in picture.arrows:
        yield _arrow(arrow)
    yield '}'


def _placed_lines(picture: Picture) -> Iterator[str]:
    """Yield the lines of a picture with positions, for the layout `nop2`, which only draws."""
    placed = place(picture)
    legend = placed[0].at
    yield 'digraph mddag {'
    width = max(d.at.x + d.at.width / 2 for d in placed)
    dots = max(24, min(96, round(_MOST_PIXELS * 72 / width)))
    yield f'  graph [layout=nop2, splines=line, fontname="Helvetica", dpi={dots}]'
    yield '  node [fontname="Helvetica", fontsize=10, fixedsize=true]'
    yield '  edge [arrowsize=0.6]'
    top = legend.y + legend.height / 2
    yield (f'  "title" [label={_label([picture.title], _LEFT)}, shape=plaintext, fontsize=24, '
           f'{_at(Rectangle(300, top + 70, 600, 30))}]')
    for number, (colour, text) in enumerate(picture.legend):
        at = Rectangle(60 + 110 * number, top + 35, 100, 24)
        yield (f'  "k{number}" [label={quoted(text)}, shape=box, style="filled", '
               f'color={quoted(colour)}, fillcolor={quoted(colour)}, {_at(at)}]')
    for dag in placed:  # frames first: what comes later is drawn over them
        yield (f'  {quoted(dag.frame.mark)} [label={_label([dag.frame.title], _LEFT)}, '
               'shape=box, style="rounded,bold", color="#444444", labelloc=t, fontsize=14, '
               f'{_at(dag.at)}]')
    for dag in placed:
        for box, lines, at in dag.boxes:
            yield f'  {_box(box, lines)[:-1]}, {_at(at)}]'
    for arrow in picture.arrows:
        yield _arrow(arrow)
    yield '}'


def _at(at: Rectangle) -> str:
    return (f'pos="{at.x:.1f},{at.y:.1f}", width={at.width / 72:.3f}, '
            f'height={at.height / 72:.3f}')


def _dag(dag: DagFrame) -> Iterator[str]:
    yield f'  subgraph {quoted("cluster_" + dag.mark)} {{'
    yield (f'    label={quoted(dag.title)} labeljust=l fontsize=16 style="rounded,bold" '
           'color="#444444"')
    for node in dag.nodes:
        yield f'    subgraph {quoted("cluster_" + node.mark)} {{'
        yield (f'      label={_label(_wrapped(node.title), _LEFT)} labeljust=l fontsize=10 '
               'style="filled" color="#bbbbbb" fillcolor="#f6f6f6" penwidth=1')
        for box in node.boxes:
            yield f'      {_box(box)}'
        yield '    }'
    yield '  }'


def _box(box: Box, lines: Iterable[str] | None = None) -> str:
    sink = ', peripheries=2' if box.sink else ''
    return (f'{quoted(box.mark)} [label={_label(lines or box.lines)}, {_SHAPES[box.kind]}, '
            f'fillcolor={quoted(box.colour)}{sink}, tooltip={quoted(box.note)}]')


def _arrow(arrow: Arrow) -> str:
    ends = f'  {quoted(arrow.start)} -> {quoted(arrow.end)}'
    note = f'tooltip={quoted(arrow.note)}'
    if not arrow.queue:
        return f'{ends} [{note}]'
    # A queue edge often leads back; it must not pull the boxes out of their order.
    return (f'{ends} [style=dotted, color="#2244bb", penwidth=1.6, constraint=false, '
            f'arrowhead=open, {note}]')


def _legend(picture: Picture) -> Iterator[str]:
    yield '  subgraph "cluster_legend" {'
    yield '    label="RAD offset" labeljust=l fontsize=12 style="dashed" color="#888888"'
    shapes = (
        ('timer', 'timer', False), ('subscription', 'subscription', False),
        ('sync', 'sync (joins topics)', False), ('service', 'service', False),
        ('subscription', 'sink, with deadline', True))
    names = [f'k{place}' for place in range(len(picture.legend) + len(shapes))]
    for name, (colour, text) in zip(names, picture.legend):
        yield (f'    {quoted(name)} [label={quoted(text)}, shape=box, style="filled", '
               f'color={quoted(colour)}, fillcolor={quoted(colour)}]')
    for name, (kind, text, sink) in zip(names[len(picture.legend):], shapes):
        double = ', peripheries=2' if sink else ''
        yield (f'    {quoted(name)} [label={quoted(text)}, {_SHAPES[kind]}, '
               f'fillcolor=white{double}]')
    yield '  }'
