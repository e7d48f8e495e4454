# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Exports: rows for spreadsheets and data frames, and traces for Perfetto, read back."""

from collections import Counter
import csv
import io

from mddag_executor.replay import replay
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


def test_the_rows_are_those_of_the_replay():
    outcome = replay(DEMO)
    result = outcome.result()
    jobs = read_csv(exported(DEMO, 'csv', jobs=True))
    for dag_name, dag in result['dags'].items():
        for name, sink in dag['sinks'].items():
            mine = [row for row in jobs if (row['dag'], row['sink']) == (dag_name, name)]
            verdicts = Counter(row['verdict'] for row in mine)
            assert verdicts['in_time'] + verdicts['late'] == sink['completed']
            assert verdicts['late'] + verdicts['overdue'] == sink['late']
            responses = [int(row['response_ns']) for row in mine if row['response_ns']]
            assert (min(responses), max(responses)) == (
                sink['response_ns']['min'], sink['response_ns']['max'])
    executions = read_csv(exported(DEMO, 'csv'))
    declared = [row for row in executions if row['dag']]
    busy = sum(int(row['executing_ns']) for row in declared)
    assert busy == sum(use['busy_ns'] for use in result['callbacks'].values())
    assert all(row['release_ns'] for row in declared)
