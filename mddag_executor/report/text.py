# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Text output: aligned tables, times with units, and harmless names from files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
import os
import re
import sys
from typing import TextIO

from mddag_executor.text import listed as listed_plainly

Cell = str | int | None

WIDTH, NARROW = 120, 100
"""
A table on a terminal is at most 120 columns wide, or 100 with few rows, if its names can be
shortened.
"""
_FEW_ROWS = 15
_LONGEST_LIST = 10
_SHORTEST_NAME = 18
_NUMBER = re.compile(r'[-+]?[\d,]+(\.\d+)?( ?(%|ns|us|ms|s|min|h|MB|KB))?|-|')
_RED, _PLAIN = '\x1b[31m', '\x1b[0m'
_UNITS = ((1, 'ns'), (1_000, 'us'), (1_000_000, 'ms'), (1_000_000_000, 's'))


def printable(text: str) -> str:
    r"""
    Return a text with control characters written as escapes (`\x1b`).

    Names come from files; a terminal must never interpret them. Line breaks, changes of the
    writing direction and lone surrogates are escaped as well. (``msg_graph.errors`` has a copy for
    its own errors; importing that one would load YAML for every `--help`.)
    """
    if text.isprintable():
        return text
    return ''.join(c if c.isprintable() else c.encode('unicode_escape').decode() for c in text)


def listed(names: Sequence[str]) -> str:
    """Return names for a line on a terminal: the first ones, and the number of others."""
    return listed_plainly([printable(name) for name in names], _LONGEST_LIST)


def format_ns(nanoseconds: int, digits: int = 4) -> str:
    """
    Return a time as text, for instance `12.34 ms`.

    An exact value has no zeros at the end (`100 ms`); a rounded one keeps them (`100.0 ms`).

    :param nanoseconds: the time
    :param digits: number of significant digits
    """
    sign, size = ('-', -nanoseconds) if nanoseconds < 0 else ('', nanoseconds)
    text, unit = '', ''
    for scale, unit in _UNITS:
        value = size / scale
        decimals = max(0, digits - len(str(int(value))))
        text = f'{value:.{decimals}f}'
        # Rounding may carry: 999.96 us is 1.000 ms, not 1000.0 us.
        if float(text) < 1000 or unit == 's':
            break
    exact = round(float(text) * scale) == size
    if '.' in text and exact:
        text = text.rstrip('0').rstrip('.')
    return f'{sign}{text} {unit}'


def shortened(text: str, longest: int) -> str:
    """Return a text of limited length, with an ellipsis in place of its middle."""
    if len(text) <= longest:
        return text
    half = (longest - 1) // 2
    return f'{text[:longest - 1 - half]}…{text[len(text) - half:]}'


def is_coloured(stream: TextIO | None = None) -> bool:
    """Return whether a stream (standard output) shows colours (see no-color.org)."""
    return (stream or sys.stdout).isatty() and not os.environ.get('NO_COLOR') and os.environ.get(
        'TERM') != 'dumb'


def table(
    header: Sequence[str], rows: Iterable[Sequence[Cell]], marked: Sequence[bool] = (),
    most: int | None = None, grouped: int = 0,
) -> str:
    """
    Return an aligned table; columns of numbers, with or without a unit, are right-aligned.

    Long names are shortened in their middle, so that a table on a terminal is at most ``WIDTH``
    columns wide, with few rows ``NARROW``.  In a file or pipe names are whole: programs read them.

    :param header: the titles of the columns
    :param rows: their cells; None is printed as `-`
    :param marked: rows that are red if colours are available
    :param most: maximum width instead of these
    :param grouped: number of columns on the left that are empty if the first one is as above
    """
    body = [[_cell(cell) for cell in row] for row in rows]
    for row in body:
        if len(row) != len(header):
            raise ValueError(f'a row of {len(row)} cells under {len(header)} titles')
    for above, row in [*pairwise(body)][::-1] if grouped else ():
        if row[0] == above[0]:
            row[:grouped] = [''] * grouped
    columns = list(zip(*body)) if body else [() for _ in header]
    right = [bool(column) and all(_NUMBER.fullmatch(cell) for cell in column)
             for column in columns]
    lines = [[printable(title) for title in header], *body]
    names = [i for i, column in enumerate(columns)
             if not right[i] and not any(' ' in cell for cell in column)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    if most or sys.stdout.isatty():
        widths = _fitting(widths, names, most or (NARROW if len(body) <= _FEW_ROWS else WIDTH))
    lines = [[shortened(cell, width) for cell, width in zip(line, widths)] for line in lines]
    texts = ['  '.join(
        cell.rjust(width) if is_right else cell.ljust(width)
        for cell, width, is_right in zip(line, widths, right)).rstrip() for line in lines]
    if any(marked) and is_coloured():
        texts[1:] = [f'{_RED}{text}{_PLAIN}' if red else text
                     for text, red in zip(texts[1:], marked)]
    return ''.join(text + '\n' for text in texts)


def _fitting(widths: list[int], names: Sequence[int], most: int) -> list[int]:
    """Return widths of columns that fit together: the widest columns of names lose most."""
    too_many = sum(widths) + 2 * (len(widths) - 1) - most
    while too_many > 0 and names:
        widest = max(names, key=lambda i: widths[i])
        if widths[widest] <= _SHORTEST_NAME:
            break
        widths[widest] -= 1
        too_many -= 1
    return widths


def _cell(cell: Cell) -> str:
    return '-' if cell is None else printable(str(cell))
