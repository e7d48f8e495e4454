# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
r"""
A picture in DOT, Graphviz's language.

Every name stands in a quoted string. In those Graphviz gives a meaning to the quotation mark and
to the backslash (`\n`, `\N`, `\G`, …), to nothing else, and an HTML-like label only begins with
`<` outside of quotes; control characters are written as escapes, so that no name can break a line.

A queue edge begins at a text that says what is read and from whom, beside the reader: a line from
the writer would cross the pictures of other DAGs.  So no line joins the DAGs.  Graphviz then puts
them above one another, the first lowest, or fills rows from the lowest one up: they are written
in that order.

``dot`` takes minutes for thousands of boxes, as it weighs each against all others.  So in a
picture of more than ``_MANY`` it lays out each DAG by itself, spends less on it, draws straight
lines and puts the DAGs into rows.  (Without ``newrank``: with it, version 2.43 fails.)
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import zip_longest
import math
import re

from mddag_executor.report.picture import Box, DagFrame, Picture
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
_MANY = 1_000
_IN_ROWS = ('pack=true, splines=line, nslimit=0.1, nslimit1=0.1, mclimit=0.1, size="166,166", '
            'packmode=array_c')
"""166 inches are 16,000 dots: viewers take no wider PNG."""


def to_dot(picture: Picture) -> str:
    """Return the DOT text of a picture."""
    return '\n'.join(_lines(picture)) + '\n'


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
    yield '  graph [rankdir=LR, compound=true, ranksep=0.35, nodesep=0.1,'
    yield '    fontname="Helvetica", labelloc=t, labeljust=l, fontsize=20,'
    columns = 1
    if sum(len(node.boxes) for dag in picture.dags for node in dag.nodes) > _MANY:
        columns = math.isqrt(len(picture.dags) // 2) + 1
        yield f'    {_IN_ROWS}{columns},'
    else:
        yield '    newrank=false,'
    yield f'    label={quoted(picture.title)}]'
    yield '  node [fontname="Helvetica", fontsize=12, margin="0.08,0.04", height=0.3]'
    yield '  edge [arrowsize=0.7]'
    stubs = _stubs(picture)
    yield from _legend(picture)
    for dag in _upwards(picture.dags, columns):
        yield from _dag(dag, stubs)
    for arrow in picture.arrows:
        if not arrow.queue:
            yield (f'  {quoted(arrow.start)} -> {quoted(arrow.end)} '
                   f'[tooltip={quoted(arrow.note)}]')
    yield '}'


def _upwards(dags: Sequence[DagFrame], columns: int) -> Iterator[DagFrame]:
    """Yield DAGs row by row, the lowest row, in which the legend comes first, at first."""
    end, room = len(dags), max(1, columns - 1)
    while end > 0:
        yield from dags[max(0, end - room):end]
        end, room = end - room, columns


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


def _box(box: Box) -> str:
    sink = ', peripheries=2' if box.sink else ''
    return (f'{quoted(box.mark)} [label={_label(box.lines)}, {_SHAPES[box.kind]}, '
            f'fillcolor={quoted(box.colour)}{sink}, tooltip={quoted(box.note)}]')


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
