# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Events as rows of numbers are those that the reader gives, in the same order."""

from __future__ import annotations

from pathlib import Path
import tempfile
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from mddag_executor.trace import column_layout as cl
from mddag_executor.trace import TraceFile, TraceReader
import pytest

pytest.importorskip('numba')

KINDS = {'ros2:callback_end': 1, 'mddag:complete': 2, 'mddag:job_release': 3}
WANTED = {*KINDS, 'mddag:drop', 'mddag:lost', 'ros2:rcl_node_init'}
U64, I64, I32 = (st.integers(0, 2**64 - 1), st.integers(-2**63, 2**63 - 1),
                 st.integers(-2**31, 2**31 - 1))
EVENT = st.one_of(
    st.tuples(st.just('callback_end'), U64),
    st.tuples(st.just('callback_start'), U64, st.booleans()),
    st.tuples(st.just('complete'), U64, I32, I32, I64, st.booleans(), I64, I32),
    st.tuples(st.just('job_release'), I32, I64, I64),
    st.tuples(st.just('drop'), U64, I32, I32, I64, st.text(max_size=5)),
    st.tuples(st.just('lost'), I64))


def rows_of(path: Path) -> list[tuple[Any, ...]]:
    """Return the events as the compiled code sees them."""
    from mddag_executor.replay.fast_compile import entries
    names = {kind: name for name, kind in KINDS.items()}
    unsigned = {'ros2:callback_end': {4}, 'mddag:complete': {4}}
    fields = {'ros2:callback_end': 1, 'mddag:complete': 7, 'mddag:job_release': 3}
    found: list[tuple[Any, ...]] = []
    for rows, others in TraceReader(path).columns(WANTED, KINDS, entries()['scan']):
        for row in rows.tolist():
            if row[cl.KIND] == cl.OTHER:
                found.append(others[row[cl.THREAD]])
                assert found[-1][0] not in KINDS
                continue
            name = names[row[cl.KIND]]
            event = [name, row[cl.TIME], row[cl.PROCESS], row[cl.THREAD],
                     *row[cl.FIELDS:cl.FIELDS + fields[name]]]
            for place in unsigned.get(name, ()):
                event[place] %= 2**64
            found.append(tuple(event))
    return found


@given(st.lists(st.tuples(EVENT, st.integers(0, 20), I32, I32), max_size=60), st.integers(1, 9))
@settings(max_examples=100, deadline=None)
def test_rows_are_the_events(
    events: list[tuple[tuple[Any, ...], int, int, int]], flush_every: int
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'a.mcap')
        with TraceFile(path) as file:
            for i, ((name, *fields), time, pid, thread) in enumerate(events):
                file.add(name, time, pid, thread, *fields)
                if i % flush_every == 0:
                    file.flush()
        assert rows_of(path) == list(TraceReader(path).events(WANTED, sorted=True))


def test_a_channel_that_is_defined_in_a_later_chunk(tmp_path: Path) -> None:
    """The chunks of two threads overlap, so that the second one in the file is read last."""
    path = tmp_path / 'a.mcap'
    with TraceFile(path) as file:
        for name, time in (('callback_end', 0), ('job_release', 9), ('job_release', 5)):
            file.add(name, time, 1, 1, *range(1 if name == 'callback_end' else 3))
            file.flush()
    assert [event[1] for event in rows_of(path)] == [0, 5, 9]
