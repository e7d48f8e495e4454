# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the callbacks of a recording are called that no declaration names."""

from __future__ import annotations

from mddag_executor.replay.happenings import ADDRESS, Event, Handlers, Observer
from mddag_executor.trace.census import Census


class CallbackNames(Observer):
    """Tells the name of a callback by its address (of an imported one: its number)."""

    def __init__(self) -> None:
        self._census = Census()
        self._known: dict[int, str] | None = None

    def handlers(self) -> Handlers:
        """Return what takes in who there is."""
        return dict.fromkeys(self._census.who, self._take)

    def _take(self, event: Event) -> None:
        self._census.take(event)
        self._known = None

    def __call__(self, callback: int) -> str:
        """Return a callback's name."""
        if self._known is None:
            self._known = self._census.names()
        return self._known.get(
            callback & ADDRESS, 'a callback whose start is not recorded')


def no_names(callback: int) -> str:
    """Stand for all undeclared callbacks, where a run was computed."""
    return 'undeclared callbacks'
