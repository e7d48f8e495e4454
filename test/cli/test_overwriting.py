# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What is recorded stays: no recording is replaced unasked, and no output is left half written.

`golden/errors.txt` has what commands refuse.
"""

import json
import os
from pathlib import Path
import stat

from mddag_executor import MultiDeadlineExecutor
from mddag_executor.cli import common
from mddag_executor.errors import InputError, MddagError
from mddag_executor.output_rules import check_output
from mddag_executor.rerun import rerun
from mddag_executor.trace import TraceFile, TraceWriter
import pytest

DEMO = Path(__file__).parents[2] / 'bags' / 'demo_short.mcap'


def test_what_is_replaced(graph, call):
    simulate = ['simulate', 'graph.yaml', '--duration', '50ms', '--trace', 'run.mcap']
    Path('run.mcap').touch()    # as mktemp leaves it
    Path('result.json').write_text('{"old": true}')
    assert call(*simulate)[0] == 0
    before = Path('run.mcap').read_bytes()
    assert call(*simulate, '--policy', 'fifo', '--overwrite')[0] == 0
    assert Path('run.mcap').read_bytes() != before
    assert call('replay', 'run.mcap', '--json', 'result.json')[0] == 0
    assert 'dags' in json.loads(Path('result.json').read_text())
    assert call('replay', 'run.mcap', '--json', '/dev/null', '--junit', '/dev/null')[0] == 0


def test_a_declaration_is_replaced_only_if_that_is_asked_for(graph, call):
    edited = Path('edited.yaml')
    for verb in (f'from-trace {DEMO}', f'assign-deadlines {graph} --runs 1',
                 f'place {graph} --processes 1'):
        edited.write_text('edited')
        words = ['graph', *verb.split(), '-o', str(edited)]
        status, _, err = call(*words)
        assert status == 2 and err.startswith('error: edited.yaml: there is a file already: name')
        assert edited.read_text() == 'edited'
        done = call(*words, '--overwrite')
        assert done[0] == 0 and edited.read_text() != 'edited', done


def test_in_python_no_recording_is_replaced(graph, call, ros_context):
    assert call('simulate', graph, '--duration', '100ms', '--trace', 'run.mcap').returncode == 0
    out = Path('precious.mcap')
    out.write_text('precious')
    for make in (TraceFile, TraceWriter, lambda path: rerun('run.mcap', graph, [], output=path),
                 lambda path: rerun('run.mcap', graph, [], trace=path),
                 lambda path: MultiDeadlineExecutor(trace=path, context=ros_context)):
        with pytest.raises(MddagError, match='^precious.mcap: there is a file already: name'):
            make('precious.mcap')
        assert out.read_text() == 'precious'
    for name in ('output', 'trace'):
        with pytest.raises(MddagError, match=f'it cannot be both recording and {name}'):
            rerun('run.mcap', graph, [], overwrite=True, **{name: 'run.mcap'})
    MultiDeadlineExecutor(trace='precious.mcap', overwrite=True, context=ros_context).shutdown()
    assert out.read_bytes().startswith(b'\x89MCAP')


def test_a_recording_that_a_run_is_writing_is_not_replaced(graph, call, ros_context):
    writer = TraceWriter('live.mcap')
    writer.record('callback_end', 7, 8, 9)
    error = 'live.mcap: another run is writing this file: name another file, or end that run first'
    for verb in (f'run {graph} --synthetic sleep --duration 1s --trace',
                 f'simulate {graph} --duration 1s --trace',
                 f'import ctf {DEMO} -o'):
        status, _, err = call(*verb.split(), 'live.mcap', '--overwrite')
        assert status == 2 and err == f'error: {error}\n'
    for make in (TraceFile, TraceWriter, lambda path, **options: MultiDeadlineExecutor(
            trace=path, context=ros_context, **options)):
        with pytest.raises(MddagError, match=error):
            make('live.mcap', overwrite=True)
    path = os.path.realpath('live.mcap')
    forked = os.dup(next(int(number) for number in os.listdir('/proc/self/fd')
                         if os.path.realpath(f'/proc/self/fd/{number}') == path))
    try:    # a forked process may have it open as well
        writer.close()
        assert Path(path).read_bytes().endswith(b'\x89MCAP0\r\n')
        with TraceFile(path, overwrite=True):
            pass
    finally:
        os.close(forked)


def test_a_failed_output_leaves_what_was_there(tmp_path):
    path = tmp_path / 'out.bin'
    path.write_bytes(b'before')
    for error in (RuntimeError, KeyboardInterrupt):
        with pytest.raises(error), common.output_file(str(path)) as file:
            file.write(b'half')
            raise error
    for value in ({'a': float('nan')}, {'a': object()}):
        with pytest.raises((ValueError, TypeError)):
            common.write_json(str(path), value)
    assert path.read_bytes() == b'before' and os.listdir(tmp_path) == ['out.bin']


def test_a_killed_process_with_the_same_number_may_have_left_a_file(tmp_path):
    """Each process of a container may have the same one."""
    out, left = tmp_path / 'out.json', tmp_path / f'.out.json.{os.getpid()}-0.part'
    left.write_text('half')
    common.write_json(str(out), {})
    assert sorted(tmp_path.iterdir()) == [left, out] and left.read_text() == 'half'


def test_an_output_keeps_links_and_permissions(tmp_path):
    target, link = tmp_path / ('é' * 127), tmp_path / 'link'     # as long as a name may be
    target.write_text('before')
    target.chmod(0o640)
    link.symlink_to(target)
    common.write_text(str(link), 'after')
    assert link.is_symlink() and target.read_text() == 'after'
    assert stat.S_IMODE(target.stat().st_mode) == 0o640
    assert len(os.listdir(tmp_path)) == 2


def test_an_output_may_be_a_pipe(tmp_path):
    pipe = tmp_path / 'pipe'
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    check_output(str(pipe))
    common.write_text(str(pipe), 'through')
    assert os.read(reader, 100) == b'through'
    os.close(reader)
    assert stat.S_ISFIFO(pipe.stat().st_mode)


@pytest.mark.skipif(os.geteuid() == 0, reason='root may write everywhere')
def test_a_folder_without_write_permission(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match='cannot be written to'):
        check_output(str(tmp_path / 'new.json'))
