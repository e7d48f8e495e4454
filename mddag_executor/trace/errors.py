# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Errors and warnings of traces."""

from __future__ import annotations

from mddag_executor.errors import InputError


class TraceError(InputError):
    """A trace that cannot be read or written; its text is `FILE: what is wrong: what to do`."""


class TraceWarning(UserWarning):
    """A trace with missing data; its text says which, with counts."""


def renamed(text: str, path: str, name: str) -> str:
    """Return a message with the user's name of a file instead of the path at its beginning."""
    return name + text[len(path):] if text.startswith(path) else text


def unreadable(path: str, error: OSError) -> TraceError:
    """Return the error for a file or folder that cannot be read."""
    if isinstance(error, FileNotFoundError):
        return TraceError(path, 'no such file or directory', 'check the path')
    return TraceError(path, f'cannot be read ({error.strerror})',
                      'check its name, that you may read it, and the disk it is on')
