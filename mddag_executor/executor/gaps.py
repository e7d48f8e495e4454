# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Counts the messages of a subscription that the middleware dropped before they were taken.

Theory of operation
-------------------
The middleware numbers the messages of each publisher, and reports the number with each message,
but not the publisher.  So only a topic with one publisher has numbers that follow each other.

1.  The first message is the base: nothing is known of those before it.
2.  The next message has the number that is expected: one comparison.  A higher number shows how
    many messages are missing.
3.  A lower number means that the publisher was restarted.  Before a gap counts, the publishers are
    compared with those of the base: their number, and their ids at most once in ``_KNOWN_NS``.  If
    anything has changed, or there is not exactly one, the message is a new base.  So gaps may go
    unnoticed, but what was not dropped does not count.
4.  Nothing is counted for subscriptions with a content filter, whose numbers have gaps by design,
    and for middleware that does not report numbers.
"""

from __future__ import annotations

from collections.abc import Callable
import time

_KNOWN_NS = 100_000_000


class Gaps:
    """
    The message numbers of a subscription.

    :param publishers: returns the ids of the publishers that it receives all messages of; None:
        they are unknown, or messages are filtered.
    :param matched: returns the number of publishers that are matched now.
    :ivar expected: the next number; the caller adds 1 if a message has it, and calls ``missing``
        otherwise.
    """

    __slots__ = ('expected', '_publishers', '_find', '_found_at', '_matched', '_count')

    def __init__(
        self, publishers: Callable[[], frozenset[bytes] | None], matched: Callable[[], int]
    ) -> None:
        self.expected = -1
        self._find = publishers
        self._matched = matched
        self._count = -1
        self._publishers: frozenset[bytes] | None = None
        self._found_at = 0

    def missing(self, number: int | None) -> int:
        """Handle an unexpected number; return how many messages are known to be missing."""
        if number is None:
            return 0
        expected, self.expected = self.expected, number + 1
        if self._have_changed() or self._publishers is None or len(self._publishers) != 1:
            return 0
        return max(0, number - expected)

    def _have_changed(self) -> bool:
        """Return whether there are other publishers than at the last base."""
        before = self._count, self._publishers
        if (time.monotonic_ns() >= self._found_at + _KNOWN_NS
                or self._matched() != self._count):
            self._count = self._matched()
            self._publishers, self._found_at = self._find(), time.monotonic_ns()
        return (self._count, self._publishers) != before
