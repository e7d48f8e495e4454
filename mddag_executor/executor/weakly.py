# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Methods of an executor that threads may have without keeping it alive."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
import weakref


def weakly(method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that calls a method as long as its object is alive, else returns None."""
    reference = weakref.WeakMethod(method)

    def call(*args: Any) -> Any:
        living = reference()
        return None if living is None else living(*args)

    return call
