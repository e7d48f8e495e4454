# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Lines that tell where a run and its declaration disagree (see ``msg_graph.drift``)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from mddag_executor.report.text import printable
from mddag_executor.text import counted

MOST_LINES = 12


def drift_lines(found: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """
    Yield a line for each disagreement, and none where there is none.

    :param found: what ``drift`` holds in a result for machines.
    """
    if not found:
        return
    yield f'{counted(len(found), "difference")} between the run and the declaration:'
    for each in found[:MOST_LINES]:
        yield f'  {printable(each["text"])}'
    if len(found) > MOST_LINES:
        yield f'  … ({len(found) - MOST_LINES} more)'
