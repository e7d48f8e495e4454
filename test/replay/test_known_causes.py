# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Live runs in which deadlines are missed for one known reason: most misses are told to be so."""

from __future__ import annotations

from pathlib import Path

from benchmarks.known_causes import causes, record
import pytest


@pytest.mark.slow
@pytest.mark.parametrize('cause', ['waited', 'group', 'machine', 'lost'])
def test_the_cause_of_most_misses(cause: str, tmp_path: Path) -> None:
    for misses in (9, 36):  # a busy machine has stops of its own, so that fewer are made
        trace = tmp_path / f'{misses}.mcap'
        record(cause, trace, misses, scale=3.0)
        told = causes(trace)
        if told.get(cause, 0) >= 5:
            break
    assert told.get(cause, 0) >= 5
    assert all(n <= told[cause] for other, n in told.items() if other != 'machine'), told
