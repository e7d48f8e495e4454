# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Timers that a node made again: several timers of a recording that users know as one.

A timer that was made after another one of its node, with the same period and function, is that
callback made again if the earlier one had fired for the last time, or had never fired although a
period had passed (it was destroyed or cancelled before).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from mddag_executor.recording.names import Callback

_LATE_SHARE = 0.1
"""A first execution this part of a period too late is not explained by the machine."""
_MADE_NS = 50_000_000
"""When a timer was made is recorded this much earlier or later at most."""


def made_again(
    timers: Iterable[Callback], last_starts: Mapping[int, int], end: int
) -> Iterator[tuple[Callback, Callback]]:
    """
    Yield each timer that was made again, and the first one of its kind.

    :param timers: in the order in which they were made.
    :param last_starts: the start of the last execution of each callback that ran, by number, ns.
    :param end: of the recording, ns.
    """
    first: dict[tuple[str, int, str], Callback] = {}
    last: dict[int, int] = {}
    for timer in timers:
        before = first.setdefault((timer.node_name, timer.period, timer.symbol), timer)
        if before is not timer:
            start = last.get(before.number)
            was_gone = timer.made > start if start is not None else is_overdue(before, end)
            if not (timer.symbol and was_gone):
                continue
            yield timer, before
        if timer.number in last_starts:
            last[before.number] = max(
                last.get(before.number, 0), last_starts[timer.number])


def is_overdue(timer: Callback, time: int) -> bool:
    """Return whether a time is too late for the first execution of a timer: reset, or gone."""
    return time - timer.made > (1 + _LATE_SHARE) * timer.period + _MADE_NS
