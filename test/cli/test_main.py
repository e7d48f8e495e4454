# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The program as a whole: verbs, exit status, one line of error, text for people, `ros2 mddag`."""

import argparse
from asyncio import CancelledError
from importlib.metadata import distribution
from importlib.util import find_spec
import io
import json
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import time
from types import ModuleType

from hypothesis import given, strategies
from mddag_executor import __version__
from mddag_executor.cli import main as program
from mddag_executor.cli.text import format_ns, one_line, printable, Progress, set_quiet
from mddag_executor.errors import InputError, MddagError
from msg_graph import errors
import pytest

AUTOWARE = Path(__file__).resolve().parents[2] / 'config' / 'autoware.yaml'
GRAPH = """
mddag: 1
nodes:
  - {node: /n, callbacks: [{name: tick, timer: 10ms, deadline: 10ms, execution_time: 1ms}]}
"""


@pytest.fixture
def verb(monkeypatch):
    """Give a function that makes `mddag probe [--number N] [FILE …]` do what a callable does."""
    def install(action):
        def add_arguments(parser):
            parser.add_argument('files', nargs='*')
            parser.add_argument('--number', type=int)

        module = ModuleType('probe')
        module.__dict__.update(EXAMPLE='mddag probe graph.yaml', add_arguments=add_arguments,
                               main=action)
        monkeypatch.setattr(program, 'VERBS', {'probe': 'try things'})
        monkeypatch.setattr(program, 'load', lambda _: module)
    return install


def fail_with(error):
    def action(_):
        raise error
    return action


@pytest.mark.parametrize(('error', 'line'), [
    (InputError('a.yaml', 'no source', 'add a timer', line=3), 'a.yaml:3: no source: add a timer'),
    (MddagError('a\n  b\tc\x1b[31m\u202e'), 'a b c\\x1b[31m\\u202e'),
    (PermissionError(13, 'Permission denied', 'a', None, 'b'),
     'b: permission denied: change its permissions or name another file'),
    (FileNotFoundError(2, 'No such file or directory'),
     'working directory: no such file or directory: check the path'),
    (OSError(24, 'Too many open files'),
     "this process: too many open files: allow more with 'ulimit -n'"),
    (OSError(5, 'Input/output error', 'out.json'),
     'out.json: input/output error: check the path and the disk'),
])
def test_bad_input_is_one_line(verb, capsys, error, line):
    verb(fail_with(error))
    assert program.main(['probe']) == 2
    assert capsys.readouterr() == ('', f'error: {line}\n')


@pytest.mark.parametrize('error', [
    ZeroDivisionError('a defect'), OSError('a defect'), CancelledError('a defect'),
    ModuleNotFoundError('a defect', name='somebodys_module')])
def test_a_defect_keeps_its_traceback(verb, capsys, error):
    verb(fail_with(error))
    assert program.main(['probe']) == 70
    err = capsys.readouterr().err
    assert 'Traceback' in err and 'in action' in err and 'a defect' in err


def test_an_interrupt_is_quiet(verb, capsys):
    verb(fail_with(KeyboardInterrupt()))
    assert program.main(['probe']) == 130 and capsys.readouterr() == ('', '')


INTERRUPTED = """
import runpy, sys

class Finder:
    def find_spec(self, name, *more):
        if name == 'mddag_executor.errors':
            raise KeyboardInterrupt

sys.meta_path.insert(0, Finder())
runpy.run_module('mddag_executor', run_name='__main__')
"""


def test_an_interrupt_while_it_is_imported_is_quiet():
    done = subprocess.run([sys.executable, '-c', INTERRUPTED], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, '', '')


def test_the_command_line_itself_imports_no_ros():
    code = ('import mddag_executor.cli.main, sys\n'
            'assert not {"rclpy", "numpy", "asyncio"} & {*sys.modules}')
    subprocess.run([sys.executable, '-c', code], check=True)


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_no_incomplete_file(folder, number):
    (folder / 'g.yaml').write_text(GRAPH)
    with subprocess.Popen(
            [sys.executable, '-m', 'mddag_executor', 'simulate', 'g.yaml', '--duration', '1000s',
             '--trace', 'run.mcap'], stderr=subprocess.PIPE) as process:
        try:
            while not list(folder.glob('.run.mcap.*.part')):
                assert process.poll() is None
                time.sleep(0.01)
            process.send_signal(number)
            process.send_signal(number)     # as `timeout` does: to the process, and to its group
            err = process.communicate(timeout=60)[1]
        finally:
            process.kill()
    assert (process.returncode, err) == (128 + number, b'')
    assert os.listdir(folder) == ['g.yaml']


