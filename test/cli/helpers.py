# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Running a verb in this process."""

from __future__ import annotations

from collections.abc import Callable

from mddag_executor.cli import main as program
import pytest


def caller(*verb: str) -> Callable[..., tuple[int, str, str]]:
    """Return what runs a verb with arguments: the status, and what it printed and complained."""
    def call(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
        status = program.main([*verb, *map(str, arguments)])
        output = capsys.readouterr()
        return status, output.out, output.err

    return call
