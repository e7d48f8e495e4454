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

"""The one error of the package, and how text from a file is shown in it."""

from __future__ import annotations

from collections.abc import Iterable
import difflib

_LONGEST_SHOWN = 120


class GraphError(Exception):
    """
    A declaration that cannot be used.

    ``str()`` gives one line, ``FILE[:LINE]: what is wrong: what to do``.

    :ivar file: the file's name as it was given to ``load`` or ``loads``.
    :ivar line: line of the offending entry, counted from 1; None where no line can be blamed.
    :ivar problem: what is wrong, naming the entry.
    :ivar remedy: what to do about it.
    """

    def __init__(self, file: str, line: int | None, problem: str, remedy: str) -> None:
        super().__init__(file, line, problem, remedy)
        self.file = file
        self.line = line
        self.problem = problem
        self.remedy = remedy

    def __str__(self) -> str:
        """Return the error as one line."""
        place = self.file if self.line is None else f'{self.file}:{self.line}'
        return printable(f'{place}: {self.problem}: {self.remedy}')


def printable(text: str) -> str:
    """Return the text with everything escaped that would break a line or a terminal."""
    if text.isprintable():
        return text
    return ''.join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def shown(text: str) -> str:
    """Return text from a file in quotes, on one line and not too long."""
    if len(text) > _LONGEST_SHOWN:
        text = text[:_LONGEST_SHOWN] + '…'
    return f"'{printable(text)}'"


def listed(texts: Iterable[str], most: int = 8) -> str:
    """Return quoted texts with commas between them; what is beyond ``most`` is only counted."""
    every = list(texts)
    parts = [shown(text) for text in every[:most]]
    if len(every) > most:
        parts.append(f'… ({len(every) - most} more)')
    return ', '.join(parts)


def nearest(word: str, known: Iterable[str]) -> str | None:
    """Return the known word that the misspelt one most likely stands for, or None."""
    matches = difflib.get_close_matches(word[:_LONGEST_SHOWN], list(known), n=1)
    return matches[0] if matches else None


def did_you_mean(word: str, known: Iterable[str], otherwise: str) -> str:
    """Return the remedy for a misspelt word: the nearest known one, else ``otherwise``."""
    match = nearest(word, known)
    return otherwise if match is None else f'did you mean {shown(match)}?'
