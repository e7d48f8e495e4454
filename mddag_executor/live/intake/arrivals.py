# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the intake hands over, and to whom."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol


class Arrival(NamedTuple):
    """
    Something that became ready and has been taken: it is no longer in the middleware.

    :ivar entity: the timer, subscription, service, guard condition or waitable.
    :ivar function: what is to be called for it, with ``args``.
    :ivar then: what is to be called with its result, or None: a service's response is sent so.
    :ivar info: of a message: what the middleware tells of it, with its stamps.
    :ivar due: of a timer: its nominal due time, ns on the scale of ``time.monotonic_ns``, a point
        of the timer's exact phase grid; with simulated time active, when it was noticed. After
        an overrun it is when the first of the missed periods was due.
    :ivar missed: so many periods after that one are skipped, as rcl does it.
    """

    entity: Any
    function: Callable[..., Any]
    args: tuple[Any, ...] = ()
    then: Callable[[Any], Any] | None = None
    info: dict[str, Any] | None = None
    due: int | None = None
    missed: int = 0


class Receiver(Protocol):
    """
    Whom the intake hands over to, from its threads (several at once) or from ``poll``.

    A receiver that raises does no harm to the intake: its exception goes to ``on_intake_error``.

    :ivar executor: the executor in which futures run their callbacks.
    """

    executor: Any

    def take_in(self, arrivals: Sequence[Arrival]) -> None:
        """Take in what became ready at one instant: it is to be chosen among all of it."""

    def on_intake_error(self, error: BaseException) -> None:
        """Take in an exception of a take or of ``take_in``."""
