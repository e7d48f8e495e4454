# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0

import json
import os
from pathlib import Path
import shutil
import subprocess
import sys

import pytest

from . import golden

EXAMPLE = Path(__file__).resolve().parents[2] / 'examples' / 'rerun'
THIRD_PARTY = EXAMPLE.parent / 'third_party'
NODES = ('--node', 'robot:Tracker', '--node', 'robot:Brake')


@pytest.fixture(scope='module')
def drive(tmp_path_factory):
    """Return a folder with the example, and a drive of 5 s."""
    folder = tmp_path_factory.mktemp('rerun')
    for name in ('graph.yaml', 'robot.py'):
        shutil.copy(EXAMPLE / name, folder)
    (folder / 'binary').write_bytes(b'\xff')
    mddag(folder, 'simulate', 'graph.yaml', '--duration', '5s', '--trace', 'releases.mcap')
    mddag(folder, 'rerun', 'releases.mcap', 'graph.yaml', '--node', 'robot:Lidar', '-o',
          'drive.mcap')
    return folder


def mddag(folder, *args, status=0, **more):
    """Run mddag in a folder, as a user would."""
    done = subprocess.run(
        [sys.executable, '-m', 'mddag_executor', *args], cwd=folder, capture_output=True,
        text=True, check=False, timeout=120, env={**os.environ, **more})
    assert done.returncode == status, done.stderr
    return done


def digest(folder, *args, **more):
    done = mddag(folder, 'rerun', 'drive.mcap', *args, '--json', '-', **more)
    return json.loads(done.stdout)['digest']


def test_a_run_and_its_result(drive):
    done = mddag(
        drive, 'rerun', 'drive.mcap', 'graph.yaml', *NODES, '-o', 'out.mcap', '--trace',
        'run.mcap', '--json', 'result.json')
    golden.compare('rerun', done.stdout)
    result = json.loads((drive / 'result.json').read_text())
    assert result['topics'] == {'/brake': 50, '/parameter_events': 4, '/track': 50}
    assert result['messages'] == 104
    assert (result['callbacks'], result['warnings'], result['recorded']) == (100, [], [])
    assert result['dags']['brake']['sinks']['/brake:decide']['completed'] == 50
    replayed = mddag(drive, 'replay', 'run.mcap', '--json', '-')
    sinks = json.loads(replayed.stdout)['dags']['brake']['sinks']
    assert sinks['/brake:decide']['response_ns']['max'] == 9_000_000
    same = mddag(drive, 'rerun', 'drive.mcap', 'graph.yaml', *NODES, '--expect', 'out.mcap')
    assert 'the same as out.mcap' in same.stdout


def test_a_wrong_name_of_a_topic_is_guessed(drive):
    text = (drive / 'robot.py').read_text()
    (drive / 'typo.py').write_text(text.replace('/track', '/trak'))
    done = mddag(drive, 'rerun', 'drive.mcap', 'graph.yaml', '--node', 'typo:Brake', status=2)
    assert "/brake:decide (did you mean the topic '/trak'?)" in done.stderr.splitlines()[-1]


@pytest.mark.slow
def test_the_same_each_time_also_next_to_busy_processes(drive):
    """Also where seven workers are too few, and with other hashes of strings."""
    text = (drive / 'graph.yaml').read_text()
    (drive / 'overload.yaml').write_text(
        text.replace('execution_time: 8ms', 'execution_time: 130ms'))
    busy = [subprocess.Popen([sys.executable, '-c', 'while True: pass']) for _ in range(2)]
    try:
        found = {
            digest(drive, 'overload.yaml', *NODES, '--workers', '7', PYTHONHASHSEED=str(i))
            for i in range(2)}
    finally:
        for each in busy:
            each.kill()
            each.wait()
    found.add(digest(drive, 'overload.yaml', *NODES, '--workers', '7'))
    assert len(found) == 1
    assert found != {digest(drive, 'graph.yaml', *NODES)}


def test_differences_end_with_status_1(drive, tmp_path):
    for name in ('graph.yaml', 'robot.py', 'drive.mcap'):
        shutil.copy(drive / name, tmp_path)
    mddag(tmp_path, 'rerun', 'drive.mcap', 'graph.yaml', *NODES, '-o', 'before.mcap')
    text = (tmp_path / 'robot.py').read_text()
    (tmp_path / 'robot.py').write_text(text.replace('GAIN = 0.3', 'GAIN = 0.3001'))
    expect = ('rerun', 'drive.mcap', 'graph.yaml', *NODES, '--expect', 'before.mcap')
    done = mddag(tmp_path, *expect, status=1)
    assert done.stdout.splitlines()[-1].startswith(
        '/track: content, first in message 1 at 0.110000 s: data is ')
    done = mddag(tmp_path, *expect, '--json', '-', status=1)
    difference, = json.loads(done.stdout)['differences']
    assert (difference['topic'], difference['field'], difference['number']) == (
        '/track', 'data', 1)
    mddag(tmp_path, *expect, '--tolerance', '1%')


