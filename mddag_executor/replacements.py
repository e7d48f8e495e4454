# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Functions and methods that are replaced for the duration of a run."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any


def instead(function: Callable[..., Any]) -> Callable[[Any], Any]:
    """Return a `make` (see `replace`) that puts a function in the place of a method."""
    return lambda original: lambda *args, **more: function(*args, **more)


class Replacements(ExitStack):
    """The replaced functions; ``close`` restores the originals."""

    def replace(self, owner: Any, name: str, make: Callable[[Any], Any]) -> None:
        """
        Replace a function of a module, or a method or property of a class.

        :param make: returns the new value, given the original one.
        """
        original = vars(owner)[name]
        replacement = make(original)
        if callable(original) and replacement.__doc__ is None:
            replacement.__doc__ = original.__doc__
        self.callback(setattr, owner, name, original)
        setattr(owner, name, replacement)
