# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Reports of long work in the background of another, such as compiling."""

from __future__ import annotations

from collections.abc import Callable

LISTENERS: list[Callable[[str], None]] = []
"""The last one gets the reports; a progress line adds itself."""


def report(what: str) -> None:
    """Show what is being done; call it now and then meanwhile."""
    if LISTENERS:
        LISTENERS[-1](what)