@pytest.mark.parametrize('words', [
    'a b --number 3 c', '--number 3 a b c', 'a --number=3 b c', 'a b c --number 3',
    '--number 3 -- a b c'])
def test_options_and_files_come_in_any_order(verb, words):
    found = []
    verb(lambda args: found.append(args) or 0)
    assert program.main(['probe', *words.split()]) == 0
    assert (found[0].files, found[0].number) == (['a', 'b', 'c'], 3)


def printed(capsys, *words):
    with pytest.raises(SystemExit) as stop:
        program.main(words)
    assert stop.value.code == 0
    return capsys.readouterr().out


def test_the_help_of_each_verb(capsys):
    for verb in program.VERBS:
        text = printed(capsys, *verb.split(), '--help')
        assert f'\nexample:\n  mddag {verb}' in text
        assert not re.search(r' $|^ +exit status', text, re.M)
    for family in ('', 'graph'):
        found = re.findall(r'^  ([a-z-]+(?: [a-z-]+)?)  ', printed(
            capsys, *family.split(), '--help'), re.M)
        assert set(found) == {verb for verb in program.VERBS if verb.startswith(family)}
    assert printed(capsys, '--version') == f'mddag {__version__}\n'


def test_completion(tmp_path):
    """As a shell asks for it; see register-python-argcomplete."""
    pytest.importorskip('argcomplete')

    def completed(line):
        out = tmp_path / 'out'
        out.touch()
        subprocess.run(
            [sys.executable, '-m', 'mddag_executor'], check=True, env={
                **os.environ, '_ARGCOMPLETE': '1', '_ARGCOMPLETE_IFS': ' ', 'COMP_LINE': line,
                'COMP_POINT': str(len(line)), '_ARGCOMPLETE_STDOUT_FILENAME': str(out)})
        return set(out.read_text().split())

    assert completed('mddag expl') == {'explain'}
    assert completed('mddag graph from-') == {'from-trace', 'from-caret'}
    assert completed('mddag graph place g.yaml --pro') == {'--processes'}


def program_with(words, **streams):
    """Run the program; return its status, and what it says but warnings."""
    done = subprocess.run(
        f'{sys.executable} -m mddag_executor {words}', shell=True, text=True, check=False,
        **{'stderr': subprocess.PIPE, **streams}, env={
            name: value for name, value in os.environ.items() if name != 'PYTHONUNBUFFERED'})
    said = (done.stderr or '').splitlines(keepends=True)
    return done.returncode, ''.join(line for line in said if not line.startswith('warning: '))


@pytest.mark.parametrize('words', [f'graph check {AUTOWARE}', 'graph schema'])
def test_a_reader_that_goes_away_is_no_error(words):
    """Of less and of more than a buffer."""
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, 'w') as gone:
        assert program_with(words, stdout=gone) == (141, '')


@pytest.mark.skipif(not Path('/dev/full').exists(), reason='this system has no /dev/full')
@pytest.mark.parametrize(('how', 'place'), [
    ('--json /dev/full', '/dev/full'), ('> /dev/full', 'standard output')])
def test_a_full_disk_is_one_line(how, place):
    assert program_with(f'graph check {AUTOWARE} {how}', stdout=subprocess.DEVNULL) == (
        2, f'error: {place}: no space left on device: free space, or name another file\n')


@pytest.mark.skipif(not Path('/dev/full').exists(), reason='this system has no /dev/full')
def test_a_result_that_cannot_be_written_is_still_shown(call):
    done = call('graph', 'check', AUTOWARE, '--json', '/dev/full')
    assert done.returncode == 2 and done.stderr.endswith(
        'error: /dev/full: no space left on device: free space, or name another file\n')
    assert done.stdout == call('graph', 'check', AUTOWARE).stdout


