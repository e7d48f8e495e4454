# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What the verbs print for people: tables, times, progress, and names from files made harmless."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
import re
import sys
import time
from types import TracebackType
from typing import TextIO

Cell = str | int | float | None

_NUMBER = re.compile(r'[-+]?[\d,]+(\.\d+)?( ?(%|ns|us|ms|s|min|h|MB|KB))?|-|')
_UNITS = ((1, 'ns'), (1_000, 'us'), (1_000_000, 'ms'), (1_000_000_000, 's'))


def printable(text: str) -> str:
    r"""
    Return a text with control characters written as escapes (`\x1b`).

    Names come from files; a terminal must never obey what stands in them. Escaped are also
    line breaks, changes of the writing direction and lone surrogates.
    """
    if text.isprintable():
        return text
    return ''.join(c if c.isprintable() else c.encode('unicode_escape').decode() for c in text)


def one_line(text: str) -> str:
    """Return a message as a single harmless line."""
    return printable(' '.join(text.split()))


def format_ns(nanoseconds: int, digits: int = 4) -> str:
    """
    Return a time for people, for instance `12.34 ms`.

    An exact value has no zeros at the end (`100 ms`); a rounded one keeps them (`100.0 ms`).

    :param nanoseconds: the time
    :param digits: how many digits count
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


def table(header: Sequence[str], rows: Iterable[Sequence[Cell]]) -> str:
    """
    Return an aligned table; columns of numbers (also with a unit) are right-aligned.

    :param header: the titles of the columns
    :param rows: their cells; None is printed as `-`, a float with two decimals
    :raises ValueError: when a row has more or fewer cells than the header
    """
    body = [[_cell(cell) for cell in row] for row in rows]
    for row in body:
        if len(row) != len(header):
            raise ValueError(f'a row of {len(row)} cells under {len(header)} titles')
    columns = list(zip(*body)) if body else [() for _ in header]
    right = [bool(column) and all(_NUMBER.fullmatch(cell) for cell in column)
             for column in columns]
    lines = [[printable(title) for title in header], *body]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    return ''.join(
        '  '.join(cell.rjust(width) if is_right else cell.ljust(width)
                  for cell, width, is_right in zip(line, widths, right)).rstrip() + '\n'
        for line in lines)


def _cell(cell: Cell) -> str:
    if cell is None:
        return '-'
    if isinstance(cell, float):
        return f'{cell:.2f}'
    return printable(str(cell))


class Progress:
    """
    One line on a terminal for work that takes longer than two seconds, and silence otherwise.

    It is a context manager; the line is wiped when the work ends. Nothing is written when the
    stream is no terminal.
    """

    PATIENCE_S = 2.0
    INTERVAL_S = 0.2

    def __init__(self, what: str, total: int | float | None = None, *,
                 stream: TextIO | None = None,
                 clock: Callable[[], float] = time.monotonic) -> None:
        """
        Start to measure.

        :param what: what is going on, for instance `simulating`
        :param total: how much there is to do; None when that is not known
        :param stream: where to write, standard error by default
        :param clock: gives seconds; tests bring their own
        """
        self._what = one_line(what)
        self._total = total
        self._stream = sys.stderr if stream is None else stream
        self._clock = clock
        self._next = clock() + self.PATIENCE_S if self._stream.isatty() else float('inf')
        self._shown = 0

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        if self._shown:
            self._stream.write('\r' + ' ' * self._shown + '\r')
            self._stream.flush()

    def update(self, done: int | float, note: str = '') -> None:
        """
        Tell how much is done so far; cheap enough for an inner loop.

        :param done: in the unit of the total
        :param note: something to add to the line
        """
        if self._next == float('inf'):
            return
        now = self._clock()
        if now < self._next:
            return
        self._next = now + self.INTERVAL_S
        if self._total:
            part = f'{100 * min(done / self._total, 1.0):.0f} %'
        else:
            part = f'{done:g}'
        line = f'{self._what}: {part} {one_line(note)}'.rstrip()[:79]
        self._stream.write('\r' + line.ljust(self._shown))
        self._stream.flush()
        self._shown = max(self._shown, len(line))
