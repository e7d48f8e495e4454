# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Whom the intake hands over to what became ready."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from mddag_executor.live.work import Work


class Receiver(Protocol):
    """
    Whom the intake hands over to, from its threads (several at once) or from ``poll``.

    A receiver that raises does no harm to the intake: its exception goes to ``on_intake_error``.

    :ivar executor: the executor in which futures run their callbacks.
    """

    executor: Any

    def take(self, work: Work) -> None:
        """Handle what became ready."""

    def take_in(self, arrivals: Sequence[Work]) -> None:
        """Handle what became ready at one instant: it is to be chosen among all of it."""

    def on_intake_error(self, error: BaseException) -> None:
        """Handle an exception of a take or of ``take_in``."""