def test_unmodified_programs(drive, tmp_path):
    """A talker, and a listener with an executor of its own, started as ros2 run does."""
    graph = str(THIRD_PARTY / 'graph.yaml')
    prefix = str(THIRD_PARTY / 'install')
    args = ('rerun', str(drive / 'drive.mcap'), graph, '--node', 'their_robot/talker.py',
            '--node', 'their_robot/listener.py')
    first = mddag(tmp_path, *args, '-o', 'chatter.mcap', AMENT_PREFIX_PATH=prefix)
    assert 'heard 49 messages' in first.stdout
    again = mddag(tmp_path, *args, '--expect', 'chatter.mcap', AMENT_PREFIX_PATH=prefix)
    assert 'the same as chatter.mcap' in again.stdout
    # Of the listener alone: what the talker said is in the bag.
    alone = mddag(tmp_path, 'rerun', 'chatter.mcap', graph, '--node', 'their_robot/listener.py',
                  AMENT_PREFIX_PATH=prefix)
    assert 'heard 49 messages' in alone.stdout


HASHES = """\
import rclpy
from std_msgs.msg import Float64, String


def make():
    node = rclpy.create_node('tracker')
    node.create_subscription(Float64, '/distance', lambda message: None, 10)
    node.create_publisher(String, '/hash', 10).publish(String(data=str(hash('tracker'))))
    return node
"""
MADE = ('rerun', 'drive.mcap', 'graph.yaml', '--node', 'hashes:make', '--json', '-')


@pytest.fixture
def hashes(drive, monkeypatch):
    monkeypatch.delenv('PYTHONHASHSEED', raising=False)
    (drive / 'hashes.py').write_text(HASHES)
    return drive


def test_hashes_are_fixed_however_the_program_is_installed(hashes):
    """`ros2 run` starts PREFIX/lib/PACKAGE/mddag, which colcon has put there."""
    script = hashes / 'lib' / 'mddag_executor' / 'mddag'
    script.parent.mkdir(parents=True)
    script.write_text('import sys\nfrom mddag_executor.cli.main import main\nsys.exit(main())\n')
    digests = set()
    for command in ([str(script)], [str(script)], ['-m', 'mddag_executor']):
        done = subprocess.run(
            [sys.executable, *command, *MADE], cwd=hashes, capture_output=True, text=True,
            check=True, timeout=120, env={**os.environ, 'PYTHONPATH': os.getcwd()})
        digests.add(json.loads(done.stdout)['digest'])
        assert not done.stderr
    assert len(digests) == 1


@pytest.mark.parametrize('options', [
    ['-E', '-m', 'mddag_executor'],
    ['-c', 'import sys; from mddag_executor.cli.main import main; sys.exit(main())']])
def test_where_hashes_cannot_be_fixed_that_is_said(hashes, options):
    done = subprocess.run(
        [sys.executable, *options, *MADE], cwd=hashes, capture_output=True, text=True,
        check=True, timeout=120)
    assert done.stderr.startswith('warning: hashes of strings are not the same in each run: ')
    assert done.stderr.count('\n') == 1


@pytest.mark.parametrize(('args', 'message'), [
    (('none.mcap', 'graph.yaml', *NODES), 'none.mcap: '),
    (('drive.mcap', 'graph.yaml'), 'the following arguments are required: --node'),
    (('drive.mcap', 'graph.yaml', '--node', 'robot:Breake'), "did you mean 'Brake'"),
    (('drive.mcap', 'graph.yaml', *NODES, '--times', 'recorded'),
     '--times recorded: drive.mcap is a bag'),
    (('drive.mcap', 'graph.yaml', *NODES, '--times', 'binary'), 'binary: not usable JSON'),
    (('drive.mcap', 'graph.yaml', '--node', 'robot:Brake'),
     '/track, which /brake:decide needs, is not recorded'),
    (('releases.mcap', 'graph.yaml', '--node', 'robot:Tracker'),
     '/distance, which /tracker:track needs, is not recorded'),
])
def test_bad_input_is_one_line(drive, args, message):
    before = sorted(path.name for path in drive.iterdir())
    done = mddag(drive, 'rerun', *args, status=2)
    errors = [line for line in done.stderr.splitlines() if line.startswith('error: ')]
    assert len(errors) == 1 and message in errors[0], done.stderr
    assert 'Traceback' not in done.stderr
    assert sorted(path.name for path in drive.iterdir() if path.name != '__pycache__') == [
        name for name in before if name != '__pycache__']
