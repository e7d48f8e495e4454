# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
r"""
A picture in DOT, Graphviz's language.

Every name stands in a quoted string. In those Graphviz gives a meaning to the quotation mark and
to the backslash (`\n`, `\N`, `\G`, …), to nothing else, and an HTML-like label only begins with
`<` outside of quotes; control characters are written as escapes, so that no name can break a line.

A queue edge begins at a text that says what is read and from whom, beside the reader: a line from
the writer would cross the pictures of other DAGs.  So no line joins the DAGs.  Graphviz then puts
them above one another, the first lowest: they are written from the last to the first.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import zip_longest
import re

from mddag_executor.report.layered import place, Rectangle
from mddag_executor.report.picture import Arrow, Box, DagFrame, Picture
from mddag_executor.report.text import printable

_SHAPES = {
    'timer': 'shape=ellipse, style="filled"',
    'subscription': 'shape=box, style="filled,rounded"',
    'sync': 'shape=hexagon, style="filled"',
    'service': 'shape=parallelogram, style="filled"',
}
_CENTRED = '\\n'
_LEFT = '\\l'
_WIDTH, _WIDE = 22, 32
_MOST_WRITERS = 3
_QUEUE = 'style=dotted, color="#2244bb", penwidth=1.6, arrowhead=open'
_STUB = 'shape=plaintext, fontsize=9, fontcolor="#2244bb", margin="0.02,0.02"'
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


def _wrapped(name: str, width: int = _WIDTH) -> list[str]:
    """Return a long name in lines, broken at its slashes and underscores."""
    lines = ['']
    for piece in _PIECES.findall(name):
        if lines[-1] and len(lines[-1]) + len(piece) > width:
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
    stubs = _stubs(picture)
    yield from _legend(picture)
    for dag in reversed(picture.dags):
        yield from _dag(dag, stubs)
    for arrow in picture.arrows:
        if not arrow.queue:
            yield _arrow(arrow)
    yield '}'


def _stubs(picture: Picture) -> dict[str, list[list[str]]]:
    """Return by reader the texts at which its queue edges begin."""
    names = {box.mark: f'{node.title.rpartition("/")[2]}:{box.lines[0]}'
             for dag in picture.dags for node in dag.nodes for box in node.boxes}
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


def _placed_lines(picture: Picture) -> Iterator[str]:
    """Yield the lines of a picture with positions, for the layout `nop2`, which only draws."""
    placed = place(picture)
    legend = placed[0].at
    yield 'digraph mddag {'
    width = max(d.at.x + d.at.width / 2 for d in placed)
    dots = max(24, min(96, round(_MOST_PIXELS * 72 / width)))
    yield ('  graph [layout=nop2, splines=line, outputorder=edgesfirst, fontname="Helvetica", '
           f'dpi={dots}]')
    yield '  node [fontname="Helvetica", fontsize=10, fixedsize=true]'
    yield '  edge [arrowsize=0.6]'
    top = legend.y + legend.height / 2
    yield (f'  "title" [label={_label([picture.title], _LEFT)}, shape=plaintext, fontsize=24, '
           f'{_at(Rectangle(300, top + 110, 600, 30))}]')
    meaning = ' '.join((*_LEGEND, 'Dotted arrows are queue edges: data that is read later.'))
    yield (f'  "legend" [label={_label([meaning], _LEFT)}, shape=plaintext, fontsize=12, '
           f'{_at(Rectangle(len(meaning) * 3.3, top + 72, len(meaning) * 6.6, 20))}]')
    for number, (colour, text) in enumerate(picture.legend):
        at = Rectangle(60 + 110 * number, top + 35, 100, 24)
        yield (f'  "k{number}" [label={quoted(text)}, shape=box, style="filled", '
               f'color={quoted(colour)}, fillcolor={quoted(colour)}, {_at(at)}]')
    for dag in placed:  # frames first: what comes later is drawn over them
        yield (f'  {quoted(dag.frame.mark)} [label={_label(["", dag.frame.title], _LEFT)}, '
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


def _dag(dag: DagFrame, stubs: dict[str, list[list[str]]]) -> Iterator[str]:
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
    for node in dag.nodes:
        for box in node.boxes:
            for number, text in enumerate(stubs.get(box.mark, ())):
                mark = quoted(f'{box.mark}q{number}')
                yield f'    {mark} [label={_label(text)}, {_STUB}]'
                yield f'    {mark} -> {quoted(box.mark)} [{_QUEUE}]'
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
    return f'{ends} [{_QUEUE}, constraint=false, {note}]'


_LEGEND = (
    'Colour: the RAD offset of a callback, which is',
    'the time from the release of its job to the',
    'earliest deadline that the callback leads to.')


def _legend(picture: Picture) -> Iterator[str]:
    """Yield the legend, a row for each pair of its texts."""
    yield '  subgraph "cluster_legend" {'
    yield (f'    label={_label(_LEGEND, _LEFT)} labeljust=l fontsize=12 style="dashed" '
           'color="#888888"')
    colours = [f'label={quoted(text)}, shape=box, style="filled", color={quoted(colour)}, '
               f'fillcolor={quoted(colour)}' for colour, text in picture.legend]
    shapes = [f'label={quoted(text)}, {_SHAPES[kind]}, fillcolor=white{double}'
              for kind, text, double in (
                  ('timer', 'timer', ''), ('subscription', 'subscription', ''),
                  ('sync', 'sync (joins topics)', ''), ('service', 'service', ''),
                  ('subscription', 'sink, with deadline', ', peripheries=2'))]
    rows = [(*pair, 'style=invis') for pair in zip_longest(
        colours, shapes, fillvalue='style=invis')]
    rows += [('label="publishes", shape=plaintext', 'label="is started by it", shape=plaintext',
              ''),
             (f'label="topic and writer", {_STUB}',
              'label="reads it later (queue edge)", shape=plaintext', _QUEUE)]
    for number, (left, right, edge) in enumerate(rows):
        yield f'    "k{number}" [{left}]'
        yield f'    "s{number}" [{right}]'
        yield f'    "k{number}" -> "s{number}" [{edge}]'
    yield '  }'