@pytest.mark.parametrize('closed', ['<&- >&-', '2>&-', '<&- >&- 2>&-'])
def test_closed_streams(folder, closed):
    """Nothing is printed, also not into files that are written."""
    (folder / 'g.yaml').write_text(GRAPH)
    for words in ('simulate g.yaml --trace run.mcap', 'replay run.mcap --json out.json'):
        assert program_with(f'{words} {closed}', stderr=None) == (0, '')
    assert json.loads((folder / 'out.json').read_text())['deadline_missed'] is False


@given(strategies.integers(-10**15, 10**15))
def test_times_are_right_to_four_digits(ns):
    number, unit = format_ns(ns).split()
    value = float(number) * {'ns': 1, 'us': 1e3, 'ms': 1e6, 's': 1e9}[unit]
    assert value == pytest.approx(ns, rel=5.01e-4)
    assert abs(float(number)) < 1000 or unit == 's'
    assert [format_ns(ns) for ns in (0, 1_000, 12_345, 999_960, 30_500_000, 10**8)] == [
        '0 ns', '1 us', '12.35 us', '1.000 ms', '30.5 ms', '100 ms']


@given(strategies.text())
def test_no_control_character_reaches_the_terminal(text):
    assert printable(text).isprintable() and one_line(text).isprintable()
    assert printable(text) == text or not text.isprintable()


def test_both_packages_make_names_harmless_alike():
    every = ''.join(map(chr, range(0x11000))) + '\U000e0001\U0010ffff'
    assert printable(every) == errors.printable(every)


def test_progress_waits_two_seconds():
    set_quiet(False)  # as a command that ran before may have left it
    stream, now = io.StringIO(), [100.0]
    stream.isatty = lambda: True
    with Progress('simulating', 10, stream=stream, clock=lambda: now[0]) as progress:
        now[0] += 1.9
        progress.update(3)
        assert stream.getvalue() == ''
        now[0] += 0.2
        progress.update(4, 'run\x1b 4')
        assert stream.getvalue() == '\rsimulating: 40 % run\\x1b 4'
        progress.update(5)
        assert '50 %' not in stream.getvalue(), 'more often than five times a second'
        now[0] += 0.2
        progress.update(20)
        assert '100 %' in stream.getvalue()
    assert stream.getvalue().endswith('\r'), 'the line is wiped'


@pytest.fixture
def ros2(monkeypatch):
    """Give what ros2cli does with a command line, in short: parse it, call the command's main."""
    if find_spec('ros2cli') is None:
        command_module = ModuleType('ros2cli.command')
        command_module.CommandExtension = object
        monkeypatch.setitem(sys.modules, 'ros2cli', ModuleType('ros2cli'))
        monkeypatch.setitem(sys.modules, 'ros2cli.command', command_module)
        monkeypatch.delitem(sys.modules, 'mddag_executor.cli.ros2', raising=False)
    entry, = distribution('mddag_executor').entry_points.select(group='ros2cli.command')
    extension = entry.load()()

    def main(*arguments):
        parser = argparse.ArgumentParser('ros2')
        extension.add_arguments(
            parser.add_subparsers().add_parser(entry.name), 'ros2 mddag')
        return extension.main(parser=parser, args=parser.parse_args(['mddag', *arguments]))
    return main


def test_it_is_the_same_program(ros2, graph, capsys, monkeypatch):
    assert ros2('graph', 'check', str(graph)) == 0
    assert 'deadline' in capsys.readouterr().out
    assert ros2('simulate', '--duration', '100ms', '--', str(graph)) == 0
    for words, place in (('graph', 'check', 'none.yaml'), 'none.yaml'), ((), 'mddag'):
        assert ros2(*words) == 2
        assert capsys.readouterr().err.startswith(f'error: {place}: ')
    asked = []
    monkeypatch.setattr('mddag_executor.cli.completion.complete', lambda: asked.append(
        (os.environ['COMP_LINE'], os.environ['COMP_POINT'])))
    for name, value in (('_ARGCOMPLETE', '1'), ('COMP_LINE', 'ros2 mddag expl'),
                        ('COMP_POINT', '15')):
        monkeypatch.setenv(name, value)
    ros2('graph')
    assert asked[0] == ('mddag expl', '10')
