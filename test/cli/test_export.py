# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `export` with pyarrow: tables, folders, and errors in one line."""

import os
from pathlib import Path
import shutil

from mddag_executor import open_recording, replay
from mddag_executor.analysis.result_table import result_tables
from mddag_executor.recording.tables import TABLES
import pytest

DEMO = Path(__file__).resolve().parents[2] / 'bags' / 'demo_short.mcap'
parquet = pytest.importorskip('pyarrow.parquet', reason='pyarrow is not installed')


def test_the_tables_of_a_recording(tmp_path, call):
    out = tmp_path / 'tables'
    assert call('export', DEMO, '-o', f'{out}/') == (0, f'exported: {out}/\n', '')
    recording = open_recording(DEMO)
    assert {path.stem for path in out.iterdir()} == {*TABLES, *result_tables()}
    for name in TABLES:
        table = parquet.read_table(out / f'{name}.parquet')
        assert table.num_rows == len(getattr(recording, name))
        assert table.schema.metadata[b'mddag.tables'] == b'1'
    verdicts = parquet.read_table(out / 'verdicts.parquet')
    assert verdicts.to_pylist() == replay(DEMO).to_arrow('verdicts').to_pylist()
    executions = parquet.read_table(out / 'executions.parquet')
    assert executions.schema.field('start').metadata == {b'unit': b'ns'}
    assert executions['start'].to_pylist() == recording.executions['start'].tolist()
    keys = {vertex.name: vertex.callback.key for vertex in recording.task_set.vertices}
    assert {(row['vertex'], row['callback']) for row in executions.to_pylist()
            if row['vertex']} <= keys.items()


def test_the_name_of_a_recording_need_not_be_utf_8(tmp_path, call):
    path = os.fsdecode(os.fsencode(tmp_path) + b'/drive \xff.mcap')
    shutil.copy(DEMO, path)
    for out in ('a.pftrace', 'a.csv', 'a.parquet', 'a/'):
        assert call('export', path, '-o', f'{tmp_path}/{out}').returncode == 0
    assert parquet.read_schema(tmp_path / 'a' / 'releases.parquet').metadata[
        b'mddag.recording'].endswith(b'/drive \\udcff.mcap')


def test_a_folder_replaces_an_earlier_export_only(tmp_path, call):
    out, part, file = (tmp_path / name for name in ('tables', '.tables.part', 'file'))
    done = 0, f'exported: {out}/\n', ''
    part.mkdir()        # as a killed command leaves it
    (part / 'releases.parquet').write_bytes(b'half')
    assert call('export', DEMO, '-o', f'{out}/') == done
    whole = {path.name: path.read_bytes() for path in out.iterdir()}
    (out / 'misses.parquet').unlink()
    (out / 'releases.parquet').write_bytes(b'old')
    assert call('export', DEMO, '-o', f'{out}/') == done
    assert {path.name: path.read_bytes() for path in out.iterdir()} == whole
    (out / 'mine.txt').write_text('notes')
    file.write_text('notes')
    for folder, says in ((out, 'this folder holds other files, for instance mine.txt: name a new '
                          'folder, or remove this one\n'), (file, 'there is a file already')):
        status, _, error = call('export', DEMO, '-o', f'{folder}/')
        assert status == 2 and error.startswith(f'error: {folder}: {says}')
    assert len(os.listdir(out)) == len(whole) + 1
    assert sorted(os.listdir(tmp_path)) == ['file', 'tables']


def test_an_export_that_fails_is_one_line(tmp_path, mddag):
    """In a process of its own: pyarrow complains when its writer is collected."""
    (tmp_path / 'other.yaml').write_text(
        'mddag: 1\nnodes: [{node: /other, callbacks: [{name: t, timer: 1ms, deadline: 1ms}]}]\n')
    done = mddag('export', DEMO, 'other.yaml', '-o', 'out.parquet', '--rows', 'jobs', cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr.count('\n')) == (2, '', 1)
    assert done.stderr.startswith('error: ') and os.listdir(tmp_path) == ['other.yaml']
