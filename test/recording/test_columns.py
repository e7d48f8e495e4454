# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Tables: named columns of one length."""

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.recording.columns import concatenate, Growing, rows, Table
import numpy as np
import pytest

KIND = np.dtype([('job', 'i8'), ('vertex', 'i4'), ('holds', '?')])


def table_of(n):
    return rows(KIND, n, job=np.arange(n) * 10, vertex=-1)


def test_columns_rows_and_parts_of_a_table():
    table = table_of(4)
    assert (table.names, table.dtype, len(table)) == (('job', 'vertex', 'holds'), KIND, 4)
    assert table['job'].tolist() == [0, 10, 20, 30]
    assert table[['vertex', 'job']].tolist() == [(-1, 0), (-1, 10), (-1, 20), (-1, 30)]
    for which in (np.array([1, 3]), table['job'] % 20 > 0, slice(1, None, 2), [1, 3]):
        assert table[which]['job'].tolist() == [10, 30]
    assert len(table[[]]) == len(table[:0]) == 0
    row = table[-1]
    assert (row['job'], row['vertex'], row.item()) == (30, -1, (30, -1, False))
    assert [row['job'] for row in table] == table['job'].tolist()
    for wrong in (4, -5, np.array([4])):
        with pytest.raises(IndexError):
            table[wrong]
    with pytest.raises(IndexError, match='a mask of 3 rows for a table of 4'):
        table[np.ones(3, dtype=np.bool_)]
    with pytest.raises(KeyError):
        table['nope']
    with pytest.raises(ValueError, match="no column 'nope'"):
        rows(KIND, 1, nope=1)


def test_columns_keep_their_types_and_copies_are_copies():
    table = table_of(3)
    other, view = table.copy(), table[:2]
    table['job'] = [1.0, 2.0, 3.0]
    table['vertex'][0] = 7
    assert table.dtype == KIND
    assert view.tolist() == [(1, 7, False), (2, -1, False)]
    assert other['job'].tolist() == [0, 10, 20]
    assert (table == other).tolist() == [False] * 3 and (other == table_of(3)).all()
    assert table.records().dtype == KIND and table.records().tolist() == table.tolist()


@given(st.lists(st.integers(0, 3000), max_size=6))
def test_a_growing_table_has_all_rows(sizes):
    growing = Growing(KIND, vertex=-1)
    parts = [rows(KIND)]
    for number, n in enumerate(sizes):
        if number % 2:
            part = rows(KIND, n, job=number, vertex=np.arange(n), holds=True)
            growing.add(part)
        else:
            part = growing.more(n, job=number)
        parts.append(part.copy())
        assert len(growing) == sum(sizes[:number + 1])
    whole = concatenate(parts)
    assert isinstance(whole, Table) and growing.table().dtype == KIND
    assert growing.table().tolist() == whole.tolist()


def test_rows_that_were_expected_are_added_without_a_copy():
    growing = Growing(KIND, vertex=-1)
    growing.expect(0.05)
    first = growing.more(2000, job=np.arange(2000))
    for _ in range(19):
        growing.more(2000, job=1)
    assert np.shares_memory(first['job'], growing.rows()['job'])
    growing.more(100_000, job=2)    # more than expected
    table = growing.table()
    assert not np.shares_memory(first['job'], table['job'])
    assert table['job'].tolist() == [*range(2000), *[1] * 38_000, *[2] * 100_000]
    assert set(table['vertex'].tolist()) == {-1}
