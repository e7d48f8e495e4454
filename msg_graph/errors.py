# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The errors of the package, single or several together, and the display of text from files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, cast, TypeVar

T = TypeVar('T')
R = TypeVar('R')

MOST_ERRORS = 50
"""The most errors of a declaration that are collected."""

_LONGEST_SHOWN = 120


class GraphError(Exception):
    """
    A declaration that cannot be used, or several independent errors of one, the first one first.

    ``str()`` gives one line, ``FILE[:LINE]: what is wrong: what to do``, and how many more follow.

    :ivar file: the file's name as passed to ``load`` or ``loads``.
    :ivar line: line of the entry, counted from 1; None: of no single line.
    :ivar problem: what is wrong, naming the entry.
    :ivar remedy: what to do about it.
    """

    def __init__(
        self, file: str, line: int | None, problem: str, remedy: str,
        found: tuple[GraphError, ...] = (),
    ) -> None:
        super().__init__(file, line, problem, remedy, found)
        self.file = file
        self.line = line
        self.problem = problem
        self.remedy = remedy
        self._found = found

    def __str__(self) -> str:
        place = self.file if self.line is None else f'{self.file}:{self.line}'
        more = f' (and {len(self._found) - 1} more)' if self._found else ''
        return printable(f'{place}: {self.problem}: {self.remedy}') + more

    @property
    def errors(self) -> tuple[GraphError, ...]:
        """Return the single errors, in the order in which they were found."""
        return self._found or (self,)


class ValueProblem(ValueError):
    """A text that is not a valid value; ``str()`` is one line: its problem and the remedy."""

    def __init__(self, problem: str, remedy: str) -> None:
        super().__init__(problem, remedy)
        self.problem = problem
        self.remedy = remedy

    def __str__(self) -> str:
        return f'{self.problem}: {self.remedy}'


def combine_errors(errors: Sequence[GraphError]) -> GraphError:
    """Return several errors, at least one, as one."""
    first = errors[0]
    return first if len(errors) == 1 else GraphError(
        first.file, first.line, first.problem, first.remedy, tuple(errors))


class Collector:
    """
    Collects errors that do not depend on each other.

    ``check`` raises the collected ones. At ``MOST_ERRORS`` they are raised at once: more are not
    read, and the search for similar words takes time.
    """

    def __init__(self) -> None:
        self._errors: list[GraphError] = []

    def attempt(self, work: Callable[..., R], *arguments: Any) -> R:
        """Return what a function returns; if it raises an error, ``check`` raises it."""
        result: Any = None  # if it fails; not used then, since ``check`` raises
        try:
            result = work(*arguments)
        except GraphError as error:
            self._errors.extend(error.errors)
        if len(self._errors) >= MOST_ERRORS:
            self.check()
        return cast(R, result)

    def check(self) -> None:
        """End a stage: the next one would only find consequences of these errors."""
        if self._errors:
            raise combine_errors(self._errors[:MOST_ERRORS])


def for_each(items: Iterable[T], work: Callable[[T], R]) -> list[R]:
    """Apply a function to each item; return the results."""
    errors = Collector()
    results = [errors.attempt(work, item) for item in items]
    errors.check()
    return results


def printable(text: str) -> str:
    """Escape everything in a text that would break a line or a terminal."""
    if text.isprintable():
        return text
    return ''.join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def quoted(text: str) -> str:
    """Return text from a file in quotes, shortened to one line."""
    if len(text) > _LONGEST_SHOWN:
        text = text[:_LONGEST_SHOWN] + '…'
    return f"'{printable(text)}'"


def listed(texts: Iterable[str], most: int = 8) -> str:
    """Return quoted texts with commas between them; those beyond ``most`` are only counted."""
    every = list(texts)
    parts = [quoted(text) for text in every[:most]]
    if len(every) > most:
        parts.append(f'… ({len(every) - most} more)')
    return ', '.join(parts)


def did_you_mean(word: str, known: Iterable[str], otherwise: str) -> str:
    """Return the remedy for a misspelt word: the nearest known one, else ``otherwise``."""
    similar = nearest(word, known)
    return otherwise if similar is None else f'did you mean {quoted(similar)}?'


def nearest(word: str, known: Iterable[str]) -> str | None:
    """Return the known word that is most similar to a misspelt one; None: none is similar."""
    import difflib  # rarely needed
    matches = difflib.get_close_matches(word[:_LONGEST_SHOWN], list(known), n=1)
    return matches[0] if matches else None
