# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What a recording lacks, or what in it is doubtful.

===========  =================================================================================
kind         what it counts
===========  =================================================================================
damage       damaged or missing parts of a file
events       events that the recorder or tracer lost
strange      events that make no sense, or contradict others: they are left out
open         executions whose start is not recorded
end          processes whose end is not recorded
empty        the recording, if no job was released in it
clock        groups of processes whose clock differs from that of the first one; steps of the clock
callbacks    declared callbacks or DAGs that are not recorded
duplicate    processes that two of the recordings have: the events of one are left out
stamps       releases by another stamp or time than the declared one
unjudged     jobs that are not judged
===========  =================================================================================
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

Kind = Literal['damage', 'events', 'strange', 'open', 'end', 'empty', 'clock', 'callbacks',
               'stamps', 'duplicate', 'unjudged']


@dataclass(frozen=True)
class Loss:
    """
    Missing or doubtful data.

    :ivar kind: see the table of this module; ``count``: how many there are, 1 or more.
    :ivar text: one line for the user.
    """

    kind: Kind
    count: int
    text: str


class Losses:
    """All that a recording lacks, in the order in which it is reported."""

    __slots__ = ('_losses',)

    def __init__(self, losses: Iterable[Loss] = ()) -> None:
        self._losses = tuple(losses)

    def __iter__(self) -> Iterator[Loss]:
        return iter(self._losses)

    def __len__(self) -> int:
        return len(self._losses)

    def __repr__(self) -> str:
        return f'Losses({list(self._losses)!r})'

    def count(self, kind: Kind) -> int:
        """Return how many there are of a kind."""
        return sum(loss.count for loss in self._losses if loss.kind == kind)

    def lines(self) -> list[str]:
        """Return one line for each."""
        return [loss.text for loss in self._losses]

    def more(self, *losses: Loss) -> Losses:
        """Return these and further ones."""
        return Losses((*self._losses, *losses))
