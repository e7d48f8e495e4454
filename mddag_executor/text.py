# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Numbers and lists in messages: `1 DAG`, `2 DAGs`, `a, b, … (7 more)`."""

from __future__ import annotations

from collections.abc import Collection
from itertools import islice


def counted(number: int, noun: str, plural: str | None = None) -> str:
    """
    Return a number with its noun, which is in the plural unless the number is 1.

    :param number: how many
    :param noun: the noun for one
    :param plural: the noun for several, where that is not the noun and an `s`
    """
    return f'{number} {noun if number == 1 else plural or noun + "s"}'


def listed(names: Collection[str], most: int = 5) -> str:
    """Return the first names of a list, and how many more there are."""
    more = len(names) - most
    return ', '.join(islice(names, most)) + (f', … ({more} more)' if more > 0 else '')


def step_text(step: int) -> str:
    """Return a line about a step of the system clock; ``step``: ns forward."""
    return (f'the system clock was set {"forward" if step > 0 else "back"} by '
            f'{abs(step) / 1e9:.3f} s during the run: timers and stamps go by it, so results '
            'around that time are not those of the program: set the clock before the run')
