# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What is recorded stays: no output is an input, and no recording is replaced unasked."""

import json
import os
from pathlib import Path
import stat
import subprocess
import sys

from mddag_executor.cli import common
from mddag_executor.errors import InputError
from mddag_executor.trace import TraceError, TraceFile, TraceWriter
import pytest

GRAPH = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: t, timer: 10ms, publishes: [/a], execution_time: 2ms}
      - {name: s, subscription: /a, deadline: 5ms, execution_time: 4ms}
"""


@pytest.fixture
def run(graph, call):
    """Give a recorded run, run.mcap in the working directory."""
    assert call('simulate', graph, '--duration', '100ms', '--trace', 'run.mcap').returncode == 0
    return Path('run.mcap')


@pytest.mark.parametrize('command', [
    'export run.mcap -o run.mcap',
    'export run.mcap -o ./run.mcap',
    'export run.mcap -o link.csv',
    'replay run.mcap graph.yaml --json graph.yaml',
    'replay run.mcap --report run.html --json run.html',
    'diff run.mcap run.mcap graph.yaml --json graph.yaml',
    'graph from-caret graph.yaml --trace run.mcap -o run.mcap',
    'graph place graph.yaml --processes 2 --trace run.mcap -o run.mcap',
    'graph assign-deadlines graph.yaml -o graph.yaml',
    'simulate graph.yaml --trace graph.yaml --overwrite',
    'simulate graph.yaml --trace link.csv --json run.mcap --overwrite',
    'run graph.yaml --synthetic sleep --trace graph.yaml --overwrite',
    'rerun run.mcap graph.yaml --node a:b -o run.mcap --overwrite',
    'rerun run.mcap graph.yaml --node a:b --expect out.mcap -o out.mcap',
])
def test_an_output_is_never_an_input_or_another_output(run, call, command):
    Path('link.csv').symlink_to(run)
    before = {path.name: path.read_bytes() for path in Path().iterdir()}
    status, out, err = call(*command.split())
    assert (status, out, err.count('\n')) == (2, '', 1)
    assert 'it cannot be both' in err
    assert {path.name: path.read_bytes() for path in Path().iterdir()} == before


@pytest.mark.parametrize('command', [
    'simulate graph.yaml --duration 50ms --trace run.mcap',
    'import ctf . -o run.mcap',
    'rerun drive.mcap graph.yaml --node a:b -o run.mcap',
    'rerun drive.mcap graph.yaml --node a:b --trace run.mcap',
    'run graph.yaml --synthetic sleep --duration 100ms --trace run.mcap',
    'simulate graph.yaml --duration 50ms --trace precious.txt',
])
def test_a_recording_replaces_no_file(run, call, command):
    Path('precious.txt').write_text('precious')
    before = {path.name: path.read_bytes() for path in Path().iterdir()}
    status, out, err = call(*command.split())
    assert (status, out) == (2, '')
    name = command.split()[-1]
    assert err == (f'error: {name}: there is a file already: name another file, or replace this '
                   'one with --overwrite (in Python overwrite=True)\n')
    assert {path.name: path.read_bytes() for path in Path().iterdir()} == before


@pytest.mark.parametrize('command', [
    'graph check graph.yaml --json run.mcap',
    'evaluate graph.yaml --runs 2 --json other.dat',
    'generate -o other.dat',
    'simulate graph.yaml --report damaged.mcap.html --json damaged.mcap',
])
def test_no_other_output_replaces_a_recording(run, call, command):
    Path('other.dat').write_bytes(run.read_bytes())
    Path('damaged.mcap').write_bytes(b'\0' + run.read_bytes()[1:])
    before = {path.name: path.read_bytes() for path in Path().iterdir()}
    status, out, err = call(*command.split())
    assert (status, out) == (2, '')
    assert 'this file is a recording: name another file for the result' in err
    assert {path.name: path.read_bytes() for path in Path().iterdir()} == before


def test_overwrite_replaces_a_recording(run, call):
    before = run.read_bytes()
    command = ['simulate', 'graph.yaml', '--duration', '50ms', '--trace', run, '--overwrite']
    assert call(*command)[0] == 0
    assert run.read_bytes() != before
    assert call('replay', run)[0] == 0


def test_empty_files_and_other_results_are_replaced(run, call):
    Path('new.mcap').touch()    # as mktemp leaves it
    Path('result.json').write_text('{"old": true}')
    assert call('simulate', 'graph.yaml', '--trace', 'new.mcap')[0] == 0
    assert call('replay', 'new.mcap', '--json', 'result.json')[0] == 0
    assert 'dags' in json.loads(Path('result.json').read_text())
    assert call('replay', run, '--json', '/dev/null', '--junit', '/dev/null')[0] == 0


@pytest.mark.parametrize('there', ['run.p.mcap', 'run.q.mcap'])
def test_several_processes_replace_no_trace(folder, call, there):
    Path('two.yaml').write_text(
        GRAPH + '  - {node: /m, callbacks: [{name: t, timer: 10ms, deadline: 9ms}]}\n'
        'processes: {p: [/n], q: [/m]}\n')
    Path(there).write_text('precious')
    status, out, err = call('run', 'two.yaml', '--synthetic', 'sleep', '--duration', '10ms',
                            '--trace', 'run.mcap')
    assert (status, out) == (2, '')
    assert f'{there}: there is a file already' in err
    assert Path(there).read_text() == 'precious'


@pytest.mark.parametrize('make', [TraceFile, TraceWriter])
def test_writers_keep_what_is_there(tmp_path, make):
    path = tmp_path / 'run.mcap'
    path.write_text('precious')
    with pytest.raises(TraceError, match='run.mcap: there is a file already'):
        make(path)
    assert path.read_text() == 'precious'


def test_the_executor_keeps_what_is_there(folder):
    Path('run.mcap').write_text('precious')
    code = ('import rclpy\n'
            'from mddag_executor import MultiDeadlineExecutor\n'
            'from mddag_executor.errors import MddagError\n'
            'rclpy.init()\n'
            'try:\n'
            "    MultiDeadlineExecutor(trace='run.mcap')\n"
            'except MddagError as error:\n'
            '    print(error)\n'
            "assert open('run.mcap').read() == 'precious'\n"
            "MultiDeadlineExecutor(trace='run.mcap', overwrite=True).shutdown()\n")
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert 'run.mcap: there is a file already: name another file' in done.stdout
    assert Path('run.mcap').read_bytes().startswith(b'\x89MCAP')


def test_rerun_in_python_keeps_what_is_there(run):
    from mddag_executor.errors import MddagError
    from mddag_executor.rerun import rerun
    Path('precious.mcap').write_text('precious')
    for name in ('output', 'trace'):
        with pytest.raises(MddagError, match='precious.mcap: there is a file already'):
            rerun(run, 'graph.yaml', [], **{name: 'precious.mcap'})
        with pytest.raises(MddagError, match=f'it cannot be both recording and {name}'):
            rerun(run, 'graph.yaml', [], overwrite=True, **{name: run})
    assert Path('precious.mcap').read_text() == 'precious'


@pytest.mark.parametrize('value', [{'a': float('nan')}, {'a': object()}])
def test_what_json_lacks_leaves_no_file(tmp_path, value):
    with pytest.raises((ValueError, TypeError)):
        common.write_json(str(tmp_path / 'result.json'), value)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize('error', [RuntimeError, KeyboardInterrupt])
def test_a_failed_output_leaves_what_was_there(tmp_path, error):
    path = tmp_path / 'out.bin'
    path.write_bytes(b'before')
    with pytest.raises(error), common.output_file(str(path)) as file:
        file.write(b'half')
        raise error
    assert path.read_bytes() == b'before'
    assert os.listdir(tmp_path) == ['out.bin']


def test_an_output_keeps_links_and_permissions(tmp_path):
    target, link = tmp_path / 'target', tmp_path / 'link'
    target.write_text('before')
    target.chmod(0o640)
    link.symlink_to('target')
    common.write_text(str(link), 'after')
    assert link.is_symlink()
    assert target.read_text() == 'after'
    assert stat.S_IMODE(target.stat().st_mode) == 0o640


def test_the_name_of_an_output_may_be_as_long_as_a_name_may_be(tmp_path):
    path = tmp_path / ('é' * 127)
    common.write_text(str(path), 'x')
    assert os.listdir(tmp_path) == [path.name]


def test_an_output_may_be_a_pipe(tmp_path):
    pipe = tmp_path / 'pipe'
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        common.check_output(str(pipe))
        common.write_text(str(pipe), 'through')
        assert os.read(reader, 100) == b'through'
    finally:
        os.close(reader)
    assert stat.S_ISFIFO(pipe.stat().st_mode)


@pytest.mark.skipif(os.geteuid() == 0, reason='root may write everywhere')
def test_a_folder_without_write_permission(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match='cannot be written to'):
        common.check_output(str(tmp_path / 'new.json'))
