# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Blanks of a drafted declaration, which its user fills in."""

from __future__ import annotations

import re

from msg_graph.errors import GraphError

MARK = 'FILL IN'
_OPEN = re.compile(rf'\s*#\s+(?:(\w+:).*\s#\s+)?{MARK}: (.*)')


def open_blanks(text: str, file: str) -> list[GraphError]:
    """Return an error for each open blank in a declaration."""
    return [GraphError(
        file, number,
        f"{match[1] or 'this'} is a blank to fill in ({match[2]})",
        "correct the value and remove the '# '" if match[1] else 'do so, then remove the line')
        for number, line in enumerate(text.splitlines(), 1)
        if MARK in line and (match := _OPEN.fullmatch(line)) is not None]
