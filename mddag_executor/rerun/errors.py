# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What can go wrong in a rerun."""

from __future__ import annotations

from mddag_executor.errors import MddagError, UserCodeError
from mddag_executor.hosting.loading import describe


class RerunError(MddagError):
    """A run that cannot go on; its text is `PLACE: what is wrong: what to do`."""


class CallbackFailed(RerunError, UserCodeError):
    """
    A callback, or a program's main, has raised: the cause of this exception.

    :ivar at_ns: the virtual time, ns after the start of the recording.
    """

    def __init__(self, name: str, error: BaseException, at_ns: int) -> None:
        super().__init__(
            f'{name}: it raised {describe(error)} at {at_ns / 1e9:.6f} s: correct it, or see its '
            'traceback')
        self.at_ns = at_ns
