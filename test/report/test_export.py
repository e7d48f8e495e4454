# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Exports for spreadsheets and data frames; ``cli/golden/export_*.txt`` have their rows."""

import csv
import io

from mddag_executor import replay
from mddag_executor.report.export import _harmless, write
import pytest

from . import runs

DEMO = runs.CONFIG.parent / 'bags' / 'demo_short.mcap'


def exported(path, form, jobs=False):
    file = io.BytesIO()
    write(form, file, replay(path), 'jobs' if jobs else 'executions')
    return file.getvalue()


def read_csv(data):
    return list(csv.DictReader(io.StringIO(data.decode(), newline='')))


def test_csv_is_harmless(tmp_path):
    path = runs.by_hand(tmp_path / 'run.mcap', hostile=True)
    data = exported(path, 'csv')
    assert b'\x1b' not in data
    assert read_csv(data)[6]['vertex'] == runs.HOSTILE.replace('\x1b', '\\x1b')
    assert [_harmless(text) for text in ('=1+1', '+1', '-1', '@x', '/n:a')] == [
        "'=1+1", "'+1", "'-1", "'@x", '/n:a']


@pytest.mark.parametrize('jobs', [False, True])
def test_parquet_and_csv_hold_the_same(jobs):
    parquet = pytest.importorskip('pyarrow.parquet', reason='pyarrow is not installed')
    table = parquet.read_table(io.BytesIO(exported(DEMO, 'parquet', jobs)))
    rows = read_csv(exported(DEMO, 'csv', jobs))
    assert table.num_rows == len(rows) > 500

    def plain(value):
        if isinstance(value, bool):
            return str(value).lower()
        if isinstance(value, float):
            return f'{value:.9f}'
        return '' if value is None else str(value)

    assert [{key: plain(value) for key, value in row.items()}
            for row in table.to_pylist()] == rows
