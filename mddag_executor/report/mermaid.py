# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A picture in Mermaid, which many web pages and editors show as a drawing.

Names are in quoted labels, which Mermaid reads as HTML. So all characters except plain letters,
digits and a few harmless signs are written as their number (`#35;`): no name can end the label,
open a tag or start a comment. Identifiers are generated.
"""

from __future__ import annotations

from collections.abc import Iterator
import re

from mddag_executor.report.picture import Box, MOST_LABELLED, Picture
from mddag_executor.report.text import printable

_BRACKETS = {
    'timer': ('([', '])'),
    'subscription': ('[', ']'),
    'sync': ('{{', '}}'),
    'service': ('[/', '/]'),
}
_NOT_PLAIN = re.compile(r'[^A-Za-z0-9_/:,. -]')


def to_mermaid(picture: Picture) -> str:
    """Return the Mermaid text of a picture."""
    return '\n'.join(_lines(picture)) + '\n'


def quoted(text: str) -> str:
    """Return a text as a literal quoted label."""
    return '"' + _NOT_PLAIN.sub(lambda found: f'#{ord(found[0])};', printable(text)) + '"'


def _lines(picture: Picture) -> Iterator[str]:
    yield 'flowchart LR'
    classes: dict[str, str] = {}
    members: dict[str, list[str]] = {}
    sinks = []
    for dag in picture.dags:
        yield f'  subgraph {dag.mark}[{quoted(dag.title)}]'
        for box in dag.boxes:
            yield f'    {_box(box)}'
            name = classes.setdefault(box.colour, f'c{len(classes)}')
            members.setdefault(name, []).append(box.mark)
            if box.sink:
                sinks.append(box.mark)
        yield '  end'
    labelled = len(picture.boxes) <= MOST_LABELLED
    for arrow in picture.arrows:
        topic = f'|{quoted(arrow.note)}|' if labelled and not arrow.queue else ''
        yield f'  {arrow.start} {"-.->" if arrow.queue else "-->"}{topic} {arrow.end}'
    for colour, name in classes.items():
        yield f'  classDef {name} fill:{colour},stroke:#444444,color:#000000'
        yield f'  class {",".join(members[name])} {name}'
    yield '  classDef sink stroke-width:3px'
    yield f'  class {",".join(sinks)} sink'


def _box(box: Box) -> str:
    opening, closing = _BRACKETS[box.kind]
    label = '<br>'.join(quoted(line)[1:-1] for line in (box.node, *box.lines))
    return f'{box.mark}{opening}"{label}"{closing}'
