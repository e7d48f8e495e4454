# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What can go wrong with a trace."""

from __future__ import annotations

from mddag_executor.errors import InputError


class TraceError(InputError):
    """A trace that cannot be read or written; its text is `FILE: what is wrong: what to do`."""


class TraceWarning(UserWarning):
    """A trace of which something is missing; its text says what, with counts."""
