# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The first keys of every file with a result."""

from __future__ import annotations

from typing import TypedDict


class Head(TypedDict):
    """The first keys of every result."""

    mddag: str
    """The version of the program that wrote it."""
    format: int
    """The version of the format: it changes when a key changes its meaning or goes away."""
