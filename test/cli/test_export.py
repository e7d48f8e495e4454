# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verbs `export` and `diff`, and `--report`: files, exit status, bad input in one line."""

import os
from pathlib import Path

from mddag_executor.recording.tables import TABLES
from mddag_executor.replay import open_recording
import pytest

DEMO = Path(__file__).resolve().parents[2] / 'bags' / 'demo_short.mcap'
GRAPH = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: t, timer: 10ms, publishes: [/a], execution_time: 2ms}
      - {name: s, subscription: /a, deadline: 5ms, execution_time: %s}
"""


@pytest.fixture
def graph(tmp_path):
    path = tmp_path / 'graph.yaml'
    path.write_text(GRAPH % '4ms')
    return path


@pytest.fixture
def trace(graph, tmp_path, call):
    path = tmp_path / 'run.mcap'
    call('simulate', graph, '--duration', '100ms', '--workers', 1, '--trace', path)
    return path


def test_a_report_of_each_kind(graph, trace, tmp_path, call):
    pytest.importorskip('bokeh', reason='Bokeh is not installed')
    for name, arguments in (
            ('Replay as recorded', ['replay', trace]),
            ('Replay, rescheduled', ['replay', trace, graph, '--reschedule', '--workers', 3]),
            ('Simulation', ['simulate', graph, '--duration', '50ms'])):
        out = tmp_path / 'out.html'
        status, text, err = call(*arguments, '--report', out)
        assert (status, err) == (0, '') and 'results due' in text
        page = out.read_text()
        assert f'<h1>{name}: ' in page and page.endswith('</html>\n')
        assert not list(tmp_path.glob('.*.part'))


def test_diff(graph, trace, tmp_path, call):
    quick, wide, after = (tmp_path / name for name in ('quick.yaml', 'wide.yaml', 'after.mcap'))
    quick.write_text(GRAPH % '1ms')
    wide.write_text(GRAPH.replace('5ms', '9ms') % '4ms')    # nothing is late by it
    call('simulate', quick, '--duration', '100ms', '--workers', 1, '--trace', after)
    for words, status, n_worse in (
            ((trace, after, '--fail-on-worse'), 0, '0 sinks'),
            ((after, trace, '--fail-on-worse'), 1, '1 sink'), ((after, trace), 0, '1 sink'),
            ((after, trace, wide, '--fail-on-worse'), 0, '0 sinks'),
            ((after, trace, wide, '--fail-on-worse', '--tolerance', '50%'), 1, '1 sink'),
            ((after, trace, wide, '--fail-on-worse', '--tolerance', '1.0'), 0, '0 sinks')):
        done = call('diff', *words)
        assert (done.returncode, done.stderr) == (status, '')
        assert done.stdout.endswith(f'worse in B: {n_worse}\n')
    result = call('diff', after, trace, '--json', '-').result
    sink = result['dags']['/n']['sinks']['/n:s']
    assert result['worse'] is sink['worse'] is True
    assert sink['change_ns']['median'] == 3_000_000 and sink['change']['median'] == 1.0


def test_the_tables_of_a_recording(trace, tmp_path, call):
    parquet = pytest.importorskip('pyarrow.parquet', reason='pyarrow is not installed')
    out = tmp_path / 'tables'
    assert call('export', DEMO, '-o', f'{out}/') == (0, f'exported: {out}/\n', '')
    recording = open_recording(DEMO)
    assert {path.stem for path in out.iterdir()} == set(TABLES)
    for name in TABLES:
        table = parquet.read_table(out / f'{name}.parquet')
        assert table.num_rows == len(getattr(recording, name))
        assert table.schema.metadata[b'mddag.tables'] == b'1'
    executions = parquet.read_table(out / 'executions.parquet')
    assert executions.schema.field('start').metadata == {b'unit': b'ns'}
    assert executions['start'].to_pylist() == recording.executions['start'].tolist()
    names = {vertex.name for vertex in recording.task_set.vertices}
    assert set(executions['vertex'].to_pylist()) - {None} <= names
    keys = {callback.key for callback in recording.task_set.callbacks}
    assert {row['callback'] for row in executions.to_pylist() if row['vertex']} <= keys


def test_a_folder_replaces_an_earlier_export_only(tmp_path, call):
    pytest.importorskip('pyarrow.parquet', reason='pyarrow is not installed')
    out, part = tmp_path / 'tables', tmp_path / '.tables.part'
    done = 0, f'exported: {out}/\n', ''
    part.mkdir()        # as a killed command leaves it
    (part / 'releases.parquet').write_bytes(b'half')
    assert call('export', DEMO, '-o', f'{out}/') == done
    whole = {path.name: path.read_bytes() for path in out.iterdir()}
    (out / 'misses.parquet').unlink()
    (out / 'releases.parquet').write_bytes(b'old')
    assert call('export', DEMO, '-o', f'{out}/') == done
    assert {path.name: path.read_bytes() for path in out.iterdir()} == whole
    assert os.listdir(tmp_path) == ['tables']
    (out / 'mine.txt').write_text('notes')
    assert call('export', DEMO, '-o', f'{out}/') == (
        2, '', f'error: {out}: this folder holds other files, for instance mine.txt: name a new '
        'folder, or remove this one\n')
    assert len(os.listdir(out)) == len(whole) + 1 and os.listdir(tmp_path) == ['tables']
    file = tmp_path / 'file'
    file.write_text('notes')
    status, _, error = call('export', DEMO, '-o', f'{file}/')
    assert status == 2 and error.startswith(f'error: {file}: there is a file already')


@pytest.mark.parametrize('command', [
    'export g.mcap -o out.parquet', 'export run.mcap other.yaml -o out.parquet --rows jobs'])
def test_a_parquet_export_that_fails_is_one_line(trace, tmp_path, mddag, command):
    """In a process of its own: pyarrow complains when its writer is collected."""
    pytest.importorskip('pyarrow', reason='pyarrow is not installed')
    (tmp_path / 'g.mcap').write_text('no recording')
    (tmp_path / 'other.yaml').write_text(GRAPH.replace('/n', '/other') % '1ms')
    done = mddag(*command.split(), cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, '')
    assert done.stderr.startswith('error: ') and done.stderr.count('\n') == 1
    assert not (tmp_path / 'out.parquet').exists()
