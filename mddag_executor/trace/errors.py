# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What can go wrong with a trace."""

from __future__ import annotations

from mddag_executor.errors import InputError


class TraceError(InputError):
    """A trace that cannot be read or written; its text is `FILE: what is wrong: what to do`."""


class TraceWarning(UserWarning):
    """A trace of which something is missing; its text says what, with counts."""


def renamed(text: str, path: str, name: str) -> str:
    """Return a message with what the user calls a file in place of its path at the beginning."""
    return name + text[len(path):] if text.startswith(path) else text
