# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What does something else for as long as a run lasts."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any


def instead(function: Callable[..., Any]) -> Callable[[Any], Any]:
    """Return what puts a function, or a bound method, in the place of a method."""
    return lambda original: lambda *args, **more: function(*args, **more)


class Replacements(ExitStack):
    """What has been replaced; ``close`` puts it back."""

    def replace(self, owner: Any, name: str, make: Callable[[Any], Any]) -> None:
        """
        Replace a function of a module, or a method or property of a class.

        :param make: returns what stands there from now on, given what stood there.
        """
        original = vars(owner)[name]
        replacement = make(original)
        if callable(original) and replacement.__doc__ is None:
            replacement.__doc__ = original.__doc__
        self.callback(setattr, owner, name, original)
        setattr(owner, name, replacement)
