# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Draws: a seeded source of randomness, and the random distribution of a total.

Theory of operation
-------------------
Only ``Random.random``, whose numbers are the same in every version of Python, and plain arithmetic
are used; so a seed gives the same file everywhere.

*Dirichlet-rescale* (Griffin, Bate and Davis, "Generating utilization vectors for the systematic
evaluation of schedulability tests", RTSS 2020) draws uniformly from all shares with a given sum
and upper bounds, and rejects no draw: the part of the simplex that exceeds some bounds is a
smaller simplex, and is stretched back over the whole, until no bound is exceeded.  If more than
half of the room is asked for, the free room is distributed instead.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
import random
from typing import TypeVar

from mddag_executor.errors import UsageError

T = TypeVar('T')

_MOST_TRIES = 10_000
_MOST_STRETCHES = 1_000
_NEGLIGIBLE = 1e-6
"""A bound of this part of the total is treated as 0: a draw would hardly ever be below it."""


class Dice:
    """A source of random numbers; the same seed text gives the same numbers everywhere."""

    def __init__(self, seed: str) -> None:
        self._random = random.Random(seed).random

    def number(self, low: float = 0.0, high: float = 1.0) -> float:
        """Return a number between two."""
        return low + (high - low) * self._random()

    def whole(self, low: int, high: int) -> int:
        """Return an integer from one to another, both included."""
        return low + int(self._random() * (high - low + 1))

    def chance(self, probability: float) -> bool:
        """Return whether something with a probability comes true."""
        return self._random() < probability

    def pick(self, choices: Sequence[T]) -> T:
        """Return one of several."""
        return choices[self.whole(0, len(choices) - 1)]


def dirichlet_rescale(dice: Dice, total: float, most: Sequence[float]) -> list[float]:
    """Return shares that sum up to a total of at most ``sum(most)``, each with its bound."""
    room = sum(most)
    if total > room / 2:
        free = _stretched(dice, max(0.0, room - total), most)
        return [max(0.0, limit - share) for limit, share in zip(most, free)]
    return _stretched(dice, total, most)


def _stretched(dice: Dice, total: float, most: Sequence[float]) -> list[float]:
    if total <= 0.0:
        return [0.0] * len(most)
    some = [limit for limit in most if limit > total * _NEGLIGIBLE]
    if len(some) < len(most):
        dealt = iter(_stretched(dice, total, some))
        return [next(dealt) if limit > total * _NEGLIGIBLE else 0.0 for limit in most]
    for _ in range(_MOST_TRIES):
        # A flat Dirichlet distribution: exponential numbers by their sum.
        numbers = [-math.log(1.0 - dice.number()) for _ in most]
        factor = total / sum(numbers)
        shares = [number * factor for number in numbers]
        for _ in range(_MOST_STRETCHES):
            over = [share > limit for share, limit in zip(shares, most)]
            if not any(over):
                if abs(sum(shares) - total) <= total * 1e-9:
                    return shares
                break  # stretching often has made the rounding large
            rest = total - sum(limit for limit, is_over in zip(most, over) if is_over)
            if rest <= total * 1e-9:
                break  # nothing but rounding is left to stretch
            lower = [limit if is_over else 0.0 for limit, is_over in zip(most, over)]
            shares = [(share - less) * total / rest for share, less in zip(shares, lower)]
    raise UsageError(
        f'--utilisation: {_MOST_TRIES} draws did not fit: give more --dags, or a larger '
        '--max-dag-load')
